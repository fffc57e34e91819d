"""One file a task, each readable as an example.

A task module has `make(horizon)`, which returns a Problem, and may have `CHAINS` (a number of
chains that suits a CPU) and `draw(axes, states)`, which draws its surroundings and a motion on
matplotlib axes where there is no model to render. All are solved with the default settings.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from types import ModuleType

from mjx_drax.errors import DraxError


def names() -> list[str]:
    """Names of all tasks."""
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem != "__init__")


def summary(name: str) -> str:
    """First line of a task's docstring, read without importing it."""
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0]


def load(name: str) -> ModuleType:
    """The module of a task.

    Raises:
        DraxError: there is no such task; lists those there are.
    """
    if name not in names():
        raise DraxError(f"there is no task {name!r}: choose one of {', '.join(names())}.")
    return import_module(f"{__name__}.{name}")
