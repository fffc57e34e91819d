"""Choices inside compiled programs: what is computed only where needed, and what is finite."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import jaxpr_as_fun


def where_needed(needed: Array, function: Callable[[], Any]) -> Any:
    """function() where `needed`, else zeros of the same shapes.

    `jax.lax.cond` needs the shapes for its other branch; `jax.eval_shape` would trace the function
    a second time, which takes seconds for a step of a robot.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)()
    zeros = [jnp.zeros(shape.shape, shape.dtype) for shape in jax.tree.leaves(shapes)]
    found = jax.lax.cond(needed, jaxpr_as_fun(closed), lambda: zeros)
    return jax.tree.unflatten(jax.tree.structure(shapes), found)


def all_finite(arrays: list[Array]) -> Array:
    """Whether all entries are finite, scalar: one pass over each, and no array of truth values."""
    total = sum(jnp.sum(0.0 * array) for array in arrays)  # 0, or NaN where one is not finite
    return jnp.asarray(total == 0.0)
