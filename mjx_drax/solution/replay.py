"""Replays: what an engine that knows nothing of a solve did with the controls of its chains.

MuJoCo's C engine replays plans of models, a float64 rollout those of functions; open loop, and with
the feedback

    u_k + K_k (x_k - x_k^plan),   clipped to the control bounds,

where K is the time-varying LQR that the solver's factorization yields. A replay succeeds if it
reaches the goal, or ends as planned where there is none, and keeps all bounds and constraints,
within their tolerances; see `violations`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.problem.problem import Problem
from mjx_drax.search.family import Family
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.solution.violations import (
    DYNAMICS,
    GOAL,
    KINDS,
    STILL,
    TRACKING,
    Tolerances,
    Violation,
    Violations,
    driven_extents,
    extents,
    measured,
    scatter_widths,
)

OPEN_LOOP, WITH_FEEDBACK = "open loop", "with feedback"

FOLLOWED = 0.1
"""A replay that deviates by more than this share of the motion in any coordinate, and costs another
amount by more than this share, is another motion: with a goal it may succeed, and its plan's
residual says nothing of it."""

ROUNDING = 1e-5
"""Costs of replays, summed in float32, are alike if they differ by this share."""


@dataclass(frozen=True)
class Replays:
    """What the engine did with every chain's controls.

    states (chains, K+1, nx), controls (chains, K, nu), largest deviation from the plan over the
    whole motion and at its end, how far it leaves the bounds, cost, and whether it succeeded,
    (chains,) each; and the largest violation of each kind.
    """

    states: np.ndarray
    controls: np.ndarray
    max_deviation: np.ndarray
    final_deviation: np.ndarray
    max_violation: np.ndarray
    cost: np.ndarray
    success: np.ndarray
    violations: Violations

    def summary(self, chain: int) -> dict[str, Any]:
        """One chain's numbers."""
        return {
            "success": bool(self.success[chain]),
            "cost": float(self.cost[chain]),
            "max_deviation": float(self.max_deviation[chain]),
            "final_deviation": float(self.final_deviation[chain]),
            "max_violation": float(self.max_violation[chain]),
            "violations": self.violations.data(chain),
        }

    def outcome(self, problem: Problem, chain: int) -> str:
        """What one chain's replay came to, in words."""
        if not np.isfinite(self.max_deviation[chain]):
            return "diverges"
        broken = [v for v in self.violations.of(chain) if v.broken and v.kind != GOAL]
        if broken:
            words = max(broken, key=lambda v: v.ratio).told(problem)
            missed = self.violations.size[chain, KINDS.index(GOAL)] > 0
            return f"misses the goal and {words}" if missed else words
        words = ("misses the goal", "reaches the goal")[int(self.success[chain])]
        if problem.goal is None:
            words = ("leaves the plan", "keeps to the plan")[int(self.success[chain])]
        return f"{words}, {self.max_deviation[chain]:.1e} off plan"


@dataclass(frozen=True)
class Certificate:
    """What happened when the best chain was replayed, open loop and with feedback."""

    engine: str
    open_loop: dict[str, Any]
    feedback: dict[str, Any]

    @property
    def success(self) -> bool:
        """Whether one of the two replays reached the goal and kept all constraints."""
        return bool(self.open_loop["success"] or self.feedback["success"])


def open_loop_is_better(open_loop: Replays, feedback: Replays) -> np.ndarray:
    """Whether the replay without feedback is the better one, (chains,).

    It is if it succeeds, and the one with feedback does not or is no cheaper. Costs that differ by
    rounding count as equal.
    """
    one, other = open_loop.cost, feedback.cost
    no_cheaper = (one <= other) | np.isclose(one, other, ROUNDING, 0.0)
    return open_loop.success & (no_cheaper | ~feedback.success)


def followed(
    problem: Problem, plan: np.ndarray, cost: np.ndarray, open_loop: Replays, feedback: Replays
) -> np.ndarray:
    """Whether the better replays are the motions that were planned, (n,): in states, or in cost.

    Args:
        plan: states x_0..x_K, (n, K + 1, nx).
        cost: of the plans, (n,).
    """
    better = open_loop_is_better(open_loop, feedback)
    states = np.where(better[:, None, None], open_loop.states, feedback.states)
    replayed = np.where(better, open_loop.cost, feedback.cost)
    with np.errstate(invalid="ignore"):  # of plans that are not finite
        with problem.arithmetic():
            of_states, of_differences, _ = scatter_widths(problem)
        try:
            away, width = problem.dynamics.host_difference(states, plan), of_differences
            moves = extents(problem, plan, open_loop.controls)[1]
        except DraxError:  # loaded without the problem, whose differences are a user's own code
            away, width = states - plan, of_states
            moves = np.ptp(plan, axis=1)
        moves = np.maximum(moves, STILL * np.asarray(width))
        off = np.abs(away).max(axis=1, initial=0.0)
        most = np.maximum(np.abs(cost), np.abs(replayed))
        alike: np.ndarray = np.abs(replayed - cost) <= FOLLOWED * most
    return (off <= FOLLOWED * moves).all(axis=1) | alike


def both_ways(
    family: Family, plan: np.ndarray, u: np.ndarray, gains: np.ndarray, tolerances: Tolerances
) -> tuple[Replays, Replays, np.ndarray]:
    """Replays of plans, open loop and with feedback, and the gains that the feedback used.

    Args:
        family: one problem for each plan, or one for all.
        plan: planned states x_0..x_K, (n, K + 1, nx).
        u: planned controls, (n, K, nu).
        gains: feedback, (n, K, nu, ndx); see `Family.tracked`.
    """
    which = np.resize(np.arange(family.count), len(u))
    extent = driven_extents(family, which, plan, u)
    open_loop = family.replay(which, plan, u, 0.0 * gains)
    found = family.tracked(which, plan, u, gains)
    feedback = judged(family, plan, extent, (found.states, found.controls), tolerances)
    return judged(family, plan, extent, open_loop, tolerances), feedback, found.gains


def judged(
    family: Family,
    plan: np.ndarray,
    extent: tuple[np.ndarray, ...],
    ran: tuple[np.ndarray, np.ndarray],
    tolerances: Tolerances,
) -> Replays:
    """Replays with their costs, violations and successes.

    Args:
        family: the problems, for their functions and bounds.
        plan: planned states x_0..x_K, (n, K + 1, nx).
        extent: of the plans, which gives violations their scale; from `extents`.
        ran: replayed states and controls, of the same shapes.
    """
    problem, (states, controls) = family.at(0), ran
    off = np.nan_to_num(problem.dynamics.host_difference(states, plan), nan=np.inf)
    cost, violations = measured(family, ran, off[:, -1], extent, tolerances)
    place = KINDS.index(GOAL)
    if problem.goal is not None:
        violations.size[:, place] = ~family.reached(np.arange(len(states)), states)
        violations.allowed[:, place] = 0.0
        violations.knot[:, place] = problem.horizon
        violations.allowed[:, KINDS.index(TRACKING)] = np.nan
    return Replays(
        states=states,
        controls=controls,
        max_deviation=np.abs(off).max(axis=(1, 2), initial=0.0),
        final_deviation=np.abs(off[:, -1]).max(axis=1, initial=0.0),
        max_violation=bounds_left(violations),
        cost=cost,
        success=violations.kept & np.isfinite(states).all(axis=(1, 2)),
        violations=violations,
    )


def bounds_left(violations: Violations) -> np.ndarray:
    """How far motions leave the box of the bounds, (motions,).

    The larger distance of two: of states and of controls, each where its violation is the largest.
    """
    places = [KINDS.index(kind) for kind in ("state_bounds", "control_bounds")]
    return violations.size[:, places].max(axis=1)


def plan_violations(family: Family, plan: np.ndarray, u: np.ndarray) -> Violations:
    """Violations of plans themselves, but of the dynamics, by the default tolerances."""
    off = np.zeros((len(u), family.problem.dynamics.ndx))
    extent = driven_extents(family, np.resize(np.arange(family.count), len(u)), plan, u)
    found = measured(family, (plan, u), off, extent, Tolerances())[1]
    found.allowed[:, KINDS.index(TRACKING)] = np.nan
    return found


def largest_defect(problem: Problem, plan: np.ndarray, u: np.ndarray) -> Violation:
    """Where one plan breaks the dynamics most; see `Problem.engine_defects`."""
    off, allowed = problem.engine_defects(plan, u), FEASIBLE * np.asarray(problem.defect_unit(plan))
    knot, entry = np.unravel_index(int((off / allowed).argmax()), off.shape)
    tolerated = float(allowed[entry])
    return Violation(DYNAMICS, float(off[knot, entry]), tolerated, int(entry), int(knot))
