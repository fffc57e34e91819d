"""The augmented Lagrangian at an iterate, its gradient, and its quadratic model.

    L_mu(X, lambda) = c(X) + rho b(X) + lambda'h(X) + mu/2 |h(X)|^2

X holds the knots x_1..x_K, u_0..u_{K-1} and slack variables s of inequalities. h holds the defects
f(x_k, u_k) - x_{k+1} of the dynamics, the equality constraints, and g + s for inequalities g <= 0.
b is the barrier of the bounds. Around knots that need not be feasible,

    h_k(dz) ~ h_k + A_k dx_k + B_k du_k - dx_{k+1},     A = df/dx (ndx, ndx),  B = df/du (ndx, nu)

and costs have a positive semidefinite model of their Hessian (Gauss-Newton).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.schedules import Weights
from mjx_drax.problem.differentiators import Differentiator, without_gaps
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Knot, Stagewise, Trajectory, Values


@register_dataclass
@dataclass(frozen=True)
class Multipliers:
    """lambda of the dynamics (K, ndx) and of the constraints; v of the bounds, where followed."""

    dynamics: Array
    constraints: Stagewise
    bounds: tuple[Trajectory, Trajectory] | None = None


@register_dataclass
@dataclass(frozen=True)
class Linearization:
    """A (K, ndx, ndx), B (K, ndx, nu) and the defects h (K, ndx), all in tangent space."""

    A: Array
    B: Array
    h: Array


@register_dataclass
@dataclass(frozen=True)
class QuadraticCost:
    """Second-order model of the cost at x_0..x_K and u_0..u_{K-1}; all Hessians semidefinite.

    gx (K+1, ndx), gu (K, nu), Hxx (K+1, ndx, ndx), Hux (K, nu, ndx), Huu (K, nu, nu).
    """

    gx: Array
    gu: Array
    Hxx: Array
    Hux: Array
    Huu: Array


class Derivatives(NamedTuple):
    """Of dynamics, costs and constraints at every knot.

    Attributes:
        dynamics, cost: their models.
        stage: Jacobian of the constraints in (dx, du), (K, m, ndx + nu).
        terminal: Jacobian of the terminal constraints in dx, (m_end, ndx).
    """

    dynamics: Linearization
    cost: QuadraticCost
    stage: Array
    terminal: Array


@register_dataclass
@dataclass(frozen=True)
class Model:
    """What a metric may know of an iterate.

    Attributes:
        trajectory: the knots.
        gradient: of L_mu, in tangent space, shaped like the knots.
        h: defects (K, ndx) and constraints [equality; inequality + slack].
        multipliers: lambda, and those of bounds.
        weights: sigma, mu, delta, rho.
        barrier: gradient and diagonal curvature of rho b, shaped like the knots.
        derivatives: at every knot; None where the metric asked for none.
        start: E (ndx, n0), where x_0 = x_init + E `start` is free; else None.
    """

    trajectory: Trajectory
    gradient: Trajectory
    h: Multipliers
    multipliers: Multipliers
    weights: Weights
    barrier: tuple[Trajectory, Trajectory]
    derivatives: Derivatives | None = None
    start: Array | None = None


def expand(
    problem: Problem,
    bounds: Any,
    trajectory: Trajectory,
    multipliers: Multipliers,
    weights: Weights,
    by: Differentiator | None,
    key: Array,
) -> Model:
    """The model at a trajectory: every function differentiated by `by`, knot by knot.

    Without `by` only the gradient is made, by one reverse-mode derivative of L_mu.
    """
    present = problem.plan_bounds, trajectory, weights.barrier, multipliers.bounds
    slope, curvature = bounds.derivatives(*present)
    tangent = problem.dynamics.tangent
    barrier = replace(slope, x=tangent(slope.x)), replace(curvature, x=tangent(curvature.x))
    if by is None:

        def merit(change: Trajectory) -> Array:
            moved = problem.displaced(trajectory, change)
            return jnp.sum(penalized(problem, moved, problem.values(moved), multipliers, weights))

        gradient = jax.grad(merit)(problem.no_change(trajectory))
        slope = jax.tree.map(jnp.add, gradient, barrier[0])
        constraints = problem.with_slack(problem.constraints(trajectory), trajectory.slack)
        h = Multipliers(problem.defects(trajectory), constraints)
        return Model(trajectory, slope, h, multipliers, weights, barrier, start=problem.start_map)

    keys = jax.random.split(key, problem.horizon + 1)
    dynamics = linearize(problem, trajectory, by, keys[:-1])
    cost, stage, terminal, values = _expand_costs(problem, trajectory, by, keys)
    h = Multipliers(dynamics.h, problem.with_slack(values, trajectory.slack))
    derivatives = Derivatives(dynamics, cost, stage, terminal)
    force = jax.tree.map(lambda m, r: m + weights.penalty * r, replace(multipliers, bounds=None), h)
    E = problem.start_map
    slope = jax.tree.map(jnp.add, slope_of(derivatives, force, trajectory, E), barrier[0])
    return Model(trajectory, slope, h, multipliers, weights, barrier, derivatives, E)


def linearize(
    problem: Problem, trajectory: Trajectory, by: Differentiator, keys: Array
) -> Linearization:
    """A, B and h at every knot, with one random key for each, (K,)."""
    dynamics = problem.dynamics
    ndx, by = dynamics.ndx, dynamics.step_differentiator(by)

    def stage(x: Array, u: Array, knot: Knot, x_next: Array, key: Array) -> tuple[Array, Array]:
        f = dynamics.at(knot).step

        def defect(dz: Array) -> Array:
            moved = dynamics.integrate(x, dz[:ndx])
            return dynamics.difference(f(moved, u + dz[ndx:]), x_next)

        return by.jacobian(defect, ndx + dynamics.nu, key)

    J, h = jax.vmap(stage)(*problem.stages(trajectory), trajectory.x, keys)
    J = without_gaps(J) if dynamics.checked else J
    return Linearization(J[:, :, :ndx], J[:, :, ndx:], h)


def _expand_costs(
    problem: Problem, trajectory: Trajectory, by: Differentiator, keys: Array
) -> tuple[QuadraticCost, Array, Array, Stagewise]:
    """The costs' model, the constraints' Jacobians and their values, at every knot."""
    dynamics = problem.dynamics
    ndx, nu, by = dynamics.ndx, dynamics.nu, dynamics.differentiator(by)

    def stage(
        x: Array, u: Array, knot: Knot, key: Array
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        here = problem.at(knot)

        def moved(dz: Array) -> tuple[Any, ...]:
            return here.seen(dynamics.integrate(x, dz[:ndx]), u + dz[ndx:])

        def constrained(dz: Array) -> Array:
            return here.constraint.in_units(here.constraint(*moved(dz)))

        cost = here.running.expand(moved, ndx + nu, by, key)
        return cost, by.jacobian(constrained, ndx + nu, key)

    def end(dx: Array) -> tuple[Any, ...]:
        return problem.end.seen(dynamics.integrate(trajectory.x[-1], dx))

    (g, H), (J, values) = jax.vmap(stage)(*problem.stages(trajectory), keys[:-1])
    last = problem.end
    g_end, H_end = last.terminal.expand(end, ndx, by, keys[-1])
    at_end = last.terminal_constraint

    def constrained_end(dx: Array) -> Array:
        return at_end.in_units(at_end(*end(dx)))

    J_end, values_end = by.jacobian(constrained_end, ndx, keys[-1])
    cost = QuadraticCost(
        jnp.concatenate([g[:, :ndx], g_end[None]]),
        g[:, ndx:],
        jnp.concatenate([H[:, :ndx, :ndx], H_end[None]]),
        H[:, ndx:, :ndx],
        H[:, ndx:, ndx:],
    )
    return cost, J, J_end, Stagewise(values, values_end)


def slope_of(
    derivatives: Derivatives,
    multipliers: Multipliers,
    knots: Trajectory,
    E: Array | None,
    sign: float = -1.0,
) -> Trajectory:
    """grad c + J'lambda in tangent space; with sign = 1, of absolute values, the sum of terms."""
    dynamics, cost, stage, terminal = derivatives
    ndx, rows = dynamics.h.shape[-1], multipliers.constraints
    of_stage = jnp.einsum("kij,ki->kj", stage, rows.stage)
    gx = cost.gx.at[:-1].add(of_stage[:, :ndx])
    gx = gx.at[:-1].add(jnp.einsum("kij,ki->kj", dynamics.A, multipliers.dynamics))
    gx = gx.at[-1].add(terminal.T @ rows.terminal)
    gu = cost.gu + of_stage[:, ndx:]
    gu = gu + jnp.einsum("kij,ki->kj", dynamics.B, multipliers.dynamics)
    slack = None
    if knots.slack is not None:  # the rows of inequalities, the last ones
        slack = jax.tree.map(lambda s, r: r[..., r.shape[-1] - s.shape[-1] :], knots.slack, rows)
    start = None if E is None else gx[0] @ E
    return Trajectory(gx[1:] + sign * multipliers.dynamics, gu, slack, start)


def penalized(
    problem: Problem,
    trajectory: Trajectory,
    values: Values,
    multipliers: Multipliers,
    weights: Weights,
) -> Array:
    """c + lambda'h + mu/2 |h|^2 as one term per stage, (K + 1,)."""

    def penalty(multiplier: Array, h: Array) -> Array:
        return jnp.sum(multiplier * h + 0.5 * weights.penalty * jnp.square(h), axis=-1)

    h = problem.with_slack(values.constraints, trajectory.slack)
    running = values.costs[:-1] + penalty(multipliers.dynamics, values.defects)
    running = running + penalty(multipliers.constraints.stage, h.stage)
    terminal = values.costs[-1] + penalty(multipliers.constraints.terminal, h.terminal)
    return jnp.append(running, terminal)
