"""The first of several ways that succeeds: one after the other, or all at once.

A loop over ways does the least work, and is what CPUs do. But a batch loops as long as its row that
takes most, and on a GPU each round costs its launches, while more rows hardly cost anything. So
GPUs try all ways of all rows at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.kernels.batching import on_gpu


def first_success(
    attempt: Callable[..., tuple[Array, Any]], ways: tuple[Array, ...], needed: Array
) -> tuple[Array, Any, Array]:
    """Whether any way succeeds, what the first such gives, and which it is.

    If none does, what the last one gives. Where none is needed, what is returned has no meaning but
    that nothing has succeeded, and less work may be done.

    Args:
        attempt: attempt(*way) returns whether it has succeeded, and arrays.
        ways: arrays with a row for each way.
        needed: whether any is.
    """
    way = all_at_once if on_gpu() else one_by_one
    return way(attempt, ways, needed)


def one_by_one(
    attempt: Callable[..., tuple[Array, Any]], ways: tuple[Array, ...], needed: Array
) -> tuple[Array, Any, Array]:
    """`first_success` by a loop."""
    count = len(ways[0])

    def again(carry: tuple[Any, Array]) -> tuple[Any, Array]:
        i = carry[1]
        return attempt(*(w[i] for w in ways)), i + 1

    def unfinished(carry: tuple[Any, Array]) -> Array:
        (ok, _), i = carry
        return needed & ~ok & (i < count)

    shapes = jax.eval_shape(attempt, *(w[0] for w in ways))
    nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    (ok, found), tries = jax.lax.while_loop(unfinished, again, (nothing, jnp.zeros((), int)))
    return ok, found, jnp.maximum(tries - 1, 0)


def all_at_once(
    attempt: Callable[..., tuple[Array, Any]], ways: tuple[Array, ...], needed: Array
) -> tuple[Array, Any, Array]:
    """`first_success` of all ways side by side."""
    count = len(ways[0])
    ok, each = jax.vmap(attempt)(*ways)
    found = jax.tree.map(lambda a: a[count - 1], each)
    index = jnp.full((), count - 1, int)
    for i in reversed(range(count - 1)):
        found = jax.tree.map(lambda a, b, i=i: jnp.where(ok[i], a[i], b), each, found)
        index = jnp.where(ok[i], i, index)
    return needed & ok.any(), found, index
