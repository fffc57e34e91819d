"""Equations of many positive definite matrices of middle size, by one kernel on GPUs.

Libraries take a dozen launches for the Cholesky factors of a batch and what follows from them. And
XLA's fused loops compute every entry of an unrolled factor by itself, with all that it depends on.
Here the factor of a small matrix stays in the registers of one thread, unrolled into scalars; a
larger one is inverted by a block of threads, as a tile.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels import small_matrices, tiles
from mjx_drax.kernels.batching import block_for_each_row, padded, thread_for_each_row
from mjx_drax.kernels.small_matrices import Matrix

THREADS = 32
"""Matrices that a block of threads works on, a thread for each: one warp."""

MOST_OF_ONE_THREAD, MOST = 12, 32
"""Largest matrices of one thread, kernels for which compile in seconds, and those for 18 in a
minute; and of a block of threads. Beyond, the library is called: 480 matrices of 35 rows took it
0.37 ms on an H200, and one warp with a tile of 64 rows 1.4 ms."""

WARPS, COLUMNS = 2, 64
"""Warps of a block of threads, and columns of b that it works on at a time. With one, a kernel
takes twice as long to compile; with four, 61,440 matrices of 18 rows take a third longer."""


def fits(M: Array) -> bool:
    """Whether there is a kernel for such matrices (..., n, n)."""
    n = M.shape[-1]
    return n <= MOST_OF_ONE_THREAD or (n <= MOST and M.dtype == np.float32)


def solutions(M: Array, b: Array, interpret: bool = False) -> Array:
    """M^{-1} b, (rows, n, m), for M (rows, n, n), of which lower triangles are read, and b.

    In plain JAX it is the vmap of `linalg.solve_positive`.
    """
    by = _by_threads if M.shape[-1] <= MOST_OF_ONE_THREAD else _by_blocks
    return by(M, b, interpret)


def _by_blocks(M: Array, b: Array, interpret: bool) -> Array:
    """`solutions` from inverses, with one refinement."""
    n, m = b.shape[1:]
    N, columns = tiles.tile(n), tiles.tile(m)
    chunk, product = min(columns, COLUMNS), tiles.products(interpret)

    def body(M_ref: Any, b_ref: Any, x_ref: Any) -> None:
        lower = M_ref[0]
        row, column = tiles.indices(N)
        M = jnp.where(row >= column, lower, lower.T)
        inverse = -tiles.swept(M, n)
        for start in range(0, columns, chunk):
            b = b_ref[0, :, start : start + chunk]
            x = product(inverse, b)
            x_ref[0, :, start : start + chunk] = x + product(inverse, b - product(M, x))

    arrays = tiles.padded(M, N, N), tiles.padded(b, N, columns)
    found = block_for_each_row(body, {"x": arrays[1].shape}, arrays, WARPS, interpret)
    return found["x"][:, :n, :m]


def _by_threads(M: Array, b: Array, interpret: bool) -> Array:
    """`solutions` from factors."""
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
