"""Solve a problem, and certify the answer by replaying it.

A cost alone says nothing, because an infeasible trajectory undercuts the optimum. So every chain's
controls are replayed from x_init by an engine that knows nothing of the solve (MuJoCo's C engine
for MJCF, a float64 rollout for functions), open loop and with the feedback

    u_k + K_k (x_k - x_k^plan),   clipped to the control bounds,

where K is the time-varying LQR that the solver's factorization yields. Success means that the
replay reaches the goal, and leaves the bounds by `OUTSIDE` at most; without a goal, that it ends
within `TRACKED` of the plan.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError
from mjx_drax.method.langevin import FEASIBLE, Langevin, feedback_gains, worth
from mjx_drax.method.metrics import GaussNewton, Multipliers
from mjx_drax.problem.problem import Problem, Trajectory, checked
from mjx_drax.search.checkpoint import Checkpoint
from mjx_drax.search.recording import Recorder, Recording
from mjx_drax.search.restarts import Progress, Restarts, Run, run

if TYPE_CHECKING:
    from mjx_drax.solution.optima import Optimum

TRACKED = 1e-2
"""Largest final deviation |x - plan| of a successful replay, where the problem has no goal."""

OUTSIDE = 1e-2
"""How far a replay that succeeds may leave the bounds of the states."""

OPEN_LOOP, WITH_FEEDBACK = "open loop", "with feedback"
CONVERGED, INFEASIBLE, DIVERGED = "converged", "infeasible", "diverged"


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


@dataclass(frozen=True)
class Solution:
    """All chains of a solve, what they reached, and how the answer replays. Arrays are numpy's.

    Attributes:
        problem: what was solved.
        solver: with which settings.
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
    solver: Langevin | Restarts
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
        from mjx_drax.solution.optima import distinct

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
        from mjx_drax.solution.save import save

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
        from mjx_drax.solution.load import load

        return load(folder, problem)

    def certify(self) -> Solution:
        """The same solution with every chain replayed again, by the engine that is here now.

        Raises:
            DraxError: it was loaded without its problem, whose cost and goal judge replays.
        """
        problem, plans = self.problem, self.trajectories
        return replace(
            self,
            open_loop=_replays(problem, plans, np.zeros_like(self.gains)),
            feedback=_replays(problem, plans, self.gains),
            engine=problem.dynamics.engine,
        )


def solve(
    problem: Problem,
    chains: int = 64,
    seed: int = 0,
    solver: Langevin | Restarts | None = None,
    guess: Trajectory | None = None,
    progress: Progress | None = None,
    record: int | None = None,
    devices: int = 1,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Solution:
    """Run `chains` Langevin chains and replay what they found.

    Args:
        problem: from `from_mjcf` or `from_function`.
        chains: number of chains.
        seed: of all random numbers.
        solver: `Restarts()` by default, whose settings are scaled from the problem; or one
            `Langevin` with its schedules as they stand.
        guess: initial knots instead of random ones: one trajectory for all chains, (K, nx) and
            (K, nu), or one each, (chains, K, nx) and (chains, K, nu). They need not be feasible.
        progress: called with (iterations done, of how many, diagnostics) every few iterations;
            Ctrl-C between two calls ends the solve early and keeps what there is.
        record: keep the knots of all chains every so many iterations, in `solution.recording`, for
            `render_diffusion`; the answer is the same. It takes 4 (nx + 1) K bytes for each chain
            and snapshot, and at most `recording.LIMIT`, beyond which fewer snapshots are kept.
        devices: how many of this process to spread the chains over, evenly; the answer is the
            same. Each compiles the program for itself, all at once.
        checkpoint: a file to write every half minute, and to go on from where it is there, after
            the same call was killed or ended by Ctrl-C. The answer is the same, bit for bit. A
            file that belongs to a complete solve gives its answer again; it may be deleted.

    Returns:
        the solution with its certificate; look at `solution.certified`.

    Raises:
        DraxError: sizes that misfit; functions that cannot be differentiated, compute something
            else each time, or are finite, with their derivatives, at no initial knot; a checkpoint
            that cannot be written, is damaged or belongs to another solve.
    """
    problem = checked(problem)
    if problem.dynamics.nx == 0:
        raise DraxError(f"{problem.name} has no states to replay: use mjx_drax.minimize.")
    solver = Restarts() if solver is None else solver
    recorder = None if record is None else Recorder(record)
    file = None if checkpoint is None else Checkpoint(checkpoint)
    found = run(problem, chains, seed, solver, guess, progress, recorder, devices, file)
    solution = _certified(problem, solver, seed, found)
    return solution if recorder is None else replace(solution, recording=recorder.recording())


def _certified(problem: Problem, solver: Langevin | Restarts, seed: int, run: Run) -> Solution:
    """The solution: everything on the host, every chain replayed twice."""
    state, records = run.state, run.records
    trajectories = jax.tree.map(np.asarray, state.trajectory)
    gains = np.asarray(state.gains)
    flow = solver.flow
    if not isinstance(flow.preconditioner, GaussNewton):  # the others bring no gains
        gains = np.asarray(feedback_gains(flow, problem, state))
    info = run.info
    return Solution(
        problem=problem,
        solver=solver,
        seed=seed,
        trajectories=trajectories,
        multipliers=jax.tree.map(np.asarray, state.multipliers),
        gains=gains,
        cost=np.asarray(info.cost),
        max_defect=np.asarray(info.max_defect),
        max_violation=np.asarray(info.max_violation),
        converged_at=np.where(np.asarray(state.died_at) < 0, run.converged_at, -1),
        died_at=np.asarray(state.died_at),
        open_loop=_replays(problem, trajectories, np.zeros_like(gains)),
        feedback=_replays(problem, trajectories, gains),
        history={
            "iteration": np.array([done for done, _ in records]),
            "cost": np.stack([np.asarray(i.cost) for _, i in records]),
            "max_defect": np.stack([np.asarray(i.max_defect) for _, i in records]),
            "began": np.array([began for began, _ in run.began]),
            "noise_ends": np.array([end for _, end in run.began]),
        },
        iterations=records[-1][0],
        compile_time=run.compile_time,
        solve_time=run.solve_time,
        engine=problem.dynamics.engine,
    )


def _replays(problem: Problem, trajectories: Trajectory, gains: np.ndarray) -> Replays:
    """Every chain's controls, applied from x_0 with the given feedback gains."""
    plan = np.asarray(problem.with_start(trajectories), float)
    ran = problem.replay(plan, trajectories.u, gains)
    return judged(problem, plan, ran, partial(worth, problem))


def judged(
    problem: Problem,
    plan: np.ndarray,
    ran: tuple[np.ndarray, np.ndarray],
    worth_of: Callable[[Trajectory], tuple[Array, Array]],
) -> Replays:
    """What replays are worth.

    Args:
        problem: for its goal, its state arithmetic and its precision.
        plan: planned states x_0..x_K, (runs, K + 1, nx).
        ran: replayed states, of the same shape, and the controls that were applied (runs, K, nu).
        worth_of: gives cost and bound violation of a batch of trajectories.
    """
    states, controls = ran
    off = np.nan_to_num(problem.dynamics.deviation(states, plan), nan=np.inf)
    dtype = problem.x_init.dtype
    knots = Trajectory(jnp.asarray(states[:, 1:], dtype), jnp.asarray(controls, dtype))
    cost, outside = worth_of(knots)
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
