"""|h|^2 over the iterations of the paper's flow on the pendulum, for several penalties mu."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.langevin import Langevin, State
from mjx_drax.method.schedules import Constant
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE, advance, evaluate, start
from mjx_drax.solution.progress import reporting
from mjx_drax.studies.measurements import judge
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, tell
from mjx_drax.view.plotting import CURVES, label_axes, new_figure


def make(
    chains: int = 32,
    iterations: int | None = None,
    penalties: Sequence[float] = (0.01, 0.1, 1.0, 10.0, 100.0),
) -> tuple[Numbers, Figure]:
    """Median and middle 80 % of the chains.

    The step is alpha = 0.025 as long as that is stable, and 0.25 / mu beyond mu = 10, because the
    largest eigenvalue of mu J'J grows with mu.
    There are `chains` of each penalty mu, and 20,000 iterations by default.
    """
    problem = tasks.load("pendulum").make()
    flow = settings.pendulum_flows(iterations)["paper's flow"]
    total, usual = int(flow.iterations), float(np.asarray(flow.step_size))
    stops = np.unique(np.linspace(0, total, 201).round().astype(int))
    figure = new_figure(7.0, 4.2)
    axes = figure.subplots()
    rows, series = [], {}
    for mu, color in zip(penalties, CURVES, strict=False):
        tell(f"convergence: μ = {mu:g}")
        squares, state, row = followed(flow, problem, mu, chains, stops)
        low, median, high = np.nanquantile(squares, (0.1, 0.5, 0.9), axis=1)
        diverged = float(np.mean(~np.asarray(state.alive)))
        rows.append({"mu": mu, **row, "diverged": diverged})
        curves = {"p10": low, "median": median, "p90": high}
        series[f"mu={mu:g}"] = {name: values.tolist() for name, values in curves.items()}
        step = row["step size"]
        label = f"μ = {mu:g}" + ("" if step == usual else f",  α = {step:g}")
        axes.fill_between(stops, low, high, color=color, alpha=0.2, lw=0)
        axes.plot(stops, median, color=color, lw=1.6, label=label)
    axes.set(yscale="log", xlim=(0, total))
    label_axes(axes, "iteration", "constraint violation |h|²")
    axes.set_title(
        f"Paper's flow, pendulum: median and middle 80 % of {chains} chains, "
        f"α = {usual:g} unless stated",
        loc="left",
        fontsize=9,
    )
    axes.legend(fontsize=8, loc="lower left", framealpha=0.9, edgecolor="none")
    return {
        "rows": rows,
        "settings": {"paper's flow": flow},
        "series": {"iteration": stops.tolist(), **series},
    }, figure


def followed(
    flow: Langevin, problem: Problem, mu: float, chains: int, stops: np.ndarray
) -> tuple[np.ndarray, State, Numbers]:
    """|h|^2 (stops, chains) after so many iterations with a penalty, the last state, and its row.

    alpha is the flow's own, and less where a large mu would make it unstable.
    """
    step = min(float(np.asarray(flow.step_size)), 0.25 / mu)
    solver = replace(flow, penalty=Constant(mu), step_size=step)
    state = start(solver, problem, settings.initial_knots(problem, chains), jax.random.key(0))
    squares = [np.asarray(_square(problem, state.trajectory))]
    with reporting(None, f"μ = {mu:g}") as report:
        for begin, end in pairwise(stops):
            state, _ = advance(solver, problem, state, int(begin), int(end))
            squares.append(np.asarray(_square(problem, state.trajectory)))
            if report is not None:
                report(int(end), int(stops[-1]))
    defect = np.asarray(evaluate(problem, state.trajectory).max_defect)
    upright = judge(problem, np.asarray(state.trajectory.u, float)).success
    return (
        np.stack(squares),
        state,
        {
            "step size": step,
            "iterations": int(flow.iterations),
            "chains": chains,
            "median |h|²": float(np.nanmedian(squares[-1])),
            "median max|h|": float(np.median(defect)),
            "feasible": float(np.mean(defect < FEASIBLE)),
            "rollout upright": float(np.mean(upright)),
        },
    )


@jax.jit
def _square(problem: Problem, trajectory: Trajectory) -> Array:
    """|h|^2 of every chain."""
    return jax.vmap(lambda z: jnp.sum(jnp.square(problem.defects(z))))(trajectory)
