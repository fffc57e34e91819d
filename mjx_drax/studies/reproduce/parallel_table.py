"""N pendulums at once, one chain each: time, and what the time bought."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.langevin import Langevin
from mjx_drax.problem.problem import Problem
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.studies.many_starts import solve_each
from mjx_drax.studies.measurements import judge
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, tell
from mjx_drax.view.plotting import BLUE, GRAY, VERMILLION, label_axes, new_figure

PUBLISHED = {64: 0.68, 256: 0.75, 1024: 1.04, 2048: 1.49, 4096: 2.12, 8192: 3.53, 16384: 7.95}
"""Times [s] that the paper gives for N pendulums, 20,000 iterations, on an RTX 4070."""

FULL = {"sizes": tuple(PUBLISHED)}
"""Sizes with --full: the paper's."""

STARTS = ("random", "hanging")
"""Initial states of the problems: U(-4, 4)², or all (3.1, 0)."""


def make(
    chains: int | None = None,
    iterations: int | None = None,
    sizes: Sequence[int] = (64, 256),
) -> tuple[Numbers, Figure]:
    """Each pendulum from its own random x_init, U(-4, 4)²; then the same with all hanging at rest.

    From many random states upright cannot be reached, from (3.1, 0) it can. Times are of compiled
    programs, from drawing the initial knots to the final ones. `chains` leaves out larger N of
    `sizes`; the paper's flow has 20,000 iterations by default.
    """
    problem, solvers = tasks.load("pendulum").make(), settings.pendulum_flows(iterations)
    sizes = [n for n in sizes if chains is None or n <= chains] or [min(sizes)]
    rows, key = [], jax.random.key(0)
    for size, kind in product(sizes, STARTS):
        tell(f"parallel-table: N = {size}, x_init {kind}")
        starts = jnp.broadcast_to(problem.x_init, (size, 2))
        if kind == "random":
            starts = jax.random.uniform(key, (size, 2), minval=-4.0, maxval=4.0)
        row: Numbers = {"N": size, "x_init": kind, "published, RTX 4070 [s]": PUBLISHED.get(size)}
        for name, solver in solvers.items():
            row |= {f"{name}: {k}": v for k, v in _measure(solver, problem, starts, key).items()}
        rows.append(row)
    return {"rows": rows, "settings": solvers}, _draw(rows, solvers)


def _measure(solver: Langevin, problem: Problem, starts: Array, key: Array) -> Numbers:
    """Time and quality of one chain for each of the initial states (N, nx)."""
    keys = jax.random.split(key, len(starts))
    knots, info, _, seconds = solve_each(solver, problem, starts, keys)
    h, u = np.asarray(info.max_defect), np.asarray(knots.u, float)
    return {
        "time [s]": seconds,
        "max|h| < 5e-3": float(np.mean(h < 5 * FEASIBLE)),
        "max|h| < 1e-3": float(np.mean(h < FEASIBLE)),
        "rollout upright": float(np.mean(judge(problem, u, np.asarray(starts)).success)),
    }


def _draw(rows: Sequence[Numbers], solvers: dict[str, Langevin]) -> Figure:
    """Times, and shares of problems whose rollout reaches upright, over N."""
    figure = new_figure(8.0, 3.6)
    left, right = figure.subplots(1, 2, sharex=True)
    left.loglog(*zip(*PUBLISHED.items(), strict=True), "o--", color=GRAY)
    left.lines[-1].set_label("published, 20,000 iterations, RTX 4070")
    for (name, color, marker), (kind, (dashes, fill)) in product(
        zip(solvers, (VERMILLION, BLUE), "s^", strict=True),
        zip(STARTS, ((":", "none"), ("-", "full")), strict=True),
    ):
        own = [row for row in rows if row["x_init"] == kind]
        sizes = [row["N"] for row in own]
        style: Any = {"color": color, "marker": marker, "ls": dashes, "ms": 6, "fillstyle": fill}
        if kind == "hanging":
            total = settings.budget_of(solvers[name])
            label = f"{name}, {total:,} iterations, {jax.devices()[0].device_kind}"
            left.plot(sizes, [row[f"{name}: time [s]"] for row in own], label=label, **style)
        shares = [row[f"{name}: rollout upright"] for row in own]
        right.plot(sizes, shares, label=f"{name}, x_init {kind}", **style)
    right.set_ylim(-0.05, 1.05)
    for axes, label in ((left, "time [s]"), (right, "share whose rollout reaches upright")):
        label_axes(axes, "problems N", label)
        shown = sorted({*PUBLISHED, *(row["N"] for row in rows)})
        axes.set_xticks(shown, [f"{n:,}" for n in shown], rotation=45, fontsize=7)
        axes.set_xticks([], minor=True)
        axes.legend(fontsize=7)
    figure.suptitle("N pendulums at once: time, and how many end upright", fontsize=10)
    return figure
