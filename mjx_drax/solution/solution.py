"""What came of a solve: all chains, how they replay, and the certificate of the best.

A cost alone says nothing, because an infeasible trajectory undercuts the optimum. So every chain's
controls are replayed from x_init; see `replay`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import jax
import numpy as np

from mjx_drax.method.model import Multipliers
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.recording import Recording
from mjx_drax.search.restarts import Restarts
from mjx_drax.solution.load import load
from mjx_drax.solution.optima import Optimum, distinct
from mjx_drax.solution.replay import (
    OPEN_LOOP,
    OUTSIDE,
    TRACKED,
    WITH_FEEDBACK,
    Certificate,
    Replays,
    replays,
)
from mjx_drax.solution.save import save

CONVERGED, INFEASIBLE, DIVERGED = "converged", "infeasible", "diverged"


@dataclass(frozen=True)
class Solution:
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

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write `result.json` and `result.npz` into a folder, for `load`; see `results.save`.

        Raises:
            DraxError: the folder cannot be written to.
        """
        return save(self, folder)

    @staticmethod
    def load(folder: str | os.PathLike[str], problem: Problem | None = None) -> Solution:
        """The solution that was saved into a folder, by `save` or by `mjx-drax solve`.

        Args:
            folder: that holds `result.json` and `result.npz`.
            problem: what was solved. Functions are not saved, so without it the problem of the
                solution has no costs, no constraints, no goal and, unless it came from MJCF, no
                dynamics; plots, films, exports and optima need none of them, but to solve or
                `certify` again does.

        Raises:
            DraxError: the files are missing, damaged or of another format, or the problem is not
                the one that was solved.
        """
        return load(Solution, folder, problem)

    def certify(self) -> Solution:
        """The same solution with every chain replayed again, by the engine that is here now.

        Raises:
            DraxError: it was loaded without its problem, whose cost and goal judge replays.
        """
        problem, plans = self.problem, self.trajectories
        return replace(
            self,
            open_loop=replays(problem, plans, np.zeros_like(self.gains)),
            feedback=replays(problem, plans, self.gains),
            engine=problem.dynamics.engine,
        )
