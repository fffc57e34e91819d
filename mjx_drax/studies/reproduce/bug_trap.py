"""Who leaves the trap: gradient descent, quasi-Newton and diffusion, side by side."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.langevin import Langevin
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, new_figure, reaching, solve_row
from mjx_drax.studies.reproduce.settings import NO_NOISE, with_budget
from mjx_drax.view.plotting import BLACK, BLUE, GREEN, VERMILLION

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def make(
    chains: int = 256, iterations: int | None = None, longer: int = 50
) -> tuple[Numbers, Figure]:
    """The same knots, and the same budget of iterations, for every method.

    First-order methods are shown a second time with `longer` times that budget, because one of
    their iterations costs less.

    Args:
        chains: of every method.
        iterations: the budget; that of the preconditioned settings by default.
        longer: factor of the second budget.
    """
    problem = tasks.load("bug_trap").make()
    budget = iterations or settings.budget_of(settings.TRAP)
    solvers = _methods(budget, longer)
    start = settings.initial_knots(problem, chains)
    columns = -(-len(solvers) // 2)
    figure = new_figure(2.6 * columns, 6.8)
    panels = figure.subplots(2, columns, sharex=True, sharey=True).ravel()
    rows = []
    for axes, (name, solver) in zip(panels, solvers.items(), strict=False):
        solution = solve(problem, chains, solver=solver, guess=start)
        rows.append(solve_row(name, solution))
        _draw_paths(axes, solution)
        axes.set_title(f"{name}\n{_outcome(rows[-1])}", loc="left", fontsize=8)
    for axes in panels[len(solvers) :]:
        axes.axis("off")
    for color, label in (
        (BLUE, "escaped"),
        (VERMILLION, "feasible, misses the goal"),
        ("0.7", "infeasible"),
    ):
        panels[0].plot([], [], color=color, label=label)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(
        f"Bug trap, K = {problem.horizon}, {chains} chains from the same knots", fontsize=10
    )
    return {"rows": rows, "budget": budget, "settings": solvers}, figure


def _methods(budget: int, longer: int) -> dict[str, Langevin]:
    """The methods that are compared, each with a budget of iterations."""
    flow, diffusion = settings.TRAP_FLOW, with_budget(settings.TRAP, budget)
    first_order = {
        "gradient descent": replace(flow, noise=NO_NOISE),
        "quasi-Newton": settings.TRAP_QUASI_NEWTON,
        "paper's flow": flow,
    }
    return {
        **{name: with_budget(solver, budget) for name, solver in first_order.items()},
        "preconditioned, no noise": replace(diffusion, noise=NO_NOISE),
        "preconditioned diffusion": diffusion,
        **{
            f"{name}, {longer}×": with_budget(solver, longer * budget)
            for name, solver in first_order.items()
        },
    }


def _draw_paths(axes: Axes, solution: Solution) -> None:
    """Paths of all chains over the obstacles."""
    task = tasks.load("bug_trap")
    side = np.linspace(-3.0, 3.0, 121)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    shade = np.exp(-5.0 * np.square(grid[..., None, :] - task.WALL).sum(-1)).sum(-1)
    axes.contourf(side, side, shade, levels=20, cmap="Greys", vmax=1.6 * shade.max())
    paths = solution.plans
    escaped = reaching(solution)
    styles: list[tuple[np.ndarray, str, dict[str, Any]]] = [
        (~solution.feasible, "0.7", {"lw": 0.3, "alpha": 0.4}),
        (solution.feasible & ~escaped, VERMILLION, {"lw": 0.7, "alpha": 0.5}),
        (escaped, BLUE, {"lw": 0.7, "alpha": 0.5}),
    ]
    for chosen, color, style in styles:
        for path in paths[chosen]:
            axes.plot(path[:, 0], path[:, 1], color=color, **style)
    axes.plot(*paths[0, 0, :2], "s", ms=5, color=BLACK)
    axes.plot(*task.GOAL, "*", ms=13, color=GREEN, mec="white")
    axes.set(xlim=(-3, 3), ylim=(-3, 3), aspect="equal")
    axes.tick_params(labelsize=7)


def _outcome(row: Numbers) -> str:
    """The title of a panel."""
    best = "" if row["best cost"] is None else f", cost {row['best cost']:.4g}"
    return (
        f"{row['iterations']:,} iterations: {row['reaches goal']:.0%} escape{best}\n"
        f"{row['feasible']:.0%} feasible, median max|h| {row['median max|h|']:.0e}"
    )
