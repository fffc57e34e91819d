"""A plan, some time later: what model predictive control starts its next plan from."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.method.langevin import Langevin, State
from mjx_drax.polish.interior_point import Progress
from mjx_drax.polish.secant import Secant
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.warm import Warm

AHEAD = 8
"""Knots that f goes on for behind the last one; a shift by more repeats the state reached."""


def shifted(flow: Langevin, problem: Problem, by: Array, state: State) -> State:
    """One chain `by` dt later; one that had died starts anew with its multipliers.

    Where the duration is free, what is left of it has as many knots, within its new bounds.
    """
    dynamics, K = problem.dynamics, problem.horizon
    knots = state.trajectory
    start, by, ratio = _what_is_left(problem, by, knots)
    place = by + ratio * jnp.arange(K)
    place_after = by + ratio * jnp.arange(1, K + 1) - 1.0

    def between(a: Array, place: Array) -> tuple[Array, Array, Array]:
        """Rows of (n, ...) on both sides of places, and the share of the way between them."""
        low, last = jnp.floor(place).astype(jnp.int32), len(a) - 1
        return a[jnp.minimum(low, last)], a[jnp.minimum(low + 1, last)], place - low

    def rows(a: Array, place: Array = place) -> Array:
        one, two, share = between(a, place)
        return one + share.reshape(-1, *[1] * (a.ndim - 1)) * (two - one)

    own = Warm(knots, state.multipliers, state.gains)
    later = own.resampled(rows, lambda a: rows(a, place_after))
    last = problem.end.dynamics

    def ahead(i: Array, beyond: Array) -> Array:
        x = last.step(beyond[-1], knots.u[-1])
        return jnp.where(jnp.arange(AHEAD)[:, None] < i, beyond, x)

    steps = jnp.clip(jnp.ceil(by - 1e-3), 0, AHEAD).astype(jnp.int32)  # no more than are needed
    beyond = jax.lax.fori_loop(0, steps, ahead, jnp.tile(knots.x[-1], (AHEAD, 1)))
    beyond = jnp.where(jnp.isfinite(beyond), beyond, knots.x[-1])
    inside = flow.bounds.interior(
        problem.plan_bounds, Trajectory(beyond, jnp.broadcast_to(knots.u[-1], (AHEAD, dynamics.nu)))
    )
    x = jax.vmap(lambda a, b, w: dynamics.integrate(a, w * dynamics.difference(b, a)))(
        *between(jnp.concatenate([knots.x, inside.x]), place_after)
    )
    polish = state.polish
    if isinstance(polish, Progress):
        polish = replace(polish, stalled=polish.stalled | ~state.alive)
        if isinstance(polish.secant, Secant):
            secant = polish.secant  # which a plan has no time to measure
            secant = replace(secant, B=rows(secant.B), age=jnp.zeros_like(secant.age))
            polish = replace(polish, secant=secant)
    return replace(
        state,
        trajectory=dynamics.consistent(replace(later.knots, x=x, start=start)),
        multipliers=jax.tree.map(lambda m: jnp.where(state.alive, m, 0.0), later.multipliers),
        damping=jnp.where(state.alive, state.damping, 1.0),
        gains=later.gains,
        alive=jnp.ones_like(state.alive),
        died_at=jnp.full_like(state.died_at, -1),
        polish=polish,
    )


def _what_is_left(
    problem: Problem, by: Array, knots: Trajectory
) -> tuple[Array | None, Array, Array | float]:
    """`Trajectory.start` of the rest, `by` in knots of the plan, and the ratio of its step."""
    dynamics, K = problem.dynamics, problem.horizon
    if not isinstance(dynamics, Extended) or not dynamics.phases:
        return knots.start, by, 1.0
    assert knots.start is not None  # for the type checker
    assert problem.bounds.start_lower is not None
    assert problem.bounds.start_upper is not None
    step = dynamics.nominal[-1] + knots.start[-1]
    by = by * dynamics.dt / step
    low, high = problem.bounds.start_lower[-1], problem.bounds.start_upper[-1]
    gap = 1e-3 * (high - low)
    rest = jnp.clip(step * (1.0 - by / K) - dynamics.nominal[-1], low + gap, high - gap)
    return knots.start.at[-1].set(rest), by, (dynamics.nominal[-1] + rest) / step
