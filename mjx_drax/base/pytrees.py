"""Dataclasses as pytrees, such that two classes are never taken for one another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, TypeVar

import jax

Static: dict[str, Any] = {"static": True}
"""Metadata of a field that is part of the structure, not a leaf: `field(metadata=Static)`."""

Class = TypeVar("Class", bound=type)


def register_dataclass(cls: Class) -> Class:
    """Register a dataclass as a pytree; fields with metadata `Static` are not traced.

    The decorator of JAX with the same name makes structures that are equal whatever their class is
    (up to jaxlib 0.11, at least; only their hashes differ): of two classes with the same number of
    traced fields and equal static ones, a compiled function that has seen one of them may run the
    program of this one for the other, now and then, as hashes happen to collide.
    """
    traced = [field.name for field in fields(cls) if not field.metadata.get("static")]
    static = [field.name for field in fields(cls) if field.metadata.get("static")]
    names = [*traced, *static]
    keys = [jax.tree_util.GetAttrKey(name) for name in traced]

    def flatten(node: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(node, name) for name in traced], tuple(getattr(node, n) for n in static)

    def flatten_with_keys(node: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        leaves, aside = flatten(node)
        return list(zip(keys, leaves, strict=True)), aside

    def unflatten(aside: tuple[Any, ...], leaves: Iterable[Any]) -> Any:
        return cls(**dict(zip(names, (*leaves, *aside), strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls
