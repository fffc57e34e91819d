"""Accelerations under constraints: Newton's method, for each row.

The acceleration a minimizes

    1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - aref_i)

where s_i'(y) is D y, clipped where a contact or a limit opens, y > 0, or where dry friction slides;
`elliptic_cones` has the s of elliptic friction cones. Without these the function is piecewise
quadratic: once the constraints that are active stay the same, a full step ends at the minimum;
before, a shorter one may be better. On GPUs one kernel does all iterations of a row, in a block of
threads.

Forces may be larger than what they leave over by more digits than numbers have. So only changes of
the function are computed, and M a0, which is the sum of all other forces, is never taken from M a.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels import elliptic_cones as elliptic
from mjx_drax.kernels import positive_matrices
from mjx_drax.kernels.batching import (
    block_for_each_row,
    merged_vmaps,
    of_one_precision,
    on_gpu,
    repeated,
)
from mjx_drax.kernels.linalg import cholesky, solve, symmetric
from mjx_drax.kernels.riccati_blocks import (
    LEAST,
    SPLIT,
    padded,
    product,
    swept,
    tile,
    times,
    transposed_times,
)

ITERATIONS, SIZES = 20, 16
"""Most iterations, and how many step sizes each chooses from, 1, 1/2, 1/4, ..., and one between."""

DIGITS = 32.0
"""A step shorter, measured by M, than so many roundings of all that came before is the last."""

MOST_ROWS, MOST_IN_CONES = ((32, 512), (64, 128)), 64
"""Most rows of J for which there is a kernel, up to so many columns; and those with elliptic cones.

On an H100 with other work, 275 rows of a hand's contacts, in 1,600 states, take 26 ms in the kernel
and 70 ms as arrays; 72 rows of Spot's cones, in 8,960 states, 90 and 65 ms."""

MOST_OF_ONE_WARP = 64
"""Rows of J up to which one warp of 32 threads works on a row: no threads wait for others. Four do
for more, and with elliptic cones, for which the registers of one are too few."""


class Constraints(NamedTuple):
    """M (nv, nv), J (m, nv), D and aref (m,), a0 (nv,).

    s'(y) = D clip(y, lower, upper), all (m,). What holds to both sides has no bounds; contacts and
    limits, which only push, have upper = 0; dry friction has the y at which it slides. Rows of
    elliptic friction cones have D = 0.
    """

    M: Array
    J: Array
    D: Array
    aref: Array
    lower: Array
    upper: Array
    a0: Array
    cones: elliptic.Cones | None = None


def law(given: Constraints, y: Array) -> tuple[Array, Array]:
    """-s'(y) and s''(y) of y = J a - aref, (..., m), without cones."""
    clipped = jnp.clip(y, given.lower, given.upper)
    return -given.D * clipped, jnp.where(clipped == y, given.D, 0.0)


def changes(given: Constraints, y: Array, h: Array) -> tuple[Array, Array]:
    """s(y + h) - s(y) - s'(y) h and s'(y + h) - s'(y), (..., m), without cones."""
    later = y + h
    here, there = (jnp.clip(a, given.lower, given.upper) for a in (y, later))
    moved = jnp.where((here == y) & (there == later), h, there - here)
    return given.D * moved * (later - there + 0.5 * moved), given.D * moved


def forces(given: Constraints, y: Array) -> Array:
    """-s'(y), (m,), of cones too."""
    return _forces(given, None if given.cones is None else _total(given.cones), y)[0]


def hessian(given: Constraints, y: Array, product: Callable[..., Array] = jnp.matmul) -> Array:
    """M + J' s''(y) J, (nv, nv)."""
    _, active = law(given, y)
    bent = given.J * active[:, None]
    if given.cones is not None:
        at = elliptic.place(given.cones, _total(given.cones), y)
        bent = bent + product(elliptic.curvature(given.cones, at), given.J)
    return given.M + product(bent.T, given.J)


def _total(cones: elliptic.Cones) -> elliptic.Total:
    return partial(times, elliptic.together(cones))


def _forces(
    given: Constraints, total: elliptic.Total | None, y: Array
) -> tuple[Array, elliptic.Place | None]:
    """-s'(y), and where cones are."""
    push, _ = law(given, y)
    if given.cones is None or total is None:
        return push, None
    at = elliptic.place(given.cones, total, y)
    return push + elliptic.forces(given.cones, at), at


def _line(
    given: Constraints,
    total: elliptic.Total | None,
    at: elliptic.Place | None,
    y: Array,
    h: Array,
) -> Callable[[Array], tuple[Array, Array]]:
    """size, (..., 1) or () -> `changes` from y to y + size h, with those of cones."""
    cones = given.cones
    if cones is None or total is None or at is None:
        return lambda size: changes(given, y, size * h)
    of_cones = partial(elliptic.changes, cones, at, elliptic.ray(cones, total, at, h))

    def both(size: Array) -> tuple[Array, Array]:
        pairs = zip(changes(given, y, size * h), of_cones(size), strict=True)
        change, rise = (a + b for a, b in pairs)
        return change, rise

    return both


def iterated(
    given: Constraints, product: Callable[..., Array], newton: Callable[..., Any], left: Any
) -> tuple[Array, Any]:
    """The minimum (nv,), and what the last iteration left of its Hessian there.

    Args:
        product: of two matrices.
        newton: newton(H, g) -> H^{-1} g, and what is left of H.
        left: an array like what is left, or None.
    """
    M, J, a0 = given.M, given.J, given.a0
    eps, sizes = jnp.finfo(a0.dtype).eps, jnp.exp2(-lax.iota(jnp.int32, SIZES).astype(a0.dtype))
    total = None if given.cones is None else _total(given.cones)

    def iteration(carry: Any) -> Any:
        count, _, *here, nothing, _ = carry
        _, rest, y = here
        push, at = _forces(given, total, y)
        pull = transposed_times(J, push)
        gradient = rest - pull
        direction, left = newton(hessian(given, y, product), gradient)
        along = direction, times(M, direction), times(J, direction)
        first, second = jnp.sum(gradient * direction), jnp.sum(direction * along[1])

        line = _line(given, total, at, y, -along[2])

        def tried(sizes: Array, each: Array) -> tuple[Array, Array]:
            """Change of what is minimized by steps of these sizes, and its slope there."""
            of_rows, rise = line(each)
            change = nothing + sizes * (0.5 * sizes * second - first) + jnp.sum(of_rows, axis=-1)
            return change, sizes * second - first - jnp.sum(rise * along[2], axis=-1)

        change, slope = tried(sizes, sizes[:, None])
        size, least = _level(sizes, slope, -first), jnp.min(change)
        between, _ = tried(size, size)
        on_ladder = jnp.max(jnp.where(change == least, sizes, 0.0))
        inside = between < least
        size, least = jnp.where(inside, size, on_ladder), jnp.where(inside, between, least)
        lost = eps * jnp.sum(jnp.abs(direction) * (jnp.abs(rest) + jnp.abs(pull)))
        size = jnp.where(-least > lost, size, 0.0)
        unfinished = -least > jnp.maximum(lost, (DIGITS * eps) ** 2 * jnp.sum(here[0] * rest))
        moved = (a - size * d for a, d in zip(here, along, strict=True))
        return count + 1, unfinished, *moved, 0.0 * least, left

    none = jnp.zeros_like(a0)
    # Without a number that is carried on, the compiler of kernels crashes; this one stays 0
    begin = 0, True, none, none, times(J, a0) - given.aref, jnp.zeros((), a0.dtype), left
    end = lax.while_loop(lambda c: (c[0] < ITERATIONS) & c[1], iteration, begin)
    return a0 + end[2], end[-1]


def _level(sizes: Array, slopes: Array, slope: Array) -> Array:
    """Where a convex function's slope is about 0, from those at 0 and at falling sizes (n,)."""
    rises = slopes > 0.0
    far = jnp.min(jnp.where(rises, sizes, 2.0))
    near = jnp.max(jnp.where(rises, 0.0, sizes))
    at_far = jnp.sum(jnp.where(sizes == far, slopes, 0.0))
    at_near = jnp.where(near > 0.0, jnp.sum(jnp.where(sizes == near, slopes, 0.0)), slope)
    bracketed = at_far > at_near
    share = -at_near / jnp.where(bracketed, at_far - at_near, 1.0)
    return jnp.where(bracketed & (far < 2.0), near + share * (far - near), 1.0)


def _plain(given: Constraints) -> tuple[Array, Array]:
    def newton(H: Array, gradient: Array) -> tuple[Array, Array]:
        factor = cholesky(symmetric(H))
        return solve(factor, gradient), factor

    return iterated(given, jnp.matmul, newton, jnp.zeros_like(given.M))


def _hessian_at(given: Constraints, a: Array) -> Array:
    """The Hessian at a, symmetric to the last bit."""
    return symmetric(hessian(given, times(given.J, a) - given.aref))


def _all_rows(has_rows: tuple[bool, ...], given: Constraints) -> tuple[Array, Array]:
    given = repeated(has_rows, given)
    rows, nv = given.J.shape[-2:]
    most = max((m for columns, m in MOST_ROWS if nv <= columns), default=0)
    most = most if given.cones is None else min(most, MOST_IN_CONES)
    fits = rows <= most and given.M.dtype == np.float32
    plain = jax.vmap(_plain)
    if not (on_gpu() and fits and of_one_precision(jax.tree.leaves(given))):
        return plain(given)

    def kernel(given: Constraints) -> tuple[Array, Array]:
        a = minima(given)
        H = jax.vmap(_hessian_at)(given, a)
        small = nv <= positive_matrices.MAX_SIZE
        return a, positive_matrices.factors(H) if small else jax.vmap(cholesky)(H)

    found: tuple[Array, Array] = lax.platform_dependent(given, cuda=kernel, default=plain)
    return found


constrained_minimum = merged_vmaps(_plain, _all_rows)
"""The acceleration (nv,), and the lower Cholesky factor of the Hessian there, (nv, nv)."""


def minima(given: Constraints, interpret: bool = False) -> Array:
    """The accelerations (rows, nv) by the kernel; every array leads with the axis of rows."""
    m, n = given.J.shape[-2:]
    M, N = tile(m), tile(n)
    shapes = (N, N), (M, N), (M,), (M,), (M,), (M,), (N,)
    arrays = [padded(a, *shape) for a, shape in zip(given[:-1], shapes, strict=True)]
    arrays += [padded(a, M) for a in given.cones or ()]
    precision = lax.Precision.HIGHEST if interpret else SPLIT
    body = partial(_body, n, partial(product, precision=precision))
    alone = M <= MOST_OF_ONE_WARP if given.cones is None else M == LEAST
    found = block_for_each_row(
        body, {"a": (len(arrays[0]), N)}, arrays, 1 if alone else 4, interpret
    )
    return found["a"][:, :n]


def _body(n: int, product: Callable[..., Array], *refs: Any) -> None:
    """One row."""
    *inputs, out = refs
    M, J, D, aref, lower, upper, a0, *of_cones = (ref[0] for ref in inputs)
    cones = elliptic.Cones(*of_cones) if of_cones else None
    given = Constraints(M, J, D, aref, lower, upper, a0, cones)

    def newton(H: Array, gradient: Array) -> tuple[Array, None]:
        return -times(swept(H, n), gradient), None

    out[0], _ = iterated(given, product, newton, None)
