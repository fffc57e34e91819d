"""The benchmark: every task, several seeds, what share of chains succeeds and in what time.

Success is decided by each chain's own replay (MuJoCo's C engine, or float64 for functions).
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_drax import tasks
from mjx_drax.langevin import Langevin
from mjx_drax.solution import Solution, solve

Row = dict[str, Any]


def run(
    names: Sequence[str],
    seeds: Sequence[int],
    chains: int | None = None,
    report: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Solve tasks with their own settings, once for every seed; one row a solve.

    Args:
        names: tasks.
        seeds: of the random numbers.
        chains: for all tasks; by default each task's own number.
        report: called with every row as it is ready.
    """
    rows = []
    for name in names:
        task = tasks.load(name)
        problem, solver = task.make(), getattr(task, "SOLVER", None) or Langevin()
        for seed in seeds:
            number = chains or int(getattr(task, "CHAINS", 64))
            solution = solve(problem, number, seed, solver)
            rows.append(row(solution))
            report(rows[-1])
    return rows


def row(solution: Solution) -> Row:
    """The numbers of one solve."""
    best, certificate = solution.best_chain, solution.certificate
    return {
        "problem": solution.problem.name,
        "horizon": solution.problem.horizon,
        "seed": solution.seed,
        "chains": solution.chains,
        "iterations": solution.iterations,
        "success_rate": solution.success_rate,
        "certified": solution.certified,
        "best_cost": float(solution.cost[best]),
        "max_defect": float(solution.max_defect[best]),
        "open_loop_deviation": certificate.open_loop["max_deviation"],
        "feedback_deviation": certificate.feedback["max_deviation"],
        "median_success_cost": float(np.median(solution.cost[solution.success]))
        if solution.success.any()
        else None,
        "compile_time_s": solution.compile_time,
        "solve_time_s": solution.solve_time,
        "device": jax.devices()[0].device_kind,
    }


HEADER = (
    "| problem | K | seed | chains | iterations | success | best cost | max\\|h\\| "
    "| open loop off by | feedback off by | compile [s] | solve [s] |\n" + "|---" * 12 + "|"
)


def line(row: Row) -> str:
    """A row of the table, in Markdown."""
    return (
        f"| {row['problem']} | {row['horizon']} | {row['seed']} | {row['chains']} "
        f"| {row['iterations']} | {row['success_rate']:.1%} | {row['best_cost']:.6g} "
        f"| {row['max_defect']:.0e} | {row['open_loop_deviation']:.0e} "
        f"| {row['feedback_deviation']:.0e} | {row['compile_time_s']:.1f} "
        f"| {row['solve_time_s']:.2f} |"
    )


def save(rows: Sequence[Row], folder: str | os.PathLike[str]) -> Path:
    """Write `benchmark.json`: the rows, and what they were measured on."""
    machine = {
        "device": jax.devices()[0].device_kind,
        "cpus": os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
    path = Path(folder) / "benchmark.json"
    path.write_text(json.dumps({"machine": machine, "rows": list(rows)}, indent=2) + "\n")
    return path
