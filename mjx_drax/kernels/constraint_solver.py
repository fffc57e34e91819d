"""Accelerations under constraints whose friction cones are pyramids: Newton's method, for each row.

The acceleration a minimizes

    1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - aref_i),      M a0 = force

where s_i(y) is D y^2 / 2 for y < 0, for rows of `both` sides for all y, and goes on as a line where
dry friction of the size `loss` slides, |y| >= loss / D. The function is piecewise quadratic: once
the constraints that are active stay the same, a full step ends at the minimum; before, a shorter
one may be better. On GPUs one kernel does all iterations of a row, in a block of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels.batching import (
    block_for_each_row,
    merged_vmaps,
    of_one_precision,
    on_gpu,
    repeated,
)
from mjx_drax.kernels.linalg import cholesky, solve, symmetric
from mjx_drax.kernels.riccati_blocks import (
    SPLIT,
    WARPS,
    padded,
    product,
    swept,
    tile,
    times,
    transposed_times,
)

ITERATIONS, SIZES = 20, 8
"""Most iterations, and how many step sizes each chooses from, 1, 1/2, 1/4, ..."""

LEAST_SHARE = 1e-3
"""Least share of its predicted decrease that a step must achieve for another one to follow. In
float32, or where constraints are about to switch, costs go on decreasing by almost nothing."""

MOST_DOFS, MOST_ROWS = 64, 128
"""Largest M and J of the kernel."""


class Constraints(NamedTuple):
    """M (nv, nv), J (m, nv), D, aref, loss and both (m,), force and a0 (nv,)."""

    M: Array
    J: Array
    D: Array
    aref: Array
    loss: Array
    both: Array
    force: Array
    a0: Array


def law(given: Constraints, y: Array) -> tuple[Array, Array, Array]:
    """s(y), -s'(y) and s''(y) of y = J a - aref, (..., m)."""
    far = jnp.abs(y) * given.D >= given.loss
    slides = far & (given.loss > 0)
    acts = ((y < 0) | (given.both > 0)) & ~slides
    line = given.loss * (jnp.abs(y) - 0.5 * given.loss / jnp.where(slides, given.D, 1.0))
    cost = jnp.where(slides, line, jnp.where(acts, 0.5 * given.D * y * y, 0.0))
    push = jnp.where(y < 0, given.loss, -given.loss)
    push = jnp.where(slides, push, jnp.where(acts, -given.D * y, 0.0))
    return cost, push, jnp.where(acts, given.D, 0.0)


def iterated(
    given: Constraints, product: Callable[..., Array], newton: Callable[..., Any], left: Any
) -> tuple[Array, Any]:
    """The minimum (nv,), and what the last iteration left of its Hessian there.

    Args:
        product: of two matrices.
        newton: newton(H, g) -> H^{-1} g, and what is left of H.
        left: an array like what is left, or None.
    """
    M, J, force, a0 = given.M, given.J, given.force, given.a0
    sizes = jnp.exp2(-lax.iota(jnp.int32, SIZES).astype(a0.dtype))

    def total(off: Array, rest: Array, y: Array) -> Array:
        """What is minimized, (n,), for a - a0, M a - force and J a - aref, (n, ...)."""
        return 0.5 * jnp.sum(rest * off, axis=1) + jnp.sum(law(given, y)[0], axis=1)

    def iteration(carry: Any) -> Any:
        count, _, *here, cost, _ = carry
        _, rest, y = here
        _, push, slope = law(given, y)
        gradient = rest - transposed_times(J, push)
        direction, left = newton(M + product((J * slope[:, None]).T, J), gradient)
        along = direction, times(M, direction), times(J, direction)
        # Changes are added up: values from anew differ by rounding, which could look like progress
        costs = total(
            *(a[None] - sizes[:, None] * d[None] for a, d in zip(here, along, strict=True))
        )
        lowest = jnp.min(costs)
        size = jnp.max(jnp.where(costs == lowest, sizes, 0.0))
        rounding = jnp.finfo(cost.dtype).eps * jnp.abs(cost)
        least = jnp.maximum(rounding, LEAST_SHARE * jnp.sum(gradient * direction))
        better = cost - lowest > least
        size, cost = jnp.where(better, size, 0.0), jnp.where(better, lowest, cost)
        return (
            count + 1,
            better,
            *(a - size * d for a, d in zip(here, along, strict=True)),
            cost,
            left,
        )

    here = jnp.zeros_like(a0), times(M, a0) - force, times(J, a0) - given.aref
    begin = 0, True, *here, jnp.sum(total(*(a[None] for a in here))), left
    end = lax.while_loop(lambda c: (c[0] < ITERATIONS) & c[1], iteration, begin)
    return a0 + end[2], end[-1]


def _plain(given: Constraints) -> tuple[Array, Array]:
    def newton(H: Array, gradient: Array) -> tuple[Array, Array]:
        factor = cholesky(symmetric(H))
        return solve(factor, gradient), factor

    return iterated(given, jnp.matmul, newton, jnp.zeros_like(given.M))


def _factor(given: Constraints, a: Array) -> Array:
    """Of the Hessian at a."""
    _, _, slope = law(given, times(given.J, a) - given.aref)
    return cholesky(symmetric(given.M + (given.J * slope[:, None]).T @ given.J))


def _all_rows(has_rows: tuple[bool, ...], given: Constraints) -> tuple[Array, Array]:
    given = repeated(has_rows, given)
    rows, nv = given.J.shape[-2:]
    fits = nv <= MOST_DOFS and rows <= MOST_ROWS and given.M.dtype == np.float32
    plain = jax.vmap(_plain)
    if not (on_gpu() and fits and of_one_precision(given)):
        return plain(given)

    def kernel(given: Constraints) -> tuple[Array, Array]:
        a = minima(given)
        return a, jax.vmap(_factor)(given, a)

    found: tuple[Array, Array] = lax.platform_dependent(given, cuda=kernel, default=plain)
    return found


constrained_minimum = merged_vmaps(_plain, _all_rows)
"""The acceleration (nv,), and the lower Cholesky factor of the Hessian there, (nv, nv)."""


def minima(given: Constraints, interpret: bool = False) -> Array:
    """The accelerations (rows, nv) by the kernel; every array leads with the axis of rows."""
    m, n = given.J.shape[-2:]
    M, N = tile(m), tile(n)
    shapes = (N, N), (M, N), (M,), (M,), (M,), (M,), (N,), (N,)
    arrays = [padded(a, *shape) for a, shape in zip(given, shapes, strict=True)]
    precision = lax.Precision.HIGHEST if interpret else SPLIT
    body = partial(_body, n, partial(product, precision=precision))
    found = block_for_each_row(body, {"a": (len(arrays[0]), N)}, arrays, WARPS, interpret)
    return found["a"][:, :n]


def _body(n: int, product: Callable[..., Array], *refs: Any) -> None:
    """One row."""
    *inputs, out = refs
    given = Constraints(*(ref[0] for ref in inputs))

    def newton(H: Array, gradient: Array) -> tuple[Array, None]:
        return -times(swept(H, n), gradient), None

    out[0], _ = iterated(given, product, newton, None)
