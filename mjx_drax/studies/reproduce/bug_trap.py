"""Who leaves the trap: gradient descent, quasi-Newton and diffusion, side by side."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.langevin import Langevin
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.studies.lbfgs import BFGS
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, reaching, solve_row, tell
from mjx_drax.studies.reproduce.settings import NO_NOISE, with_budget
from mjx_drax.view.plotting import BLACK, BLUE, GREEN, VERMILLION, new_figure

FULL = {"chains": 256, "matrix": True}
"""Sizes with --full. docs/paper.md has 32 chains, and 10 of the row that `matrix` adds."""

FIRST_ORDER = "gradient descent", "L-BFGS", "paper's flow"

MATRIX = "BFGS, full matrix"

BROKEN: dict[str, Any] = {"ls": "", "marker": "x", "ms": 2.5, "mew": 0.5, "color": "0.65"}
"""How the knots are drawn at which an infeasible chain breaks the dynamics; a line through them
would look like a path."""

STYLES: tuple[tuple[str, dict[str, Any]], ...] = (
    (f"infeasible: knots with |h| > {FEASIBLE:g}", BROKEN),
    ("feasible, does not reach the goal", {"color": VERMILLION, "lw": 1.2}),
    ("feasible, reaches the goal", {"color": BLUE, "lw": 1.2}),
)
"""Outcomes of a chain: its label and how it is drawn."""


def make(
    chains: int = 32, iterations: int | None = None, longer: int = 50, matrix: bool = False
) -> tuple[Numbers, Figure]:
    """The same knots, and the same budget of iterations, for every method.

    The budget is by default that of the preconditioned settings. First-order methods have rows for
    `longer` times as much too, because one of their iterations costs less; these are drawn, as the
    paper draws them. With `matrix` so has BFGS with a full matrix, which takes the longest; then it
    is drawn in the place of L-BFGS, as in the paper.
    """
    problem = tasks.load("bug_trap").make()
    budget = iterations or settings.budget_of(settings.TRAP)
    solvers = _methods(budget, longer, matrix)
    start = settings.initial_knots(problem, chains)
    solutions = {}
    for i, (name, solver) in enumerate(solvers.items()):
        count = f"{i + 1} of {len(solvers)}"
        tell(f"bug-trap, {count}: {name}, {settings.budget_of(solver):,} iterations")
        solutions[name] = solve(problem, chains, solver=solver, guess=start)
    rows = {name: solve_row(name, solution) for name, solution in solutions.items()}
    drawn = FIRST_ORDER[0], MATRIX if matrix else FIRST_ORDER[1], FIRST_ORDER[2]
    titles = {FIRST_ORDER[1]: "L-BFGS (in the paper: BFGS)"}
    found = {titles.get(name, name): f"{name}, {longer}×" for name in drawn}
    figure = _draw({name: (solutions[long], rows[long]) for name, long in found.items()})
    return {"rows": list(rows.values()), "budget": budget, "settings": solvers}, figure


def _methods(budget: int, longer: int, matrix: bool) -> dict[str, Langevin]:
    """The methods that are compared, each with a budget of iterations."""
    flow, diffusion = settings.TRAP_FLOW, with_budget(settings.TRAP, budget)
    full = replace(settings.TRAP_QUASI_NEWTON, preconditioner=BFGS())
    solvers = replace(flow, noise=NO_NOISE), settings.TRAP_QUASI_NEWTON, flow
    first_order = dict(zip(FIRST_ORDER, solvers, strict=True))
    return {
        **{name: with_budget(solver, budget) for name, solver in first_order.items()},
        MATRIX: with_budget(full, budget),
        "preconditioned, no noise": replace(diffusion, noise=NO_NOISE),
        "preconditioned diffusion": diffusion,
        **{
            f"{name}, {longer}×": with_budget(solver, longer * budget)
            for name, solver in {**first_order, **({MATRIX: full} if matrix else {})}.items()
        },
    }


def _draw(found: dict[str, tuple[Solution, Numbers]]) -> Figure:
    """A panel for each method's solution and row."""
    figure = new_figure(10.2, 5.0)
    panels = figure.subplots(1, len(found), sharey=True)
    for letter, axes, (name, (solution, row)) in zip("abc", panels, found.items(), strict=True):
        _draw_paths(axes, solution)
        axes.set_title(f"({letter}) {name}\n{_outcome(row)}", loc="left", fontsize=8)
    for label, style in STYLES:
        panels[0].plot([], [], label=label, **{**style, "ms": 5, "mew": 1.0})
    panels[0].plot([], [], color=BLACK, lw=2.2, label="the best")
    panels[0].set_ylabel("y [m]", fontsize=8)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=7.5)
    horizon, chains = solution.problem.horizon, solution.chains
    figure.suptitle(f"Bug trap, K = {horizon}, {chains} chains from the same knots", fontsize=10)
    return figure


def _draw_paths(axes: Axes, solution: Solution) -> None:
    """Paths of all chains over the obstacles, the best of them thick."""
    task = tasks.load("bug_trap")
    side = np.linspace(-3.0, 3.0, 121)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    shade = np.exp(-5.0 * np.square(grid[..., None, :] - task.WALL).sum(-1)).sum(-1)
    axes.contourf(side, side, shade, levels=20, cmap="Reds", vmax=1.3 * shade.max())
    escaped = reaching(solution)
    paths, feasible = solution.plans, solution.feasible
    h = np.abs(jax.vmap(solution.problem.defects)(solution.trajectories)).max(axis=-1)
    broken = paths[:, 1:][~feasible][h[~feasible] > FEASIBLE]
    axes.plot(*broken[:, :2].T, **BROKEN)
    outcomes = feasible & ~escaped, escaped
    for chosen, (_, style) in zip(outcomes, STYLES[1:], strict=True):
        for path in paths[chosen]:
            axes.plot(path[:, 0], path[:, 1], **style)
    best = paths[solution.best_chain]
    if feasible.any():
        axes.plot(best[:, 0], best[:, 1], color=BLACK, lw=2.2, zorder=4)
    start = paths[0, 0, :2]
    marked: dict[str, Any] = {"ls": "", "mec": "white", "zorder": 5}
    axes.plot(*start, "s", ms=6, color=BLACK, label="start", **marked)
    axes.plot(*task.GOAL, "*", ms=15, color=GREEN, label="goal", **marked)
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
