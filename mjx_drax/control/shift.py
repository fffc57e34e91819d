"""A plan, some knots later: what model predictive control starts its next plan from."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.method.langevin import Langevin, State
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory

AHEAD = 8
"""Knots that f goes on for behind the last one; a shift by more repeats the state reached."""


def shifted(flow: Langevin, problem: Problem, by: Array, state: State) -> State:
    """One chain `by` knots later; one that had died starts anew with its multipliers."""
    dynamics, K = problem.dynamics, problem.horizon
    knots, multipliers = state.trajectory, state.multipliers
    place = by + jnp.arange(K)
    low = jnp.floor(place).astype(jnp.int32)
    share = place - low

    def rows(a: Array) -> Array:
        """Rows of (K, ...) at those places, the last one repeated."""
        one, two = a[jnp.minimum(low, K - 1)], a[jnp.minimum(low + 1, K - 1)]
        return one + share.reshape(-1, *[1] * (a.ndim - 1)) * (two - one)

    last = problem.end.dynamics

    def ahead(x: Array, _: None) -> tuple[Array, Array]:
        x = last.step(x, knots.u[-1])
        return x, x

    _, beyond = jax.lax.scan(ahead, knots.x[-1], length=AHEAD)
    beyond = jnp.where(jnp.isfinite(beyond), beyond, knots.x[-1])
    inside = flow.bounds.interior(
        problem.bounds, Trajectory(beyond, jnp.broadcast_to(knots.u[-1], (AHEAD, dynamics.nu)))
    )
    x = jnp.concatenate([knots.x, inside.x])
    one, two = (x[jnp.minimum(low + i, K + AHEAD - 1)] for i in (0, 1))
    x = jax.vmap(lambda a, b, w: dynamics.integrate(a, w * dynamics.difference(b, a)))(
        one, two, share
    )

    def stages(numbers: Stagewise) -> Stagewise:
        return replace(numbers, stage=rows(numbers.stage))

    def moved(z: Trajectory) -> Trajectory:
        slack = None if z.slack is None else stages(z.slack)
        return Trajectory(rows(z.x), rows(z.u), slack)

    of_bounds = multipliers.bounds
    if of_bounds is not None:
        of_bounds = moved(of_bounds[0]), moved(of_bounds[1])
    later = replace(
        multipliers,
        dynamics=rows(multipliers.dynamics),
        constraints=stages(multipliers.constraints),
        bounds=of_bounds,
    )
    return replace(
        state,
        trajectory=replace(moved(knots), x=x),
        multipliers=jax.tree.map(lambda m: jnp.where(state.alive, m, 0.0), later),
        damping=jnp.where(state.alive, state.damping, 1.0),
        gains=rows(state.gains),
        alive=jnp.ones_like(state.alive),
        died_at=jnp.full_like(state.died_at, -1),
    )
