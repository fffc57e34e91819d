"""Cholesky factors and solutions of many matrices of middle size: a thread of a GPU for each.

Libraries take a dozen launches for a batch of Cholesky factors, and blocks of threads that wait for
each other. XLA's fused loops compute every entry of an unrolled factor by itself, with all that it
depends on. Here a factor stays in the registers of one thread, unrolled into scalars.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mjx_drax.kernels import small_matrices
from mjx_drax.kernels.batching import padded, thread_for_each_row
from mjx_drax.kernels.small_matrices import Matrix

THREADS = 32
"""Matrices that a block of threads works on: one warp."""

MAX_SIZE = 12
"""Largest matrices: kernels for 12 compile in seconds, those for 18 in a minute."""


def factors(M: Array, interpret: bool = False) -> Array:
    """Lower triangular L, (rows, n, n), with L L' = M, of which lower triangles are read.

    In plain JAX it is the vmap of `linalg.cholesky`.
    """
    rows, n, _ = M.shape

    def body(M_ref: Any, out_ref: Any) -> None:
        L = small_matrices.cholesky(_triangle(M_ref, n), lax.sqrt, lax.div)
        for i in range(n):
            for j in range(n):
                out_ref[i * n + j, :] = L[i][j] if j <= i else jnp.zeros_like(L[0][0])

    arrays = [_by_entries(_lower(M))]
    found = thread_for_each_row(body, THREADS, (n * n,), arrays, interpret=interpret)
    return found[:, :rows].T.reshape(M.shape)


def solutions(M: Array, b: Array, interpret: bool = False) -> Array:
    """M^{-1} b, (rows, n, m), for M (rows, n, n), of which lower triangles are read, and b.

    In plain JAX it is the vmap of `linalg.solve_positive`.
    """
    rows, n, m = b.shape

    def body(M_ref: Any, b_ref: Any, out_ref: Any) -> None:
        L = small_matrices.cholesky(_triangle(M_ref, n), lax.rsqrt, lax.mul)

        def column(c: Array, _: None) -> None:
            y = [b_ref[c * n + i, :] for i in range(n)]
            y = small_matrices.solve_lower(L, y, lax.mul)
            for i, x in enumerate(small_matrices.solve_upper(L, y, lax.mul)):
                out_ref[c * n + i, :] = x

        lax.fori_loop(0, m, column, None)

    arrays = [_by_entries(_lower(M)), _by_entries(jnp.swapaxes(b, 1, 2))]
    found = thread_for_each_row(body, THREADS, (m * n,), arrays, interpret=interpret)
    return jnp.swapaxes(found[:, :rows].T.reshape(rows, m, n), 1, 2)


def _lower(M: Array) -> Array:
    """Its lower triangles, row by row, (rows, n (n + 1) / 2)."""
    return jnp.concatenate([M[:, i, : i + 1] for i in range(M.shape[-1])], axis=1)


def _by_entries(a: Array) -> Array:
    """(rows, ...) as (entries, rows), padded."""
    return padded(a.reshape(len(a), -1).T, THREADS)


def _triangle(ref: Any, n: int) -> Matrix:
    """What `_lower` has packed, of a block of rows."""
    return [[ref[i * (i + 1) // 2 + j, :] for j in range(i + 1)] for i in range(n)]
