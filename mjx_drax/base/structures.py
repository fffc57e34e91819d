"""Texts of the structures of pytrees: the same in every process, and different where these differ.

Python's hashes are not the same in every process, and the text of a function or an object may hold
its address.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from jax.tree_util import Partial, PyTreeDef

from mjx_drax.base.digests import digest

_PLAIN = bool, int, float, complex, str, bytes, type(None)
_KNOWN = "builtins", "mjx_drax", "jax", "jaxlib", "mujoco", "numpy"
_HERE = Path(__file__).parents[1]


class Unspelled(ValueError):
    """Some part of a structure has no lasting text: a user's class, or a function."""


def spelled(tree: PyTreeDef, explained: Callable[[type], bool] = lambda kind: False) -> str:
    """The structure of a tree as a text, with all that is static in it.

    Args:
        explained: for the type of a node, whether functions in the nodes and the static parts
            below need no text, because whoever asks knows what they compute.

    Raises:
        Unspelled: it holds functions that are not explained, or classes of other packages.
    """
    return _of_tree(tree, explained, False)


def _of_tree(tree: PyTreeDef, explained: Callable[[type], bool], free: bool) -> str:
    node = tree.node_data()
    if node is None:
        return "*" * tree.num_nodes  # a leaf; nothing for no tree at all
    kind, static = node
    free |= explained(kind)
    if free and kind is Partial:
        return f"function of {tree.num_leaves}"
    parts = (_of_tree(child, explained, free) for child in tree.children())
    return f"{_of_class(kind)}[{_of(static, free)}]({','.join(parts)})"


def _of_class(kind: type) -> str:
    """Its name, if that is a class that always has this name."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    if kind is not type(None) and not _is_known(kind):
        raise Unspelled(name)
    return name


def _is_known(kind: type) -> bool:
    """Whether this package, or one whose version is asked for, has that class under its name."""
    module: Any = sys.modules.get(kind.__module__)
    found = module
    for part in kind.__qualname__.split("."):
        found = getattr(found, part, None)
    root = kind.__module__.partition(".")[0]
    if found is not kind or root not in _KNOWN:
        return False
    return root != "mjx_drax" or Path(str(module.__file__)).is_relative_to(_HERE)


def _of(value: Any, free: bool) -> str:
    """A static part."""
    if isinstance(value, _PLAIN):
        return repr(value)
    if isinstance(value, type):
        return _of_class(value)
    if isinstance(value, FunctionType):
        if free:
            return "function"
        raise Unspelled(value.__qualname__)
    if isinstance(value, PyTreeDef):
        return _of_tree(value, lambda kind: free, free)
    if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        return f"{value.dtype}{value.shape}{digest(np.asarray(value).tobytes())}"
    parts: Any
    if isinstance(value, Enum):
        parts = value.name
    elif isinstance(value, tuple | list):
        parts = list(value)
    elif isinstance(value, dict):
        parts = [*value.keys(), *value.values()]
    elif is_dataclass(value):
        parts = [getattr(value, field.name) for field in fields(value)]
    elif hasattr(value, "array"):  # as MJX wraps arrays, to hash them
        parts = value.array
    else:
        raise Unspelled(type(value).__qualname__)
    if isinstance(parts, list):
        return f"{_of_class(type(value))}({','.join(_of(part, free) for part in parts)})"
    return f"{_of_class(type(value))}({_of(parts, free)})"
