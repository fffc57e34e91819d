"""The notebooks run from top to bottom; all but one are stored without outputs.

Sizes stand in the cell tagged `parameters`; after it the small ones below take their place.
"""

import ast
import json
from pathlib import Path

import matplotlib as mpl
import pytest

import mjx_drax

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))

_SMALL_VIDEO = {"size": (128, 96), "fps": 5}
SMALL = {
    "quickstart": {"CHAINS": 4, "VIDEO": _SMALL_VIDEO},
    "your_robot": {"CHAINS": 4, "VIDEO": _SMALL_VIDEO},
    "diagnostics": {"CHAINS": 4, "TRAPPED": 8},
    "thousands": {"CHAINS": 32, "TRAPPED": 8, "PROBLEMS": 2, "STATES": 16},
}


def code(path):
    return [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]


SHOWN = "paper_in_ten_minutes"
"""Stored with outputs, for readers of a forge."""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_stored(path):
    assert code(path)
    if path.stem == SHOWN:
        assert all(cell["outputs"] for cell in code(path)[1:])
        assert path.stat().st_size < 200_000
        return
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code(path))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_first_cell_installs_what_is_missing(path):
    assert "@ git+" in "".join(code(path)[0]["source"])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_import_finds_its_names(path):
    """Quickly, what running every cell finds out slowly."""
    source = "\n".join("".join(cell["source"]) for cell in code(path)[1:])
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom | ast.Import):
            exec(compile(ast.Module([node], []), str(path), "exec"), {})
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "mjx_drax":
            assert hasattr(mjx_drax, node.attr), node.attr


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs(path, tmp_path, monkeypatch):
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    names, small = {"__name__": "__main__"}, dict(SMALL.get(path.stem, {}))
    for cell in code(path):
        exec(compile("".join(cell["source"]), str(path), "exec"), names)
        if "parameters" in cell["metadata"].get("tags", []):
            assert set(small) <= set(names), "sizes that the notebook does not have"
            names.update(small)
            small = {}
    assert not small, "the notebook has no cell tagged `parameters`"
