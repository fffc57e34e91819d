"""Plots of a solution: the motion, how the chains got there, where they ended; and its optima.

Colors are those of Okabe and Ito, which colour-blind readers tell apart; markers and dashes say the
same without color. Figures are drawn by matplotlib's Agg objects: no display, no global state.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import complete, file_path
from mjx_drax.physics.c_engine.states import finite
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.solution.log import residuals
from mjx_drax.solution.replay import OPEN_LOOP, WITH_FEEDBACK
from mjx_drax.solution.results import Optimum
from mjx_drax.solution.solution import Solution, require_solution
from mjx_drax.view.drawing import Draw
from mjx_drax.view.labels import control_labels, state_groups

Panel = Callable[[Axes], None]

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE, GRAY = "#0072B2", "#D55E00", "#CC79A7", "#767676"
CURVES = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)

DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))

DPI = 150
MAPS, PANELS = 9, 12
"""Most panels of a figure: optima as the task draws them, coordinates."""

FAR = 100.0
"""Bounds that are so many times as large as all of a plan are out of the picture."""

_LEAST_WIDTH, _TITLE_HEIGHT = 5.2, 0.8  # of figures, and of the space for their titles [inches]


def plot_solution(
    solution: Solution, path: str | os.PathLike[str], draw: Draw | None = None
) -> Path:
    """Draws a solution as a PNG, and returns its path.

    Panels: the best chain's states and controls, planned (dashed) and as replayed (solid); max|h|
    of all chains, the cost of the feasible ones and, if there was a polish, the residual over the
    iterations; every chain's final cost.

    Args:
        path: where to, ending in .png; its folder is made if need be.
        draw: draw(axes, states (K + 1, nx)), for one more panel; tasks may have one.

    Raises:
        DraxError: the path cannot be written.
    """
    require_solution(solution)
    times, mode = solution.times, solution.replay_mode
    panels: list[Panel] = []
    if draw is not None:
        panels.append(partial(_draw_scene, solution=solution, draw=draw))
    panels += [partial(curves.draw, times=times, mode=mode) for curves in motion_curves(solution)]
    of_polish = [_draw_residuals] * bool(np.isfinite(residuals(solution.history)).any())
    panels += [
        partial(draw_chains, solution=solution)
        for draw_chains in (draw_defects, _draw_costs, *of_polish, _draw_final_costs)
    ]
    color = BLACK if solution.certified else VERMILLION
    figure = panel_figure(panels, 2, (4.0, 2.6), fill=True)
    figure.suptitle(title_of(solution), fontsize=9, color=color, linespacing=1.4, parse_math=False)
    return save_figure(figure, path)


def plot_optima(solution: Solution, path: str | os.PathLike[str], draw: Draw | None = None) -> Path:
    """Draws the cheapest of a solution's distinct optima as a PNG, and returns its path.

    Each is drawn as replayed. With `draw`: side by side, up to `MAPS` of them, one panel each.
    Without: over each other, as many as there are colors, one panel for each of the first
    `PANELS` coordinates of the state.

    Args:
        path: where to, ending in .png; its folder is made if need be.
        draw: draw(axes, states (K + 1, nx)); tasks may have one.

    Raises:
        DraxError: no chain is certified, or the path cannot be written.
    """
    found = solution.optima
    if not found:
        raise DraxError(
            f"{solution.problem.name} has no optima to draw: no chain is certified. See "
            "solution.certificate."
        )
    panels: list[Panel]
    if draw is not None:
        shown = found[:MAPS]
        panels = [
            partial(_draw_map, rank=rank, optimum=optimum, draw=draw)
            for rank, optimum in enumerate(shown, 1)
        ]
        figure = panel_figure(panels, 3, (3.0, 3.2))
    else:
        shown = found[: len(CURVES)]
        times = [solution.times_of(optimum.chain) for optimum in shown]
        kinds = state_groups(solution.problem.dynamics).values()
        labels = sorted(pair for labels in kinds for pair in labels.items())
        panels = [
            partial(_draw_column, optima=shown, column=column, label=label, times=times)
            for column, label in labels[:PANELS]
        ]
        figure = panel_figure(panels, 2, (4.0, 2.6), legend=3)
    drawn = "" if len(shown) == len(found) else f", the cheapest {len(shown)}"
    title = f"{solution.problem.name}: {len(found)} distinct optima{drawn}, as replayed"
    figure.suptitle(title, fontsize=9, parse_math=False)
    return save_figure(figure, path)


def panel_figure(
    panels: Sequence[Panel],
    columns: int,
    size: tuple[float, float],
    legend: int = 0,
    fill: bool = False,
) -> Figure:
    """A figure with panels row by row.

    Args:
        panels: each draws on the axes that it is given.
        columns: number of them at the most.
        size: (width, height) of a panel [inches].
        legend: number of columns in a legend below, which explains the first panel; 0 for none.
        fill: whether the last panel fills its row.
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    inches = (max(size[0] * columns, _LEAST_WIDTH), size[1] * rows + _TITLE_HEIGHT)
    figure = new_figure(*inches)
    grid = figure.add_gridspec(rows, columns)
    for i, panel in enumerate(panels):
        row, column = divmod(i, columns)
        end = columns if fill and i == len(panels) - 1 else column + 1
        panel(figure.add_subplot(grid[row, column:end]))
    if legend:
        names = figure.axes[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=legend, fontsize=7, frameon=False)
    return figure


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches.

    It has whole pixels and a quarter: versions of matplotlib cut or round what is left.
    """
    size = (round(width * DPI) + 0.25) / DPI, (round(height * DPI) + 0.25) / DPI
    return Figure(size, DPI, layout="constrained", facecolor="white")


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Writes a figure as a PNG, its folder made if need be; or a DraxError."""
    target = file_path(path)
    with complete(target, (".png",)) as partial:
        FigureCanvasAgg(figure).print_png(partial)
    return target


def title_of(solution: Solution) -> str:
    """The verdict, the numbers of the best chain, and what its replays did, a line each."""
    chain, certificate = solution.best_chain, solution.certificate
    return "\n".join(
        [
            f"{solution.problem.name}: {solution.verdict}",
            f"cost {solution.replay_cost[chain]:.4g} (plan {solution.cost[chain]:.4g}),  "
            f"max|h| {solution.max_defect[chain]:.1g},  {solution.optimality},  "
            f"{solution.success_rate:.0%} of {solution.chains} chains succeed",
            *(
                fill(f"{certificate.engine}, {mode}: {solution.outcome(mode)}", 110)
                for mode in (OPEN_LOOP, WITH_FEEDBACK)
            ),
        ]
    )


# The best chain


def _draw_scene(axes: Axes, solution: Solution, draw: Draw) -> None:
    """The replayed motion among its surroundings, as the task draws it."""
    draw(axes, finite(solution.replayed[0]))
    axes.set_title("replayed motion", loc="left", fontsize=9, fontweight="bold")
    axes.tick_params(labelsize=8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set_fontsize(8)


# Distinct optima


def _name(rank: int, optimum: Optimum) -> str:
    share = f"{optimum.share:.0%}" if optimum.share >= 0.01 else f"{optimum.share:.1%}"
    return f"{rank}: cost {optimum.cost:.4g}, {share} of chains"


def _draw_map(axes: Axes, rank: int, optimum: Optimum, draw: Draw) -> None:
    """One optimum among its surroundings, as the task draws it."""
    draw(axes, optimum.replayed[0])
    axes.set_title(_name(rank, optimum), loc="left", fontsize=8, fontweight="bold")
    axes.set(xlabel="", ylabel="")
    axes.tick_params(labelsize=7)


def _draw_column(
    axes: Axes, optima: Sequence[Optimum], column: int, label: str, times: Sequence[np.ndarray]
) -> None:
    """One coordinate of the state over time, a curve for every optimum; the cheapest on top."""
    for i, optimum in enumerate(optima):
        axes.plot(
            times[i],
            optimum.replayed[0][:, column],
            color=CURVES[i],
            linestyle=DASHES[i],
            lw=1.8,
            zorder=3 - i / len(optima),
            label=_name(i + 1, optimum),
        )
    axes.set_xlim(times[0][0], max(each[-1] for each in times))
    label_panel(axes, label, "time [s]", [])


@dataclass(frozen=True)
class Curves:
    """Quantities of one kind, columns of (K + 1, n) arrays for states, (K, n) for controls."""

    title: str
    labels: Sequence[str]
    plan: np.ndarray
    replay: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def parts(self) -> list[Curves]:
        """As few as hold no more curves than there are colors."""
        count = -(-len(self.labels) // len(CURVES))
        return [
            Curves(self.title, self.labels[i:j], *(a[:, i:j] for a in self._arrays))
            for i, j in pairwise(round(k * len(self.labels) / count) for k in range(count + 1))
        ]

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.plan, self.replay, self.lower, self.upper

    def draw(self, axes: Axes, times: np.ndarray, mode: str) -> None:
        """Plan dashed, replay solid, bounds dotted."""
        held = len(self.plan) < len(times)  # a control lasts until the next knot
        plan, replay, *ends = (np.vstack([a, a[-1:]]) if held else a for a in self._arrays)
        style: Any = {"drawstyle": "steps-post" if held else "default"}
        shared = all(np.array_equal(end[:, 0], row) for end in ends for row in end.T)
        handles = []
        for i, label in enumerate(self.labels):
            color = CURVES[i % len(CURVES)]
            handles += axes.plot(times, replay[:, i], color=color, lw=2.4, label=label, **style)
            dark = [0.4 * part for part in to_rgb(color)]
            axes.plot(times, plan[:, i], "--", color=dark, lw=1.0, **style)
            for end in ends:
                bound = GRAY if shared else color
                axes.plot(times, end[:, i], ":", color=bound, lw=1.3, **style)
        low, high = _limits(plan, replay, ends if held else [])
        rows = -(-len(handles) // 3)
        axes.set_ylim(low, high + 0.13 * rows * (high - low))  # the legend stands above the curves
        axes.set_xlim(times[0], times[-1])
        label_panel(axes, self.title, "time [s]", handles, loc="upper left", ncols=3)
        axes.set_title(f"plan dashed, replay ({mode}) solid", loc="right", fontsize=7, color=GRAY)


def motion_curves(solution: Solution) -> list[Curves]:
    """States, then controls, of the best chain."""
    problem, best = solution.problem, solution.best
    plan = solution.plans[solution.best_chain]
    states, controls = solution.replayed
    lower, upper = (
        np.vstack([side.x[:1], side.x]).astype(float) for side in problem.bounds.sides(best)
    )
    groups = []
    for kind, labels in state_groups(problem.dynamics).items():
        arrays = (a[:, list(labels)] for a in (plan, states, lower, upper))
        groups += Curves(kind, list(labels.values()), *arrays).parts()
    limits = (np.asarray(side.u) for side in problem.bounds.sides(best))
    labels_u = control_labels(problem.dynamics)
    return groups + Curves("controls", labels_u, np.asarray(best.u), controls, *limits).parts()


def _limits(
    plan: np.ndarray, replay: np.ndarray, bounds: Sequence[np.ndarray]
) -> tuple[float, float]:
    """Ends of the vertical axis: plan, bounds and replay if near."""
    planned = plan[np.isfinite(plan)]
    ends = np.concatenate([np.zeros(0), *map(np.ravel, bounds)])
    far = FAR * np.abs(planned).max(initial=0.0) or np.inf  # a plan of zeros has all bounds
    needed = np.concatenate([planned, ends[np.isfinite(ends) & (np.abs(ends) <= far)]])
    low, high = (needed.min(), needed.max()) if needed.size else (-1.0, 1.0)
    span = max(high - low, 1e-3)
    near = np.clip(replay[np.isfinite(replay)], low - span, high + span)
    low, high = min(low, near.min(initial=low)), max(high, near.max(initial=high))
    return low - 0.06 * span, high + 0.06 * span


# All chains


def _draw_history(
    axes: Axes, solution: Solution, values: np.ndarray, shown: np.ndarray, color: str
) -> list[Artist]:
    """Median and range over the chains shown, where (records, chains), at every record."""
    iterations = solution.history["iteration"]
    spread = np.full((len(values), 3), np.nan)
    for row, (value, chosen) in enumerate(zip(values, shown & np.isfinite(values), strict=True)):
        if chosen.any():
            spread[row] = np.quantile(value[chosen], (0.0, 0.5, 1.0))
    low, median, high = spread.T
    band = axes.fill_between(iterations, low, high, color=color, alpha=0.25, lw=0)
    band.set_label("smallest to largest")
    handles: list[Artist] = [*axes.plot(iterations, median, ".-", ms=3, lw=1.6, color=color)]
    handles[0].set_label("median")
    began, ended = solution.history["began"], solution.history["noise_ends"]
    for marks, dash, label in (
        (began[1:], "-", "next attempt"),
        (ended[ended > began], "--", "noise ends"),
    ):
        for mark in marks:
            line = axes.axvline(mark, ls=dash, lw=1, color=GRAY, zorder=1)
        if len(marks):
            line.set_label(label)
            handles.append(line)
    axes.set_xlim(0, max(1, iterations[-1]))
    return [*handles, band]


def draw_defects(axes: Axes, solution: Solution) -> None:
    """max|h| of all chains over the iterations, and where attempts began."""
    values = solution.history["max_defect"]
    handles = _draw_history(axes, solution, values, np.ones_like(values, bool), BLUE)
    _draw_limit(axes, "max|h| of all chains", "feasible", FEASIBLE, handles)


def _draw_costs(axes: Axes, solution: Solution) -> None:
    feasible = solution.history["max_defect"] < FEASIBLE
    handles = _draw_history(axes, solution, solution.history["cost"], feasible, VERMILLION)
    _scale_costs(axes, solution.history["cost"][feasible])
    nothing = "" if feasible.any() else ": there are none"
    label_panel(axes, f"cost of feasible chains{nothing}", "iteration", handles)


def _draw_residuals(axes: Axes, solution: Solution) -> None:
    values = residuals(solution.history)
    known = np.maximum(values, np.finfo(values.dtype).tiny)  # for the logarithm
    handles = _draw_history(axes, solution, known, np.isfinite(values), PURPLE)
    _draw_limit(axes, "residual of polished chains", "optimal", solution.tolerance, handles)


def _draw_limit(axes: Axes, title: str, word: str, limit: float, handles: Sequence[Artist]) -> None:
    """What is below a limit has a name."""
    label = f"{word}: below {limit:g}"
    line = axes.axhline(limit, ls=":", lw=1.2, color=BLACK, label=label)
    axes.set_yscale("log")
    label_panel(axes, title, "iteration", [*handles, line])


def _draw_final_costs(axes: Axes, solution: Solution) -> None:
    """Final costs in rising order, of replays; what is infeasible may undercut the optimum."""
    certified = solution.certified_chains
    cost = np.where(certified, solution.replay_cost, solution.cost).astype(float)
    rank = np.empty(len(cost), int)
    rank[np.argsort(cost, kind="stable")] = np.arange(1, len(cost) + 1)
    diverged = (solution.died_at >= 0) & ~solution.feasible
    handles: list[Artist] = []
    for name, chosen, marker, color in (
        ("optimal", solution.optimal_chains, "*", GREEN),
        ("certified", certified & ~solution.optimal_chains, "o", GREEN),
        ("feasible, replays fail", solution.feasible & ~certified, "s", ORANGE),
        ("infeasible", ~solution.feasible & ~diverged, "x", VERMILLION),
        ("diverged", diverged, "+", BLACK),
    ):
        if chosen.any():
            label = f"{name}: {np.count_nonzero(chosen)}"
            hidden = np.count_nonzero(~np.isfinite(cost[chosen]))
            label += f" ({hidden} without a finite cost)" if hidden else ""
            handles += axes.plot(
                rank[chosen], cost[chosen], marker, ms=5, color=color, label=label, clip_on=False
            )
    best = solution.best_chain
    handles += axes.plot(
        rank[best], cost[best], "o", ms=11, mfc="none", color=BLUE, label="best", clip_on=False
    )
    _scale_costs(axes, cost)
    axes.set_xlim(0, len(cost) + 1)
    label_panel(axes, "final cost of every chain", "chains in order of cost", handles)


def _scale_costs(axes: Axes, costs: np.ndarray) -> None:
    """A logarithmic axis for positive costs that differ much; else one of 2 % or more."""
    costs = costs[np.isfinite(costs)]
    if not costs.size:
        axes.set_yticks([])
        return
    low, high = float(costs.min()), float(costs.max())
    if 0.0 < 10.0 * low < high:
        axes.set_yscale("log")
        label_decades(axes.yaxis)
        return
    pad = max(0.06 * (high - low), 0.01 * abs(high), 1e-9)
    axes.set_ylim(low - pad, high + pad)
    axes.ticklabel_format(axis="y", useOffset=False)


def label_decades(axis: Axis) -> None:
    """Of a logarithmic axis 1, 2 and 5 of every decade, as plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def label_axes(axes: Axes, xlabel: str, ylabel: str = "") -> None:
    """Labels, a grid, and no frame above and on the right."""
    axes.set_xlabel(xlabel, fontsize=8)
    axes.set_ylabel(ylabel, fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(True, color="0.9", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def label_panel(
    axes: Axes, title: str, xlabel: str, handles: Sequence[Artist], **legend_style: Any
) -> None:
    """What every panel has."""
    axes.set_title(title, loc="left", fontsize=9, fontweight="bold", parse_math=False)
    label_axes(axes, xlabel)
    if not handles:
        return
    legend = axes.legend(
        handles=list(handles), fontsize=7, framealpha=0.8, edgecolor="none", **legend_style
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
