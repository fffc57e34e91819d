"""What default settings answer: success, costs, residuals and time of tasks, seed by seed.

    python -m mjx_drax.studies.answers [TASK[:CHAINS] ...] [--seeds N]

A row for each task and seed: the share of chains whose replay with feedback succeeds; the best and
the median cost of their better replays; the share of all chains within 1 % of the best, and the
share that has converged, with a residual below the tolerance; the share that is certified, as a
replay with or without feedback succeeds; iterations; and seconds to solve and to compile. Of each
task the first row's solve time has work that is done once in a process.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from mjx_drax import tasks
from mjx_drax.problem.problem import Problem
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.studies.measurements import task_and_chains

DEFAULT = (
    "pendulum:16384",
    "cartpole_swingup:1024",
    "acrobot_swingup:256",
    "double_pendulum_swingup:64",
    "quadrotor_planar:64",
    "bug_trap:1024",
    "deep_trap:1024",
)

HEADER = (
    "| problem | chains | seed | success | best cost | median | within 1 % | converged | certified "
    "| iterations | solve [s] | compile [s] |\n" + "|---" * 12 + "|"
)


def line(solution: Solution) -> str:
    """The row of a solve, in Markdown."""
    good = np.asarray(solution.success)
    costs = solution.replay_cost[good]
    best = solution.replay_cost[solution.best_chain]
    median = np.median(costs) if good.any() else np.inf
    close = (costs <= best + 0.01 * abs(best)).sum() / solution.chains
    converged = solution.residual < solution.tolerance
    return (
        f"| {solution.problem.name} | {solution.chains:,} | {solution.seed} | {good.mean():.2%} "
        f"| {best:.6g} | {median:.5g} | {close:.0%} | {converged.mean():.1%} "
        f"| {solution.certified_chains.mean():.1%} | {solution.iterations} "
        f"| {solution.solve_time:.3f} | {solution.compile_time:.0f} |"
    )


def start() -> str:
    """What the table begins with: the device, and the names of the columns."""
    return f"{jax.devices()[0].device_kind}, jax {jax.__version__}\n\n{HEADER}"


def answers(
    problem: Problem, chains: int, seeds: int, **settings: Any
) -> Iterator[tuple[str, Solution]]:
    """The row and the solution of each seed; `settings` are those of `solve`."""
    for seed in range(seeds):
        solution = solve(problem, chains=chains, seed=seed, progress=False, **settings)
        yield line(solution), solution


def main(arguments: Sequence[str] | None = None) -> None:
    """Solve and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("tasks", nargs="*", default=DEFAULT)
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="solves of each task")
    options = parser.parse_args(arguments)
    print(start(), flush=True)
    for word in options.tasks:
        name, chains = task_and_chains(word, 64)
        for row, _ in answers(tasks.load(name).make(), chains, options.seeds):
            print(row, flush=True)


if __name__ == "__main__":
    main()
