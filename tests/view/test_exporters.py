"""The exporters of the library, by their names."""

import pytest

from mjx_drax import DraxError
from mjx_drax.solution.export import exporters
from mjx_drax.tasks import load
from mjx_drax.view.exporters import Csv, Dataset, Html, Keyframes

ALL = {"html": Html, "csv": Csv, "keyframes": Keyframes, "dataset": Dataset}


@pytest.mark.parametrize("name", ALL)
def test_every_exporter_writes_its_file(slider, name, tmp_path):
    if name == "html":
        pytest.importorskip("viser")
    each = exporters()[name]
    assert type(each) is ALL[name]
    assert each.summary
    each.check(slider.problem)
    each.write(slider, tmp_path / each.file)
    assert (tmp_path / each.file).stat().st_size > 1000


def test_what_cannot_be_written_is_refused_before_a_solve(slider, without):
    trap = load("bug_trap").make()
    Csv().check(trap)
    for each in (Html(), Keyframes()):
        with pytest.raises(DraxError, match="bug_trap has no MuJoCo model"):
            each.check(trap)
    without("h5py")
    with pytest.raises(DraxError, match="a dataset needs h5py"):
        Dataset().check(slider.problem)
