"""Equality-constrained Langevin diffusion over state and control knots.

One iteration of a chain (Kurtz and Burdick, with the metric M of `precondition`):

    X      <- X + alpha d + sigma sqrt(2 alpha) n,    d = -M^{-1} grad L_mu,  n ~ N(0, M^{-1})
    lambda <- lambda + alpha r,                       r = mu (h + J d)

While sigma > 0 knots leave the dynamics and wander between basins; the multipliers pull them back
onto h = 0 as sigma falls. The noise-free tail then takes the step size that lowers the augmented
Lagrangian most, from a short geometric ladder evaluated in one batch: with Gauss-Newton that is
sequential quadratic programming, and it is what brings max|h| to rounding level.

`init`, `step` and `advance` work on all chains at once. Chains never exchange numbers: a chain
that turns non-finite is frozen where it last was finite and marked as diverged.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import register_dataclass
from jax.typing import ArrayLike

from mjx_drax.barrier import LogBarrier
from mjx_drax.precondition import (
    Direction,
    GaussNewton,
    Identity,
    Levels,
    augmented_lagrangian,
)
from mjx_drax.problem import Problem, Trajectory
from mjx_drax.schedules import Constant, Geometric

FEASIBLE = 1e-3
"""Largest defect max|h| that counts as feasible."""

LADDER = (*(0.5**i for i in range(9)), 0.0)
"""Step sizes that the tail chooses from."""


@register_dataclass
@dataclass(frozen=True)
class State:
    """What every chain carries; all arrays lead with the chain axis.

    Attributes:
        trajectory: knots, (chains, K, nx) and (chains, K, nu).
        multipliers: lambda, (chains, K, ndx).
        gains: time-varying LQR feedback of the last factorization, (chains, K, nu, ndx).
        key: random key of each chain, (chains,).
        alive: False from the moment a chain would have turned non-finite, (chains,).
        died_at: iteration at which it did, or -1, (chains,).
    """

    trajectory: Trajectory
    multipliers: Array
    gains: Array
    key: Array
    alive: Array
    died_at: Array


@register_dataclass
@dataclass(frozen=True)
class Info:
    """Diagnostics of every chain: cost, max|h| and bound violation, (chains,) each."""

    cost: Array
    max_defect: Array
    max_violation: Array


@register_dataclass
@dataclass(frozen=True)
class Langevin:
    """The solver: its settings and its interchangeable parts. Every number is traced.

    Attributes:
        iterations: iterations with noise.
        tail: noise-free iterations after them.
        step_size: alpha while noise is on.
        noise: schedule of sigma.
        penalty: schedule of mu.
        damping: schedule of delta, added to the diagonal of the cost's Hessian.
        barrier_weight: schedule of rho.
        preconditioner: the metric M.
        barrier: how bounds are kept.
    """

    iterations: int = 100
    tail: int = 60
    step_size: ArrayLike = 0.3
    noise: Geometric | Constant = Geometric(0.3, 0.01)
    penalty: Geometric | Constant = Geometric(100.0, 1000.0, 1e4)
    damping: Geometric | Constant = Geometric(0.1, 0.1, 0.03)
    barrier_weight: Geometric | Constant = Geometric(0.1, 0.01, 1e-4)
    preconditioner: GaussNewton | Identity = field(default_factory=GaussNewton)
    barrier: LogBarrier = field(default_factory=LogBarrier)

    def levels(self, t: ArrayLike) -> Levels:
        """The schedules' values at progress t in [0, 2]."""
        t = jnp.asarray(t)
        return Levels(self.noise(t), self.penalty(t), self.damping(t), self.barrier_weight(t))

    def init(self, problem: Problem, trajectory: Trajectory, key: Array) -> State:
        """The first state of a batch of chains that start at the given knots.

        Args:
            problem: the problem.
            trajectory: initial knots, (chains, K, nx) and (chains, K, nu).
            key: one random key; chain c uses fold_in(key, c), so that results do not depend on how
                chains are split over calls or devices.
        """
        chains, dynamics = trajectory.x.shape[0], problem.dynamics
        K, nu, ndx = problem.horizon, dynamics.nu, dynamics.ndx
        inside = jax.vmap(self.barrier.interior, in_axes=(None, 0))(problem.bounds, trajectory)
        return State(
            trajectory=inside,
            multipliers=jnp.zeros((chains, K, ndx), inside.x.dtype),
            gains=jnp.zeros((chains, K, nu, ndx), inside.x.dtype),
            key=jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(chains)),
            alive=jnp.ones(chains, bool),
            died_at=jnp.full(chains, -1),
        )

    def step(self, problem: Problem, state: State, iteration: ArrayLike) -> State:
        """One iteration of every chain; the schedules are read at `iteration`."""
        iteration = jnp.asarray(iteration)
        noisy = iteration < self.iterations
        t = jnp.where(
            noisy,
            iteration / jnp.maximum(self.iterations - 1, 1),
            1.0 + (iteration - self.iterations + 1) / jnp.maximum(self.tail, 1),
        )
        levels = self.levels(t)

        def direction(trajectory: Trajectory, multipliers: Array, key: Array) -> Direction:
            return self.preconditioner.direction(
                problem,
                self.barrier,
                trajectory,
                multipliers,
                levels,
                jax.random.fold_in(key, iteration),
            )

        directions = jax.vmap(direction)(state.trajectory, state.multipliers, state.key)

        def diffuse(state: State) -> tuple[Trajectory, Array]:
            def move(old: Trajectory, to: Direction) -> Trajectory:
                scale = levels.noise * jnp.sqrt(2.0 * self.step_size)
                change = jax.tree.map(
                    lambda d, n: self.step_size * d + scale * n, to.drift, to.noise
                )
                return self._moved(problem, old, change)

            moved = jax.vmap(move)(state.trajectory, directions)
            return moved, jnp.broadcast_to(jnp.asarray(self.step_size), state.alive.shape)

        def descend(state: State) -> tuple[Trajectory, Array]:
            def search(
                old: Trajectory, multipliers: Array, to: Direction
            ) -> tuple[Trajectory, Array]:
                def merit(z: Trajectory) -> Array:
                    return augmented_lagrangian(problem, self.barrier, z, multipliers, levels)

                now = merit(old)

                def attempt(size: Array) -> tuple[Array, Trajectory]:
                    change = jax.tree.map(lambda d: size * d, to.drift)
                    new = self._moved(problem, old, change)
                    gain = jnp.sum(merit(new) - now)
                    worst = jnp.finfo(gain.dtype).max  # standing still: if nothing else is finite
                    gain = jnp.where(size > 0.0, gain, worst)
                    return jnp.where(jnp.isfinite(gain), gain, jnp.inf), new

                sizes = jnp.asarray(LADDER, old.x.dtype)
                gains, candidates = jax.vmap(attempt)(sizes)
                best = jnp.argmin(gains)
                return jax.tree.map(lambda z: z[best], candidates), sizes[best]

            return jax.vmap(search)(state.trajectory, state.multipliers, directions)

        trajectory, size = jax.lax.cond(noisy, diffuse, descend, state)
        multipliers = state.multipliers + size[:, None, None] * directions.multipliers
        new = replace(state, trajectory=trajectory, multipliers=multipliers, gains=directions.gains)
        return _keep_finite(state, new, iteration)

    def _moved(self, problem: Problem, old: Trajectory, change: Trajectory) -> Trajectory:
        """The knots `old` moved along a tangent `change`, kept inside the bounds."""
        x = jax.vmap(problem.dynamics.integrate)(old.x, change.x)
        return self.barrier.confine(problem.bounds, old, Trajectory(x, old.u + change.u))


def _keep_finite(old: State, new: State, iteration: Array) -> State:
    """The new state, where chains that would turn non-finite stay what they were."""

    def numbers(state: State) -> tuple[Array, ...]:
        return state.trajectory.x, state.trajectory.u, state.multipliers, state.gains

    finite = jnp.stack(
        [jnp.all(jnp.isfinite(a), axis=tuple(range(1, a.ndim))) for a in numbers(new)]
    ).all(0)
    alive = old.alive & finite
    x, u, multipliers, gains = (
        jnp.where(alive.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        for a, b in zip(numbers(new), numbers(old), strict=True)
    )
    died_at = jnp.where(old.alive & ~finite, iteration, old.died_at)
    return State(Trajectory(x, u), multipliers, gains, old.key, alive, died_at)


@jax.jit
def evaluate(problem: Problem, trajectory: Trajectory) -> Info:
    """Cost, max|h| and bound violation of a batch of trajectories."""

    def one(z: Trajectory) -> Info:
        return Info(
            problem.cost(z), jnp.max(jnp.abs(problem.defects(z))), problem.bounds.violation(z)
        )

    return jax.vmap(one)(trajectory)


@jax.jit
def advance(
    solver: Langevin, problem: Problem, state: State, start: ArrayLike, stop: ArrayLike
) -> State:
    """Iterations start..stop-1 of every chain.

    Both ends are traced: any number of iterations runs the same compiled loop, and none at all
    (start = stop) just compiles it.
    """
    return jax.lax.fori_loop(start, stop, lambda i, s: solver.step(problem, s, i), state)
