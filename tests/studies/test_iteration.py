"""The study of the parts of an iteration."""

import pytest

from mjx_drax.studies import iteration


@pytest.mark.slow
def test_a_row_has_a_positive_time_for_every_part(capsys):
    iteration.main(["cartpole_swingup:2", "--horizon", "1", "--repeats", "1"])
    row = capsys.readouterr().out.splitlines()[-1].strip("|").split("|")
    assert row[0].strip() == "cartpole_swingup"
    assert row[1].strip() == "50"
    assert len(row) == 10
    assert all(float(entry) > 0 for entry in row[3:9])
