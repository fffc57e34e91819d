"""Dataclasses as pytrees, such that two classes are never taken for one another.

Trees that go to a device and back go as one vector where it matters (`packed`).
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Static: dict[str, Any] = {"static": True}
"""Metadata of a field that is part of the structure, not a leaf: `field(metadata=Static)`."""

HostOnly: dict[str, Any] = {"host": True}
"""Metadata of a field that no compiled computation reads, such as a name or a test of replays.

It is no part of the pytree, so another value never recompiles, and it needs a default: what JAX
gives back has that in its place. `with_host_fields` puts the value back.
"""

REGISTERED: list[type] = []
"""All classes that were registered, those of users included."""

Class = TypeVar("Class", bound=type)
Node = TypeVar("Node")


def register_dataclass(cls: Class) -> Class:
    """Register a dataclass as a pytree: fields are traced, but for those of metadata `Static`.

    Fields of metadata `HostOnly` are left out.

    The decorator of JAX with the same name makes structures that are equal whatever their class is
    (up to jaxlib 0.11, at least; only their hashes differ): of two classes with the same number of
    traced fields and equal static ones, a compiled function that has seen one of them may run the
    program of this one for the other, now and then, as hashes happen to collide.
    """
    inside = [field for field in fields(cls) if not field.metadata.get("host")]
    traced = [field.name for field in inside if not field.metadata.get("static")]
    static = [field.name for field in inside if field.metadata.get("static")]
    names = [*traced, *static]
    keys = [jax.tree_util.GetAttrKey(name) for name in traced]

    def flatten(node: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(node, name) for name in traced], tuple(getattr(node, n) for n in static)

    def flatten_with_keys(node: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        leaves, static_values = flatten(node)
        return list(zip(keys, leaves, strict=True)), static_values

    def unflatten(static_values: tuple[Any, ...], leaves: Iterable[Any]) -> Any:
        return cls(**dict(zip(names, (*leaves, *static_values), strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    REGISTERED.append(cls)
    return cls


def with_host_fields(node: Node, like: Node) -> Node:
    """The node with the `HostOnly` fields of another one of its kind, those inside it included."""
    new = copy(node)
    for field in fields(node):  # type: ignore[arg-type]
        mine, other = getattr(node, field.name), getattr(like, field.name)
        if field.metadata.get("host"):
            object.__setattr__(new, field.name, other)
        elif is_dataclass(mine) and type(mine) is type(other):
            object.__setattr__(new, field.name, with_host_fields(mine, other))
    return new


def packed(tree: Any, dtype: Any, xp: Any = jnp) -> Any:
    """All numbers of a tree in one vector, so that one copy brings them to or from a device.

    `jax.flatten_util.ravel_pytree` would unpack them on the device, array by array.

    Args:
        tree: of arrays or numbers, which that type can hold.
        dtype: of the vector.
        xp: jax.numpy or numpy, which makes it.
    """
    leaves = [xp.ravel(xp.asarray(leaf)).astype(dtype) for leaf in jax.tree.leaves(tree)]
    return xp.concatenate(leaves)


def unpacked(vector: Any, like: Any) -> Any:
    """What was `packed`, with the structure, shapes and types of `like`."""
    leaves, tree = jax.tree.flatten(like)
    leaves = [np.asarray(leaf) for leaf in leaves]
    ends = np.cumsum([leaf.size for leaf in leaves]).tolist()
    parts = [
        vector[end - leaf.size : end].reshape(leaf.shape).astype(leaf.dtype)
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    return jax.tree.unflatten(tree, parts)
