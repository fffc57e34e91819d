"""A solution for a person, in a few lines."""

from __future__ import annotations

from mjx_drax.solution.replay import OPEN_LOOP, WITH_FEEDBACK
from mjx_drax.solution.solution import Solution

OPTIMA = 5
"""So many distinct optima are printed."""


def lines(solution: Solution) -> list[str]:
    """Chains, the best one, its replays, distinct optima, times, and the verdict."""
    best, status = solution.best_chain, solution.status
    counts = ", ".join(f"{status.count(name)} {name}" for name in sorted(set(status)))
    rate = f"{solution.success_rate:.1%} succeed when replayed"
    times = f"compile {solution.compile_time:.1f} s, solve {solution.solve_time:.1f} s"
    return [
        f"chains         {solution.chains}: {counts}; {rate}",
        f"best           cost {solution.cost[best]:.5g}, max|h| {solution.max_defect[best]:.1e}, "
        f"bound violation {solution.max_violation[best]:.1e}",
        *(f"{mode:14} {solution.outcome(mode)}" for mode in (OPEN_LOOP, WITH_FEEDBACK)),
        *optima_lines(solution),
        f"engine         {solution.certificate.engine}",
        f"time           {times}",
        "CERTIFIED" if solution.certified else "NOT CERTIFIED: " + _advice(solution),
    ]


def optima_lines(solution: Solution) -> list[str]:
    """The cheapest of the distinct optima as a table; nothing if no chain is certified."""
    found = solution.optima
    if len(found) < 2:
        return ["optima         one: certified chains agree on the motion"] if found else []
    words = ("misses goal", "reaches goal")
    if solution.problem.goal is None:
        words = ("leaves plan", "keeps to plan")
    table = [f"optima         rank {'cost':>9}  chains  {'open loop':13}  with feedback"]
    for rank, optimum in enumerate(found[:OPTIMA], 1):
        replays = optimum.certificate.open_loop, optimum.certificate.feedback
        open_loop, feedback = (words[replay["success"]] for replay in replays)
        table.append(
            f"{rank:19} {optimum.cost:9.5g}  {optimum.share:6.1%}  {open_loop:13}  {feedback}"
        )
    if len(found) > OPTIMA:
        table.append(f"{'':14} and {len(found) - OPTIMA} more")
    return table


def _advice(solution: Solution) -> str:
    """What to try when no chain could be certified."""
    if not solution.feasible.any():
        return "no chain satisfies the dynamics. Try more --iterations, or a longer --horizon."
    return (
        "feasible chains miss the goal when replayed. Try more --chains, a higher weight on the "
        "terminal cost, or a longer --horizon."
    )
