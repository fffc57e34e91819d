"""Arrays of numpy's that functions read, and whether they were changed in place.

Tracing a function again shows that a variable has another value, but not that an array has other
numbers: while a program lives, JAX takes the array's numbers of that program's time.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import jax
import numpy as np

from mjx_drax.base.digests import digest

REACHED = 10_000
"""Objects that are looked through at most."""

_LIBRARIES = ("jax", "jaxlib", "mjx_drax", "mujoco", "numpy")


@dataclass
class _Known:
    """An array, digests of its numbers, and the functions that lead to it and do not read it.

    The digests are of the numbers as they are, and as float32 has them.
    """

    array: weakref.ref[np.ndarray]
    numbers: tuple[str, str]
    unread_by: set[Any]


_known: dict[int, _Known] = {}


def changed_in_place(functions: Any) -> dict[int, bool]:
    """Identities of arrays that functions, hashable, lead to, and whose numbers were others before.

    And whether float32 shows the change. The numbers count as known from now on. Arrays that the
    functions do `not_read` are left out.
    """
    for key in [key for key, known in _known.items() if known.array() is None]:
        del _known[key]  # another array may get its identity
    changed = {}
    for array in _arrays(functions):
        known = _known.get(id(array))
        if known is None:
            _known[id(array)] = _Known(weakref.ref(array), _digests(array), set())
        elif functions not in known.unread_by:
            before, known.numbers = known.numbers, _digests(array)
            if known.numbers != before:
                changed[id(array)] = known.numbers[1] != before[1]
    return changed


def not_read(functions: Any, changed: dict[int, bool]) -> None:
    """Look at these arrays no more: what the functions compute did not depend on their change.

    Those whose change float32 does not show may well be read.
    """
    for key, shown in changed.items():
        if shown:
            _known[key].unread_by.add(functions)


def _digests(array: np.ndarray) -> tuple[str, str]:
    with np.errstate(over="ignore"):
        rounded = array.astype(np.float32) if array.dtype == np.float64 else array
    return digest(array), digest(rounded)


def _arrays(root: Any) -> Iterator[np.ndarray]:
    """All that are reached by closures, globals, attributes and containers."""
    waiting, seen = [root], set[int]()
    while waiting and len(seen) < REACHED:
        reached = waiting.pop()
        if id(reached) in seen or isinstance(
            reached, type | ModuleType | BuiltinFunctionType | jax.Array
        ):
            continue
        seen.add(id(reached))
        if isinstance(reached, np.ndarray) and not reached.dtype.hasobject:
            yield reached
        elif isinstance(reached, FunctionType):
            waiting += [reached.__closure__, reached.__defaults__, reached.__kwdefaults__]
            waiting += _globals(reached)
        else:
            waiting += gc.get_referents(reached)


def _globals(function: FunctionType) -> list[Any]:
    """Values of those that its code, and code within, names; none of a library's."""
    values = function.__globals__
    if str(values.get("__name__")).partition(".")[0] in _LIBRARIES:
        return []
    codes, names = [function.__code__], set[str]()
    for code in codes:
        names.update(code.co_names)
        codes += [inner for inner in code.co_consts if hasattr(inner, "co_names")]
    return [values[name] for name in sorted(names) if name in values]
