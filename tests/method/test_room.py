"""The rule of the room: equations only, in few short files that can be read beside the paper."""

import ast
from pathlib import Path

import pytest

import mjx_drax

FILES = [
    path
    for path in sorted((Path(mjx_drax.__file__).parent / "method").glob("*.py"))
    if path.name != "__init__.py"
]
FORBIDDEN = {
    "kinked": "whether f has kinks is the business of the search",
    "jit": "the search compiles",
    "device_put": "the search chooses devices",
    "devices": "the search chooses devices",
}


def test_the_room_is_small():
    assert len(FILES) <= 8


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_holds_equations_only(path):
    text = path.read_text(encoding="utf-8")
    lines = text.count("\n")
    assert lines <= 250
    for node in ast.walk(ast.parse(text)):
        assert not isinstance(node, ast.Raise), f"line {node.lineno}: checks stand at the doors"
        for name in {getattr(node, field, None) for field in ("id", "attr", "arg", "name")}:
            assert name not in FORBIDDEN, f"line {node.lineno}: {FORBIDDEN[name]}"
