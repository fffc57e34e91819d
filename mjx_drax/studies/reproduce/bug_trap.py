"""Who leaves the trap: gradient descent, quasi-Newton and diffusion, side by side."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.langevin import Langevin
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.studies.lbfgs import BFGS
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, reaching, solve_row, tell
from mjx_drax.studies.reproduce.settings import NO_NOISE, with_budget
from mjx_drax.view.plotting import BLACK, BLUE, GREEN, VERMILLION, new_figure

FULL = {"chains": 256}
"""Sizes with --full: those of the numbers in docs/paper.md."""

FIRST_ORDER = "gradient descent", "quasi-Newton", "paper's flow"

STYLES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("infeasible: breaks the dynamics", {"color": "0.3", "lw": 1.0, "ls": ":"}),
    ("feasible, does not reach the goal", {"color": VERMILLION, "lw": 1.2}),
    ("feasible, reaches the goal", {"color": BLUE, "lw": 1.2}),
)
"""Outcomes of a chain: its label and how its path is drawn."""


def make(
    chains: int = 32, iterations: int | None = None, longer: int = 50
) -> tuple[Numbers, Figure]:
    """The same knots, and the same budget of iterations, for every method.

    The budget is by default that of the preconditioned settings. First-order methods have rows for
    `longer` times as much too, because one of their iterations costs less; these are drawn, as the
    paper draws them.
    """
    problem = tasks.load("bug_trap").make()
    budget = iterations or settings.budget_of(settings.TRAP)
    solvers = _methods(budget, longer)
    start = settings.initial_knots(problem, chains)
    solutions = {}
    for name, solver in solvers.items():
        tell(f"bug-trap: {name}, {settings.budget_of(solver):,} iterations")
        solutions[name] = solve(problem, chains, solver=solver, guess=start, progress=False)
    rows = {name: solve_row(name, solution) for name, solution in solutions.items()}
    figure = new_figure(10.2, 5.0)
    drawn = [f"{name}, {longer}×" for name in FIRST_ORDER]
    for i, name in enumerate(drawn):
        axes = figure.add_subplot(1, len(drawn), i + 1)
        _draw_paths(axes, solutions[name])
        axes.set_title(
            f"({'abc'[i]}) {FIRST_ORDER[i]}\n{_outcome(rows[name])}", loc="left", fontsize=8
        )
        if i == 0:
            for label, style in STYLES:
                axes.plot([], [], label=label, **style)
            axes.plot([], [], color=BLACK, lw=2.2, label="the best")
            axes.set_ylabel("y [m]", fontsize=8)
            figure.legend(loc="outside lower center", ncols=len(STYLES) + 2, fontsize=8)
    figure.suptitle(
        f"Bug trap, K = {problem.horizon}, {chains} chains from the same knots", fontsize=10
    )
    return {"rows": list(rows.values()), "budget": budget, "settings": solvers}, figure


def _methods(budget: int, longer: int) -> dict[str, Langevin]:
    """The methods that are compared, each with a budget of iterations."""
    flow, diffusion = settings.TRAP_FLOW, with_budget(settings.TRAP, budget)
    full = replace(settings.TRAP_QUASI_NEWTON, preconditioner=BFGS())
    solvers = replace(flow, noise=NO_NOISE), settings.TRAP_QUASI_NEWTON, flow
    first_order = dict(zip(FIRST_ORDER, solvers, strict=True))
    return {
        **{name: with_budget(solver, budget) for name, solver in first_order.items()},
        "quasi-Newton, full matrix": with_budget(full, budget),
        "preconditioned, no noise": replace(diffusion, noise=NO_NOISE),
        "preconditioned diffusion": diffusion,
        **{
            f"{name}, {longer}×": with_budget(solver, longer * budget)
            for name, solver in first_order.items()
        },
    }


def _draw_paths(axes: Axes, solution: Solution) -> None:
    """Paths of all chains over the obstacles, the best of them thick."""
    task = tasks.load("bug_trap")
    side = np.linspace(-3.0, 3.0, 121)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    shade = np.exp(-5.0 * np.square(grid[..., None, :] - task.WALL).sum(-1)).sum(-1)
    axes.contourf(side, side, shade, levels=20, cmap="Reds", vmax=1.3 * shade.max())
    escaped = reaching(solution)
    paths, feasible = solution.plans, solution.feasible
    outcomes = ~feasible, feasible & ~escaped, escaped
    for chosen, (_, style) in zip(outcomes, STYLES, strict=True):
        for path in paths[chosen]:
            axes.plot(path[:, 0], path[:, 1], **style)
    best = paths[solution.best_chain]
    if feasible.any():
        axes.plot(best[:, 0], best[:, 1], color=BLACK, lw=2.2, zorder=4)
    axes.plot(*paths[0, 0, :2], "s", ms=6, color=BLACK, mec="white", zorder=5)
    axes.plot(*task.GOAL, "*", ms=15, color=GREEN, mec="white", zorder=5, label="goal")
    axes.set(xlim=(-3, 3), ylim=(-3, 3), aspect="equal")
    axes.set_xlabel("x [m]", fontsize=8)
    axes.tick_params(labelsize=7)


def _outcome(row: Numbers) -> str:
    """The title of a panel."""
    best = "" if row["best cost"] is None else f", cost {row['best cost']:.4g}"
    return (
        f"{row['iterations']:,} iterations: {row['reaches goal']:.0%} escape{best}\n"
        f"{row['feasible']:.0%} feasible, median max|h| {row['median max|h|']:.0e}"
    )
