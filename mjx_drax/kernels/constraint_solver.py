"""Accelerations under constraints: Newton's method, for each row.

The acceleration a minimizes

    1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - aref_i)

where s_i'(y) is D y, clipped where a contact or a limit opens, y > 0, or where dry friction slides;
`elliptic_cones` has the s of elliptic friction cones. Without these the function is piecewise
quadratic: once the constraints that are active stay the same, a full step ends at the minimum;
before, a shorter one may be better. On GPUs one kernel does all iterations of a row, in a block of
threads: that of `constraints_cuda`, or, where it serves none, in float32, that of `minima`.

Forces may be larger than what they leave over by more digits than numbers have. So only changes of
the function are computed, and M a0, which is the sum of all other forces, is never taken from M a.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels import constraints_cuda
from mjx_drax.kernels import elliptic_cones as elliptic
from mjx_drax.kernels.batching import (
    block_for_each_row,
    merged_vmaps,
    of_one_precision,
    on_gpu,
    repeated,
)
from mjx_drax.kernels.constraints_cuda import DIGITS, DIMS, ITERATIONS, SIZES, rows_of_cones
from mjx_drax.kernels.linalg import solve_positive, symmetric
from mjx_drax.kernels.tiles import LEAST, padded, products, swept, tile, times, transposed_times

MOST_ROWS, MOST_WITH_CONES = ((32, 512), (64, 128)), 128
"""Most rows of J, in tiles, for which there is a kernel, up to so many columns; and with cones.

Beyond, arrays are used: nobody has measured the kernel there.
On an H100, 275 rows of a hand's contacts, in 1,600 states, take 26 ms in the kernel and 70 ms as
arrays; 72 rows of Spot's elliptic cones, in 8,960 states, 5.6 and 21 ms."""

MOST_OF_ONE_WARP = 64
"""Rows of J, in tiles, up to which one warp of 32 threads works on a state: none waits for others.
Four do for more, for which the registers of one are too few."""


class Constraints(NamedTuple):
    """M (nv, nv), J (m, nv), D and aref (m,), a0 (nv,).

    s'(y) = D clip(y, lower, upper), all (m,). What holds to both sides has no bounds; contacts and
    limits, which only push, have upper = 0; dry friction has the y at which it slides. Elliptic
    friction cones have rows of their own.
    """

    M: Array
    J: Array
    D: Array
    aref: Array
    lower: Array
    upper: Array
    a0: Array
    cones: tuple[elliptic.Cones, ...] = ()


Rows = tuple[Array, ...]
"""Of the rows of `law`, (m,), then of each of the cones, (d, c)."""


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


def excess(given: Constraints, a: Array) -> Rows:
    """y = J a - aref."""
    pairs = zip(_turned(given, a), (given.aref, *(c.aref for c in given.cones)), strict=True)
    return tuple(turned - aref for turned, aref in pairs)


def _turned(given: Constraints, a: Array) -> Rows:
    """J a."""
    return (times(given.J, a), *(jnp.sum(c.J * a[None, None, :], axis=-1) for c in given.cones))


def forces(given: Constraints, y: Rows) -> Rows:
    """-s'(y)."""
    return _forces(given, y)[0]


def _forces(given: Constraints, y: Rows) -> tuple[Rows, list[elliptic.Place]]:
    """-s'(y), and where cones are."""
    at = _places(given, y)
    pushes = [elliptic.forces(*each) for each in zip(given.cones, at, strict=True)]
    return (law(given, y[0])[0], *pushes), at


def _places(given: Constraints, y: Rows) -> list[elliptic.Place]:
    return [elliptic.place(*each) for each in zip(given.cones, y[1:], strict=True)]


def pulled(given: Constraints, push: Rows) -> Array:
    """J' times forces, (nv,)."""
    found = transposed_times(given.J, push[0])
    for cones, each in zip(given.cones, push[1:], strict=True):
        found = found + jnp.sum(jnp.sum(cones.J * each[:, :, None], axis=0), axis=0)
    return found


def hessian(given: Constraints, y: Rows, product: Callable[..., Array] = jnp.matmul) -> Array:
    """M + J' s''(y) J, (nv, nv)."""
    _, active = law(given, y[0])
    found = given.M + product((given.J * active[:, None]).T, given.J)
    for cones, at in zip(given.cones, _places(given, y), strict=True):
        by_row = [J.reshape(-1, J.shape[-1]) for J in (elliptic.curved(cones, at), cones.J)]
        found = found + product(by_row[0].T, by_row[1])
    return found


def _line(
    given: Constraints, at: list[elliptic.Place], y: Rows, h: Rows
) -> Callable[[Array], tuple[Array, Array]]:
    """size, (...,) -> sums of `changes` from y to y + size h, and their slopes, (...,)."""
    rays = [elliptic.ray(*each) for each in zip(given.cones, at, h[1:], strict=True)]

    def line(size: Array) -> tuple[Array, Array]:
        by_row, rise = changes(given, y[0], size[..., None] * h[0])
        change, slope = jnp.sum(by_row, axis=-1), jnp.sum(rise * h[0], axis=-1)
        for cones, place, ray, along in zip(given.cones, at, rays, h[1:], strict=True):
            by_contact, rise = elliptic.changes(cones, place, ray, size)
            change = change + jnp.sum(by_contact, axis=-1)
            slope = slope + jnp.sum(jnp.sum(rise * along, axis=-1), axis=-1)
        return change, slope

    return line


def iterated(
    given: Constraints,
    product: Callable[..., Array],
    newton: Callable[[Array, Array], Array],
    keeps: bool,
) -> tuple[Array, Any]:
    """The minimum (nv,), and if it `keeps` it, the Hessian of the last iteration, else None.

    Args:
        product: of two matrices.
        newton: newton(H, g) -> H^{-1} g.
    """
    M, a0 = given.M, given.a0
    eps, sizes = jnp.finfo(a0.dtype).eps, jnp.exp2(-lax.iota(jnp.int32, SIZES).astype(a0.dtype))

    def iteration(carry: Any) -> Any:
        count, _, *here, nothing, _ = carry
        _, rest, *ys = here
        y = tuple(ys)
        push, at = _forces(given, y)
        pull = pulled(given, push)
        gradient = rest - pull
        H = hessian(given, y, product)
        direction = newton(H, gradient)
        turns = _turned(given, direction)
        along = direction, times(M, direction), *turns
        first, second = jnp.sum(gradient * direction), jnp.sum(direction * along[1])

        line = _line(given, at, y, tuple(-each for each in turns))

        def tried(sizes: Array) -> tuple[Array, Array]:
            """Change of what is minimized by steps of these sizes, and its slope there."""
            change, slope = line(sizes)
            change = nothing + sizes * (0.5 * sizes * second - first) + change
            return change, sizes * second - first + slope

        change, slope = tried(sizes)
        size, least = _where_flat(sizes, slope, -first), jnp.min(change)
        between, _ = tried(size)
        on_ladder = jnp.max(jnp.where(change == least, sizes, 0.0))
        inside = between < least
        size, least = jnp.where(inside, size, on_ladder), jnp.where(inside, between, least)
        lost = eps * jnp.sum(jnp.abs(direction) * (jnp.abs(rest) + jnp.abs(pull)))
        size = jnp.where(-least > lost, size, 0.0)
        unfinished = -least > jnp.maximum(lost, (DIGITS * eps) ** 2 * jnp.sum(here[0] * rest))
        moved = (a - size * d for a, d in zip(here, along, strict=True))
        return count + 1, unfinished, *moved, 0.0 * least, H if keeps else None

    none, kept = jnp.zeros_like(a0), M if keeps else None
    # Without a number that is carried on, the compiler of kernels crashes; this one stays 0
    begin: Any = 0, True, none, none, *excess(given, a0), jnp.zeros((), a0.dtype), kept
    end = lax.while_loop(lambda c: (c[0] < ITERATIONS) & c[1], iteration, begin)
    return a0 + end[2], end[-1]


def _where_flat(sizes: Array, slopes: Array, slope: Array) -> Array:
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
    a, H = iterated(given, jnp.matmul, solve_positive, keeps=True)
    return a, symmetric(H)


def _hessian_at(given: Constraints, a: Array) -> Array:
    """The Hessian at a, symmetric to the last bit."""
    return symmetric(hessian(given, excess(given, a)))


def _all_rows(has_rows: tuple[bool, ...], given: Constraints) -> tuple[Array, Array]:
    given = repeated(has_rows, given)
    plain, by_kernel = jax.vmap(_plain), _kernel_for(given)
    if by_kernel is None:
        return plain(given)

    def kernel(given: Constraints) -> tuple[Array, Array]:
        a = by_kernel(given)
        return a, jax.vmap(_hessian_at)(given, a)

    found: tuple[Array, Array] = lax.platform_dependent(given, cuda=kernel, default=plain)
    return found


constrained_minimum = merged_vmaps(_plain, _all_rows)
"""The acceleration (nv,), and the Hessian there, (nv, nv)."""


def _kernel_for(given: Constraints) -> Callable[[Constraints], Array] | None:
    """What finds the accelerations of all rows on this GPU; None: arrays do."""
    if not (on_gpu() and of_one_precision(jax.tree.leaves(given))):
        return None
    nv = given.J.shape[-1]
    by_dim = {cones.aref.shape[1]: cones.aref.shape[2] for cones in given.cones}
    if by_dim.keys() <= set(DIMS):
        contacts = tuple(by_dim.get(dim, 0) for dim in DIMS)
        rows = max(given.J.shape[1], 1) + rows_of_cones(contacts)
        if constraints_cuda.serves(rows, nv, given.J.dtype.itemsize, contacts):
            return partial(_by_cuda, contacts)
    most = max((m for columns, m in MOST_ROWS if nv <= columns), default=0)
    most = min(most, MOST_WITH_CONES) if given.cones else most
    return minima if _rows(given) <= most and given.M.dtype == np.float32 else None


def _by_cuda(contacts: constraints_cuda.Counts, given: Constraints) -> Array:
    """The accelerations (rows, nv) by `constraints_cuda`."""
    if not given.D.shape[1]:  # it wants a row without a cone; this one does nothing
        none = jnp.zeros_like(given.a0[:, :1])
        law = given._replace(J=jnp.zeros_like(given.M[:, :1]), D=none, aref=none)
        given = law._replace(lower=none, upper=none)
    if not given.cones:
        return constraints_cuda.minima(given[:-1])
    cones = sorted(given.cones, key=lambda cones: cones.aref.shape[1])

    def by_contact(arrays: list[Array]) -> Array:
        """Rows (rows, d, c, ...), contact by contact."""
        flat = [jnp.swapaxes(a, 1, 2).reshape(len(a), -1, *a.shape[3:]) for a in arrays]
        return jnp.concatenate(flat, axis=1)

    J = jnp.concatenate([given.J, by_contact([c.J for c in cones])], axis=1)
    aref = jnp.concatenate([given.aref, by_contact([c.aref for c in cones])], axis=1)
    more = [by_contact([c.scale for c in cones])]
    more += [jnp.concatenate(a, axis=1) for a in ([c.mu for c in cones], [c.weight for c in cones])]
    return constraints_cuda.minima([*given._replace(J=J, aref=aref)[:-1], *more], contacts)


def minima(given: Constraints, interpret: bool = False) -> Array:
    """The accelerations (rows, nv) by a kernel; every array leads with the axis of rows."""
    n = given.a0.shape[-1]
    tiles = jax.tree.map(lambda a: padded(a, *map(tile, a.shape[1:])), given._replace(cones=()))
    tiles = tiles._replace(cones=tuple(_tiles(cones, tile(n)) for cones in given.cones))
    arrays, tree = jax.tree.flatten(tiles)
    body = partial(_body, n, tree, products(interpret))
    warps = 1 if _rows(given) <= MOST_OF_ONE_WARP else 4
    shapes = {"a": tiles.a0.shape}
    return block_for_each_row(body, shapes, arrays, warps, interpret)["a"][:, :n]


def _rows(given: Constraints) -> int:
    """How many rows J has in tiles, with those of cones."""
    return tile(given.D.shape[-1]) + sum(math.prod(_tile(cones)) for cones in given.cones)


def _tile(cones: elliptic.Cones) -> tuple[int, int]:
    """Powers of two for d and c, and no less rows than a tile has."""
    d, c = (1 << (size - 1).bit_length() for size in cones.aref.shape[-2:])
    return d, max(c, LEAST // d)


def _tiles(cones: elliptic.Cones, columns: int) -> elliptic.Cones:
    """The cones, padded."""
    d, c = _tile(cones)
    shapes = (d, c, columns), (d, c), (d, c), (c,), (c,)
    return elliptic.Cones(*(padded(a, *shape) for a, shape in zip(cones, shapes, strict=True)))


def _body(n: int, tree: Any, product: Callable[..., Array], *refs: Any) -> None:
    """One row."""
    *inputs, out = refs
    given: Constraints = jax.tree.unflatten(tree, [ref[0] for ref in inputs])

    def newton(H: Array, gradient: Array) -> Array:
        return -times(swept(H, n), gradient)

    out[0], _ = iterated(given, product, newton, keeps=False)
