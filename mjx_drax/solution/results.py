"""What came of a solve: all chains, how they replay, and the distinct optima.

A cost alone says nothing, because an infeasible trajectory undercuts the optimum. So every chain's
controls are replayed from x_init; see `replay`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np

from mjx_drax.base.errors import require_positive
from mjx_drax.method.model import Multipliers
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.recording import Recording
from mjx_drax.search.restarts import Restarts
from mjx_drax.solution.optima import TOLERANCE, cluster
from mjx_drax.solution.replay import (
    OPEN_LOOP,
    OUTSIDE,
    TRACKED,
    WITH_FEEDBACK,
    Certificate,
    Replays,
)

CONVERGED, INFEASIBLE, DIVERGED = "converged", "infeasible", "diverged"


@dataclass(frozen=True, eq=False)
class Optimum:
    """A local optimum: its cheapest certified chain, and the chains that belong to it.

    Attributes:
        chain: index of the cheapest chain, which represents it.
        members: indices of all its chains, cheapest first, (members,).
        share: of all chains of the solve, those that failed included.
        cost, max_defect: of the representative.
        certificate: how the representative replays, open loop and with feedback.
        trajectory: knots of the representative, x_1..x_K (K, nx) and u_0..u_{K-1} (K, nu).
        replayed: states (K+1, nx) and controls (K, nu) of its replay: open loop where that
            succeeds, else with feedback.
    """

    chain: int
    members: np.ndarray
    share: float
    cost: float
    max_defect: float
    certificate: Certificate
    trajectory: Trajectory
    replayed: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Results:
    """All chains of a solve, what they reached, and how the answer replays. Arrays are numpy's.

    Attributes:
        problem: what was solved.
        solver: with which settings, a value for each that depended on the problem.
        seed: of the random keys.
        trajectories: knots, (chains, K, nx) and (chains, K, nu), and slacks of inequalities.
        multipliers: lambda, of dynamics (chains, K, ndx) and constraints, and those of bounds.
        gains: feedback K_k, (chains, K, nu, ndx).
        cost, max_defect, max_violation: of every chain, (chains,).
        converged_at: iteration since which max|h| < 1e-3, else -1, (chains,).
        died_at: iteration at which a chain turned non-finite and was frozen, else -1, (chains,).
        open_loop, feedback: the replays of every chain.
        history: `iteration` (records,), and `cost`, `max_defect` (records, chains) of every place
            in the batch, which in later attempts of `Restarts` hold tries for unfinished chains;
            `began` and `noise_ends` (attempts,): after how many iterations each attempt began, and
            its noise ended (the same, if it had none).
        iterations: how many were done.
        compile_time, solve_time: [s].
        engine: what replayed.
        recording: the chains' knots over the iterations, where `solve` was asked to record them.
    """

    problem: Problem
    solver: Restarts
    seed: int
    trajectories: Trajectory
    multipliers: Multipliers
    gains: np.ndarray
    cost: np.ndarray
    max_defect: np.ndarray
    max_violation: np.ndarray
    converged_at: np.ndarray
    died_at: np.ndarray
    open_loop: Replays
    feedback: Replays
    history: dict[str, np.ndarray]
    iterations: int
    compile_time: float
    solve_time: float
    engine: str
    recording: Recording | None = None

    @property
    def chains(self) -> int:
        """Number of chains."""
        return len(self.cost)

    @cached_property
    def feasible(self) -> np.ndarray:
        """Whether max|h| < 1e-3, (chains,)."""
        return (self.max_defect < FEASIBLE) & (self.died_at < 0)

    @cached_property
    def success(self) -> np.ndarray:
        """Whether a chain is feasible and its replay with feedback reaches the goal, (chains,)."""
        return self.feasible & self.feedback.success

    @property
    def success_rate(self) -> float:
        """Share of chains that succeed."""
        return float(self.success.mean())

    @cached_property
    def status(self) -> list[str]:
        """`converged`, `infeasible` or `diverged`, for every chain."""
        names = np.where(self.feasible, CONVERGED, INFEASIBLE)
        return np.where(self.died_at >= 0, DIVERGED, names).tolist()

    @cached_property
    def certified_chains(self) -> np.ndarray:
        """Whether a chain is feasible and one of its replays succeeds, (chains,)."""
        return self.feasible & (self.open_loop.success | self.feedback.success)

    @cached_property
    def tracked(self) -> np.ndarray:
        """Whether a chain is feasible, and a replay of it succeeds and ends as planned, (chains,).

        In contact a goal can be reached by a motion that has little to do with the plan.
        """
        both = (self.open_loop, self.feedback)
        return self.feasible & np.any([r.success & (r.final_deviation < TRACKED) for r in both], 0)

    @cached_property
    def best_chain(self) -> int:
        """The cheapest that is tracked, succeeds or is feasible; else the least infeasible."""
        for eligible in (self.tracked, self.certified_chains, self.feasible):
            if eligible.any():
                return int(np.argmin(np.where(eligible, self.cost, np.inf)))
        return int(np.argmin(np.nan_to_num(self.max_defect, nan=np.inf)))

    @property
    def best(self) -> Trajectory:
        """The best chain's knots x_1..x_K (K, nx) and u_0..u_{K-1} (K, nu)."""
        return jax.tree.map(lambda a: a[self.best_chain], self.trajectories)

    @cached_property
    def certificate(self) -> Certificate:
        """How the best chain replays."""
        return Certificate(
            self.engine,
            self.open_loop.summary(self.best_chain),
            self.feedback.summary(self.best_chain),
        )

    @cached_property
    def optima(self) -> tuple[Optimum, ...]:
        """The distinct local optima among the certified chains, best first; see `optima`."""
        return distinct(self)

    @property
    def certified(self) -> bool:
        """Whether the best chain is feasible and a replay of it succeeds."""
        return bool(self.feasible[self.best_chain]) and self.certificate.success

    @property
    def replay_mode(self) -> str:
        """Which replay speaks for the best chain: open loop where that succeeds."""
        return OPEN_LOOP if self.certificate.open_loop["success"] else WITH_FEEDBACK

    def outcome(self, mode: str) -> str:
        """What the best chain's replay in that mode came to, in words."""
        certificate = self.certificate
        replay = certificate.open_loop if mode == OPEN_LOOP else certificate.feedback
        if not np.isfinite(replay["max_deviation"]):
            return "diverges"
        if replay["max_violation"] >= OUTSIDE:
            return f"leaves the bounds by {replay['max_violation']:.1e}"
        words = ("misses the goal", "reaches the goal")
        if self.problem.goal is None:
            words = ("leaves the plan", "keeps to the plan")
        return f"{words[replay['success']]}, {replay['max_deviation']:.1e} off plan"

    @property
    def replayed(self) -> tuple[np.ndarray, np.ndarray]:
        """States (K+1, nx) and controls (K, nu) of the best chain, replayed in `replay_mode`."""
        replays = self.open_loop if self.replay_mode == OPEN_LOOP else self.feedback
        return replays.states[self.best_chain], replays.controls[self.best_chain]


def distinct(solution: Results, tolerance: float = TOLERANCE) -> tuple[Optimum, ...]:
    """The distinct optima that the chains found, cheapest first; none if no chain is certified.

    Args:
        solution: from `solve`.
        tolerance: distance d within which motions are the same, in standard deviations of the
            states; a smaller one tells more of them apart.

    Raises:
        DraxError: the tolerance is not a positive number.
    """
    require_positive("tolerance", tolerance, f"a positive number, such as {TOLERANCE}")
    certified = np.flatnonzero(solution.certified_chains)
    if not certified.size:
        return ()
    order = certified[np.argsort(solution.cost[certified], kind="stable")]
    group = cluster(solution.problem.dynamics, solution.trajectories.x[order], tolerance)
    return tuple(_optimum(solution, order[group == g]) for g in range(group.max() + 1))


def _optimum(solution: Results, members: np.ndarray) -> Optimum:
    """What is known of the chains of one optimum, cheapest first."""
    chain = int(members[0])
    open_loop, feedback = solution.open_loop, solution.feedback
    replays = open_loop if open_loop.success[chain] else feedback
    return Optimum(
        chain=chain,
        members=members,
        share=len(members) / solution.chains,
        cost=float(solution.cost[chain]),
        max_defect=float(solution.max_defect[chain]),
        certificate=Certificate(solution.engine, open_loop.summary(chain), feedback.summary(chain)),
        trajectory=jax.tree.map(lambda a: a[chain], solution.trajectories),
        replayed=(replays.states[chain], replays.controls[chain]),
    )
