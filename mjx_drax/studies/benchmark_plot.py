"""Success against time, a panel for each problem.

A curve is the share of chains (IPOPT: starts; shooting: runs) of all seeds together that held a
certified answer at no more than twice the best known cost after so many seconds of solving;
how is in `measurements`. It starts at the earliest answer and ends where the last of its solves
ended; a method that never found one is named above the panel. Colors are Okabe and Ito's;
dashes and markers say the same without colour.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mjx_drax.view.plotting import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    label_axes,
    label_decades,
    new_figure,
    save_figure,
)

STYLES: dict[str, dict[str, Any]] = {
    "mjx_drax": {"color": BLUE, "lw": 2.4, "marker": "o"},
    "no restarts": {"color": PURPLE, "ls": "-.", "marker": "d"},
    "no noise": {"color": SKY, "ls": "--", "marker": "v"},
    "no tail": {"color": SKY, "ls": ":", "marker": "^"},
    "diagonal": {"color": BLUE, "ls": "--", "marker": "<"},
    "identity": {"color": BLUE, "ls": ":", "marker": ">"},
    "ipopt": {"color": BLACK, "marker": "s"},
    "mppi": {"color": ORANGE, "marker": "D"},
    "cem": {"color": GREEN, "ls": "-.", "marker": "P"},
    "mbd": {"color": VERMILLION, "marker": "X"},
}
OTHER = {"color": PURPLE, "marker": "."}
COLUMNS = 3


def plot(rows: Sequence[dict[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Draw the rows' curves as a PNG, and return its path."""
    panels: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        if not row.get("curve"):
            continue
        name, _, thread = row["solver"].partition(", ")
        panel = f"{row['problem']}, {thread}" if thread else row["problem"]
        label = f"{name}, {row['chains']}" if thread else name
        panels.setdefault(panel, {}).setdefault(label, []).append(row)
    columns = max(min(COLUMNS, len(panels)), 1)
    height = -(-max(len(panels), 1) // columns)
    figure = new_figure(3.6 * columns, 3.1 * height + 0.9)
    axes = np.ravel(figure.subplots(height, columns, squeeze=False))
    for axis, (title, methods) in zip(axes, panels.items(), strict=False):
        _panel(axis, title, methods)
    for axis in axes[len(panels) :]:
        axis.axis("off")
    handles = {h.get_label(): h for axis in axes for h in axis.get_legend_handles_labels()[0]}
    if handles:
        figure.legend(
            handles=list(handles.values()),
            loc="outside lower center",
            ncols=3 * columns,
            fontsize=8,
        )
    return save_figure(figure, path)


def _panel(axes: Axes, title: str, methods: dict[str, list[dict[str, Any]]]) -> None:
    failed, ends = [], []
    for label, rows in methods.items():
        seconds, share = pooled([row["curve"] for row in rows], [row["chains"] for row in rows])
        found = share > 0
        if not found.any():
            failed.append(label)
        first = int(np.argmax(found)) if found.any() else len(found) - 1
        style = {"ms": 4, "lw": 1.5, "markevery": 0.2} | _style(label)
        seconds, share = seconds[first:], share[first:]
        ends += [seconds[0], seconds[-1]]
        axes.plot(
            np.append(seconds[0], seconds),  # a wall from zero up to the first answer
            np.append(0.0, share),
            drawstyle="steps-post",
            label=label,
            clip_on=False,
            **style,
        )
    axes.set_xscale("log")
    label_decades(axes.xaxis)
    if ends:
        axes.set_xlim(0.7 * min(ends), 1.4 * max(ends))
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks(np.linspace(0, 1, 6), [f"{tick:.0%}" for tick in np.linspace(0, 1, 6)])
    axes.set_title(title, loc="left", fontsize=9, fontweight="bold")
    label_axes(axes, "solving time [s]", "certified, cost at most 2 × best known")
    if failed:
        label = fill("never: " + ", ".join(failed), 30)  # beside the title, on two lines if long
        axes.set_title(label, loc="right", fontsize=7)


def pooled(
    curves: Sequence[Sequence[Sequence[float]]], weights: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Curves of several seeds as one: times, and the weighted mean of their last shares.

    A curve is 0 before its first time and keeps its last value.
    """
    times = np.unique([point[0] for curve in curves for point in curve])
    total = np.zeros(len(times))
    for curve, weight in zip(curves, weights, strict=True):
        t, _, share = np.array(curve, float).T
        at = np.searchsorted(t, times, side="right")
        total += weight * np.append(0.0, share)[at]
    return times, total / sum(weights)


def _style(label: str) -> dict[str, Any]:
    name, _, number = label.partition(", ")
    style = dict(STYLES.get(name, OTHER))
    if number and name == "mjx_drax":  # several numbers of chains in one panel
        order = {"1": 0.35, "2": 0.5, "4": 0.65, "8": 0.8, "16": 1.0}
        style |= {"alpha": order.get(number, 1.0), "lw": 1.6}
    return style
