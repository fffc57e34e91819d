"""Dense factorizations of the small blocks that a stage brings (sizes ndx and nu).

Inside a batched scan an unrolled Cholesky beats the library's batched call many times over at
sizes up to 8 (3 to 22 times on CPU). Above that, GPUs call the library, or a kernel of ours where
equations are solved (`positive_matrices`). CPUs run a loop over columns: it is about as fast as
LAPACK, and two batches of LAPACK calls that run at the same time can wait for each other forever in
jaxlib's thread pool (0.10, on two cores, nearly always).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import truediv
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular

from mjx_drax.kernels import positive_matrices, small_matrices
from mjx_drax.kernels.batching import merged_vmaps, of_one_precision, on_gpu, repeated

UNROLLED_UP_TO = 8

SUMMED_UP_TO = 256
"""Entries of a factor up to which a `transposed_product` is a sum on GPUs, which fuses: their
library takes a block of threads for each product of a batch, however small."""


full_precision = jax.default_matmul_precision("float32")
"""Context, or decorator, in which products are of float32 numbers. GPUs round factors to 10 bits by
default, and defects then stay above 1e-3."""


def cholesky(matrix: Array) -> Array:
    """Lower triangular L (n, n) with L L' = matrix; only its lower triangle is read."""
    n = matrix.shape[-1]
    if n == 0:
        return matrix
    if n > UNROLLED_UP_TO:
        return jax.lax.platform_dependent(
            matrix, cpu=_cholesky_by_columns, default=jnp.linalg.cholesky
        )
    zero = jnp.zeros_like(matrix[0, 0])
    rows = small_matrices.cholesky(_lower_rows(matrix), jnp.sqrt, truediv)
    return jnp.stack([jnp.stack([*row, *[zero] * (n - len(row))]) for row in rows])


def _lower_rows(matrix: Array) -> list[list[Array]]:
    """The entries of the lower triangle."""
    return [[matrix[i, j] for j in range(i + 1)] for i in range(matrix.shape[-1])]


def _times_inverse(x: Array, divisor: Array) -> Array:
    """x / divisor: one division serves all columns of x."""
    return x * (1.0 / divisor)


def _cholesky_by_columns(matrix: Array) -> Array:
    """`cholesky` as a loop over columns."""
    n = matrix.shape[-1]

    def column(j: Array, factor: Array) -> Array:
        below = matrix[:, j] - factor @ factor[j]
        below = below / jnp.sqrt(below[j])
        return factor.at[:, j].set(jnp.where(jnp.arange(n) >= j, below, 0.0))

    return jax.lax.fori_loop(0, n, column, jnp.zeros_like(matrix))


def _lower_by_rows(factor: Array, b: Array) -> Array:
    """`solve_lower` as a loop over rows."""

    def row(i: Array, out: Array) -> Array:
        return out.at[i].set((b[i] - factor[i] @ out) / factor[i, i])

    return jax.lax.fori_loop(0, len(b), row, jnp.zeros_like(b))


def _upper_by_rows(factor: Array, b: Array) -> Array:
    """`solve_upper` as a loop over rows, the last one first."""

    def row(step: Array, out: Array) -> Array:
        i = len(b) - 1 - step
        return out.at[i].set((b[i] - factor[:, i] @ out) / factor[i, i])

    return jax.lax.fori_loop(0, len(b), row, jnp.zeros_like(b))


def _solved(
    factor: Array, b: Array, by_rows: Callable[..., Any], entries: Callable[..., Any], trans: int
) -> Array:
    """L^{-1} b, or L'^{-1} b if `trans`: of entries, by rows on CPUs, or by the library."""
    n = factor.shape[-1]
    if n == 0:
        return b
    if n > UNROLLED_UP_TO:
        library = partial(solve_triangular, lower=True, trans=trans)
        return jax.lax.platform_dependent(factor, b, cpu=by_rows, default=library)
    return jnp.stack(entries(_lower_rows(factor), [b[i] for i in range(n)], _times_inverse))


def solve_lower(factor: Array, b: Array) -> Array:
    """L^{-1} b for lower triangular L (n, n) and b (n,) or (n, m)."""
    return _solved(factor, b, _lower_by_rows, small_matrices.solve_lower, 0)


def solve_upper(factor: Array, b: Array) -> Array:
    """L'^{-1} b for lower triangular L (n, n) and b (n,) or (n, m)."""
    return _solved(factor, b, _upper_by_rows, small_matrices.solve_upper, 1)


def solve(factor: Array, b: Array) -> Array:
    """(L L')^{-1} b for lower triangular L (n, n) and b (n,) or (n, m)."""
    return solve_upper(factor, solve_lower(factor, b))


def solve_positive(matrix: Array, b: Array) -> Array:
    """M^{-1} b for a positive definite M (n, n) and b (n,) or (n, m).

    Above `UNROLLED_UP_TO` derivatives are those of the equation M y = b, not of the operations of
    its factorization.
    """
    if matrix.shape[-1] <= UNROLLED_UP_TO:
        return solve(cholesky(matrix), b)
    return solve_implicitly(matrix, b)


def _positive_solution(matrix: Array, b: Array) -> Array:
    return solve(cholesky(matrix), b)


def _positive_solutions(has_rows: Sequence[bool], *arguments: Array) -> Array:
    """`_positive_solution` of many rows, by one kernel on GPUs where one is made for it."""
    M, b = repeated(has_rows, arguments)
    plain = jax.vmap(_positive_solution)
    if not (on_gpu() and of_one_precision((M, b)) and positive_matrices.fits(M)):
        return plain(M, b)

    def kernel(M: Array, b: Array) -> Array:
        return positive_matrices.solutions(M, b.reshape(*b.shape[:2], -1)).reshape(b.shape)

    found: Array = jax.lax.platform_dependent(M, b, cuda=kernel, default=plain)
    return found


solve_implicitly = jax.custom_jvp(merged_vmaps(_positive_solution, _positive_solutions))
"""`solve_positive`, with derivatives of the equation, and a kernel on GPUs, at all sizes."""


@solve_implicitly.defjvp
def _solve_implicitly_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> Any:
    (matrix, b), (dM, db) = primals, tangents
    factor = cholesky(matrix)
    y = solve(factor, b)
    return y, solve(factor, db - dM @ y)


def product(A: Array, B: Array) -> Array:
    """A B, (n, m) or (n,), for A (n, k) and B (k, m) or (k,).

    Small ones are sums of columns, which fuse: the library that CPUs call takes a microsecond or
    more for each product of a batch, 60 times as long for (4, 4) and (4, 5).
    """
    columns = A.shape[-1]
    if not 0 < columns <= UNROLLED_UP_TO:
        return A @ B
    return small_matrices.dot(list(A.T[..., None] if B.ndim > 1 else A.T), list(B))


def transposed_product(J: Array, A: Array) -> Array:
    """J' A, (n, k) or (n,), for J (m, n) and A (m, k) or (m,)."""

    def by_library(J: Array, A: Array) -> Array:
        return J.T @ A

    def summed(J: Array, A: Array) -> Array:
        return jnp.sum(J.reshape(*J.shape, *[1] * (A.ndim - 1)) * A[:, None], axis=0)

    if J.size > SUMMED_UP_TO:
        return by_library(J, A)
    return jax.lax.platform_dependent(J, A, cpu=by_library, default=summed)


def symmetric(matrix: Array) -> Array:
    """1/2 (M + M')."""
    return 0.5 * (matrix + jnp.swapaxes(matrix, -1, -2))
