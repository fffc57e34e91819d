"""Matrices in tiles: what a block of GPU threads does with a whole matrix at a time.

A tile has the next powers of two for sizes, so that the block multiplies and adds all of it. Tiles
are inverted by sweeps: a sweep of k does for all i, j not k

    T_ij <- T_ij - T_ik T_kj / T_kk     T_ik <- T_ik / T_kk     T_kk <- -1 / T_kk

and after all of them T holds -T^{-1}. It stays symmetric, and needs one column at a time. The
pivots T_kk are positive if and only if T is positive definite; else the result is not a number.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array, lax

LEAST = 16
"""The least tile of tensor cores."""

SPLIT = lax.DotAlgorithmPreset.TF32_TF32_F32_X3
"""Products on tensor cores, of factors in two parts: as exact as float32, and fewer registers."""


def products(interpret: bool) -> Callable[[Array, Array], Array]:
    """(A, B) -> A B, on tensor cores unless `interpret`."""
    return partial(product, precision=lax.Precision.HIGHEST if interpret else SPLIT)


def swept(T: Array, count: int) -> Array:
    """T after sweeps of its first `count` rows; see above."""
    rows, columns = indices(T.shape[0])

    def sweep(k: Array, T: Array) -> Array:
        of_column = columns == k
        column = jnp.sum(jnp.where(of_column, T, 0.0), axis=1)
        pivot = jnp.sum(jnp.where(jnp.arange(T.shape[0]) == k, column, 0.0))
        scaled = column / jnp.where(pivot > 0.0, pivot, jnp.nan)
        inner = T - column[:, None] * scaled[None, :]
        border = jnp.where(of_column, scaled[:, None], scaled[None, :])
        there = of_column | (rows == k)
        corner = of_column & (rows == k)
        return jnp.where(corner, -1.0 / pivot, jnp.where(there, border, inner))

    return lax.fori_loop(0, count, sweep, T)


def indices(n: int) -> tuple[Array, Array]:
    """The row and the column of every entry of a tile (n, n)."""
    return lax.broadcasted_iota(jnp.int32, (n, n), 0), lax.broadcasted_iota(jnp.int32, (n, n), 1)


def product(A: Array, B: Array, precision: Any) -> Array:
    """A B."""
    return jnp.dot(A, B, precision=precision)


def times(A: Array, v: Array) -> Array:
    """A v."""
    return jnp.sum(A * v[None, :], axis=1)


def transposed_times(A: Array, v: Array) -> Array:
    """A'v."""
    return jnp.sum(A * v[:, None], axis=0)


def tile(n: int) -> int:
    """The size of the tile for blocks of n rows."""
    return max(LEAST, 1 << (n - 1).bit_length())


def padded(a: Array, *sizes: int) -> Array:
    """Blocks (..., *shape) with zeros around, up to `sizes`."""
    leading = a.ndim - len(sizes)
    more = [size - there for size, there in zip(sizes, a.shape[leading:], strict=True)]
    return jnp.pad(a, [(0, 0)] * leading + [(0, by) for by in more])
