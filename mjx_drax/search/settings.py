"""The settings of a solver as plain data, and changed by name.

Solvers, schedules, metrics and bounds are frozen dataclasses; a setting is named by its path
through their fields, as in `attempts` or `flow.noise.start`.
"""

from __future__ import annotations

import ast
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.method.bounds import LogBarrier, Projection, Reflection
from mjx_drax.method.langevin import Langevin, Scale
from mjx_drax.method.metrics import Diagonal, GaussNewton, Identity
from mjx_drax.method.quasi_newton import LBFGS
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.problem.differentiators import Autodiff, Smoothed
from mjx_drax.search.restarts import Restarts

Solver = TypeVar("Solver", Langevin, Restarts, Langevin | Restarts)

PARTS: dict[str, type[Any]] = {
    part.__name__: part
    for part in (
        Restarts,
        Langevin,
        Scale,
        Geometric,
        Constant,
        GaussNewton,
        Diagonal,
        Identity,
        LBFGS,
        LogBarrier,
        Reflection,
        Projection,
        Autodiff,
        Smoothed,
    )
}
"""What settings are made of, by name."""

_ALTERNATIVES = (
    {"GaussNewton", "Diagonal", "Identity", "LBFGS"},
    {"LogBarrier", "Reflection", "Projection"},
    {"Autodiff", "Smoothed"},
)
"""Parts that can take each other's place."""


def to_data(value: Any) -> Any:
    """Settings as dictionaries, lists and numbers, which JSON holds; `part` names the class.

    What is no part of this package is kept as its text.
    """
    if type(value) in PARTS.values():
        inner = {f.name: to_data(getattr(value, f.name)) for f in fields(value)}
        return {"part": type(value).__name__, **inner}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple | list):
        return [to_data(item) for item in value]
    if hasattr(value, "dtype") and hasattr(value, "tolist"):
        return value.tolist()
    return repr(value)


def from_data(data: Any) -> Any:
    """The settings that `to_data` gave.

    Raises:
        DraxError: a part or one of its settings that this version does not know.
    """
    if isinstance(data, list):
        return tuple(from_data(item) for item in data)
    if not isinstance(data, dict):
        return data
    try:
        part = PARTS[data["part"]]
        return part(**{name: from_data(value) for name, value in data.items() if name != "part"})
    except (KeyError, TypeError) as error:
        raise DraxError(
            f"settings {shown(data)} cannot be read: {error}. Another version of mjx_drax wrote "
            "them: use that one, or solve again."
        ) from error


def names(solver: Any, prefix: str = "") -> list[str]:
    """Names of all settings that are numbers or can be exchanged, in order."""
    found = []
    for field in fields(solver):
        value, name = getattr(solver, field.name), prefix + field.name
        if isinstance(value, tuple) or field.name in ("scale", "flow"):
            found += names(value, f"{name}.") if is_dataclass(value) else []
            continue
        found.append(name)
        if is_dataclass(value):
            found += names(value, f"{name}.")
    return found


def changed(solver: Solver, name: str, text: str) -> Solver:
    """The solver with one setting changed.

    Args:
        solver: whose settings.
        name: path of the setting, one of `names(solver)`.
        text: the value: a number, True, False or None; for a schedule a number or
            Geometric(start, end, final); for other parts the name of one, such as Identity.

    Raises:
        DraxError: no such setting, or a value of the wrong type; says which there are.
    """
    if name not in names(solver):
        raise DraxError(f"there is no setting {name!r}: choose one of {', '.join(names(solver))}.")
    return _changed(solver, name.split("."), name, text)


def _changed(part: Any, path: list[str], name: str, text: str) -> Any:
    old = getattr(part, path[0])
    inner = _changed(old, path[1:], name, text) if len(path) > 1 else _value(old, name, text)
    new = {path[0]: inner}
    if isinstance(part, Geometric) and path[0] == "end" and part.final == part.end:
        new["final"] = inner  # it was not given, and follows
    return replace(part, **new)


def _value(old: Any, name: str, text: str) -> Any:
    """The text as a value of the same type as the old one."""
    if isinstance(old, Geometric | Constant):
        return _schedule(name, text)
    kind = type(old).__name__
    for parts in _ALTERNATIVES:
        if kind in parts or (name.endswith("derivatives") and "Autodiff" in parts):
            if text.removesuffix("()") not in parts:
                raise DraxError(f"{name} is {text!r}: give one of {', '.join(sorted(parts))}.")
            return PARTS[text.removesuffix("()")]()
    value = _literal(text)
    if isinstance(old, bool):
        fits, wanted = isinstance(value, bool), "True or False"
    elif isinstance(old, int) or name.endswith("descent"):
        optional = name.endswith("descent")
        fits = type(value) is int or (optional and value is None)
        wanted = "a whole number" + (" or None" if optional else "")
    else:
        fits, wanted = type(value) in (int, float) and np.isfinite(value), "a number"
        value = float(value) if fits else value
    if not fits:
        raise DraxError(f"{name} is {text!r}: give {wanted}; it was {old!r}.")
    return value


def _schedule(name: str, text: str) -> Geometric | Constant:
    """A number that stays, or Geometric(start, end) or (start, end, final)."""
    numbers = _literal(text.strip().removeprefix("Geometric").removeprefix("Constant"))
    numbers = numbers if isinstance(numbers, tuple) else (numbers,)
    if not all(type(n) in (int, float) and np.isfinite(n) for n in numbers) or len(numbers) > 3:
        raise DraxError(
            f"{name} is {text!r}: give a number, Geometric(start, end) or "
            f"Geometric(start, end, final)."
        )
    return Constant(float(numbers[0])) if len(numbers) == 1 else Geometric(*map(float, numbers))


def _literal(text: str) -> Any:
    """The Python literal that the text is, else the text."""
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError):
        return text
