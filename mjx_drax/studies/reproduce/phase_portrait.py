"""The pendulum's scattered initial knots, the result, and its bang-bang controls."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, reaching, solve_row, tell
from mjx_drax.view.plotting import BLACK, BLUE, GRAY, GREEN, ORANGE, label_axes, new_figure


def make(chains: int = 64, iterations: int | None = None) -> tuple[Numbers, Figure]:
    """Left the paper's flow, right the preconditioned one, from the same random knots.

    The first chain is drawn, whatever became of it. `iterations` of the paper's flow are 20,000 by
    default.
    """
    problem, solvers = tasks.load("pendulum").make(), settings.pendulum_flows(iterations)
    start = settings.initial_knots(problem, chains)
    figure = new_figure(8.0, 6.0)
    axes = figure.subplots(2, 2, sharex="row", sharey="row", height_ratios=(2, 1))
    rows = []
    for column, (name, solver) in enumerate(solvers.items()):
        tell(f"phase-portrait: {name}, {settings.budget_of(solver):,} iterations")
        solution = solve(problem, chains, solver=solver, guess=start)
        rows.append(solve_row(name, solution))
        _draw_phase(axes[0, column], problem, jax.tree.map(lambda a: a[0], start), solution)
        _draw_controls(axes[1, column], solution)
        axes[0, column].set_title(_title(name, solution), loc="left", fontsize=8)
    for panel in axes[:, 1]:
        panel.set_ylabel("")
    axes[0, 0].legend(fontsize=7, loc="upper left", framealpha=0.9, edgecolor="none")
    figure.suptitle("Pendulum swing-up, K = 49, |u| ≤ 1: random knots and result", fontsize=10)
    return {"rows": rows, "settings": solvers}, figure


def _draw_phase(axes: Axes, problem: Problem, before: Trajectory, solution: Solution) -> None:
    """Knots of the first chain, before and after, over the field of the unforced pendulum."""
    plan = np.vstack([np.asarray(problem.x_init), solution.trajectories.x[0]])
    reach = 1.05 * max(6.5, float(np.abs(plan[:, 1]).max()))
    grid = np.stack(np.meshgrid(np.linspace(-6.5, 6.5, 25), np.linspace(-reach, reach, 25)), -1)
    free = jnp.zeros(problem.dynamics.nu)
    change = jax.vmap(jax.vmap(lambda x: problem.dynamics.step(x, free) - x))(jnp.asarray(grid))
    arrows = np.asarray(change) / problem.dynamics.dt
    axes.quiver(*np.moveaxis(grid, -1, 0), *np.moveaxis(arrows, -1, 0), color="0.75", width=2e-3)
    axes.plot(*before.x.T, "o", ms=4, mfc="none", color=ORANGE, label="initial knots")
    axes.plot(*plan.T, ".-", ms=5, lw=1.4, color=BLUE, label="result")
    axes.plot(*plan[0], "s", ms=7, color=BLACK, label="start, hanging")
    axes.plot(0, 0, "*", ms=14, color=GREEN, label="goal, upright")
    axes.set(xlim=(-6.5, 6.5), ylim=(-reach, reach))
    label_axes(axes, "angle from upright [rad]", "angular velocity [rad/s]")


def _draw_controls(axes: Axes, solution: Solution) -> None:
    """The first chain's controls, held from knot to knot, between their bounds."""
    problem, times, u = solution.problem, solution.problem.times, solution.trajectories.u[0, :, 0]
    axes.step(times, np.append(u, u[-1]), where="post", color=BLUE)
    for end in (problem.bounds.u_lower, problem.bounds.u_upper):
        axes.axhline(float(np.ravel(end)[0]), ls=":", color=GRAY)
    axes.set(xlim=(times[0], times[-1]), ylim=(-1.15, 1.15))
    label_axes(axes, "time [s]", "torque u [N m]")


def _title(name: str, solution: Solution) -> str:
    """What became of the first chain, and of all."""
    replay = solution.open_loop.summary(0)
    outcome = "reaches" if replay["success"] else "misses"
    return (
        f"{name}, {solution.iterations:,} iterations\n"
        f"cost {solution.cost[0]:.4g}, max|h| {solution.max_defect[0]:.0e}\n"
        f"float64 rollout {outcome} upright, {replay['max_deviation']:.0e} off plan\n"
        f"one of {solution.chains} chains; of all, {np.mean(reaching(solution)):.0%} do"
    )
