"""The line search of the polish: straight and bent steps of several sizes, the largest that helps.

The merit function is c - rho sum log(slacks) + sum eta |h|. A step of some size must lower it as
promised (Armijo). h, relative to its rows, may not more than double where it is above 1: a cost
without a lower bound would lead away from the constraints for ever. A step that lowers the cost as
promised may let h grow up to the `funnel`, which then narrows: the merit function alone allows but
short steps along curved constraints (Maratos 1978; a funnel: Gould and Toint 2010). So every step
is tried `bent` along the dynamics too; of two of one size that of lower merit is taken.

GPUs try all sizes of all chains at once. CPUs, and GPUs where f is `DEAR`, go from the largest to
the smallest, and chains that have found a step leave their places to those that have not.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mjx_drax.kernels.batching import merged_vmaps, on_gpu
from mjx_drax.kernels.pruning import pruned
from mjx_drax.kernels.recursion import affine_recursion
from mjx_drax.method.model import Multipliers
from mjx_drax.polish.residual import slacks_of
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

ARMIJO = 1e-4
"""Share of what is promised that a step must bring."""

LADDER = (1.0, 1 / 2, 1 / 4, 1 / 8, 1 / 32, 1 / 128)
"""Sizes of steps that are tried, as shares of the way to the boundary."""

DEAR = 1e6
"""Least chains x knots x ndx x constraint rows for which GPUs go from size to size: the work takes
their time then, and not its launches. Measured on an H200, with tasks from 0.4 to 26 million."""

INSIDE = 0.99
"""Share of the way to their bounds that controls may be moved to bend a step."""


class Ray(NamedTuple):
    """A chain and where it may go.

    Attributes:
        problem: of the chain.
        knots: where it is.
        h: defects and constraints there.
        d: the direction, in tangent space.
        reach: the largest size, up to the boundary.
        closed: A + B K of every stage, (K, ndx, ndx).
        gains: K, (K, nu, ndx).
        eta, rho: of the merit function.
        promised: changes of c - rho sum log(slacks) and of sum eta |h| for each unit of size.
        rows: scales of h.
        funnel: up to where h may grow while the cost falls.
    """

    problem: Problem
    knots: Trajectory
    h: Multipliers
    d: Trajectory
    reach: Array
    closed: Array
    gains: Array
    eta: Multipliers
    rho: Array
    promised: tuple[Array, Array]
    rows: Multipliers
    funnel: Array


class Merits(NamedTuple):
    """c - rho sum log(slacks) and sum eta |h|, a term a stage, (K + 1,), and h."""

    costs: Array
    penalties: Array
    h: Multipliers


Found = tuple[Array, Trajectory, Array]
"""The size of a step, 0 if there is none, the new knots, and whether the funnel was used."""


def line_search(ray: Ray, needed: Array) -> Found:
    """The largest step of the ladder that helps; where it is not `needed`, any or none."""

    def one(ray: Ray, needed: Array) -> Found:
        none = (False,) * len(jax.tree.leaves((ray, needed)))
        found: Found = jax.tree.map(lambda a: a[0], _all_rows(none, ray, needed))
        return found

    found: Found = merged_vmaps(one, _all_rows)(ray, needed)
    return found


def _all_rows(has_rows: tuple[bool, ...], ray: Ray, needed: Array) -> Found:
    """`line_search` of all n rows; see `merged_vmaps`."""
    arrays, tree = jax.tree.flatten(ray)
    own = has_rows[: len(arrays)]
    n = next((len(a) for a, rows in zip(arrays, own, strict=True) if rows), 1)
    of_row = jax.tree.unflatten(tree, [0 if rows else None for rows in own])
    dynamics = ray.problem.dynamics
    work = n * ray.d.u.shape[-2] * dynamics.ndx * dynamics.constraint_rows
    if jax.tree.leaves(of_row.problem) or (on_gpu() and work < DEAR):
        apart: Found = jax.vmap(_side_by_side, (of_row,), axis_size=n)(ray)
        return apart
    return _by_need(n, of_row, ray, jnp.broadcast_to(needed, (n,)))


def _side_by_side(ray: Ray) -> Found:
    """All sizes at once."""
    sizes = jnp.asarray(LADDER, ray.d.u.dtype) * ray.reach

    def tried(new: Trajectory, first: Array) -> tuple[Trajectory, Any]:
        merits = jax.vmap(partial(_merits, ray))(new)
        bent = partial(_bent, ray, new, merits.h.dynamics)
        # else XLA may bend the step once more in every thread that computes a part of f
        then = lax.optimization_barrier(lax.cond(first, bent, lambda: new))
        return then, (new, merits)

    # where f is long, as with contacts, in a loop: so it compiles once
    unroll = 1 if ray.problem.dynamics.kinked else 2
    straight = jax.vmap(partial(_straight, ray))(sizes)
    ways, merits = lax.scan(tried, straight, jnp.array([True, False]), unroll=unroll)[1]
    judged = jax.vmap(partial(_judged, ray, _here(ray)), in_axes=(0, 1))
    helps, bends, through = judged(sizes, merits)
    first = jnp.argmax(helps)
    chosen: Trajectory = jax.tree.map(lambda z: z[bends[first].astype(int), first], ways)
    return jnp.where(helps[first], sizes[first], 0.0), chosen, through[first] & helps[first]


def _by_need(n: int, of_row: Ray, ray: Ray, needed: Array) -> Found:
    """Sizes one after the other; rows that need more of them share the work of the others.

    Each stage tries n steps, straight and bent: one of each row at first, then more of those that
    are left. Rounding of a row then depends on the others, so rows of different problems do not
    share. `of_row` has 0 where arrays of the ray lead with the axis of rows, else None.
    """
    slots, count = jnp.arange(n), len(LADDER)
    ladder = jnp.asarray(LADDER, ray.d.u.dtype)

    def at(rows: Array) -> Ray:
        def taken(axis: int | None, a: Any) -> Any:
            return a if axis is None else a[rows]

        every: Ray = jax.tree.map(taken, of_row, ray, is_leaf=lambda axis: axis is None)
        return every

    def each(function: Any, rays: Ray, *more: Any) -> Any:
        in_axes = (of_row, *(0 for _ in more))
        return jax.vmap(function, in_axes, axis_size=n)(rays, *more)

    def one_bent(ray: Ray, straight: Trajectory, defects: Array) -> Trajectory:
        one = jax.tree.map(lambda a: a[None], (straight, defects))
        bent: Trajectory = jax.tree.map(lambda a: a[0], _bent(ray, *one))
        return bent

    def open_rows(ok: Array, next_size: Array) -> Array:
        return needed & ~ok & (next_size < count)

    here = each(_here, ray)

    @pruned
    def stage(carry: Any) -> Any:
        next_size, ok, found = carry
        todo = open_rows(ok, next_size)
        share = n // jnp.maximum(todo.sum(), 1)
        place, turn = slots // share, slots % share
        row = jnp.argsort(~todo, stable=True)[jnp.minimum(place, n - 1)]
        size = next_size[row] + turn
        valid = (place < todo.sum()) & (size < count)
        rays = at(row)
        sizes = ladder[jnp.minimum(size, count - 1)] * rays.reach

        def tried(new: Trajectory, first: Array) -> tuple[Trajectory, Any]:
            merits = each(_merits, rays, new)
            bent = partial(each, one_bent, rays, new, merits.h.dynamics)
            return lax.cond(first, bent, lambda: new), (new, merits)

        straight = each(_straight, rays, sizes)
        ways, merits = lax.scan(tried, straight, jnp.array([True, False]))[1]
        base = jax.tree.map(lambda a: a[row], here)
        judged = jax.vmap(_judged, in_axes=(of_row, 0, 0, 1))
        helps, bends, through = judged(rays, base, sizes, merits)
        first = jnp.full(n, n).at[row].min(jnp.where(helps & valid, slots, n))
        hit, first = first < n, jnp.minimum(first, n - 1)
        chosen = jax.tree.map(lambda z: z[bends[first].astype(int), first], ways)
        new = sizes[first], chosen, through[first]
        taken = jax.vmap(jnp.where)
        found = jax.tree.map(lambda a, b: taken(hit, a, b), new, found)
        return jnp.where(todo, next_size + share, next_size), ok | hit, found

    zero, no = jnp.zeros(n, ladder.dtype), jnp.zeros(n, bool)
    knots = jax.eval_shape(partial(each, _straight), ray, zero)
    knots = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), knots)
    begin = jnp.zeros(n, int), no, (zero, knots, no)
    found: Found = lax.while_loop(lambda now: open_rows(now[1], now[0]).any(), stage, begin)[2]
    return found


def _straight(ray: Ray, size: Array) -> Trajectory:
    """The knots after a step of some size."""
    return ray.problem.displaced(ray.knots, jax.tree.map(lambda d: size * d, ray.d))


def _bent(ray: Ray, straight: Trajectory, defects: Array) -> Trajectory:
    """Knots (n, K, ...) without most of their defects (n, K, ndx), states and controls changed.

    One Newton step from the knots to the rollout of their controls with feedback K:

        dx_{k+1} = (A_k + B_k K_k) dx_k + h_k,    du_k = K_k dx_k,    dx_0 = 0

    A second-order correction, as Maratos' effect asks for, that costs no factorization.
    """
    dx = jnp.moveaxis(affine_recursion(ray.closed, jnp.moveaxis(defects, 0, -1)), -1, 0)
    before = jnp.concatenate([jnp.zeros_like(dx[:, :1]), dx[:, :-1]], axis=1)
    du = (ray.gains @ before[..., None])[..., 0]
    here, (lower, upper) = ray.knots.u, slacks_of(ray.problem, ray.knots)
    u = jnp.clip(straight.u + du, here - INSIDE * lower.u, here + INSIDE * upper.u)
    x = jax.vmap(jax.vmap(ray.problem.dynamics.integrate))(straight.x, dx)
    return replace(straight, x=x, u=u)


def _here(ray: Ray) -> Merits:
    """Where the chain is: f is known there."""
    return _merits_of(ray, ray.knots, ray.problem.costs(ray.knots), ray.h)


def _merits(ray: Ray, knots: Trajectory) -> Merits:
    """Of knots of the chain."""
    values = ray.problem.values(knots)
    h = Multipliers(values.defects, ray.problem.with_slack(values.constraints, knots.slack))
    return _merits_of(ray, knots, values.costs, h)


def _merits_of(ray: Ray, knots: Trajectory, costs: Array, h: Multipliers) -> Merits:
    """Of knots whose costs and h are known."""
    eta, rows = ray.eta, h.constraints
    penalties = jnp.append(
        jnp.sum(eta.dynamics * jnp.abs(h.dynamics), axis=-1)
        + jnp.sum(eta.constraints.stage * jnp.abs(rows.stage), axis=-1),
        jnp.sum(eta.constraints.terminal * jnp.abs(rows.terminal)),
    )
    for slack in jax.tree.leaves(slacks_of(ray.problem, knots)):
        logs = jnp.where(jnp.isinf(slack), 0.0, jnp.log(slack))
        place = slice(None, -1) if logs.ndim > 1 else -1  # at stages, or at the end
        costs = costs.at[place].add(-ray.rho * jnp.sum(logs, axis=-1))
    return Merits(costs, penalties, h)


def _judged(ray: Ray, here: Merits, size: Array, merits: Merits) -> tuple[Array, Array, Array]:
    """Whether a step helps, straight or bent (2, ...); which does; and whether by the funnel."""
    apart = jax.vmap(partial(worst, rows=ray.rows))(merits.h)
    before = worst(here.h, ray.rows)
    cheaper = jnp.sum(merits.costs - here.costs, axis=1)
    change = cheaper + jnp.sum(merits.penalties - here.penalties, axis=1)
    eps = jnp.finfo(here.costs.dtype).eps
    rounding = 10.0 * eps * jnp.sum(jnp.abs(here.costs) + here.penalties)
    promised = ray.promised[0]
    lowers = change <= ARMIJO * size * jnp.minimum(sum(ray.promised), 0.0) + rounding
    lowers &= jnp.isfinite(change) & (apart <= jnp.maximum(2.0 * before, 1.0))
    falls = (promised < 0.0) & (cheaper <= ARMIJO * size * promised) & (apart <= ray.funnel)
    helps = lowers | falls
    change = change.at[1].add(rounding)  # to bend by rounding errors is no gain
    bent = jnp.argmin(jnp.where(helps, change, jnp.inf)[::-1]) == 0
    return helps.any(), bent, ~jnp.where(bent, lowers[1], lowers[0])


def worst(h: Multipliers, rows: Multipliers) -> Array:
    """The largest |h|, relative to the scales of its rows."""
    tiny = jnp.finfo(rows.dynamics.dtype).tiny
    shares = jax.tree.map(lambda h, s: (jnp.abs(h) / (s + tiny)).max(initial=0.0), h, rows)
    return jnp.max(jnp.stack(jax.tree.leaves(shares)))
