"""The notebooks run from top to bottom, and are stored without outputs."""

import json
from pathlib import Path

import matplotlib as mpl
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def code(path):
    return [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_stored(path):
    assert code(path)
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code(path))


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs(path):
    mpl.use("Agg")
    names = {"__name__": "__main__"}
    for cell in code(path):
        exec(compile("".join(cell["source"]), str(path), "exec"), names)
