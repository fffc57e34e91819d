"""What a chain breaks most, entry by entry: a table with names and knots, `Solution.worst`."""

from __future__ import annotations

import numpy as np

from mjx_drax.problem.problem import Problem
from mjx_drax.search.family import Family
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.solution.results import Results
from mjx_drax.solution.violations import (
    DYNAMICS,
    TRACKING,
    Tolerances,
    Violation,
    by_entry,
    driven_extents,
    entry_name,
    with_plan_tolerance,
    words,
    worst_knots,
)

HEADERS = f"{'what':19}  {'entry':24}  knot  time [s]     size  tolerated"


def of_plan(solution: Results, chain: int) -> list[Violation]:
    """Violations of a chain's plan, those of the dynamics included, the worst first.

    Dynamics and constraints are tolerated up to what makes a plan feasible: 1e-3 of the problem's
    `defect_unit` of a state, and 1e-3 of a constraint, in its unit.
    """
    problem, plan, u, extent = _motion(solution, chain)
    found = of_engine(solution, chain)
    none = np.zeros(problem.dynamics.ndx)
    for violation in by_entry(problem, (plan, u), none, extent, Tolerances()):
        if "equality" in violation.kind:
            violation = with_plan_tolerance(problem, violation)
        if violation.kind != TRACKING:
            found.append(violation)
    return _sorted(found)


def of_engine(solution: Results, chain: int) -> list[Violation]:
    """Violations of the dynamics by a chain's plan, as the engine that replays it has them."""
    problem, plan, u, _ = _motion(solution, chain)
    off = problem.engine_defects(plan, u)
    with problem.arithmetic():
        unit = np.asarray(problem.defect_unit(plan))
    allowed = np.broadcast_to(FEASIBLE * unit, off.shape)
    return list(worst_knots(DYNAMICS, off, allowed, 0))


def of_replay(solution: Results, chain: int) -> list[Violation]:
    """Violations of a chain's better replay, the worst first."""
    problem, plan, _, extent = _motion(solution, chain)
    ran = solution.replays_in(solution.mode_of(chain))
    states, u = ran.states[chain], ran.controls[chain]
    off = np.nan_to_num(problem.dynamics.host_difference(states, plan), nan=np.inf)[-1]
    found = by_entry(problem, (states, u), off, extent, solution.tolerances)
    return _sorted([v for v in found if v.kind != TRACKING or problem.goal is None])


def table(solution: Results, chain: int | None = None, count: int = 10) -> str:
    """The worst violations of a chain's plan and of its better replay; see `Solution.worst`.

    Entries that are not violated at all have no line.
    """
    chain, lines = solution.chain_or_best(chain), []
    mode = solution.mode_of(chain)
    outcome = solution.replays_in(mode).outcome(solution.problem, chain)
    plan = of_plan(solution, chain)
    of = f"plan of chain {chain}"
    if solution.feasible[chain] and any(v.kind == DYNAMICS and v.broken for v in plan):
        of += f", feasible as JAX computes f (max|h| {solution.max_defect[chain]:.1e})"
        of += ", not as the replaying engine does"
    for title, found in (
        (of, plan),
        (f"replay {mode} of chain {chain}, which {outcome}", of_replay(solution, chain)),
    ):
        broken, shown = sum(v.broken for v in found), [v for v in found if v.size][:count]
        lines.append(f"{title}: {broken} of {len(found)} entries above what is tolerated")
        lines += [HEADERS] * bool(shown)
        times = solution.times_of(chain)
        lines += [_line(solution.problem, times, violation) for violation in shown]
    return "\n".join(lines)


def _motion(
    solution: Results, chain: int
) -> tuple[Problem, np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """The problem, a chain's states x_0..x_K and controls, and their extent."""
    plan = solution.plans[chain].astype(float)
    u = np.asarray(solution.trajectories.u[chain])
    motion = np.zeros(1, int), plan[None], u[None]
    extent = tuple(each[0] for each in driven_extents(Family.of_one(solution.problem), *motion))
    return solution.problem, plan, u, extent


def _sorted(found: list[Violation]) -> list[Violation]:
    """The worst first; where nothing is tolerated, what keeps to it is not broken."""
    return sorted(found, key=lambda v: v.ratio if v.size else 0.0, reverse=True)


def _line(problem: Problem, times: np.ndarray, violation: Violation) -> str:
    kind, size, allowed, entry, knot = violation
    mark = "  broken" if violation.broken else ""
    return (
        f"{words(kind):19}  {entry_name(problem, kind, entry):24}  {knot:4}  "
        f"{times[knot]:8.4g}  {size:7.1e}  {allowed:9.1e}{mark}"
    )
