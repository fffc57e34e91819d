"""The direction in which a chain moves: drift and noise under a choice of metric M.

    X      <- X + alpha d + sigma sqrt(2 alpha) n,      d = -M^{-1} grad L_mu,   n ~ N(0, M^{-1})
    lambda <- lambda + alpha r

L_mu(X, lambda) = c(X) + rho b(X) + lambda'h(X) + mu/2 |h(X)|^2 with the barrier b. M is held fixed
within a step; the divergence of a state-dependent metric is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import register_dataclass

from mjx_drax.barrier import LogBarrier
from mjx_drax.dynamics import Static
from mjx_drax.linearize import Linearize, autodiff
from mjx_drax.problem import Problem, Trajectory
from mjx_drax.riccati import QuadraticCost, factorize, solve_and_sample


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
class Direction:
    """One step's ingredients, in tangent space.

    Attributes:
        drift: d.
        noise: n, for sigma = 1.
        multipliers: their rate r, (K, ndx).
        gains: feedback that comes with the metric, (K, nu, ndx); zeros if none does.
    """

    drift: Trajectory
    noise: Trajectory
    multipliers: Array
    gains: Array


def augmented_lagrangian(
    problem: Problem,
    barrier: LogBarrier,
    trajectory: Trajectory,
    multipliers: Array,
    levels: Levels,
) -> Array:
    """L_mu = c + rho b + lambda'h + mu/2 |h|^2 as one term per stage, (K + 1,).

    Two trajectories are compared by summing the differences of their terms, which keeps far more
    digits in float32 than the difference of their sums.
    """
    h = problem.defects(trajectory)
    walls = barrier.value(problem.bounds, trajectory)
    stage = jax.vmap(problem.running_cost)(problem.stages(trajectory), trajectory.u)
    stage = stage + levels.barrier * walls
    stage = stage + jnp.sum(multipliers * h + 0.5 * levels.penalty * jnp.square(h), axis=1)
    return jnp.append(stage, problem.terminal_cost(trajectory.x[-1]))


@register_dataclass
@dataclass(frozen=True)
class Identity:
    """M = I: the flow of the paper as printed, with alpha = dt / 2.

    X <- X - alpha grad L_mu + sigma sqrt(2 alpha) xi,  lambda <- lambda + 2 alpha mu h.
    """

    def direction(
        self,
        problem: Problem,
        barrier: LogBarrier,
        trajectory: Trajectory,
        multipliers: Array,
        levels: Levels,
        key: Array,
    ) -> Direction:
        """Drift, noise and multiplier rate, from one reverse-mode derivative of L_mu."""

        def smooth(z: Trajectory) -> tuple[Array, Array]:
            h = problem.defects(z)
            penalized = jnp.sum(multipliers * h) + 0.5 * levels.penalty * jnp.sum(jnp.square(h))
            return problem.cost(z) + penalized, h

        slope, h = jax.grad(smooth, has_aux=True)(trajectory)
        walls, _ = barrier.derivatives(problem.bounds, trajectory)
        drift = jax.tree.map(lambda g, b: -(g + levels.barrier * b), slope, walls)
        key_x, key_u = jax.random.split(key)
        noise = Trajectory(
            jax.random.normal(key_x, trajectory.x.shape, trajectory.x.dtype),
            jax.random.normal(key_u, trajectory.u.shape, trajectory.u.dtype),
        )
        dynamics = problem.dynamics
        no_gains = jnp.zeros((problem.horizon, dynamics.nu, dynamics.ndx), h.dtype)
        return Direction(drift, noise, 2.0 * levels.penalty * h, no_gains)


@register_dataclass
@dataclass(frozen=True)
class GaussNewton:
    """M = H + mu J'J + delta I, with H the Gauss-Newton model of c plus the barrier's diagonal.

    The multipliers follow the predicted, noise-free defect: r = mu (h + J d).
    """

    linearize: Linearize = field(default=autodiff, metadata=Static)

    def direction(
        self,
        problem: Problem,
        barrier: LogBarrier,
        trajectory: Trajectory,
        multipliers: Array,
        levels: Levels,
        key: Array,
    ) -> Direction:
        """Drift, noise and multiplier rate, from one block-tridiagonal factorization."""
        model = self.linearize(problem, trajectory)
        cost = quadratic_cost(problem, barrier, trajectory, levels)
        factors = factorize(model, cost, multipliers, levels.penalty)
        dx, du, nx, nu, rate = solve_and_sample(model, factors, multipliers, levels.penalty, key)
        return Direction(Trajectory(dx, du), Trajectory(nx, nu), rate, factors.K)


@jax.jit
def feedback_gains(
    problem: Problem, barrier: LogBarrier, trajectory: Trajectory, levels: Levels
) -> Array:
    """Time-varying LQR gains (chains, K, nu, ndx) around given trajectories."""

    def gains(z: Trajectory) -> Array:
        model, cost = autodiff(problem, z), quadratic_cost(problem, barrier, z, levels)
        return factorize(model, cost, jnp.zeros_like(model.h), levels.penalty).K

    return jax.vmap(gains)(trajectory)


def quadratic_cost(
    problem: Problem, barrier: LogBarrier, trajectory: Trajectory, levels: Levels
) -> QuadraticCost:
    """Second-order model of c + rho b + delta/2 |dz|^2 at every knot."""
    dynamics = problem.dynamics
    ndx, nu = dynamics.ndx, dynamics.nu

    def running(x: Array, u: Array) -> tuple[Array, Array]:
        def at(dz: Array) -> tuple[object, Array]:
            moved = u + dz[ndx:]
            return dynamics.observe(dynamics.integrate(x, dz[:ndx]), moved), moved

        return problem.running.expand(at, ndx + nu)

    def terminal(x: Array) -> tuple[Array, Array]:
        return problem.terminal.expand(
            lambda dx: (dynamics.observe(dynamics.integrate(x, dx), jnp.zeros(nu)),), ndx
        )

    g, H = jax.vmap(running)(problem.stages(trajectory), trajectory.u)
    g_end, H_end = terminal(trajectory.x[-1])
    slope, curvature = barrier.derivatives(problem.bounds, trajectory)
    gx = jnp.concatenate([g[:, :ndx], g_end[None]]).at[1:].add(levels.barrier * slope.x)
    gu = g[:, ndx:] + levels.barrier * slope.u
    Hxx = jnp.concatenate([H[:, :ndx, :ndx], H_end[None]])
    diagonal_x = jnp.full_like(gx, levels.damping).at[1:].add(levels.barrier * curvature.x)
    diagonal_u = levels.damping + levels.barrier * curvature.u
    return QuadraticCost(
        gx,
        gu,
        Hxx + jax.vmap(jnp.diag)(diagonal_x),
        H[:, ndx:, :ndx],
        H[:, ndx:, ndx:] + jax.vmap(jnp.diag)(diagonal_u),
    )
