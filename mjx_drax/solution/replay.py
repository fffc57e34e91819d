"""Replays: what an engine that knows nothing of a solve did with the controls of its chains.

MuJoCo's C engine replays plans of models, a float64 rollout those of functions; open loop, and with
the feedback

    u_k + K_k (x_k - x_k^plan),   clipped to the control bounds,

where K is the time-varying LQR that the solver's factorization yields. A replay succeeds if it
reaches the goal and leaves the bounds by `OUTSIDE` at most; without a goal, if it ends within
`TRACKED` of the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.family import Family

TRACKED = 1e-2
"""Largest final deviation |x - plan| of a successful replay, where the problem has no goal."""

OUTSIDE = 1e-2
"""How far a replay that succeeds may leave the bounds of the states."""

OPEN_LOOP, WITH_FEEDBACK = "open loop", "with feedback"


@dataclass(frozen=True)
class Replays:
    """What the engine did with every chain's controls.

    states (chains, K+1, nx), controls (chains, K, nu), largest deviation from the plan over the
    whole motion and at its end, bound violation, cost, and whether it succeeded, (chains,) each.
    """

    states: np.ndarray
    controls: np.ndarray
    max_deviation: np.ndarray
    final_deviation: np.ndarray
    max_violation: np.ndarray
    cost: np.ndarray
    success: np.ndarray

    def summary(self, chain: int) -> dict[str, Any]:
        """One chain's numbers."""
        return {
            "max_deviation": float(self.max_deviation[chain]),
            "final_deviation": float(self.final_deviation[chain]),
            "max_violation": float(self.max_violation[chain]),
            "cost": float(self.cost[chain]),
            "success": bool(self.success[chain]),
        }


@dataclass(frozen=True)
class Certificate:
    """What happened when the best chain was replayed, open loop and with feedback."""

    engine: str
    open_loop: dict[str, Any]
    feedback: dict[str, Any]

    @property
    def success(self) -> bool:
        """Whether one of the two replays reached the goal."""
        return bool(self.open_loop["success"] or self.feedback["success"])


def replays(problem: Problem, trajectories: Trajectory, gains: np.ndarray) -> Replays:
    """Every chain's controls, applied from x_0 with the given feedback gains."""
    plan = np.asarray(problem.with_start(trajectories), float)
    ran = problem.replay(plan, trajectories.u, gains)
    return judged(problem, plan, ran, Family.of_one(problem).cost_and_violation)


def judged(
    problem: Problem,
    plan: np.ndarray,
    ran: tuple[np.ndarray, np.ndarray],
    cost_and_violation: Callable[[Trajectory], tuple[Array, Array]],
) -> Replays:
    """Replays with their costs, bound violations and successes.

    Args:
        problem: for its goal, its state arithmetic and its precision.
        plan: planned states x_0..x_K, (runs, K + 1, nx).
        ran: replayed states, of the same shape, and the controls that were applied (runs, K, nu).
        cost_and_violation: gives cost and bound violation of a batch of trajectories.
    """
    states, controls = ran
    off = np.nan_to_num(problem.dynamics.deviation(states, plan), nan=np.inf)
    dtype = problem.x_init.dtype
    knots = Trajectory(jnp.asarray(states[:, 1:], dtype), jnp.asarray(controls, dtype))
    cost, outside = cost_and_violation(knots)
    ends = zip(states[:, -1], off[:, -1], strict=True)
    reached = [_reached(problem, x, deviation) for x, deviation in ends]
    violation = np.nan_to_num(np.asarray(outside), nan=np.inf)
    return Replays(
        states=states,
        controls=controls,
        max_deviation=off.max(axis=1),
        final_deviation=off[:, -1],
        max_violation=violation,
        cost=np.asarray(cost),
        success=np.array(reached) & (violation < OUTSIDE),
    )


def _reached(problem: Problem, x: np.ndarray, deviation: float) -> bool:
    """Whether a replay that ends at x (nx,), off its plan by `deviation`, is a success."""
    if not np.isfinite(x).all():
        return False
    reached = problem.reached(x)
    return bool(deviation < TRACKED) if reached is None else reached
