"""Pendulums from random states: the direct diffusion against shooting from the same controls.

Both are second-order methods with one chain for each initial state, U(-4, 4)^2, and their answers
are judged by the same rollout. The direct method is this package's default. Shooting has no states
of its own: it starts from the rollout of random controls, and each iteration follows the feedback
and the step of a Gauss-Newton model about the rollout,

    u_k <- u_k + beta k_k + K_k (x_k - x_k^old),    x_{k+1} = f(x_k, u_k),

with the beta of 1, 1/2, 1/4, ... that has the least cost (iLQR, with a barrier for the bounds
whose weight falls). Which states can be upright at all is found by dynamic programming, or by one
of the two.
"""

from __future__ import annotations

import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.bounds import LogBarrier
from mjx_drax.method.gauss_newton import GaussNewton
from mjx_drax.method.model import Multipliers, expand
from mjx_drax.method.schedules import Weights
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory
from mjx_drax.solution.batch import solve_batch
from mjx_drax.studies import random_states
from mjx_drax.studies.measurements import judge
from mjx_drax.studies.reproduce.output import Numbers, tell
from mjx_drax.view.plotting import BLUE, VERMILLION, label_axes, new_figure

FULL = {"chains": 16_384, "grid": (6001, 1401)}
"""Sizes with --full."""

BARRIER = 0.1, 1e-6
"""Weight of the barrier in shooting, at the first and at the last iteration."""

Outcome = tuple[np.ndarray, np.ndarray, np.ndarray, float]
"""Feasible, upright, cost of each state, and seconds for all."""

Carried = tuple[Trajectory, Array]
"""The rollout of a chain, and its damping."""

LADDER = (*(0.5**i for i in range(9)), 0.0)
"""Step sizes beta."""


def make(
    chains: int = 256, iterations: int | None = None, grid: tuple[int, int] = (2001, 1001)
) -> tuple[Numbers, Figure]:
    """One chain of each method for every one of `chains` initial states.

    Shooting has 300 iterations by default, where its costs have long stopped to fall. The grid of
    dynamic programming has so many angles and velocities.
    """
    problem = tasks.load("pendulum").make()
    starts = np.random.default_rng(0).uniform(-4, 4, (chains, 2)).astype(np.float32)
    tell(f"direct-against-shooting: dynamic programming on {grid[0]} x {grid[1]} states")
    best, can = random_states.values(problem, starts, grid)
    tell(f"direct-against-shooting: direct, {chains} states")
    began = time.perf_counter()
    found = solve_batch(lambda x: replace(problem, x_init=x), starts, 1)
    seconds = time.perf_counter() - began
    upright = found.open_loop.success | found.feedback.success
    direct = found.feasible, upright, found.cost, seconds
    count = iterations or 300
    tell(f"direct-against-shooting: shooting, {count} iterations in one program")
    began = time.perf_counter()
    u = np.asarray(_shoot(problem, jnp.asarray(starts), jax.random.key(0), count), float)
    seconds = time.perf_counter() - began
    replayed = judge(problem, u, starts)
    whole = np.ones(chains, bool)  # a rollout obeys the dynamics
    shooting = whole, replayed.success, replayed.cost, seconds
    can = can | upright | replayed.success  # the grid is not perfect
    rows = [_row("direct", best, can, direct), _row("shooting", best, can, shooting)]
    figure = new_figure(9.0, 3.8)
    reached = {"direct": upright, "shooting": replayed.success}
    for i, (name, good) in enumerate(reached.items()):
        axes = figure.add_subplot(1, 2, i + 1)
        for chosen, color, label in (
            (~can, "0.8", "cannot be brought upright"),
            (can & ~good, VERMILLION, "can, but is not"),
            (good, BLUE, "is brought upright"),
        ):
            axes.plot(*starts[chosen].T, "o", ms=3, color=color, label=label)
        label_axes(axes, "initial angle from upright [rad]", "initial velocity [rad/s]")
        share = (good & can).sum() / max(can.sum(), 1)
        axes.set_title(f"{name}: {share:.0%} of those that can", loc="left", fontsize=9)
        if i == 0:
            figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return {"rows": rows, "states that can be upright": float(can.mean()), "settings": {}}, figure


def _row(name: str, best: np.ndarray, can: np.ndarray, came: Outcome) -> Numbers:
    """What one method came to."""
    feasible, upright, cost, seconds = came
    close = (upright & (cost <= 1.2 * best + 1e-3))[can]
    return {
        "method": name,
        "states": len(can),
        "feasible": float(feasible.mean()),
        "upright": float(upright.mean()),
        "of those that can": float((upright & can).sum() / max(can.sum(), 1)),
        "of those, within 1.2 times dynamic programming": float(close.sum() / max(len(close), 1)),
        "time with compilation [s]": seconds,
    }


def _shoot(problem: Problem, starts: Array, key: Array, iterations: int) -> Array:
    """Controls (N, K, nu) for initial states (N, nx), after so many iterations from random ones."""
    bounds, box, metric = LogBarrier(), problem.bounds, GaussNewton()
    low, high = box.u_lower, box.u_upper
    K, ndx = problem.horizon, problem.dynamics.ndx
    none = Multipliers(jnp.zeros((K, ndx)), Stagewise(jnp.zeros((K, 0)), jnp.zeros(0)), None)

    def rollout(
        own: Problem, u: Array, step: Array, gains: Array, old: Array, beta: Array
    ) -> Trajectory:
        """A rollout that follows the old one (K + 1, nx) with feedback and a step."""

        def advance(x: Array, at: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
            u, du, gain, x_old = at
            margin = 1e-3 * (high - low)
            new = jnp.clip(u + beta * du + gain @ (x - x_old), low + margin, high - margin)
            x = own.dynamics.step(x, new)
            return x, (x, new)

        _, (x, u) = jax.lax.scan(advance, own.x_init, (u, step, gains, old[:-1]))
        return Trajectory(x, u)

    def merit(own: Problem, knots: Trajectory, rho: Array) -> Array:
        return own.cost(knots) + rho * jnp.sum(bounds.value(box, knots))

    def one(x_init: Array, key: Array) -> Array:
        own = replace(problem, x_init=x_init)
        u = jax.random.uniform(key, (K, problem.dynamics.nu), minval=low, maxval=high)
        zero = jnp.zeros_like(u), jnp.zeros((K, problem.dynamics.nu, ndx))
        states = jnp.zeros((K + 1, problem.dynamics.nx))
        first = rollout(own, 0.99 * u, *zero, states, jnp.zeros(()))

        def improve(carried: Carried, t: Array) -> tuple[Carried, None]:
            knots, delta = carried
            rho = BARRIER[0] * (BARRIER[1] / BARRIER[0]) ** t
            weights = Weights(jnp.zeros(()), jnp.full((), 1e5), delta, rho)
            model = expand(own, bounds, knots, none, weights, metric.derivatives, key)
            to = metric.direction(own, model, None, ())
            before = jnp.concatenate([jnp.zeros((1, ndx)), to.drift.x[:-1]])
            step = to.drift.u - jnp.einsum("kij,kj->ki", to.gains, before)
            old = jnp.concatenate([own.x_init[None], knots.x])

            def tried(beta: Array) -> tuple[Array, Trajectory]:
                new = rollout(own, knots.u, step, to.gains, old, beta)
                value = merit(own, new, rho)
                return jnp.where(jnp.isfinite(value), value, jnp.inf), new

            values, all_new = jax.vmap(tried)(jnp.asarray(LADDER))
            chosen = jnp.argmin(values)
            best = jax.tree.map(lambda a: a[chosen], all_new)
            stands = chosen == len(LADDER) - 1
            return (best, jnp.clip(jnp.where(stands, 4.0, 0.5) * delta, 1e-4, 1e3)), None

        at = jnp.linspace(0.0, 1.0, iterations)
        (knots, _), _ = jax.lax.scan(improve, (first, jnp.asarray(1e-2)), at)
        return knots.u

    return jax.jit(jax.vmap(one))(starts, jax.random.split(key, len(starts)))
