"""How much a warm start saves when little has changed.

    python -m mjx_drax.studies.warm_starts [TASK[:CHAINS] ...]

A task is solved; then neighbours of it are solved twice, from nothing and with that solution as
guess: the task itself, with x_init moved by 1, 5 and 20 % of the half width of the box that initial
knots are drawn from, and with a horizon longer by a tenth. A row says iterations, the best cost and
the share of chains that are optimal, of both.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

import numpy as np

from mjx_drax import tasks
from mjx_drax.problem.problem import Problem
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.studies.measurements import task_and_chains

DEFAULT = ("pendulum:64", "cartpole_swingup:64", "bug_trap:64")

HEADER = (
    "| problem | change | iterations, from nothing | warm | best cost, from nothing | warm "
    "| optimal, from nothing | warm |\n" + "|---" * 8 + "|"
)


def neighbours(name: str, problem: Problem) -> Iterator[tuple[str, Problem]]:
    """What has changed, and the problem that results."""
    yield "none", problem
    x, box = np.asarray(problem.x_init), problem.scatter
    half = np.asarray(box.x_upper - box.x_lower) / 2
    direction = np.random.default_rng(0).uniform(-1, 1, len(x)) * np.where(half < 1e6, half, 1.0)
    for share in (0.01, 0.05, 0.2):
        yield f"x_init {share:.0%}", problem.with_x_init(x + share * direction)
    longer = 1.1 * problem.horizon * float(problem.dynamics.dt)
    yield "horizon 10%", tasks.load(name).make(horizon=longer)


def line(name: str, change: str, cold: Solution, warm: Solution) -> str:
    """The row of a change, in Markdown."""
    pairs = [
        (f"{found.iterations}", f"{found.cost[found.best_chain]:.6g}",
         f"{found.optimal_chains.mean():.0%}") for found in (cold, warm)
    ]  # fmt: skip
    cells = [cell for pair in zip(*pairs, strict=True) for cell in pair]
    return f"| {name} | {change} | " + " | ".join(cells) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Solve and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("tasks", nargs="*", default=DEFAULT)
    options = parser.parse_args(arguments)
    print(HEADER, flush=True)
    for word in options.tasks:
        name, chains = task_and_chains(word, 64)
        problem = tasks.load(name).make()
        known = solve(problem, chains=chains)
        for change, other in neighbours(name, problem):
            cold = solve(other, chains=chains, seed=1)
            warm = solve(other, chains=chains, seed=1, guess=known)
            print(line(name, change, cold, warm), flush=True)


if __name__ == "__main__":
    main()
