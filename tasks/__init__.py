"""One file a task, each readable as an example.

A task module has `make(horizon)`, which returns a Problem, and may have `CHAINS` (a number of
chains that suits a CPU) and `draw(axes, states)`, which draws its surroundings and a motion on
matplotlib axes where there is no model to render. All are solved with the default settings.
"""

from __future__ import annotations

import ast
import difflib
from importlib import import_module
from pathlib import Path
from types import ModuleType

from mjx_drax.base.errors import DraxError


def names() -> list[str]:
    """Names of all tasks."""
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem != "__init__")


def summary(name: str) -> str:
    """First line of a task's docstring, read without importing it."""
    source = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0]


def full_name(name: str) -> str:
    """The name of a task, of which the beginning is enough if no other task has it.

    Raises:
        DraxError: there is no such task; lists those there are.
    """
    matching = [task for task in names() if task.startswith(str(name))]
    if name in matching:
        matching = [name]
    if len(matching) != 1:
        what = f"several tasks begin with {name!r}" if matching else f"there is no task {name!r}"
        near = [] if matching else difflib.get_close_matches(str(name), names(), 1)
        choice = f"{near[0]}, or another of" if near else "one of"
        raise DraxError(f"{what}: choose {choice} {', '.join(matching or names())}.")
    return matching[0]


def load(name: str) -> ModuleType:
    """The module of a task, by its name or by a beginning that no other task has.

    Raises:
        DraxError: there is no such task; lists those there are.
    """
    return import_module(f"{__name__}.{full_name(name)}")
