"""What the paper leaves open: the metric, the annealing, the noise, the gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.method.gauss_newton import GaussNewton
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.metrics import Diagonal, Identity
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.problem.differentiators import Smoothed
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE, advance, evaluate, start
from mjx_drax.solution.progress import reporting
from mjx_drax.solution.solve import solve
from mjx_drax.studies.measurements import judge
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, solve_row, tell
from mjx_drax.studies.reproduce.settings import budget_of, initial_knots, with_budget
from mjx_drax.view.plotting import BLACK, CURVES, GRAY, SKY, label_axes, new_figure

FULL = {"chains": 256}
"""Sizes with --full."""

EVERY = 5
"""Iterations between two values of sigma."""

FIRST, LAST = 30.0, 0.01
"""sigma at the first and at the last iteration with noise."""

DISTANCE = 20.0
"""delta of the adaptive rule: how far the chains may be from equilibrium."""

Rule = Callable[[float, float, np.ndarray], float]


def make(
    chains: int = 64,
    iterations: int | None = None,
    limit: int | None = None,
    pairs: Sequence[int] = (2, 3, 4, 16),
) -> tuple[Numbers, Figure]:
    """Metrics and gradients on the pendulum, annealing and noise on the bug trap.

    Args:
        chains: of every solve on the bug trap, and on the pendulum up to 64.
        iterations: budget on the bug trap; that of the preconditioned settings by default.
        limit: most iterations that a metric gets to become feasible, and those of the paper's
            flow with sampled gradients; 20,000 by default.
        pairs: antithetic pairs of samples for a gradient; a pendulum's knot has three directions.
    """
    few = min(chains, 64)
    solvers = {
        "identity": settings.PENDULUM_FLOW,
        "diagonal": replace(
            settings.PENDULUM_FLOW,
            preconditioner=Diagonal(),
            step_size=0.3,
            damping=Constant(1e-3),
        ),
        "Gauss-Newton": settings.PENDULUM,
    }
    limit = limit or budget_of(settings.PENDULUM_FLOW)
    metrics = _compare_metrics(solvers, few, limit)
    trap = with_budget(settings.TRAP, iterations or budget_of(settings.TRAP))
    annealing, sigmas = _compare_annealing(trap, chains)
    gradients = _compare_gradients(solvers, few, limit, pairs)
    figure = new_figure(9.0, 7.0)
    panels = figure.subplots(2, 2)
    _draw_metrics(panels[0, 0], metrics, few)
    _draw_sigmas(panels[0, 1], sigmas)
    _draw_shares(panels[1, 0], annealing, "escapes", "bug trap: which annealing")
    _draw_shares(panels[1, 1], gradients, "reaches goal", "pendulum: exact or sampled gradients")
    return {
        "preconditioning": metrics,
        "annealing": annealing,
        "gradients": gradients,
        "settings": {**solvers, "bug trap": trap},
        "sigmas": sigmas,
    }, figure


def _compare_metrics(solvers: dict[str, Langevin], chains: int, limit: int) -> list[Numbers]:
    """Annealed solves of the pendulum with budgets that double until half the chains are feasible.

    Each metric anneals over its whole budget, so a row is a complete solve, not a point of one.
    """
    problem = tasks.load("pendulum").make()
    knots, rows = initial_knots(problem, chains), []
    for name, solver in solvers.items():
        budget, median = 0, np.inf
        while median >= FEASIBLE and budget < limit:
            budget = min(max(2 * budget, 20), limit)
            tell(f"open-questions: {name}, {budget:,} iterations")
            solution = solve(problem, chains, solver=with_budget(solver, budget), guess=knots)
            rows.append(solve_row(name, solution))
            median = rows[-1]["median max|h|"]
    return rows


def _aarts(t: float, sigma: float, cost: np.ndarray) -> float:
    """T <- T / (1 + T log(1 + delta) / (3 std(c))), T = sigma²: Aarts, van Laarhoven (1985)."""
    if t == 0:
        return FIRST
    temperature = sigma**2
    return (temperature / (1 + temperature * np.log1p(DISTANCE) / (3 * np.std(cost)))) ** 0.5


RULES: dict[str, Rule] = {
    "geometric": lambda t, sigma, cost: FIRST * (LAST / FIRST) ** t,
    "linear": lambda t, sigma, cost: FIRST + (LAST - FIRST) * t,
    "constant, then none": lambda t, sigma, cost: FIRST,
    "constant / 3, then none": lambda t, sigma, cost: FIRST / 3,
    "adaptive": _aarts,
    "no noise": lambda t, sigma, cost: 0.0,
}
"""sigma from progress t in [0, 1], sigma so far, and the chains' costs."""


def _compare_annealing(solver: Langevin, chains: int) -> tuple[list[Numbers], dict[str, Numbers]]:
    """The bug trap under every rule: rows, and the values of sigma."""
    problem = tasks.load("bug_trap").make()
    rows, sigmas = [], {}
    for name, rule in RULES.items():
        tell(f"open-questions: annealing, {name}")
        trajectory, stops, values = _annealed(solver, problem, chains, rule)
        info = evaluate(problem, trajectory)
        feasible = np.asarray(info.max_defect) < FEASIBLE
        escaped = feasible & judge(problem, np.asarray(trajectory.u, float)).success
        share = float(escaped.mean())
        rows.append(
            {
                "annealing": name,
                "iterations": budget_of(solver),
                "chains": chains,
                "escapes": share,
                "standard error": _standard_error(share, chains),
                "feasible": float(feasible.mean()),
                "best cost": float(np.min(info.cost[escaped])) if escaped.any() else None,
                "last σ": values[-1],
            }
        )
        sigmas[name] = {"iteration": stops, "sigma": values}
    return rows, sigmas


def _annealed(
    solver: Langevin, problem: Problem, chains: int, rule: Rule
) -> tuple[Trajectory, list[int], list[float]]:
    """Final knots, and the sigmas that the rule gave at which iterations.

    sigma is a traced number: all rules run one compiled program.
    """
    state = start(solver, problem, initial_knots(problem, chains), jax.random.key(0))
    noisy = int(solver.iterations)
    stops, values, sigma = list(range(0, noisy, EVERY)), [], 0.0
    with reporting(None, "bug trap") as report:
        for i in stops:
            cost = np.asarray(evaluate(problem, state.trajectory).cost)
            sigma = float(rule(i / max(stops[-1], 1), sigma, cost))
            values.append(sigma)
            now = replace(solver, noise=Geometric(sigma, sigma))
            state, _ = advance(now, problem, state, i, min(i + EVERY, noisy))
            if report is not None:
                report(min(i + EVERY, noisy), noisy)
    quiet = replace(solver, noise=settings.NO_NOISE)
    state, _ = advance(quiet, problem, state, noisy, budget_of(solver))
    return state.trajectory, stops, values


def _compare_gradients(
    solvers: dict[str, Langevin], chains: int, limit: int, pairs: Sequence[int]
) -> list[Numbers]:
    """The pendulum with exact derivatives, and with those estimated from function values alone.

    First in the preconditioned flow (Gauss-Newton), then in the paper's (identity), for a quarter
    of the chains: it has a hundred times as many iterations.
    """
    problem = tasks.load("pendulum").make()
    choices = {"exact": {}, **{f"{n} pairs a knot": {"derivatives": Smoothed(n)} for n in pairs}}
    knots, rows = initial_knots(problem, chains), []
    flow = with_budget(solvers["identity"], limit)
    parts = (
        ("Gauss-Newton", GaussNewton, solvers["Gauss-Newton"], chains),
        ("identity", Identity, flow, max(chains // 4, 1)),
    )
    for (metric, part, solver, count), (name, by) in product(parts, choices.items()):
        tell(f"open-questions: gradients, {metric}, {name}")
        own = replace(solver, preconditioner=part(**by))
        guess = jax.tree.map(lambda z, count=count: z[:count], knots)
        rows.append(solve_row(f"{metric}, {name}", solve(problem, count, solver=own, guess=guess)))
    return rows


def _standard_error(share: float, count: int) -> float:
    """Of a share of so many chains."""
    return (share * (1 - share) / count) ** 0.5


def _draw_metrics(axes: Axes, rows: Sequence[Numbers], chains: int) -> None:
    names = list(dict.fromkeys(row["method"] for row in rows))
    for name, color, marker in zip(names, CURVES, "so^", strict=False):
        own = [row for row in rows if row["method"] == name]
        budgets, medians = ([row[k] for row in own] for k in ("iterations", "median max|h|"))
        axes.loglog(budgets, medians, f"{marker}-", ms=4, color=color, label=name)
    axes.axhline(FEASIBLE, ls=":", color=BLACK, lw=1.2, label=f"feasible: below {FEASIBLE:g}")
    label_axes(axes, "iterations of a complete annealed solve", "median max|h|")
    axes.set_title(f"pendulum, {chains} chains: which metric", loc="left", fontsize=9)
    axes.legend(fontsize=7)


def _draw_sigmas(axes: Axes, sigmas: dict[str, Numbers]) -> None:
    for (name, curve), color in zip(sigmas.items(), (*CURVES, GRAY), strict=False):
        if max(curve["sigma"]) > 0:
            axes.semilogy(curve["iteration"], curve["sigma"], color=color, label=name)
    label_axes(axes, "iteration", "σ")
    axes.set_title("bug trap: annealing schedules", loc="left", fontsize=9)
    axes.legend(fontsize=7)


def _draw_shares(axes: Axes, rows: Sequence[Numbers], key: str, title: str) -> None:
    labels = [str(next(iter(row.values()))) for row in rows]
    shares = [row[key] for row in rows]
    errors = [
        _standard_error(share, row["chains"]) for share, row in zip(shares, rows, strict=True)
    ]
    costs = [row["best cost"] for row in rows]
    bars = axes.barh(labels, shares, xerr=errors, color=SKY, ecolor=GRAY, height=0.6)
    words = ["" if cost is None else f"best cost {cost:.4g}" for cost in costs]
    axes.bar_label(bars, words, fontsize=7, padding=3)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.6 * max(0.05, *shares))
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= 1.0])
    label_axes(axes, "share of chains whose rollout reaches the goal", "")
    axes.set_title(title, loc="left", fontsize=9)
