"""What came of a solve: all chains, how they replay, and the distinct optima.

A cost alone says nothing, because an infeasible trajectory undercuts the optimum. So every chain's
controls are replayed from x_init (see `replay`), and three things are said of each:

    replays       it reaches the goal, or ends as planned, open loop or with feedback
    constraints   the same replay keeps all bounds and constraints, within tolerances
    optimality    it follows its plan, whose optimality conditions have a residual below a tolerance

It is *certified* if its plan is feasible and the first two hold, and *optimal* if all three do. The
better one of its two replays, which succeeds and is cheaper, speaks for a chain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np

from mjx_drax.base.errors import DraxError, require_positive, require_whole
from mjx_drax.method.langevin import State
from mjx_drax.method.model import Multipliers
from mjx_drax.polish.interior_point import Progress as PolishProgress
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.recording import Recording
from mjx_drax.search.restarts import Restarts
from mjx_drax.solution.log import table
from mjx_drax.solution.optima import TOLERANCE, cluster
from mjx_drax.solution.replay import (
    OPEN_LOOP,
    WITH_FEEDBACK,
    Certificate,
    Replays,
    followed,
    largest_defect,
    open_loop_is_better,
)
from mjx_drax.solution.violations import (
    DYNAMICS,
    Tolerances,
    Violation,
    Violations,
    most_broken,
    scatter_widths,
)

OPTIMAL, FEASIBLE_ONLY, INFEASIBLE = "optimal", "feasible", "infeasible"
DIVERGED, INTERRUPTED = "diverged", "interrupted"

CONVERGED, STALLED, UNFINISHED, UNPOLISHED = "converged", "stalled", "unfinished", "none"

SAME_COST = 1e-3
"""Share of a cost by which another one counts as the same."""

RESIDUAL = 1e-4
"""The tolerance that is shown where nothing was polished: then no residual is known."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """A local optimum: its cheapest certified chain, and the chains that belong to it.

    Attributes:
        chain: index of the cheapest chain, which represents it.
        members: indices of all its chains, cheapest first, (members,).
        share: of all chains of the solve, those that failed included.
        cost: of the representative's better replay.
        plan_cost, max_defect, residual: of the representative's plan.
        optimal: whether that residual is below the tolerance.
        certificate: how the representative replays, open loop and with feedback.
        trajectory: knots of the representative, x_1..x_K (K, nx) and u_0..u_{K-1} (K, nu).
        replayed: states (K+1, nx) and controls (K, nu) of its better replay.
    """

    chain: int
    members: np.ndarray
    share: float
    cost: float
    plan_cost: float
    max_defect: float
    residual: float
    optimal: bool
    certificate: Certificate
    trajectory: Trajectory
    replayed: tuple[np.ndarray, np.ndarray]

    def __repr__(self) -> str:
        known = f"residual {self.residual:.1e}, {'' if self.optimal else 'not '}optimal"
        return f"<Optimum: cost {self.cost:.6g}, {self.share:.0%} of chains, {known}>"


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
        cost, max_defect, max_violation: of every chain's plan, (chains,); `Problem.worst` says
            what max_defect is measured in.
        residual: of the optimality conditions of every chain's plan, scaled: the largest of the
            Lagrangian's slope, defects, constraints and complementarity; NaN if not known,
            (chains,).
        stalled: whether the polish of a chain found no step any more, (chains,).
        tolerance: below which a residual is that of an optimum.
        feasible_since: iteration since which max|h| < 1e-3, else -1, (chains,).
        died_at: iteration at which a chain turned non-finite and was frozen, else -1, (chains,).
        interrupted: whether the solve was ended before its time.
        plan: violations of bounds and constraints of every chain's plan.
        open_loop, feedback: the replays of every chain.
        tolerances: of violations of replays.
        history: `iteration` (records,), and `cost`, `max_defect`, `residual` (records, chains) of
            the best places in the batch at that moment, as many as there are chains, which in later
            attempts of `Restarts` hold tries for unfinished chains; residuals are infinite before
            the polish, and NaN without one; `began` and `noise_ends` (attempts,): after how many
            iterations each attempt began, and its noise ended (the same, if it had none); the last
            polish of what attempts have left early counts as one.
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
    residual: np.ndarray
    stalled: np.ndarray
    tolerance: float
    feasible_since: np.ndarray
    died_at: np.ndarray
    interrupted: bool
    plan: Violations
    open_loop: Replays
    feedback: Replays
    tolerances: Tolerances
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

    def log(self) -> str:
        """The history as a table: cost, max|h| and residual of the best and the median chain.

        A line for each report, with how many chains are feasible and optimal; see `log.table`.
        """
        return table(self.history, self.tolerance)

    @cached_property
    def plans(self) -> np.ndarray:
        """Planned states x_0..x_K of every chain, (chains, K + 1, nx)."""
        with self.problem.arithmetic():
            return np.asarray(self.problem.with_start(self.trajectories))

    @cached_property
    def feasible(self) -> np.ndarray:
        """Whether max|h| < 1e-3 where the chain ended, and the cost is finite, (chains,)."""
        return (self.max_defect < FEASIBLE) & np.isfinite(self.cost)

    @cached_property
    def success(self) -> np.ndarray:
        """Whether a chain is feasible and its replay with feedback succeeds, (chains,)."""
        return self.feasible & self.feedback.success

    @property
    def success_rate(self) -> float:
        """Share of chains that succeed."""
        return float(self.success.mean())

    @cached_property
    def certified_chains(self) -> np.ndarray:
        """Whether a chain is feasible and one of its replays succeeds, (chains,)."""
        return self.feasible & (self.open_loop.success | self.feedback.success)

    @cached_property
    def optimal_chains(self) -> np.ndarray:
        """Whether a chain is certified, `followed`, its residual below the tolerance, (chains,)."""
        return self.certified_chains & self.followed & (self.residual < self.tolerance)

    @cached_property
    def followed(self) -> np.ndarray:
        """Whether the better replay is the motion that was planned, to a tenth; (chains,)."""
        replays = self.open_loop, self.feedback
        return followed(self.problem, self.plans.astype(float), self.cost, *replays)

    @cached_property
    def status(self) -> list[str]:
        """`optimal`, `feasible`, `infeasible`, `diverged` or `interrupted`, for every chain.

        Feasible is a plan that obeys the dynamics and its constraints, whether or not a replay of
        it succeeds. Interrupted is what was infeasible when the solve was ended before its time.
        Diverged is what was infeasible when it would have turned non-finite.
        """
        return statuses(self.feasible, self.optimal_chains, self.died_at >= 0, self.interrupted)

    @cached_property
    def polished(self) -> list[str]:
        """How the polish of every chain ended: `converged`, `stalled`, `unfinished` or `none`.

        Converged: the residual is below the tolerance. Stalled: no step was found, as at a kink.
        Unfinished: out of iterations, interrupted, or left aside when the others were done. None:
        there was no polish.
        """
        return endings(self.residual, self.tolerance, self.stalled)

    @cached_property
    def open_loop_is_better(self) -> np.ndarray:
        """Which replay speaks for a chain: the one that succeeds, then the cheaper; (chains,)."""
        return open_loop_is_better(self.open_loop, self.feedback)

    @cached_property
    def replay_cost(self) -> np.ndarray:
        """Costs of the better replays, (chains,)."""
        return np.where(self.open_loop_is_better, self.open_loop.cost, self.feedback.cost)

    @cached_property
    def best_chain(self) -> int:
        """The certified chain with the cheapest replay; else a feasible, or the least infeasible.

        Of certified chains that cost as much, up to 1e-3 of it, an optimal one: others may use what
        tolerances of constraints allow. Plans of feasible chains say little where a replay does not
        follow them: there replays are compared, too.
        """
        if self.certified_chains.any():
            least = self.replay_cost[self.certified_chains].min()
            alike = self.optimal_chains & (self.replay_cost <= least + SAME_COST * abs(least))
            if alike.any():
                return int(np.argmin(np.where(alike, self.replay_cost, np.inf)))
        costs = np.nan_to_num(self.replay_cost, nan=np.inf)
        for eligible in (self.certified_chains, self.feasible):
            if eligible.any():
                of = np.flatnonzero(eligible)  # whose costs may all be infinite
                return int(of[np.argmin(costs[of])])
        return int(np.argmin(np.nan_to_num(self.max_defect, nan=np.inf)))

    def chain_or_best(self, chain: int | None) -> int:
        """The chain's number, if there is such a chain; the best one's for None."""
        if chain is None:
            return self.best_chain
        require_whole("chain", chain, 0)
        if chain >= self.chains:
            raise DraxError(f"chain is {chain}: give a number below {self.chains}.")
        return chain

    def where(self, chain: int) -> Violation | None:
        """What keeps a chain's plan from being feasible: the largest defect or constraint.

        Returns:
            what is broken, by how much, in which entry, at which knot; None for a feasible chain.
            Entry and knot are -1 if the defects of a problem that was loaded without f are largest.
        """
        chain = self.chain_or_best(chain)
        if self.feasible[chain]:
            return None
        plan, u = self.plans[chain].astype(float), np.asarray(self.trajectories.u[chain])
        try:
            of_dynamics = largest_defect(self.problem, plan, u)
        except DraxError:  # f is not there
            defect = float(np.nan_to_num(self.max_defect[chain], nan=np.inf))
            of_dynamics = Violation(DYNAMICS, defect, FEASIBLE, -1, -1)
        return most_broken(self.problem, self.plan.of(chain), of_dynamics)

    @property
    def best(self) -> Trajectory:
        """The best chain's knots x_1..x_K (K, nx) and u_0..u_{K-1} (K, nu)."""
        return jax.tree.map(lambda a: a[self.best_chain], self.trajectories)

    def times_of(self, chain: int) -> np.ndarray:
        """Times of x_0..x_K of a chain, (K + 1,) [s]."""
        problem = self.problem
        return problem.dynamics.times(self.plans[chain], float(problem.t_init))

    @property
    def times(self) -> np.ndarray:
        """Times of x_0..x_K of the best chain, (K + 1,) [s]."""
        return self.times_of(self.best_chain)

    @cached_property
    def parameters(self) -> dict[str, np.ndarray]:
        """The parameters that the best chain has chosen, by name; none if there are none."""
        dynamics = self.problem.dynamics
        if not isinstance(dynamics, Extended):
            return {}
        chosen = dynamics.extras(self.plans[self.best_chain, 0]).p
        return {name: np.asarray(value) for name, value in dynamics.parameters(chosen).items()}

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
        """Whether the best chain is feasible, and a replay reaches the goal and keeps constraints.

        Without a goal, a replay has to end as planned.
        """
        return bool(self.certified_chains[self.best_chain])

    @property
    def optimal(self) -> bool:
        """Whether the best chain is certified and `followed`, its residual below the tolerance."""
        return bool(self.optimal_chains[self.best_chain])

    @property
    def replay_mode(self) -> str:
        """Which replay speaks for the best chain: the one that succeeds, then the cheaper."""
        return self.mode_of(self.best_chain)

    def mode_of(self, chain: int) -> str:
        """Which replay speaks for a chain."""
        return OPEN_LOOP if self.open_loop_is_better[chain] else WITH_FEEDBACK

    def replays_in(self, mode: str) -> Replays:
        """The replays of all chains in a mode."""
        return self.open_loop if mode == OPEN_LOOP else self.feedback

    def outcome(self, mode: str) -> str:
        """What the best chain's replay in that mode came to, in words."""
        return self.replays_in(mode).outcome(self.problem, self.best_chain)

    @property
    def optimality(self) -> str:
        """What is known of the best chain's optimality, in words."""
        best, problem = self.best_chain, self.problem
        words = self.optimality_of(best)
        if self.polished[best] != STALLED:
            return words
        if problem.saturates:
            return f"{words}; forces at the ends of their ranges (forcerange) may keep it there"
        rounded = problem.precision == 32 and not problem.dynamics.kinked
        return f"{words}; precision=64 may get further" if rounded else words

    def optimality_of(self, chain: int) -> str:
        """What the residual of a chain says, in words, and if it is small for another motion."""
        words, small = optimality(self, chain), self.residual[chain] < self.tolerance
        if small and self.certified_chains[chain] and not self.followed[chain]:
            return f"{words}, of a plan that the replay does not follow"
        return words

    @property
    def verdict(self) -> str:
        """The three parts of the certificate, in a few words."""
        if not self.certified:
            return "NOT CERTIFIED"
        return "CERTIFIED and optimal" if self.optimal else "CERTIFIED, not known to be optimal"

    @property
    def replayed(self) -> tuple[np.ndarray, np.ndarray]:
        """States (K+1, nx) and controls (K, nu) of the best chain, replayed in `replay_mode`."""
        replays = self.replays_in(self.replay_mode)
        return replays.states[self.best_chain], replays.controls[self.best_chain]


def statuses(
    feasible: np.ndarray, optimal: np.ndarray, diverged: np.ndarray, interrupted: bool
) -> list[str]:
    """The status of every chain, from what is known of it, (chains,) each."""
    names = np.where(optimal, OPTIMAL, np.where(feasible, FEASIBLE_ONLY, INFEASIBLE))
    if interrupted:
        names = np.where(feasible, names, INTERRUPTED)
    found: list[str] = np.where(diverged & ~feasible, DIVERGED, names).tolist()
    return found


def tolerance_of(settings: Restarts) -> float:
    """Below which a residual is that of an optimum: the polish's tolerance, if there is one."""
    polish = settings.polish
    return float(np.asarray(polish.tolerance)) if polish and polish.iterations else RESIDUAL


def endings(residual: np.ndarray, tolerance: float, stalled: np.ndarray) -> list[str]:
    """How the polish of every chain ended, from what is known of it, (chains,) each."""
    names = np.where(stalled, STALLED, UNFINISHED)
    names = np.where(residual < tolerance, CONVERGED, names)
    found: list[str] = np.where(np.isnan(residual), UNPOLISHED, names).tolist()
    return found


def stalled_of(state: State) -> np.ndarray:
    """Whether the polish of every chain found no step any more, (chains,)."""
    progress = state.polish
    known = isinstance(progress, PolishProgress)
    return np.asarray(progress.stalled if known else np.zeros(len(state.trajectory.u), bool))


def optimality(found: Any, chain: int) -> str:
    """What the residual of a chain says, in words; of a `Solution` or a `Minimum`."""
    residual, tolerance = float(found.residual[chain]), found.tolerance
    if residual < tolerance:
        digits = 1 if float(f"{residual:.1e}") < tolerance else 3  # 9.96e-05 is no 1.0e-04
        return f"residual {residual:.{digits}e}, below {tolerance:g}"
    unfinished = "was interrupted" if found.interrupted else "is unfinished (max_iterations)"
    how = {STALLED: ": the polish stalled", UNFINISHED: f": the polish {unfinished}"}
    known = f"{residual:.1e}, above {tolerance:g}" if np.isfinite(residual) else "not known"
    return f"residual {known}{how.get(found.polished[chain], '')}"


def distinct(solution: Results, tolerance: float = TOLERANCE) -> tuple[Optimum, ...]:
    """The distinct optima that the chains found, cheapest first; none if no chain is certified.

    Args:
        tolerance: distance d within which motions are the same, in standard deviations of the
            states; a smaller one tells more of them apart.

    Raises:
        DraxError: the tolerance is not a positive number.
    """
    require_positive("tolerance", tolerance, f"a positive number, such as {TOLERANCE}")
    certified = np.flatnonzero(solution.certified_chains)
    if not certified.size:
        return ()
    order = certified[np.argsort(solution.replay_cost[certified], kind="stable")]
    problem = solution.problem
    with problem.arithmetic():
        still = FEASIBLE * scatter_widths(problem)[1]
        group = cluster(problem.dynamics, solution.trajectories.x[order], tolerance, still)
    return tuple(_optimum(solution, order[group == g]) for g in range(group.max() + 1))


def _optimum(solution: Results, members: np.ndarray) -> Optimum:
    """What is known of the chains of one optimum, cheapest first."""
    chain = int(members[0])
    open_loop, feedback = solution.open_loop, solution.feedback
    replays = open_loop if solution.open_loop_is_better[chain] else feedback
    return Optimum(
        chain=chain,
        members=members,
        share=len(members) / solution.chains,
        cost=float(solution.replay_cost[chain]),
        plan_cost=float(solution.cost[chain]),
        max_defect=float(solution.max_defect[chain]),
        residual=float(solution.residual[chain]),
        optimal=bool(solution.optimal_chains[chain]),
        certificate=Certificate(solution.engine, open_loop.summary(chain), feedback.summary(chain)),
        trajectory=jax.tree.map(lambda a: a[chain], solution.trajectories),
        replayed=(replays.states[chain], replays.controls[chain]),
    )
