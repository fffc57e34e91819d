"""What a chain takes of a direction: line search, Metropolis test, damping, bounds' multipliers.

With Gauss-Newton the noise-free tail is sequential quadratic programming, and it is what brings
max|h| to rounding level. The step size is the one with the least L_mu, from a short geometric
ladder evaluated in one batch. Each chain adapts its damping as Levenberg and Marquardt do, less
after a full step and more after a short one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.bounds import Bounds
from mjx_drax.method.model import Multipliers, penalized
from mjx_drax.method.schedules import Weights
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory, Values

LESS_DAMPING, MORE_DAMPING, SHORT_STEP = 1 / 3, 4.0, 0.2
"""Factors on a chain's damping after a full step, and after one shorter than `SHORT_STEP`."""

DAMPING_RANGE = 1e-3, 1e3
"""Range of a chain's factor on the damping."""


@register_dataclass
@dataclass(frozen=True)
class Info:
    """Diagnostics of a chain: cost, max|h|, bound violation, residual and size, scalars.

    h holds the dynamics' defects and all constraints; inequalities count where positive. The
    residual is that of the polish, and so is the size: that of the cost, whatever constants have
    been added to it. Elsewhere both are not a number.
    """

    cost: Array
    max_defect: Array
    max_violation: Array
    residual: Array
    size: Array

    @classmethod
    def of(cls, value: Any) -> Info:
        """The same value for all of them."""
        return cls(*(value for _ in fields(cls)))


def diagnosed(problem: Problem, trajectory: Trajectory, values: Values) -> Info:
    """The diagnostics of a trajectory whose functions have these values."""
    outside = problem.plan_bounds.violation(trajectory)
    unknown = jnp.full_like(outside, jnp.nan)
    return Info(values.cost, problem.worst(values, trajectory.x), outside, unknown, unknown)


def augmented_lagrangian(
    problem: Problem,
    bounds: Any,
    trajectory: Trajectory,
    multipliers: Multipliers,
    weights: Weights,
    values: Values,
) -> Array:
    """L_mu as one term per stage, (K + 1,), of a trajectory where functions have these values.

    Two trajectories are compared by summing the differences of their terms, which keeps far more
    digits in float32 than the difference of their sums.
    """
    barrier = weights.barrier * bounds.value(problem.plan_bounds, trajectory)
    return jnp.append(barrier, 0.0) + penalized(problem, trajectory, values, multipliers, weights)


def line_search(
    problem: Problem,
    bounds: Bounds,
    old: Trajectory,
    multipliers: Multipliers,
    weights: Weights,
    drift: Trajectory,
    ladder: tuple[float, ...],
) -> tuple[Trajectory, Array, Info]:
    """X + alpha d, alpha and diagnostics, for the alpha > 0 of the ladder with the least L_mu.

    L_mu may rise by it. The ladder's last size is 0: where no other leads to finite numbers, the
    chain stands still.
    """

    def candidate(alpha: Array) -> tuple[Array, tuple[Trajectory, Array, Info]]:
        step = jax.tree.map(lambda d: alpha * d, drift)
        new = bounds.confine(problem.plan_bounds, old, problem.displaced(old, step))
        values = problem.values(new)
        merit = augmented_lagrangian(problem, bounds, new, multipliers, weights, values)
        return merit, (new, alpha, diagnosed(problem, new, values))

    sizes = jnp.asarray(ladder, old.x.dtype)
    merits, candidates = jax.vmap(candidate)(sizes)
    change = jnp.sum(merits - merits[-1], axis=1)
    worst = jnp.finfo(change.dtype).max  # standing still is the best if nothing else is finite
    change = jnp.where(sizes > 0.0, change, worst)
    best = jnp.argmin(jnp.where(jnp.isfinite(change), change, jnp.inf))
    chosen: Any = jax.tree.map(lambda z: z[best], candidates)
    return chosen


def metropolis(
    problem: Problem,
    bounds: Bounds,
    old: Trajectory,
    new: Trajectory,
    multipliers: Multipliers,
    weights: Weights,
    alpha: ArrayLike,
    drifts: tuple[Trajectory, Trajectory],
    key: Array,
) -> Trajectory:
    """`new` or `old`, so that the density exp(-L_mu / sigma^2) is kept (Metropolis and Hastings).

    The proposal is z' ~ N(z + alpha d(z), 2 alpha sigma^2 I), with d = `drifts` at the old and at
    the new knots; what leaves the box is refused.
    """
    variance = 2.0 * jnp.asarray(alpha) * weights.noise**2

    def merit(z: Trajectory) -> Array:
        values = problem.values(z)
        return augmented_lagrangian(problem, bounds, z, multipliers, weights, values)

    def log_proposal(z: Trajectory, to: Trajectory, drift: Trajectory) -> Array:
        off = jax.tree.map(lambda a, b, d: b - a - alpha * d, z, to, drift)
        return -sum(jnp.sum(jnp.square(a)) for a in jax.tree.leaves(off)) / (2.0 * variance)

    energy = jnp.sum(merit(new) - merit(old)) / weights.noise**2
    log_ratio = -energy + log_proposal(new, old, drifts[1]) - log_proposal(old, new, drifts[0])
    uniform = jax.random.uniform(jax.random.fold_in(key, 1))
    accepted = (jnp.log(uniform) < log_ratio) & (problem.plan_bounds.violation(new) == 0.0)
    return jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)


def adapted(
    problem: Problem, bounds: Bounds, old: Any, new: Any, alpha: Array, weights: Weights
) -> Any:
    """The State with the damping and bounds' multipliers that a step of size alpha leaves.

    The multipliers of bounds take Newton's step.
    """
    knots, v = (old.trajectory, new.trajectory), old.multipliers.bounds
    v = bounds.follow(problem.plan_bounds, *knots, v, weights.barrier, alpha)
    short = jnp.where(alpha < SHORT_STEP, MORE_DAMPING, 1.0)
    factor = jnp.where(alpha >= 1.0, LESS_DAMPING, short)
    damping = jnp.clip(factor * old.damping, *DAMPING_RANGE)
    return replace(new, multipliers=replace(new.multipliers, bounds=v), damping=damping)
