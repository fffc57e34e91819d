"""The direction in which a chain moves: drift and noise under a choice of metric M.

    X      <- X + alpha d + sigma sqrt(2 alpha) n,      d = -M^{-1} grad L_mu,   n ~ N(0, M^{-1})
    lambda <- lambda + alpha r

L_mu(X, lambda) = c(X) + rho b(X) + lambda'h(X) + mu/2 |h(X)|^2 with the barrier b, where h holds
the defects of the dynamics, equality constraints, and inequality constraints with their slack
variables, g + s = 0. M is held fixed within a step; the divergence of a state-dependent metric is
dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.bounds import LogBarrier, Projection, Reflection, Sides
from mjx_drax.method.constraints import Eliminated, eliminate, recover
from mjx_drax.method.linearize import Linearization, linearize
from mjx_drax.method.riccati import QuadraticCost, White, newton
from mjx_drax.problem.differentiators import Autodiff, Differentiator
from mjx_drax.problem.problem import Problem, Stagewise, Trajectory, Values

Bounds = LogBarrier | Projection | Reflection


@register_dataclass
@dataclass(frozen=True)
class Levels:
    """The schedules' values at one iteration: sigma, mu, delta and rho, scalars."""

    noise: Array
    penalty: Array
    damping: Array
    barrier: Array


@register_dataclass
@dataclass(frozen=True)
class Multipliers:
    """lambda of the dynamics (K, ndx) and of the constraints; v of the bounds, where followed."""

    dynamics: Array
    constraints: Stagewise
    bounds: Sides | None = None


@register_dataclass
@dataclass(frozen=True)
class Direction:
    """One step's ingredients, in tangent space.

    Attributes:
        drift: d.
        noise: n, for sigma = 1.
        multipliers: their rate r, without that of the bounds.
        gains: feedback that comes with the metric, (K, nu, ndx); zeros if none does.
        memory: what the metric wants to see again in the next iteration.
    """

    drift: Trajectory
    noise: Trajectory
    multipliers: Multipliers
    gains: Array
    memory: Any = ()


class Memoryless:
    """A metric that is made anew in every iteration, and whose multipliers step with its knots.

    `ladder` holds the step sizes that the tail chooses from, all halvings down to 1/256; the last
    one is 0, which stands still.
    """

    multipliers_step_alone = False
    ladder: tuple[float, ...] = (*(0.5**i for i in range(9)), 0.0)

    def memory(self, problem: Problem, trajectory: Trajectory) -> tuple[()]:
        """Nothing."""
        return ()


def residuals(problem: Problem, trajectory: Trajectory) -> tuple[Array, Stagewise]:
    """h: the defects (K, ndx), and the constraints [equality; inequality + slack]."""
    constraints = problem.constraints(trajectory)
    return problem.defects(trajectory), _with_slack(problem, trajectory, constraints)


def _with_slack(problem: Problem, trajectory: Trajectory, constraints: Stagewise) -> Stagewise:
    """[equality; inequality + slack], if the trajectory has slack variables."""
    slack = trajectory.slack
    return constraints if slack is None else problem.with_slack(constraints, slack)


def augmented_lagrangian(
    problem: Problem,
    bounds: Bounds,
    trajectory: Trajectory,
    multipliers: Multipliers,
    levels: Levels,
    values: Values | None = None,
) -> Array:
    """L_mu = c + rho b + lambda'h + mu/2 |h|^2 as one term per stage, (K + 1,).

    Two trajectories are compared by summing the differences of their terms, which keeps far more
    digits in float32 than the difference of their sums. A caller that knows the trajectory's values
    gives them.
    """
    walls = levels.barrier * bounds.value(problem.bounds, trajectory)
    values = problem.values(trajectory) if values is None else values
    return jnp.append(walls, 0.0) + _penalized(problem, trajectory, values, multipliers, levels)


def _penalized(
    problem: Problem,
    trajectory: Trajectory,
    values: Values,
    multipliers: Multipliers,
    levels: Levels,
) -> Array:
    """c + lambda'h + mu/2 |h|^2 as one term per stage, (K + 1,)."""

    def penalty(multiplier: Array, h: Array) -> Array:
        return jnp.sum(multiplier * h + 0.5 * levels.penalty * jnp.square(h), axis=-1)

    h = _with_slack(problem, trajectory, values.constraints)
    running = values.costs[:-1] + penalty(multipliers.dynamics, values.defects)
    running = running + penalty(multipliers.constraints.stage, h.stage)
    terminal = values.costs[-1] + penalty(multipliers.constraints.terminal, h.terminal)
    return jnp.append(running, terminal)


@register_dataclass
@dataclass(frozen=True)
class Identity(Memoryless):
    """M = I: the flow of the paper as printed, with alpha = dt / 2.

    X <- X - alpha grad L_mu + sigma sqrt(2 alpha) xi,  lambda <- lambda + 2 alpha mu h.

    The gradient is exact, from one reverse-mode derivative of L_mu in displacements of the knots;
    nothing of the Gauss-Newton machinery is computed. With sampled derivatives
    (`derivatives=Smoothed(...)`) it is assembled from J and the cost's gradient knot by knot.
    """

    derivatives: Differentiator | None = None

    def direction(
        self,
        problem: Problem,
        bounds: Bounds,
        trajectory: Trajectory,
        multipliers: Multipliers,
        levels: Levels,
        key: Array,
        memory: Any = (),
    ) -> Direction:
        """Drift, noise and multiplier rate."""
        key_noise, key_samples = jax.random.split(key)
        if self.derivatives is None:

            def merit(change: Trajectory) -> Array:
                moved = displaced(problem, trajectory, change)
                values = problem.values(moved)
                return jnp.sum(_penalized(problem, moved, values, multipliers, levels))

            slope = jax.grad(merit)(at_rest(problem, trajectory))
        else:
            model = expand(problem, trajectory, self.derivatives, key_samples)
            slope = _assembled_gradient(model, trajectory, multipliers, levels.penalty)
        walls, _ = _walls(problem, bounds, trajectory, levels.barrier)
        drift = jax.tree.map(lambda g, b: -(g + b), slope, walls)
        h = Multipliers(*residuals(problem, trajectory))
        rate = jax.tree.map(lambda c: 2.0 * levels.penalty * c, h)
        return Direction(drift, _white(drift, key_noise), rate, _no_gains(problem))


def at_rest(problem: Problem, trajectory: Trajectory) -> Trajectory:
    """The displacement of nothing: zeros in tangent space, (K, ndx) and (K, nu)."""
    still = jax.tree.map(jnp.zeros_like, trajectory)
    return replace(still, x=problem.dynamics.tangent(still.x))


def displaced(problem: Problem, trajectory: Trajectory, change: Trajectory) -> Trajectory:
    """The knots moved along a tangent `change`."""
    x = jax.vmap(problem.dynamics.integrate)(trajectory.x, change.x)
    slack = jax.tree.map(jnp.add, trajectory.slack, change.slack)
    return Trajectory(x, trajectory.u + change.u, slack)


def _walls(
    problem: Problem,
    bounds: Bounds,
    trajectory: Trajectory,
    weight: Array,
    multipliers: Sides | None = None,
) -> tuple[Trajectory, Trajectory]:
    """Gradient and curvature of the barrier, in tangent space."""
    slope, curvature = bounds.derivatives(problem.bounds, trajectory, weight, multipliers)
    tangent = problem.dynamics.tangent
    return replace(slope, x=tangent(slope.x)), replace(curvature, x=tangent(curvature.x))


def _white(trajectory: Trajectory, key: Array) -> Trajectory:
    """Standard normal numbers in the shape of a trajectory."""
    leaves, tree = jax.tree.flatten(trajectory)
    keys = jax.random.split(key, len(leaves))
    noise = [jax.random.normal(k, z.shape, z.dtype) for k, z in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(tree, noise)


def _no_gains(problem: Problem) -> Array:
    """Zero feedback gains (K, nu, ndx)."""
    return jnp.zeros((problem.horizon, problem.dynamics.nu, problem.dynamics.ndx))


@register_dataclass
@dataclass(frozen=True)
class Model:
    """Derivatives of everything at every knot, before any metric or barrier.

    Attributes:
        dynamics: A, B and h.
        cost: gradients, and semidefinite Hessians.
        stage: Jacobian of the constraints in (dx, du), (K, m, ndx + nu).
        terminal: Jacobian of the terminal constraints in dx, (m_end, ndx).
        residual: constraints [equality; inequality + slack].
    """

    dynamics: Linearization
    cost: QuadraticCost
    stage: Array
    terminal: Array
    residual: Stagewise


def expand(problem: Problem, trajectory: Trajectory, by: Differentiator, key: Array) -> Model:
    """Differentiate dynamics, costs and constraints at every knot."""
    dynamics = problem.dynamics
    ndx, nu, given, by = dynamics.ndx, dynamics.nu, by, dynamics.differentiator(by)
    keys = jax.random.split(key, problem.horizon + 1)

    def stage(x: Array, u: Array, key: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        def at(dz: Array) -> tuple[Any, Array]:
            moved = u + dz[ndx:]
            return dynamics.observe(dynamics.integrate(x, dz[:ndx]), moved), moved

        return problem.running.expand(at, ndx + nu, by, key), by.jacobian(
            lambda dz: problem.constraint(*at(dz)), ndx + nu, key
        )

    def end(dx: Array) -> tuple[Any]:
        moved = dynamics.integrate(trajectory.x[-1], dx)
        return (dynamics.observe(moved, jnp.zeros(nu)),)

    (g, H), (J, values) = jax.vmap(stage)(problem.stages(trajectory), trajectory.u, keys[:-1])
    g_end, H_end = problem.terminal.expand(end, ndx, by, keys[-1])
    J_end, values_end = by.jacobian(lambda dx: problem.terminal_constraint(*end(dx)), ndx, keys[-1])
    residual = Stagewise(values, values_end)
    residual = _with_slack(problem, trajectory, residual)
    return Model(
        dynamics=linearize(problem, trajectory, given, keys[:-1]),
        cost=QuadraticCost(
            jnp.concatenate([g[:, :ndx], g_end[None]]),
            g[:, ndx:],
            jnp.concatenate([H[:, :ndx, :ndx], H_end[None]]),
            H[:, ndx:, :ndx],
            H[:, ndx:, ndx:],
        ),
        stage=J,
        terminal=J_end,
        residual=residual,
    )


def _assembled_gradient(
    model: Model, trajectory: Trajectory, multipliers: Multipliers, penalty: Array
) -> Trajectory:
    """The gradient of c + lambda'h + mu/2 |h|^2, put together from the derivatives of a model."""
    ndx = model.dynamics.h.shape[-1]
    h = Multipliers(model.dynamics.h, model.residual)
    present = replace(multipliers, bounds=None)
    force = jax.tree.map(lambda m, r: m + penalty * r, present, h)  # lambda + mu h
    stage = jnp.einsum("kij,ki->kj", model.stage, force.constraints.stage)
    gx = model.cost.gx.at[:-1].add(stage[:, :ndx])
    gx = gx.at[-1].add(model.terminal.T @ force.constraints.terminal)
    gx = gx.at[:-1].add(jnp.einsum("kij,ki->kj", model.dynamics.A, force.dynamics))
    gu = model.cost.gu + stage[:, ndx:]
    gu = gu + jnp.einsum("kij,ki->kj", model.dynamics.B, force.dynamics)
    return Trajectory(gx[1:] - force.dynamics, gu, _slacks(trajectory, force.constraints))


def _slacks(trajectory: Trajectory, rows: Stagewise) -> Stagewise | None:
    """The rows of constraints that belong to inequalities, which have slacks."""
    slack = trajectory.slack
    if slack is None:
        return None
    return jax.tree.map(lambda s, r: r[..., r.shape[-1] - s.shape[-1] :], slack, rows)


@register_dataclass
@dataclass(frozen=True)
class Diagonal(Memoryless):
    """M = diag(H + mu J'J) + rho b'' + delta: each variable scaled by its own curvature.

    Multipliers move as in the paper's flow, r = 2 mu h.
    """

    derivatives: Differentiator = field(default_factory=Autodiff)

    def direction(
        self,
        problem: Problem,
        bounds: Bounds,
        trajectory: Trajectory,
        multipliers: Multipliers,
        levels: Levels,
        key: Array,
        memory: Any = (),
    ) -> Direction:
        """Drift, noise and multiplier rate, without any factorization."""
        key_noise, key_model = jax.random.split(key)
        model = expand(problem, trajectory, self.derivatives, key_model)
        slope = _assembled_gradient(model, trajectory, multipliers, levels.penalty)
        walls, curvature = _walls(problem, bounds, trajectory, levels.barrier, multipliers.bounds)
        M = jax.tree.map(
            lambda m, c: m + c + levels.damping,
            _diagonal(model, trajectory, levels.penalty),
            curvature,
        )
        drift = jax.tree.map(lambda g, b, m: -(g + b) / m, slope, walls, M)
        noise = jax.tree.map(lambda xi, m: xi / jnp.sqrt(m), _white(M, key_noise), M)
        h = Multipliers(model.dynamics.h, model.residual)
        rate = jax.tree.map(lambda c: 2.0 * levels.penalty * c, h)
        return Direction(drift, noise, rate, _no_gains(problem))


def _diagonal(model: Model, trajectory: Trajectory, penalty: Array) -> Trajectory:
    """The diagonal of H + mu J'J, in the shape of a trajectory."""
    ndx = model.dynamics.h.shape[-1]
    squares = jnp.sum(jnp.square(model.stage), axis=1)
    x = jnp.einsum("kii->ki", model.cost.Hxx)
    x = x.at[1:].add(penalty)  # dh_k / dx_{k+1} = -I
    x = x.at[:-1].add(penalty * (jnp.sum(jnp.square(model.dynamics.A), axis=1) + squares[:, :ndx]))
    x = x.at[-1].add(penalty * jnp.sum(jnp.square(model.terminal), axis=0))
    u = jnp.einsum("kii->ki", model.cost.Huu)
    u = u + penalty * (jnp.sum(jnp.square(model.dynamics.B), axis=1) + squares[:, ndx:])
    slack = jax.tree.map(lambda s: jnp.full_like(s, penalty), trajectory.slack)
    return Trajectory(x[1:], u, slack)


@register_dataclass
@dataclass(frozen=True)
class GaussNewton(Memoryless):
    """M = H + mu J'J + delta D, with H the Gauss-Newton model of c plus the barrier's diagonal.

    D = I, but where f has kinks states have `light` instead of 1 on its diagonal. The multipliers
    follow the predicted, noise-free residual: r = mu (h + J d).

    The ladder is short, because damping adapts: with ten sizes no more chains succeed, and the tail
    takes longer.

    Attributes:
        derivatives: of everything at a knot.
        light: damping of states where f has kinks, as a share of that of controls. A contact moves
            velocities within a knot by many times as much as positions, and knots that are damped
            like controls do not get there within an attempt; docs/models.md has the numbers.
    """

    ladder = (1.0, 1 / 2, 1 / 4, 1 / 16, 0.0)
    derivatives: Differentiator = field(default_factory=Autodiff)
    light: ArrayLike = 0.001

    def direction(
        self,
        problem: Problem,
        bounds: Bounds,
        trajectory: Trajectory,
        multipliers: Multipliers,
        levels: Levels,
        key: Array,
        memory: Any = (),
    ) -> Direction:
        """Drift, noise and multiplier rate, from one block-tridiagonal factorization."""
        key_model, key_noise, key_slack = jax.random.split(key, 3)
        model = expand(problem, trajectory, self.derivatives, key_model)
        walls = _walls(problem, bounds, trajectory, levels.barrier, multipliers.bounds)
        of_states = self.light if problem.dynamics.kinked else 1.0
        cost = _with_barrier(model.cost, *walls, levels.damping, of_states)
        slope, curvature = (
            d.slack or Stagewise(jnp.zeros((problem.horizon, 0)), jnp.zeros(0)) for d in walls
        )

        def reduce(J: Array, r: Array, nu: Array, b: Array, c: Array) -> Any:
            return eliminate(J, r, nu, b, c + levels.damping, levels.penalty)

        r, nu = model.residual, multipliers.constraints
        g, H, blocks = jax.vmap(reduce)(
            model.stage, r.stage, nu.stage, slope.stage, curvature.stage
        )
        g_end, H_end, block_end = reduce(
            model.terminal, r.terminal, nu.terminal, slope.terminal, curvature.terminal
        )
        ndx = problem.dynamics.ndx
        cost = QuadraticCost(
            cost.gx + jnp.concatenate([g[:, :ndx], g_end[None]]),
            cost.gu + g[:, ndx:],
            cost.Hxx + jnp.concatenate([H[:, :ndx, :ndx], H_end[None]]),
            cost.Hux + H[:, ndx:, :ndx],
            cost.Huu + H[:, ndx:, ndx:],
        )
        key_u, key_e = jax.random.split(key_noise)
        white = White(
            jax.random.normal(key_u, trajectory.u.shape),
            jax.random.normal(key_e, multipliers.dynamics.shape),
        )
        step = newton(model.dynamics, cost, multipliers.dynamics, levels.penalty, white)

        def back(block: Eliminated, dz: Array, nz: Array, xi: Array) -> Any:
            return recover(block, dz, nz, xi, levels.penalty)

        slack_white = (
            jax.random.normal(key_slack, blocks.D.shape),
            jax.random.normal(jax.random.fold_in(key_slack, 1), block_end.D.shape),
        )
        ds, ns, rate_stage = jax.vmap(back)(
            blocks, _stage_steps(step.dx, step.du), _stage_steps(step.nx, step.nu), slack_white[0]
        )
        ds_end, ns_end, rate_end = back(block_end, step.dx[-1], step.nx[-1], slack_white[1])
        has_slack = trajectory.slack is not None
        return Direction(
            Trajectory(step.dx, step.du, Stagewise(ds, ds_end) if has_slack else None),
            Trajectory(step.nx, step.nu, Stagewise(ns, ns_end) if has_slack else None),
            Multipliers(step.rate, Stagewise(rate_stage, rate_end)),
            step.K,
        )


def _stage_steps(dx: Array, du: Array) -> Array:
    """(dx_k, du_k) for k = 0..K-1, (K, ndx + nu), from steps of x_1..x_K; dx_0 = 0."""
    before = jnp.concatenate([jnp.zeros_like(dx[:1]), dx[:-1]])
    return jnp.concatenate([before, du], axis=1)


def _with_barrier(
    cost: QuadraticCost,
    slope: Trajectory,
    curvature: Trajectory,
    damping: Array,
    of_states: ArrayLike,
) -> QuadraticCost:
    """The model of c + rho b + delta/2 (|du|^2 + of_states |dx|^2); x_0 is fixed: no barrier."""
    diagonal_x = jnp.full_like(cost.gx, of_states * damping).at[1:].add(curvature.x)
    diagonal_u = damping + curvature.u
    return QuadraticCost(
        cost.gx.at[1:].add(slope.x),
        cost.gu + slope.u,
        cost.Hxx + jax.vmap(jnp.diag)(diagonal_x),
        cost.Hux,
        cost.Huu + jax.vmap(jnp.diag)(diagonal_u),
    )
