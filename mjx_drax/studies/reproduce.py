"""The paper's figures and table, and answers to its open questions: one function each.

    phase_portrait    the pendulum's knots before and after, and its bang-bang controls
    convergence       |h|^2 over the iterations for several penalties mu
    bug_trap          gradient descent, quasi-Newton and diffusion side by side
    parallel_table    N pendulums at once: time, and what the time bought
    open_questions    preconditioning, annealing, noise or none, sampled or exact gradients

Each returns numbers (`rows` of a table, `settings`, and more) and a figure; sizes are arguments.
`run` does one by name and writes both. No number below is a result: there are settings, and the
times that the paper published. A chain counts as feasible when max|h| < 1e-3, and an end as
reached when the float64 rollout of its controls, open loop, reaches it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_drax import __version__, tasks
from mjx_drax.method.langevin import FEASIBLE, Info, Langevin, State, advance, evaluate
from mjx_drax.method.metrics import Diagonal, GaussNewton, Identity
from mjx_drax.method.quasi_newton import LBFGS
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.problem.differentiators import Autodiff, Smoothed
from mjx_drax.problem.problem import Problem, Trajectory
from mjx_drax.solution.save import writable
from mjx_drax.solution.solution import Solution, solve
from mjx_drax.view.plotting import (
    BLACK,
    BLUE,
    CURVES,
    DPI,
    GRAY,
    GREEN,
    ORANGE,
    SKY,
    VERMILLION,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Numbers = dict[str, Any]

STEP = 0.025

# Preconditioned settings for one attempt, chosen by hand for each problem
PENDULUM = Langevin(
    iterations=150,
    tail=50,
    noise=Geometric(0.1, 0.01),
    penalty=Geometric(100.0, 100.0),
    damping=Geometric(1e-3, 1e-4),
    barrier_weight=Geometric(0.1, 1e-3, 1e-6),
)

TRAP = Langevin(
    iterations=300,
    tail=100,
    noise=Geometric(30.0, 0.01),
    penalty=Geometric(100.0, 1000.0),
    damping=Geometric(10.0, 0.1, 1e-3),
    barrier_weight=Geometric(0.1, 1e-3, 1e-4),
)
PENDULUM_FLOW = Langevin(
    iterations=20_000,
    tail=0,
    step_size=STEP,
    noise=Geometric(0.1, 1e-4),
    penalty=Constant(10.0),
    barrier_weight=Geometric(0.1, 1e-4),
    preconditioner=Identity(),
)
"""The paper's flow for its pendulum: mu = 10, 20,000 iterations, dlambda = mu h dt as printed."""

TRAP_FLOW = replace(
    PENDULUM_FLOW,
    step_size=1.2e-3,
    noise=Geometric(10.0, 1e-4),
    penalty=Constant(150.0),
    barrier_weight=Geometric(0.1, 1e-3),
)
"""The paper's flow for the bug trap: obstacles a thousand times stiffer allow only small steps."""

TRAP_QUASI_NEWTON = replace(
    TRAP_FLOW,
    iterations=0,
    tail=20_000,
    barrier_weight=Geometric(0.1, 0.1, 1e-3),
    preconditioner=LBFGS(),
)
"""The method of multipliers with L-BFGS and a line search."""

NO_NOISE = Geometric(0.0, 0.0)  # not Constant(0.0), which would compile everything once more

PUBLISHED = {64: 0.68, 256: 0.75, 1024: 1.04, 2048: 1.49, 4096: 2.12, 8192: 3.53, 16384: 7.95}
"""Times [s] that the paper gives for N pendulums, 20,000 iterations, on an RTX 4070."""


def phase_portrait(
    chains: int = 64, iterations: int | None = None, seed: int = 0
) -> tuple[Numbers, Figure]:
    """The pendulum's scattered initial knots, the result, and the controls.

    Left the paper's flow, right the preconditioned one, from the same random knots.

    Args:
        chains: number of chains; the first is drawn, whatever became of it.
        iterations: of the paper's flow; 20,000 by default.
        seed: of all random numbers.
    """
    problem, preconditioned = _task("pendulum")
    flow = replace(PENDULUM_FLOW, iterations=iterations or PENDULUM_FLOW.iterations)
    start = _initial_knots(problem, chains, seed)
    solvers = {"paper's flow": flow, "preconditioned": preconditioned}
    figure = _figure(8.0, 6.0)
    axes = figure.subplots(2, 2, sharex="row", sharey="row", height_ratios=(2, 1))
    rows = []
    for column, (name, solver) in enumerate(solvers.items()):
        solution = solve(problem, chains, seed, solver, guess=start)
        rows.append(_solve_row(name, solution))
        _draw_phase(axes[0, column], problem, jax.tree.map(lambda a: a[0], start), solution)
        _draw_controls(axes[1, column], solution)
        axes[0, column].set_title(_verdict(name, solution), loc="left", fontsize=8)
    for panel in (*axes[:, 1], axes[0, 1]):
        panel.set_ylabel("")
    axes[0, 0].legend(fontsize=7, loc="upper left", framealpha=0.9, edgecolor="none")
    figure.suptitle("Pendulum swing-up, K = 49, |u| ≤ 1: random knots and result", fontsize=10)
    return {"rows": rows, "settings": _settings(solvers)}, figure


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
    _style(axes, "angle from upright [rad]", "angular velocity [rad/s]")


def _draw_controls(axes: Axes, solution: Solution) -> None:
    """The first chain's controls, held from knot to knot, between their bounds."""
    problem, times, u = solution.problem, solution.problem.times, solution.trajectories.u[0, :, 0]
    axes.step(times, np.append(u, u[-1]), where="post", color=BLUE)
    for end in (problem.bounds.u_lower, problem.bounds.u_upper):
        axes.axhline(float(np.ravel(end)[0]), ls=":", color=GRAY)
    axes.set(xlim=(times[0], times[-1]), ylim=(-1.15, 1.15))
    _style(axes, "time [s]", "torque u [N m]")


def convergence(
    chains: int = 64,
    iterations: int | None = None,
    penalties: Sequence[float] = (0.01, 0.1, 1.0, 10.0, 100.0),
    seed: int = 0,
) -> tuple[Numbers, Figure]:
    """|h|^2 over the iterations of the paper's flow on the pendulum, for several penalties mu.

    The step is alpha = 0.025 as long as that is stable, and 0.25 / mu beyond mu = 10, because the
    largest eigenvalue of mu J'J grows with mu.

    Args:
        chains: of each penalty; median and the middle 80 % are drawn.
        iterations: 20,000 by default.
        penalties: values of mu.
        seed: of all random numbers; the same for every mu.
    """
    problem, _ = _task("pendulum")
    total = iterations or int(PENDULUM_FLOW.iterations)
    stops = np.unique(np.linspace(0, total, 201).round().astype(int))
    figure = _figure(7.0, 4.2)
    axes = figure.subplots()
    rows, series = [], {}
    for mu, color in zip(penalties, CURVES, strict=False):
        step = min(STEP, 0.25 / mu)
        solver = replace(PENDULUM_FLOW, iterations=total, penalty=Constant(mu), step_size=step)
        squares, state = _violations(solver, problem, chains, seed, stops)
        low, median, high = np.nanquantile(squares, (0.1, 0.5, 0.9), axis=1)
        info = evaluate(problem, state.trajectory)
        rows.append(
            {
                "mu": mu,
                "step size": step,
                "iterations": total,
                "chains": chains,
                "median |h|²": float(median[-1]),
                "median max|h|": float(np.median(info.max_defect)),
                "feasible": float(np.mean(np.asarray(info.max_defect) < FEASIBLE)),
                "rollout upright": float(np.mean(_reaches(problem, state.trajectory))),
                "diverged": float(np.mean(~np.asarray(state.alive))),
            }
        )
        series[f"mu={mu:g}"] = {
            "p10": low.tolist(),
            "median": median.tolist(),
            "p90": high.tolist(),
        }
        label = f"μ = {mu:g}" + ("" if step == STEP else f",  α = {step:g}")
        axes.fill_between(stops, low, high, color=color, alpha=0.2, lw=0)
        axes.plot(stops, median, color=color, lw=1.6, label=label)
    axes.set(yscale="log", xlim=(0, total))
    _style(axes, "iteration", "constraint violation |h|²")
    axes.set_title(
        f"Paper's flow, pendulum: median and middle 80 % of {chains} chains, "
        f"α = {STEP:g} unless stated",
        loc="left",
        fontsize=9,
    )
    axes.legend(fontsize=8, loc="lower left", framealpha=0.9, edgecolor="none")
    return {
        "rows": rows,
        "settings": _settings({"paper's flow": replace(PENDULUM_FLOW, iterations=total)}),
        "series": {"iteration": stops.tolist(), **series},
    }, figure


def _violations(
    solver: Langevin, problem: Problem, chains: int, seed: int, stops: np.ndarray
) -> tuple[np.ndarray, State]:
    """|h|^2 (stops, chains) after the given numbers of iterations, and the last state."""
    state = solver.init(problem, _initial_knots(problem, chains, seed), jax.random.key(seed))
    squares = [np.asarray(_square(problem, state.trajectory))]
    for start, stop in pairwise(stops):
        state = advance(solver, problem, state, int(start), int(stop))
        squares.append(np.asarray(_square(problem, state.trajectory)))
    return np.stack(squares), state


@jax.jit
def _square(problem: Problem, trajectory: Trajectory) -> Array:
    """|h|^2 of every chain."""
    return jax.vmap(lambda z: jnp.sum(jnp.square(problem.defects(z))))(trajectory)


def bug_trap(
    chains: int = 256, iterations: int | None = None, longer: int = 50, seed: int = 0
) -> tuple[Numbers, Figure]:
    """Who leaves the trap: the same knots, the same budget of iterations for every method.

    First-order methods are shown a second time with `longer` times that budget, because one of
    their iterations costs less.

    Args:
        chains: of every method.
        iterations: the budget; the task's own by default.
        longer: factor of the second budget.
        seed: of all random numbers.
    """
    problem, diffusion = _task("bug_trap")
    budget = iterations or int(diffusion.iterations) + int(diffusion.tail)
    solvers = _trap_methods(diffusion, budget)
    solvers |= {
        f"{name}, {longer}×": _budget(solvers[name], longer * budget)
        for name in ("gradient descent", "quasi-Newton", "paper's flow")
    }
    start = _initial_knots(problem, chains, seed)
    columns = -(-len(solvers) // 2)
    figure = _figure(2.6 * columns, 6.8)
    panels = figure.subplots(2, columns, sharex=True, sharey=True).ravel()
    rows = []
    for axes, (name, solver) in zip(panels, solvers.items(), strict=False):
        solution = solve(problem, chains, seed, solver, guess=start)
        rows.append(_solve_row(name, solution))
        _draw_trap(axes, solution)
        axes.set_title(f"{name}\n{_escapes(rows[-1])}", loc="left", fontsize=8)
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
    return {"rows": rows, "budget": budget, "settings": _settings(solvers)}, figure


def _trap_methods(diffusion: Langevin, budget: int) -> dict[str, Langevin]:
    """The methods that are compared, each with a budget of iterations."""
    flow = _budget(TRAP_FLOW, budget)
    methods = {
        "gradient descent": replace(flow, noise=NO_NOISE),
        "quasi-Newton": _budget(TRAP_QUASI_NEWTON, budget),
    }
    methods["paper's flow"] = flow
    diffusion = _budget(diffusion, budget)
    methods["preconditioned, no noise"] = replace(diffusion, noise=NO_NOISE)
    methods["preconditioned diffusion"] = diffusion
    return methods


def _draw_trap(axes: Axes, solution: Solution) -> None:
    """Paths of all chains over the obstacles."""
    task = tasks.load("bug_trap")
    side = np.linspace(-3.0, 3.0, 121)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    shade = np.exp(-5.0 * np.square(grid[..., None, :] - task.WALL).sum(-1)).sum(-1)
    axes.contourf(side, side, shade, levels=20, cmap="Greys", vmax=1.6 * shade.max())
    paths = np.asarray(solution.problem.with_start(solution.trajectories))
    escaped = solution.feasible & solution.open_loop.success
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


def _escapes(row: Numbers) -> str:
    """What a panel of the bug trap says."""
    best = "" if row["best cost"] is None else f", cost {row['best cost']:.4g}"
    return (
        f"{row['iterations']:,} iterations: {row['reaches goal']:.0%} escape{best}\n"
        f"{row['feasible']:.0%} feasible, median max|h| {row['median max|h|']:.0e}"
    )


def parallel_table(
    chains: int | None = None,
    iterations: int | None = None,
    sizes: Sequence[int] = tuple(PUBLISHED),
    seed: int = 0,
) -> tuple[Numbers, Figure]:
    """N pendulums at once, each from its own random x_init, U(-4, 4)², one chain a problem.

    Then the same with all of them hanging at rest, x_init = (3.1, 0), because from many random
    states upright cannot be reached. Times are of compiled programs, from drawing the initial knots
    to the final ones.

    Args:
        chains: leaves out larger N (for a CPU).
        iterations: of the paper's flow; 20,000 by default.
        sizes: values of N.
        seed: of all random numbers.
    """
    problem, preconditioned = _task("pendulum")
    flow = replace(PENDULUM_FLOW, iterations=iterations or PENDULUM_FLOW.iterations)
    solvers = {"paper's flow": flow, "preconditioned": preconditioned}
    sizes = [n for n in sizes if chains is None or n <= chains] or [min(sizes)]
    rows, key = [], jax.random.key(seed)
    for size, kind in product(sizes, STARTS):
        starts = jnp.broadcast_to(problem.x_init, (size, 2))
        if kind == "random":
            starts = jax.random.uniform(key, (size, 2), minval=-4.0, maxval=4.0)
        row: Numbers = {"N": size, "x_init": kind, "published, RTX 4070 [s]": PUBLISHED.get(size)}
        for name, solver in solvers.items():
            row |= {f"{name}: {k}": v for k, v in _solve_many(solver, problem, starts, key).items()}
        rows.append(row)
    return {"rows": rows, "settings": _settings(solvers)}, _draw_table(rows, solvers)


STARTS = ("random", "hanging")
"""Initial states of the table's problems: U(-4, 4)², or all (3.1, 0)."""


def _solve_many(solver: Langevin, problem: Problem, starts: Array, key: Array) -> Numbers:
    """Time and quality of one chain for each of many initial states (N, nx)."""
    total = int(solver.iterations) + int(solver.tail)
    keys = jax.random.split(key, len(starts))
    tail = int(solver.tail) > 0
    compiled = many.lower(solver, problem, starts, keys, total, tail).compile()
    jax.block_until_ready(compiled(solver, problem, starts, keys))  # loads, allocates
    clock = time.perf_counter()
    trajectory, info = jax.block_until_ready(compiled(solver, problem, starts, keys))
    seconds = time.perf_counter() - clock
    h = np.asarray(info.max_defect)
    return {
        "time [s]": seconds,
        "max|h| < 5e-3": float(np.mean(h < 5 * FEASIBLE)),
        "max|h| < 1e-3": float(np.mean(h < FEASIBLE)),
        "rollout upright": float(np.mean(_reaches(problem, trajectory, starts))),
    }


@partial(jax.jit, static_argnames=("total", "tail"))
def many(
    solver: Langevin, problem: Problem, starts: Array, keys: Array, total: int, tail: bool
) -> tuple[Trajectory, Info]:
    """One chain for each initial state: knots (N, K, ...) and diagnostics (N,) at the end.

    The number of iterations is static: a GPU then need not ask after each whether it was the last.
    """

    def one(x_init: Array, key: Array) -> State:
        own = replace(problem, x_init=x_init)
        key_knots, key_noise = jax.random.split(key)
        knots = jax.tree.map(lambda a: a[None], own.draw(key_knots))
        return solver.init(own, knots, key_noise)

    def step(x_init: Array, state: State, i: Array) -> State:
        return solver.step(replace(problem, x_init=x_init), state, i, tail)

    def judge(x_init: Array, state: State) -> tuple[Trajectory, Info]:
        answer = state.trajectory, evaluate(replace(problem, x_init=x_init), state.trajectory)
        return jax.tree.map(lambda a: a[0], answer)

    states = jax.vmap(one)(starts, keys)
    states = jax.lax.fori_loop(
        0, total, lambda i, s: jax.vmap(step, in_axes=(0, 0, None))(starts, s, i), states
    )
    return jax.vmap(judge)(starts, states)


def _draw_table(rows: Sequence[Numbers], solvers: dict[str, Langevin]) -> Figure:
    """Times, and shares of problems whose rollout reaches upright, over N."""
    figure = _figure(8.0, 3.6)
    left, right = figure.subplots(1, 2, sharex=True)
    left.loglog(*zip(*PUBLISHED.items(), strict=True), "o--", color=GRAY)
    left.lines[-1].set_label("published, 20,000 iterations, RTX 4070")
    for (name, color, marker), (kind, dashes) in product(
        zip(solvers, (VERMILLION, BLUE), "s^", strict=True), zip(STARTS, ("--", "-"), strict=True)
    ):
        own = [row for row in rows if row["x_init"] == kind]
        sizes = [row["N"] for row in own]
        style: Any = {"color": color, "marker": marker, "ls": dashes, "ms": 5}
        if kind == "hanging":
            total = int(solvers[name].iterations) + int(solvers[name].tail)
            label = f"{name}, {total:,} iterations, {jax.devices()[0].device_kind}"
            left.plot(sizes, [row[f"{name}: time [s]"] for row in own], label=label, **style)
        shares = [row[f"{name}: rollout upright"] for row in own]
        right.plot(sizes, shares, label=f"{name}, x_init {kind}", **style)
    right.set_ylim(-0.05, 1.05)
    for axes, label in ((left, "time [s]"), (right, "share whose rollout reaches upright")):
        _style(axes, "problems N", label)
        axes.legend(fontsize=7)
    return figure


def open_questions(
    chains: int = 256,
    iterations: int | None = None,
    limit: int | None = None,
    pairs: Sequence[int] = (2, 3, 4, 16),
    seed: int = 0,
) -> tuple[Numbers, Figure]:
    """What the paper leaves open: the metric, the annealing, the noise, the gradients.

    Args:
        chains: of every solve on the bug trap, and on the pendulum up to 64.
        iterations: budget on the bug trap; the task's own by default.
        limit: most iterations that a preconditioner gets to become feasible; 20,000 by default.
        pairs: antithetic pairs of samples for a gradient; a pendulum's knot has three directions.
        seed: of all random numbers.
    """
    few = min(chains, 64)
    metrics, settings = _preconditioning(few, limit or int(PENDULUM_FLOW.iterations), seed)
    annealing, sigmas, solver = _annealing(chains, iterations, seed)
    gradients = _gradients(few, pairs, seed)
    figure = _figure(8.0, 6.4)
    panels = figure.subplots(2, 2)
    _draw_metrics(panels[0, 0], metrics, few)
    _draw_sigmas(panels[0, 1], sigmas)
    _draw_shares(panels[1, 0], annealing, "escapes", "bug trap: which annealing")
    _draw_shares(panels[1, 1], gradients, "reaches goal", "pendulum: exact or sampled gradients")
    return {
        "preconditioning": metrics,
        "annealing": annealing,
        "gradients": gradients,
        "settings": settings | _settings({"bug trap": solver}),
        "sigmas": sigmas,
    }, figure


def _preconditioning(chains: int, limit: int, seed: int) -> tuple[list[Numbers], Numbers]:
    """Annealed solves of the pendulum with budgets that double until half the chains are feasible.

    Each metric anneals over its whole budget, so a row is a complete solve, not a point of one.
    """
    problem, preconditioned = _task("pendulum")
    diagonal = replace(
        PENDULUM_FLOW, preconditioner=Diagonal(), step_size=0.3, damping=Constant(1e-3)
    )
    solvers = {"identity": PENDULUM_FLOW, "diagonal": diagonal, "Gauss-Newton": preconditioned}
    start, rows = _initial_knots(problem, chains, seed), []
    for name, solver in solvers.items():
        budget, median = 0, np.inf
        while median >= FEASIBLE and budget < limit:
            budget = min(max(2 * budget, 20), limit)
            solution = solve(problem, chains, seed, _budget(solver, budget), guess=start)
            rows.append(_solve_row(name, solution))
            median = rows[-1]["median max|h|"]
    return rows, _settings(solvers)


def _annealing(
    chains: int, iterations: int | None, seed: int
) -> tuple[list[Numbers], dict[str, Any], Langevin]:
    """The bug trap under several rules for sigma(t), the adaptive one fed with the chains' costs.

    A rule sees progress t, sigma so far and the chains' costs; sigma is set every few iterations,
    as a traced number of one compiled program.
    """
    problem, solver = _task("bug_trap")
    solver = _budget(solver, iterations or int(solver.iterations) + int(solver.tail))
    first, last = 30.0, 0.01

    def aarts(t: float, sigma: float, cost: np.ndarray) -> float:
        """T <- T / (1 + T log(1 + delta) / (3 std(c))), T = sigma²: Aarts, van Laarhoven (1985)."""
        temperature = sigma**2
        return (temperature / (1 + temperature * np.log1p(DELTA) / (3 * np.std(cost)))) ** 0.5

    rules: dict[str, Callable[[float, float, np.ndarray], float]] = {
        "geometric": lambda t, sigma, cost: first * (last / first) ** t,
        "linear": lambda t, sigma, cost: first + (last - first) * t,
        "constant, then none": lambda t, sigma, cost: first,
        "constant / 3, then none": lambda t, sigma, cost: first / 3,
        "adaptive": lambda t, sigma, cost: aarts(t, sigma, cost) if t else first,
        "no noise": lambda t, sigma, cost: 0.0,
    }
    rows, sigmas = [], {}
    for name, rule in rules.items():
        trajectory, stops, values = _annealed(solver, problem, chains, seed, rule)
        info = evaluate(problem, trajectory)
        feasible = np.asarray(info.max_defect) < FEASIBLE
        escaped = feasible & _reaches(problem, trajectory)
        share = float(escaped.mean())
        rows.append(
            {
                "annealing": name,
                "iterations": int(solver.iterations) + int(solver.tail),
                "chains": chains,
                "escapes": share,
                "standard error": (share * (1 - share) / chains) ** 0.5,
                "feasible": float(feasible.mean()),
                "best cost": float(np.min(info.cost[escaped])) if escaped.any() else None,
                "last σ": values[-1],
            }
        )
        sigmas[name] = {"iteration": stops, "sigma": values}
    return rows, sigmas, solver


CHUNK, DELTA = 5, 20.0
"""Iterations between two values of sigma; distance parameter of the adaptive rule."""


def _annealed(
    solver: Langevin,
    problem: Problem,
    chains: int,
    seed: int,
    rule: Callable[[float, float, np.ndarray], float],
) -> tuple[Trajectory, list[int], list[float]]:
    """Final knots, and the sigmas that the rule gave at which iterations."""
    state = solver.init(problem, _initial_knots(problem, chains, seed), jax.random.key(seed))
    noisy, total = int(solver.iterations), int(solver.iterations) + int(solver.tail)
    stops, values, sigma = list(range(0, noisy, CHUNK)), [], 0.0
    for i in stops:
        cost = np.asarray(evaluate(problem, state.trajectory).cost)
        sigma = float(rule(i / max(stops[-1], 1), sigma, cost))
        values.append(sigma)
        now = replace(solver, noise=Geometric(sigma, sigma))
        state = advance(now, problem, state, i, min(i + CHUNK, noisy))
    state = advance(replace(solver, noise=NO_NOISE), problem, state, noisy, total)
    return jax.block_until_ready(state.trajectory), stops, values


def _gradients(chains: int, pairs: Sequence[int], seed: int) -> list[Numbers]:
    """The pendulum with exact derivatives, and with those estimated from function values alone."""
    problem, solver = _task("pendulum")
    choices = {"exact": GaussNewton(Autodiff())}
    choices |= {f"{n} pairs a knot": GaussNewton(Smoothed(n)) for n in pairs}
    start, rows = _initial_knots(problem, chains, seed), []
    for name, choice in choices.items():
        own = replace(solver, preconditioner=choice)
        rows.append(_solve_row(name, solve(problem, chains, seed, own, guess=start)))
    return rows


def _draw_metrics(axes: Axes, rows: Sequence[Numbers], chains: int) -> None:
    names = list(dict.fromkeys(row["method"] for row in rows))
    for name, color, marker in zip(names, CURVES, "so^", strict=False):
        own = [row for row in rows if row["method"] == name]
        budgets, medians = ([row[k] for row in own] for k in ("iterations", "median max|h|"))
        axes.loglog(budgets, medians, f"{marker}-", ms=4, color=color, label=name)
    axes.axhline(FEASIBLE, ls=":", color=BLACK, lw=1.2, label=f"feasible: below {FEASIBLE:g}")
    _style(axes, "iterations of a complete annealed solve", "median max|h|")
    axes.set_title(f"pendulum, {chains} chains: which metric", loc="left", fontsize=9)
    axes.legend(fontsize=7)


def _draw_sigmas(axes: Axes, sigmas: dict[str, Any]) -> None:
    for (name, curve), color in zip(sigmas.items(), (*CURVES, GRAY), strict=False):
        if max(curve["sigma"]) > 0:
            axes.semilogy(curve["iteration"], curve["sigma"], color=color, label=name)
    _style(axes, "iteration", "σ")
    axes.set_title("bug trap: annealing schedules", loc="left", fontsize=9)
    axes.legend(fontsize=7)


def _draw_shares(axes: Axes, rows: Sequence[Numbers], key: str, title: str) -> None:
    labels = [str(next(iter(row.values()))) for row in rows]
    shares = [row[key] for row in rows]
    errors = [(s * (1 - s) / row["chains"]) ** 0.5 for s, row in zip(shares, rows, strict=True)]
    bars = axes.barh(labels, shares, xerr=errors, color=SKY, ecolor=GRAY, height=0.6)
    axes.bar_label(bars, [_cost_label(row) for row in rows], fontsize=7, padding=3)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.6 * max(0.05, *shares))
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= 1.0])
    _style(axes, "share of chains whose rollout reaches the goal", "")
    axes.set_title(title, loc="left", fontsize=9)


def _cost_label(row: Numbers) -> str:
    return "" if row["best cost"] is None else f"best cost {row['best cost']:.4g}"


# What they share


def _task(name: str) -> tuple[Problem, Langevin]:
    """A task's problem, and preconditioned settings for one attempt at it."""
    return tasks.load(name).make(), {"pendulum": PENDULUM, "bug_trap": TRAP}[name]


def _initial_knots(problem: Problem, chains: int, seed: int) -> Trajectory:
    """The same random knots for every method."""
    return jax.vmap(problem.draw)(jax.random.split(jax.random.key(seed), chains))


def _budget(solver: Langevin, total: int) -> Langevin:
    """The same settings with this many iterations, of which the tail keeps its share."""
    tail = round(total * int(solver.tail) / (int(solver.iterations) + int(solver.tail)))
    return replace(solver, iterations=total - tail, tail=tail)


def _reaches(problem: Problem, trajectory: Trajectory, starts: Array | None = None) -> np.ndarray:
    """Whether the float64 rollout of each chain's controls, open loop, reaches the goal."""
    x, u = (np.asarray(a, float) for a in (trajectory.x, trajectory.u))
    first = np.asarray(problem.x_init if starts is None else starts, float)
    first = np.broadcast_to(first, (len(x), x.shape[-1]))
    gains = np.zeros((*u.shape, problem.dynamics.ndx))
    limits = np.asarray(problem.bounds.u_lower, float), np.asarray(problem.bounds.u_upper, float)
    states, _ = problem.dynamics.replay(
        np.concatenate([first[:, None], x], axis=1), u, gains, limits
    )
    return np.array([np.isfinite(s).all() and problem.reached(s[-1]) for s in states], bool)


def _solve_row(name: str, solution: Solution) -> Numbers:
    """A row of a table: what a method's chains came to."""
    reached = solution.feasible & solution.open_loop.success
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


def _verdict(name: str, solution: Solution) -> str:
    """Title of a panel that shows the first chain."""
    replay = solution.open_loop.summary(0)
    outcome = "reaches" if replay["success"] else "misses"
    reached = np.mean(solution.feasible & solution.open_loop.success)
    return (
        f"{name}, {solution.iterations:,} iterations\n"
        f"cost {solution.cost[0]:.4g}, max|h| {solution.max_defect[0]:.0e}\n"
        f"float64 rollout {outcome} upright, {replay['max_deviation']:.0e} off plan\n"
        f"one of {solution.chains} chains; of all, {reached:.0%} do"
    )


def _figure(width: float, height: float) -> Figure:
    return Figure((width, height), DPI, layout="constrained", facecolor="white")


def _style(axes: Axes, xlabel: str, ylabel: str) -> None:
    axes.set_xlabel(xlabel, fontsize=8)
    axes.set_ylabel(ylabel, fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(True, color="0.9", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _settings(part: Any) -> Any:
    """A solver's settings as JSON: names of its parts, and their numbers."""
    if isinstance(part, dict):
        return {name: _settings(value) for name, value in part.items()}
    if is_dataclass(part):
        values = {f.name: _settings(getattr(part, f.name)) for f in fields(part)}
        return {"type": type(part).__name__, **values}
    if callable(part):
        return getattr(part, "__name__", type(part).__name__)
    return part if part is None or isinstance(part, str) else np.asarray(part).tolist()


EXPERIMENTS: dict[str, Callable[..., tuple[Numbers, Figure]]] = {
    "phase-portrait": phase_portrait,
    "convergence": convergence,
    "bug-trap": bug_trap,
    "parallel-table": parallel_table,
    "open-questions": open_questions,
}


def run(
    name: str,
    folder: str | os.PathLike[str],
    chains: int | None = None,
    iterations: int | None = None,
) -> Numbers:
    """Do one of `EXPERIMENTS`; write NAME.png and NAME.json into a folder.

    Returns:
        the numbers, with the machine and versions that they were measured with.

    Raises:
        DraxError: the folder cannot be written to.
    """
    target = writable(folder)
    sizes = {"chains": chains, "iterations": iterations}
    given = {key: value for key, value in sizes.items() if value is not None}
    numbers, figure = EXPERIMENTS[name](**given)
    numbers = {
        "name": name,
        **numbers,
        "device": jax.devices()[0].device_kind,
        "cpus": os.cpu_count(),
        "versions": {
            "python": sys.version.split()[0],
            "mjx-drax": __version__,
            **{package: version(package) for package in ("jax", "numpy")},
        },
    }
    FigureCanvasAgg(figure).print_png(target / f"{name}.png")
    text = json.dumps(_without_nan(numbers), indent=2, ensure_ascii=False, allow_nan=False)
    (target / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    return numbers


def _without_nan(value: Any) -> Any:
    """The same with None where JSON has no number."""
    if isinstance(value, dict):
        return {key: _without_nan(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def table(numbers: Numbers) -> str:
    """All rows among the numbers, as Markdown tables."""
    parts = []
    for value in numbers.values():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            names = list(value[0])
            lines = [names, ["---"] * len(names)]
            lines += [[_cell(name, row[name]) for name in names] for row in value]
            parts.append("\n".join(f"| {' | '.join(cells)} |" for cells in lines))
    return "\n\n".join(parts).replace("max|h|", "max\\|h\\|")


_SHARES = ("feasible", "reaches goal", "with feedback", "escapes", "diverged", "rollout upright")


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if name.split(": ")[-1] in _SHARES or "max|h| <" in name:
        return f"{value:.1%}"
    return f"{value:.4g}" if isinstance(value, float) else f"{value}"
