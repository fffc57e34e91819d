"""Arrays of numpy's that functions read, and whether they were changed in place.

Tracing a function again shows that a variable has another value, but not that an array has other
numbers: while a program lives, JAX takes the array's numbers of that program's time.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import jax
import numpy as np

from mjx_drax.base.digests import digest

REACHED = 10_000
"""Objects that are looked through at most."""

_LIBRARIES = ("jax", "jaxlib", "mjx_drax", "mujoco", "numpy")
_numbers: dict[int, tuple[weakref.ref[np.ndarray], str]] = {}


def changed_in_place(functions: Any) -> bool:
    """Whether an array that these functions lead to had other numbers at an earlier call."""
    changed = False
    for array in _arrays(functions):
        key, now = id(array), digest(array)
        known, before = _numbers.get(key, (None, now))
        if known is None or known() is not array:  # another had this id, and is gone
            known, before = weakref.ref(array), now
        changed |= now != before
        _numbers[key] = known, now
    for key in [key for key, (known, _) in _numbers.items() if known() is None]:
        del _numbers[key]
    return changed


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
