"""Dense factorizations of the small blocks that a stage brings (sizes ndx and nu).

Inside a batched scan an unrolled Cholesky beats the library's batched call many times over at
sizes up to 8 (3 to 22 times on CPU); above that the library wins and is called.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular

UNROLLED_UP_TO = 8


def cholesky(matrix: Array) -> Array:
    """Lower triangular L (n, n) with L L' = matrix; only its lower triangle is read."""
    n = matrix.shape[-1]
    if n == 0:
        return matrix
    if n > UNROLLED_UP_TO:
        return jnp.linalg.cholesky(matrix)
    rows: list[list[Array]] = []
    zero = jnp.zeros_like(matrix[0, 0])
    for i in range(n):
        row: list[Array] = []
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total = total - row[k] * (row[k] if i == j else rows[j][k])
            row.append(jnp.sqrt(total) if i == j else total / rows[j][j])
        rows.append(row)
    return jnp.stack([jnp.stack(row + [zero] * (n - len(row))) for row in rows])


def solve_lower(factor: Array, b: Array) -> Array:
    """L^{-1} b for lower triangular L (n, n) and b (n,) or (n, m)."""
    n = factor.shape[-1]
    if n == 0:
        return b
    if n > UNROLLED_UP_TO:
        return solve_triangular(factor, b, lower=True)
    out: list[Array] = []
    for i in range(n):
        total = b[i]
        for j in range(i):
            total = total - factor[i, j] * out[j]
        out.append(total / factor[i, i])
    return jnp.stack(out)


def solve_upper(factor: Array, b: Array) -> Array:
    """L'^{-1} b for lower triangular L (n, n) and b (n,) or (n, m)."""
    n = factor.shape[-1]
    if n == 0:
        return b
    if n > UNROLLED_UP_TO:
        return solve_triangular(factor, b, lower=True, trans=1)
    out: list[Array] = [b[0]] * n
    for i in reversed(range(n)):
        total = b[i]
        for j in range(i + 1, n):
            total = total - factor[j, i] * out[j]
        out[i] = total / factor[i, i]
    return jnp.stack(out)


def solve(factor: Array, b: Array) -> Array:
    """(L L')^{-1} b for lower triangular L (n, n) and b (n,) or (n, m)."""
    return solve_upper(factor, solve_lower(factor, b))


def symmetric(matrix: Array) -> Array:
    """1/2 (M + M')."""
    return 0.5 * (matrix + jnp.swapaxes(matrix, -1, -2))
