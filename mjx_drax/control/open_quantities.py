"""What a problem leaves open, in a loop of plans: see `MPC`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError
from mjx_drax.physics.dynamics import mjx_dynamics
from mjx_drax.problem.choices import Rates
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem

WIDTH = 0.01
"""Share of its range that stays open to a duration when its end is due."""

SAME = 1e-3
"""Share of a step below which two times are the same: those of plans may be in float32."""


def require_plannable(problem: Problem) -> None:
    """Complain about what cannot be left open while a robot runs."""
    name, dynamics = problem.name, problem.dynamics
    own = dynamics if isinstance(dynamics, Extended) else None
    if own.free if own is not None else problem.free:
        raise DraxError(
            f"{name} leaves x_0 free, and MPC starts where the robot is: give a problem without "
            "x_init_bounds."
        )
    if own is None:
        return
    mjx = mjx_dynamics(dynamics)
    if mjx is not None and mjx.numbers is not None:
        raise DraxError(
            f"{name} has model_numbers, and MPC cannot change the robot that it drives: give a "
            "problem without them, of the model that solution.parameters describe."
        )
    if len(own.phases) > 1:
        raise DraxError(
            f"{name} has {len(own.phases)} phases, and the first ends while MPC runs: give one "
            "policy for each phase, or a problem with one duration, horizon=(least, most)."
        )
    if own.phases and problem.data is not None:
        raise DraxError(
            f"{name} has data for each knot and a free duration, which MPC shortens as time "
            "passes: read knot.time in its functions instead."
        )


def is_constrained(problem: Problem) -> bool:
    """Whether plans are made by the polish: with constraints, or a free duration.

    The flow's tail leaves defects there; elsewhere it is as good, and compiles and runs faster.
    """
    dynamics = problem.dynamics
    free = isinstance(dynamics, Extended) and bool(dynamics.phases)
    return free or problem.constraint.rows + problem.terminal_constraint.rows > 0


def rate_ends(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of rates of controls [unit of u / s], lower and upper, (nu,); infinite for none."""
    low, high = (np.full(problem.dynamics.nu, end) for end in (-np.inf, np.inf))
    every = jax.tree.leaves(problem.constraint, is_leaf=lambda node: isinstance(node, Rates))
    for rates in (node for node in every if isinstance(node, Rates)):
        low[list(rates.below)] = np.asarray(rates.lower)[list(rates.below)]
        high[list(rates.above)] = np.asarray(rates.upper)[list(rates.above)]
    return low, high


def step_of(problem: Problem, states: Array) -> Array:
    """Time between the knots of a plan with the states x_0..x_K (K + 1, nx) [s]."""
    dynamics = problem.dynamics
    if isinstance(dynamics, Extended) and dynamics.phases:
        return jnp.asarray(dynamics.extras(states[0]).h[0])
    return jnp.asarray(dynamics.dt, states.dtype)


def at_present(problem: Problem, passed: Array, before: tuple[Array, Any] | None) -> Problem:
    """The problem when time `passed` [s] has gone since a policy began.

    A free duration ends within its upper bound from then, but has its least length. Rates are
    counted from the last control, `before` = (u (nu,), whether there is one); None without rates.
    """
    dynamics, box = problem.dynamics, problem.bounds
    if not isinstance(dynamics, Extended):
        return problem
    if dynamics.phases:
        assert box.start_lower is not None  # for the type checker
        assert box.start_upper is not None
        low, high = box.start_lower[-1], box.start_upper[-1]
        most = jnp.maximum(high - passed / problem.horizon, low + WIDTH * (high - low))
        start_upper = jnp.asarray(box.start_upper).at[-1].set(most)
        problem = replace(problem, bounds=replace(box, start_upper=start_upper))
    if before is not None:
        u, known = before
        problem = replace(problem, dynamics=replace(dynamics, u_init=u, starts_known=known))
    return problem


def driven(dynamics: Extended, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Planned states x'_0..x'_K (K + 1, nx) with the steps and last controls as they were driven.

    u: controls (K, nu), each for dt.
    """
    start = np.tile(np.asarray(dynamics.u_init), (2, 1))
    before = np.concatenate([start, u])[1:], np.concatenate([start, u])[:-1]
    own = dynamics.extras(x)
    h, v = np.full_like(own.h, dynamics.dt), before[: dynamics.order]
    return np.concatenate([dynamics.inner_state(x), own.w, own.p, h, *v], axis=1)


class Applied:
    """The controls that a policy gave, with their times.

    One thread may read while another one adds.
    """

    def __init__(self, dynamics: Extended) -> None:
        """There are none yet, but for the problem's u_init."""
        self._first, self._order = np.asarray(dynamics.u_init, float), dynamics.order
        self._given = [(-np.inf, self._first)] if dynamics.starts_known else []

    @property
    def any(self) -> bool:
        """Whether there is a control to count rates from."""
        return bool(self._given)

    def add(self, u: np.ndarray, t: float, since: float) -> None:
        """A control (nu,) is given at time t [s]; none before `since` will be asked for."""
        before = [entry for entry in self._given if entry[0] < t]
        old = max(0, sum(time < since for time, _ in before) - 1)
        self._given = [*before[old:], (t, u)]

    def before(self, t: float, step: float) -> np.ndarray:
        """The last controls before the times t, t - step, ... [s], (order * nu,).

        Before the first control stands the first control.
        """
        given, found = self._given, [self._first]
        for i in range(self._order):
            earlier = [u for time, u in given if time < t - (i + SAME) * step]
            found.append(earlier[-1] if earlier else found[-1])
        return np.concatenate(found[1:])
