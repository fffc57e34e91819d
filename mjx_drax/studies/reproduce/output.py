"""Rows, tables and axes that the figures share."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_drax.solution.solution import Solution

Numbers = dict[str, Any]

SHARES = (
    "upright",
    "can be upright",
    "of those that can",
    "of those, within 1.2 times dynamic programming",
    "feasible",
    "reaches goal",
    "with feedback",
    "escapes",
    "diverged",
    "rollout upright",
)
"""Columns that are printed as percentages, besides those about max|h|."""


def tell(line: str) -> None:
    """Say how far a figure is, on standard error, so that tables can be piped."""
    print(line, file=sys.stderr, flush=True)


def reaching(solution: Solution) -> np.ndarray:
    """Which chains are feasible and reach the goal open loop, (chains,)."""
    return solution.feasible & solution.open_loop.success


def solve_row(name: str, solution: Solution) -> Numbers:
    """A row of a table: what a method's chains came to."""
    reached = reaching(solution)
    return {
        "method": name,
        "iterations": solution.iterations,
        "chains": solution.chains,
        "feasible": float(solution.feasible.mean()),
        "reaches goal": float(reached.mean()),
        "with feedback": float(solution.success.mean()),
        "best cost": float(solution.cost[reached].min()) if reached.any() else None,
        "median cost": float(np.median(solution.cost[reached])) if reached.any() else None,
        "median max|h|": float(np.median(solution.max_defect)),
        "time [s]": solution.solve_time,
    }


def table(numbers: Mapping[str, Any]) -> str:
    """All rows among the numbers, as Markdown tables."""
    parts = []
    for value in numbers.values():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            names = list(value[0])
            lines = [names, ["---"] * len(names)]
            lines += [[_cell(name, row[name]) for name in names] for row in value]
            parts.append("\n".join(f"| {' | '.join(cells)} |" for cells in lines))
    return re.sub(r"\|h\|", r"\\|h\\|", "\n\n".join(parts))


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if name.split(": ")[-1] in SHARES or "max|h| <" in name:
        return f"{value:.1%}"
    return f"{value:.4g}" if isinstance(value, float) else f"{value}"
