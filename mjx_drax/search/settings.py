"""The settings of a solver as plain data, and changed by name.

Solvers, schedules, metrics and bounds are frozen dataclasses; a setting is named by its path
through their fields, as in `attempts` or `flow.noise.start`. Classes of users take part like ours:
they are named by MODULE:CLASS.
"""

from __future__ import annotations

import ast
import sys
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from operator import attrgetter
from typing import Any

import numpy as np

from mjx_drax.base.errors import DraxError, reason, shown
from mjx_drax.base.imports import imported
from mjx_drax.base.pytrees import REGISTERED
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.search.restarts import Restarts

_ROLES = {
    "direction": "a metric",
    "confine": "a handling of bounds",
    "jacobian": "a way to differentiate",
    "__call__": "a schedule",
    "rounds": "a setting of rollouts",
    "tolerance": "a setting of the polish",
}
"""What a part of a solver is, by an attribute that it has; parts of one role are exchangeable."""


def to_data(value: Any) -> Any:
    """Settings as dictionaries, lists and numbers, which JSON holds; `part` names the class.

    What is no dataclass is kept as its text, and cannot be read again.
    """
    if is_dataclass(value) and not isinstance(value, type):
        inner = {f.name: to_data(getattr(value, f.name)) for f in fields(value)}
        return {"part": _name_of(type(value)), **inner}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple | list):
        return [to_data(item) for item in value]
    if hasattr(value, "dtype") and hasattr(value, "tolist"):
        return value.tolist()
    return {"text": repr(value)}


def from_data(data: Any) -> Any:
    """The settings that `to_data` gave. Modules of users are not imported, but must be.

    Raises:
        DraxError: a part or one of its settings that is not known here.
    """
    if isinstance(data, list):
        return tuple(from_data(item) for item in data)
    if not isinstance(data, dict):
        return data
    if "text" in data:
        raise DraxError(
            f"settings hold {data['text']}, which was no dataclass when they were saved: solve "
            "again with one."
        )
    try:
        name = data["part"]
        part = _class_named(name, imports=False)
        return part(**{name: from_data(value) for name, value in data.items() if name != "part"})
    except (KeyError, TypeError, AttributeError) as error:
        raise DraxError(
            f"settings {shown(data)} cannot be read: {reason(error)}. Another version of mjx_drax "
            "wrote them: use that one, or solve again."
        ) from error


def _name_of(cls: type) -> str:
    """How data name a class: ours by its name, others by MODULE:CLASS."""
    if cls.__module__.startswith("mjx_drax."):
        return cls.__name__
    return f"{cls.__module__}:{cls.__qualname__}"


def _class_named(name: Any, imports: bool) -> Any:
    """The class of that name.

    Raises:
        DraxError: its module cannot be imported, or is not while it may not be.
        AttributeError, TypeError: there is none, or the name is no text.
    """
    if not isinstance(name, str):
        raise TypeError(f"{shown(name)} is no name of a class")
    module, _, cls = name.rpartition(":")
    if not module:  # a public name, wherever it lies: files hold names that outlive a move
        found = getattr(import_module("mjx_drax"), cls)
    elif imports:
        found = imported(name)
    elif module in sys.modules:
        found = attrgetter(cls)(sys.modules[module])
    else:
        raise DraxError(
            f"settings hold a {cls} of the module {module}: import {module} before you load them."
        )
    if not (isinstance(found, type) and is_dataclass(found)):
        raise TypeError(f"{name} is no class of settings")
    return found


def names(solver: Any, prefix: str = "") -> list[str]:
    """Names of all settings that are numbers or can be exchanged, in order."""
    found = []
    for field in fields(solver):
        value, name = getattr(solver, field.name), prefix + field.name
        if field.name not in ("scale", "flow"):
            found.append(name)
        if is_dataclass(value) and field.name != "scale":
            found += names(value, f"{name}.")
    return found


def changed(solver: Restarts, name: str, text: str) -> Restarts:
    """The solver with one setting changed.

    Args:
        solver: whose settings.
        name: path of the setting, one of `names(solver)`.
        text: the value: a number, True, False or None; for a schedule a number or
            Geometric(start, end, final); for other parts the name of one, such as Identity or
            Smoothed(radius=0.1), or MODULE:CLASS for one of your own.

    Raises:
        DraxError: no such setting, or a value of the wrong type; says which there are.
    """
    known = names(solver)
    part, _, inside = name.partition(".")
    if name not in known and part in ("polish", "rollouts"):
        raise DraxError(
            f"there is no setting {name!r}, as {part} is {shown(getattr(solver, part))}: give all "
            f"of it, as in {part}={part.title()}({inside}={text})."
        )
    if name not in known:
        raise DraxError(f"there is no setting {name!r}: choose one of {', '.join(known)}.")
    out: Restarts = _changed(solver, name.split("."), name, text)
    return out


def _changed(part: Any, path: list[str], name: str, text: str) -> Any:
    old = getattr(part, path[0])
    annotation: Any = next(field.type for field in fields(part) if field.name == path[0])
    kind = getattr(annotation, "__name__", str(annotation))  # a text, or a class
    inner = _changed(old, path[1:], name, text) if len(path) > 1 else _value(old, kind, name, text)
    new = {path[0]: inner}
    if isinstance(part, Geometric) and path[0] == "end" and part.final == part.end:
        new["final"] = inner  # it was not given, and follows
    return replace(part, **new)


def _value(old: Any, kind: str, name: str, text: str) -> Any:
    """The text as a value of the kind that the field's annotation says."""
    role = next((method for method in _ROLES if hasattr(old, method)), None)
    by_kind = {"Differentiator": "jacobian", "Rollouts": "rounds", "Polish": "tolerance"}
    role = next((method for word, method in by_kind.items() if word in kind), role)
    value = _literal(text)
    if role == "__call__" and not isinstance(value, str):
        return _schedule(name, text, value)
    if value is None and "None" in kind:
        return None
    if role is not None or is_dataclass(old):
        return _part(role, name, text)
    if "bool" in kind:
        fits, wanted = isinstance(value, bool), "True or False"
    elif kind.startswith("int"):
        fits, wanted = type(value) is int, "a whole number"
    else:
        fits, wanted = type(value) in (int, float) and np.isfinite(value), "a number"
        value = float(value) if fits else value
    if not fits:
        wanted += " or None" if "None" in kind else ""
        raise DraxError(f"{name} is {text!r}: give {wanted}; it was {old!r}.")
    return value


def _schedule(name: str, text: str, value: Any) -> Geometric | Constant:
    """A number that stays, or (start, end) or (start, end, final)."""
    numbers = value if isinstance(value, tuple) else (value,)
    if not all(type(n) in (int, float) and np.isfinite(n) for n in numbers) or len(numbers) > 3:
        raise DraxError(f"{name} is {text!r}: {_WANTED_SCHEDULE}")
    return Constant(float(numbers[0])) if len(numbers) == 1 else Geometric(*map(float, numbers))


_WANTED_SCHEDULE = (
    "give a number, Geometric(start, end) or Geometric(start, end, final), or MODULE:CLASS(...) "
    "for one of your own."
)


def _part(role: str | None, name: str, text: str) -> Any:
    """The part that a text such as `Identity`, `Smoothed(radius=0.1)` or `mine:Own()` says."""
    cls, _, inside = text.strip().partition("(")
    try:
        call: Any = ast.parse(f"f({inside.removesuffix(')')})", mode="eval").body
        arguments = [ast.literal_eval(a) for a in call.args]
        named = {k.arg: ast.literal_eval(k.value) for k in call.keywords}
        part = _class_named(cls.strip(), imports=True)(*arguments, **named)
        if role is not None and not hasattr(part, role):
            raise TypeError(f"it is not {_ROLES[role]}")
    except DraxError:
        raise
    except (AttributeError, TypeError, ValueError, SyntaxError) as error:
        if role == "__call__":
            raise DraxError(f"{name} is {text!r}: {_WANTED_SCHEDULE}") from error
        package = import_module("mjx_drax")
        there = [*REGISTERED, *(getattr(package, public) for public in package.__all__)]
        parts = {c for c in there if isinstance(c, type) and is_dataclass(c)}
        known = sorted(_name_of(c) for c in parts if role is not None and hasattr(c, role))
        raise DraxError(
            f"{name} is {text!r}: give one of {', '.join(known)}, or MODULE:CLASS for one of your "
            "own."
        ) from error
    return part


def _literal(text: str) -> Any:
    """The Python literal that the text is, else the text."""
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError):
        return text
