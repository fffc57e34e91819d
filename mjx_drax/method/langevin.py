"""Equality-constrained Langevin diffusion over state and control knots: one chain, one iteration.

While noise is on (Kurtz and Burdick, with the metric M of `metrics`):

    X      <- X + alpha d + sigma sqrt(2 alpha) n,    d = -M^{-1} grad L_mu,  n ~ N(0, M^{-1})
    lambda <- lambda + alpha r,                       r = 2 mu h  (GaussNewton: mu (h + J d))

While sigma > 0 knots leave the dynamics and wander between basins; the multipliers pull them back
onto h = 0 as sigma falls. The noise-free tail takes the step X <- X + alpha d with the alpha for
which L_mu is least (`descent`).

`init` gives the State that a chain carries, `step` moves it on and gives diagnostics. A chain that
turns non-finite is frozen where it last was finite and marked as diverged.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.kernels.conditional import all_finite, where_needed
from mjx_drax.method import descent
from mjx_drax.method.bounds import Bounds, LogBarrier
from mjx_drax.method.descent import Info
from mjx_drax.method.gauss_newton import GaussNewton
from mjx_drax.method.metrics import Direction, Metric
from mjx_drax.method.model import Model, Multipliers, expand
from mjx_drax.method.schedules import Geometric, Scale, Schedule, Weights
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory

SLACK = 1e-2
"""Smallest slack that an inequality starts with."""


@register_dataclass
@dataclass(frozen=True)
class State:
    """What a chain carries.

    Attributes:
        trajectory: knots, (K, nx) and (K, nu), and slacks.
        multipliers: lambda, of dynamics (K, ndx) and constraints, and those of bounds.
        damping: factor on delta that the tail adapts, scalar.
        gains: time-varying LQR feedback of the last factorization, (K, nu, ndx).
        memory: what the metric carries from one iteration to the next; () for most.
        key: random key.
        alive: False from the moment the chain would have turned non-finite.
        died_at: iteration at which it did, or -1.
        polish: what the polish carries; () without.
    """

    trajectory: Trajectory
    multipliers: Multipliers
    damping: Array
    gains: Array
    memory: Any
    key: Array
    alive: Array
    died_at: Array
    polish: Any = ()


@register_dataclass
@dataclass(frozen=True)
class Langevin:
    """The flow: its settings, which are traced, and its interchangeable parts.

    Attributes:
        iterations: iterations with noise.
        tail: noise-free iterations after them.
        step_size: alpha while noise is on.
        noise: schedule of sigma.
        penalty: schedule of mu.
        damping: schedule of delta, added to the diagonal of the cost's Hessian.
        barrier_weight: schedule of rho.
        scale: units of the four schedules; `Restarts` measures them.
        preconditioner: the metric M.
        bounds: how bounds are kept; a polish keeps them by a barrier of its own.
        adjusted: Metropolis-adjusted noisy steps (static; with `Identity` only): a chain without
            constraints then samples exp(-c / sigma^2) exactly, whatever the step size.
    """

    iterations: int = 100
    tail: int = 60
    step_size: ArrayLike = 0.3
    noise: Schedule = Geometric(0.3, 0.01)
    penalty: Schedule = Geometric(100.0, 1000.0, 1e4)
    damping: Schedule = Geometric(0.1, 0.1, 0.03)
    barrier_weight: Schedule = Geometric(0.1, 0.01, 1e-4)
    scale: Scale = field(default_factory=Scale)
    preconditioner: Metric = field(default_factory=GaussNewton)
    bounds: Bounds = field(default_factory=LogBarrier)
    adjusted: bool = field(default=False, metadata=Static)

    def weights(self, t: ArrayLike) -> Weights:
        """The schedules' values at progress t in [0, 2]."""
        t = jnp.asarray(t)
        cost, noise = jnp.asarray(self.scale.cost), jnp.asarray(self.scale.noise)
        return Weights(
            noise * self.noise(t),
            cost * self.penalty(t),
            cost * self.damping(t),
            cost * self.barrier_weight(t),
        )

    def init(self, problem: Problem, trajectory: Trajectory, key: Array) -> State:
        """The first state of a chain that starts at the given knots, (K, nx) and (K, nu)."""
        K, nu, ndx = problem.horizon, problem.dynamics.nu, problem.dynamics.ndx
        stage, end = problem.constraint, problem.terminal_constraint
        knots, rho = self.inside(problem, trajectory), self.weights(0.0).barrier
        return State(
            trajectory=knots,
            multipliers=Multipliers(
                jnp.zeros((K, ndx)),
                Stagewise(jnp.zeros((K, stage.rows)), jnp.zeros(end.rows)),
                self.bounds.multipliers(problem.plan_bounds, knots, rho),
            ),
            damping=jnp.ones(()),
            gains=jnp.zeros((K, nu, ndx)),
            memory=self.preconditioner.memory(problem, knots),
            key=key,
            alive=jnp.ones((), bool),
            died_at=jnp.full((), -1, int),  # not weakly typed: a second type compiles again
        )

    def inside(self, problem: Problem, trajectory: Trajectory) -> Trajectory:
        """The knots inside the bounds, with slacks that satisfy g + s = 0 where g <= 0."""
        g = problem.inequalities(trajectory)
        slack = jax.tree.map(lambda g: jnp.maximum(-g, SLACK), g)
        return self.bounds.interior(problem.plan_bounds, replace(trajectory, slack=slack))

    def step(
        self,
        problem: Problem,
        state: State,
        iteration: ArrayLike,
        tail: bool = True,
        noise: bool = True,
        moves: Array | None = None,
        mixed: bool = False,
    ) -> tuple[State, Info]:
        """One iteration, and diagnostics of where it ends; zeros from steps with noise.

        Args:
            problem: the problem.
            state: the chain.
            iteration: from 0; the schedules are read there, traced.
            tail, noise: False leaves out iterations of that kind, which must not come (static).
            moves: where this is False (traced), the chain stands still and is diagnosed.
            mixed: some chains of a batch are in the tail, some are not: both kinds of steps are
                computed for all, of one factorization (static).
        """
        iteration = jnp.asarray(iteration)
        noisy = iteration < self.iterations if noise else False
        noisy = noisy if moves is None else noisy & moves
        weights, metric = self.weights(self.progress(iteration, noisy)), self.preconditioner
        key = jax.random.fold_in(state.key, iteration)
        compute = (lambda f: f()) if moves is None else partial(where_needed, moves)
        model = compute(partial(self.model, problem, state, weights, key, tail))

        def direction(key: Array | None) -> Direction:
            return compute(lambda: metric.direction(problem, model, key, state.memory))

        shared = direction(key) if mixed else None

        def diffuse() -> tuple[State, Info]:
            to = shared or direction(key)
            return self.diffuse(problem, state, model, to, key, tail), Info.of(jnp.zeros(()))

        def descend() -> tuple[State, Info]:
            to = shared or direction(None)
            at = problem, self.bounds, state.trajectory, state.multipliers, weights
            X, alpha, info = descent.line_search(*at, to.drift, metric.ladder)
            new = self._moved(state, X, alpha, to)
            new = descent.adapted(problem, self.bounds, state, new, alpha, weights)
            return new, info

        one = diffuse if noise else descend
        new, info = jax.lax.cond(noisy, diffuse, descend) if tail and noise else one()
        return keep_finite(state, new, iteration, moves), info

    def diffuse(
        self, problem: Problem, state: State, model: Model, to: Direction, key: Array, tail: bool
    ) -> State:
        """X + alpha d + sigma sqrt(2 alpha) n, in bounds, of useful controls; lambda + alpha r."""
        alpha, X, bounds, weights = self.step_size, state.trajectory, self.bounds, model.weights
        sigma = weights.noise * jnp.sqrt(2.0 * alpha)
        change = jax.tree.map(lambda d, n: alpha * d + sigma * n, to.drift, to.noise)
        new = problem.displaced(X, change)
        if self.adjusted:
            there = self.model(problem, replace(state, trajectory=new), weights, key, tail)
            back = self.preconditioner.direction(problem, there, None, state.memory)
            chain = state.multipliers, weights, alpha, (to.drift, back.drift)
            new = descent.metropolis(problem, bounds, X, new, *chain, key)
        else:
            new = problem.with_useful_controls(bounds.confine(problem.plan_bounds, X, new))
        moved = self._moved(state, new, jnp.asarray(alpha), to)
        if not tail:
            return moved
        v = bounds.multipliers(problem.plan_bounds, new, weights.barrier)  # central, for the tail
        return replace(moved, multipliers=replace(moved.multipliers, bounds=v))

    def _moved(self, state: State, X: Trajectory, alpha: Array, to: Direction) -> State:
        """The chain at X, with lambda + alpha r."""
        size = jnp.ones_like(alpha) if self.preconditioner.full_multiplier_steps else alpha
        before = replace(state.multipliers, bounds=None)
        lambda_ = jax.tree.map(lambda m, r: m + size * r, before, to.multipliers)
        return replace(
            state,
            trajectory=X,
            multipliers=replace(lambda_, bounds=state.multipliers.bounds),
            gains=to.gains,
            memory=to.memory,
        )

    def progress(self, iteration: ArrayLike, noisy: ArrayLike) -> Array:
        """t: from 0 to 1 over the iterations with noise, from 1 to 2 over the tail."""
        into_tail = (iteration - self.iterations + 1) / jnp.maximum(self.tail, 1)
        return jnp.where(noisy, iteration / jnp.maximum(self.iterations - 1, 1), 1.0 + into_tail)

    def model(
        self, problem: Problem, state: State, weights: Weights, key: Array, tail: bool
    ) -> Model:
        """The model at the chain's knots. Bounds have multipliers of their own in the tail."""
        present = state.multipliers if tail else replace(state.multipliers, bounds=None)
        damped = replace(weights, damping=state.damping * weights.damping)
        by, key_model = self.preconditioner.derivatives, jax.random.split(key)[0]
        return expand(problem, self.bounds, state.trajectory, present, damped, by, key_model)


def keep_finite(old: State, new: State, iteration: Array, moves: Array | None) -> State:
    """The new state; the old one if the chain would turn non-finite, or does not move."""
    names = ("trajectory", "multipliers", "damping", "gains", "memory")
    before, after = ({name: getattr(state, name) for name in names} for state in (old, new))
    pairs = zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True)
    finite = all_finite([a for a, b in pairs if a is not b])
    finite = finite if moves is None else finite | ~moves
    alive = old.alive & finite
    takes = alive if moves is None else alive & moves
    kept = jax.tree.map(lambda a, b: jnp.where(takes, a, b), after, before)
    died_at = jnp.where(old.alive & ~finite, iteration, old.died_at)
    return replace(new, alive=alive, died_at=died_at, **kept)
