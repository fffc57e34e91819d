"""Chains that start from the answer of another solve: its knots, multipliers and barrier."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.method.langevin import State
from mjx_drax.method.model import Multipliers
from mjx_drax.polish.interior_point import Progress
from mjx_drax.polish.residual import products
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory
from mjx_drax.search.iterate import joined

Rows = Callable[[Array], Array]

SLACK = 1e-12
"""Least slack, as a share of a range, that a bound or an inequality has at the start."""


@register_dataclass
@dataclass(frozen=True)
class Warm:
    """Where chains stood: knots with slacks, multipliers, feedback gains; rows first."""

    knots: Trajectory
    multipliers: Multipliers
    gains: Array

    def rows(self, order: np.ndarray) -> Warm:
        """Some of the chains."""
        some: Warm = jax.tree.map(lambda a: jnp.asarray(a)[order], self)
        return some

    def of_length(self, horizon: int) -> Warm:
        """The same for another number of knots: cut off, or its last stage again and again."""
        K = self.knots.u.shape[1]
        if horizon == K:
            return self
        stage = np.minimum(np.arange(horizon), K - 1)
        longer: Warm = jax.vmap(lambda one: one.resampled(lambda a: a[stage]))(self)
        return longer

    def resampled(self, rows: Rows, after: Rows | None = None) -> Warm:
        """One chain at other stages; what belongs to none of them stays.

        Args:
            rows: makes rows for the new stages of (K, ...), which go with x_k and u_k.
            after: the same of what goes with x_{k+1}; by default `rows`.
        """
        after = rows if after is None else after

        def stages(numbers: Stagewise | None) -> Any:
            return None if numbers is None else replace(numbers, stage=rows(numbers.stage))

        def knots(z: Trajectory) -> Trajectory:
            return Trajectory(after(z.x), rows(z.u), stages(z.slack), z.start)

        multipliers, of_bounds = self.multipliers, self.multipliers.bounds
        return Warm(
            knots(self.knots),
            Multipliers(
                after(multipliers.dynamics),
                stages(multipliers.constraints),
                None if of_bounds is None else (knots(of_bounds[0]), knots(of_bounds[1])),
            ),
            rows(self.gains),
        )


def require_alike(problem: Problem, warm: Warm) -> None:
    """Complain about an answer of a problem of other sizes."""
    dynamics = problem.dynamics
    stage, end = problem.constraint, problem.terminal_constraint
    start, slack = warm.knots.start, warm.knots.slack
    slacks = (0, 0) if slack is None else (slack.stage.shape[-1], slack.terminal.shape[-1])
    for label, own, given in (
        ("free coordinates of x_0", len(problem.free), 0 if start is None else start.shape[-1]),
        ("entries of the state", dynamics.nx, warm.knots.x.shape[-1]),
        ("controls", dynamics.nu, warm.knots.u.shape[-1]),
        ("constraints of a stage", stage.rows, warm.multipliers.constraints.stage.shape[-1]),
        ("terminal constraints", end.rows, warm.multipliers.constraints.terminal.shape[-1]),
        ("inequalities of a stage", stage.inequalities, slacks[0]),
        ("terminal inequalities", end.inequalities, slacks[1]),
    ):
        if own != given:
            raise DraxError(
                f"guess is the solution of a problem with {given} {label}, and {problem.name} has "
                f"{own}: give its knots only, guess=solution.best."
            )


@jax.jit
@full_precision
def warmed(own: Any, shared: Any, states: State, warm: Warm) -> State:
    """The chains at what is warm, bounds and inequalities barely kept."""

    def one(own: Any, state: State, warm: Warm) -> State:
        problem = joined(shared, own).problem
        knots, multipliers = warm.knots, warm.multipliers
        if multipliers.bounds is None:
            multipliers = replace(multipliers, bounds=state.multipliers.bounds)
        state = replace(state, trajectory=knots, multipliers=multipliers, gains=warm.gains)
        return resumed(problem, state)

    found: State = jax.vmap(one)(own, states, warm)
    return found


def resumed(problem: Problem, state: State) -> State:
    """A chain that goes on from its knots, which keep bounds and inequalities barely.

    The barrier's weight is that of the bounds' multipliers, the mean of multiplier times slack.
    """
    knots, v = _inside(problem, state.trajectory), state.multipliers.bounds
    state = replace(state, trajectory=knots)
    if not isinstance(state.polish, Progress):
        return state
    assert v is not None  # for the type checker
    parts = jax.tree.leaves(products(problem, knots, v))
    count = sum((jnp.sum(part > 0.0) for part in parts), jnp.zeros((), int))
    total = sum((jnp.sum(part) for part in parts), jnp.zeros(()))
    rho = jnp.maximum(total / jnp.maximum(count, 1), jnp.finfo(total.dtype).tiny)
    return replace(state, polish=state.polish.again(rho))


def _inside(problem: Problem, knots: Trajectory) -> Trajectory:
    """The knots with slacks for every inequality, and a distance from every bound."""
    slack, g = knots.slack, problem.inequalities(knots)
    if g is not None and slack is None:
        slack = jax.tree.map(lambda g: jnp.maximum(-g, 0.0), g)
    knots = replace(knots, slack=slack)
    lower, upper = problem.plan_bounds.with_room().sides(knots)

    def inside(z: Array, a: Array, b: Array) -> Array:
        width = jnp.where(jnp.isfinite(b - a), b - a, 1.0)
        gap = jnp.maximum(SLACK, 4 * jnp.finfo(z.dtype).eps) * jnp.maximum(width, jnp.abs(z))
        return jnp.clip(z, a + gap, b - gap)

    return jax.tree.map(inside, knots, lower, upper)
