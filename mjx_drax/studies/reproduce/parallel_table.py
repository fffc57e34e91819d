"""N pendulums at once, one chain each: time, and what the time bought.

An answer of a flow still breaks the dynamics. *Projected* is one rollout of it with the feedback of
its own linearization, which breaks none. Which states can be brought upright at all says dynamic
programming (or a flow that brings them there).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
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
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.studies import random_states
from mjx_drax.studies.many_starts import solve_each
from mjx_drax.studies.measurements import judge
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, tell
from mjx_drax.view.plotting import BLUE, GRAY, VERMILLION, label_axes, new_figure

PUBLISHED = {64: 0.68, 256: 0.75, 1024: 1.04, 2048: 1.49, 4096: 2.12, 8192: 3.53, 16384: 7.95}
"""Times [s] that the paper gives for N pendulums, 20,000 iterations, on an RTX 4070."""

FULL = {"sizes": tuple(PUBLISHED), "grid": (6001, 1401)}
"""Sizes with --full: the paper's."""

STARTS = ("random", "hanging")
"""Initial states of the problems: U(-4, 4)², or all (3.1, 0)."""


def make(
    chains: int | None = None,
    iterations: int | None = None,
    sizes: Sequence[int] = (64, 256),
    grid: tuple[int, int] = (2001, 1001),
) -> tuple[Numbers, Figure]:
    """Each pendulum from its own random x_init, U(-4, 4)²; then the same with all hanging at rest.

    From many random states upright cannot be reached, from (3.1, 0) it can. Times are of compiled
    programs, from drawing the initial knots to the final ones. `chains` leaves out larger N of
    `sizes`; the paper's flow has 20,000 iterations by default. The grid of dynamic programming has
    so many angles and velocities.
    """
    problem, solvers = tasks.load("pendulum").make(), settings.pendulum_flows(iterations)
    sizes = [n for n in sizes if chains is None or n <= chains] or [min(sizes)]
    rows, key, kinds = [], jax.random.key(0), list(product(sizes, STARTS))
    starts = [_starts(problem, size, kind, key) for size, kind in kinds]
    tell(f"parallel-table: dynamic programming on {grid[0]} x {grid[1]} states")
    known = random_states.values(problem, np.concatenate(starts), grid)[1]
    ends = np.cumsum([size for size, _ in kinds])[:-1]
    for (size, kind), x_init, can in zip(kinds, starts, np.split(known, ends), strict=True):
        row: Numbers = {"N": size, "x_init": kind, "published, RTX 4070 [s]": PUBLISHED.get(size)}
        upright = {}
        for name, solver in solvers.items():
            twice = f"{settings.budget_of(solver):,} iterations, twice"
            tell(f"parallel-table: N = {size}, x_init {kind}: {name}, {twice}")
            measured, upright[name] = _measure(solver, problem, jnp.asarray(x_init), key)
            row |= {f"{name}: {k}": v for k, v in measured.items()}
        can = np.logical_or.reduce([can, *upright.values()])  # the grid is not perfect
        row["can be upright"] = float(can.mean())
        for name, reached in upright.items():
            row[f"{name}: of those that can"] = float(reached.sum() / max(can.sum(), 1))
        rows.append(row)
    return {"rows": rows, "settings": solvers}, _draw(rows, solvers)


def _starts(problem: Problem, size: int, kind: str, key: Array) -> np.ndarray:
    """Initial states (size, 2) of a kind."""
    if kind == "random":
        return np.asarray(jax.random.uniform(key, (size, 2), minval=-4.0, maxval=4.0))
    return np.broadcast_to(np.asarray(problem.x_init), (size, 2))


def _measure(
    solver: Langevin, problem: Problem, starts: Array, key: Array
) -> tuple[Numbers, np.ndarray]:
    """Time and quality of one chain for each initial state (N, nx); who is upright, projected."""
    keys = jax.random.split(key, len(starts))
    knots, info, _, seconds = solve_each(solver, problem, starts, keys)
    h, controls = np.asarray(info.max_defect), (knots.u, _projected(problem, starts, knots))
    plain, projected = (
        judge(problem, np.asarray(u, float), np.asarray(starts)).success for u in controls
    )
    return {
        "time [s]": seconds,
        "max|h| < 5e-3": float(np.mean(h < 5 * FEASIBLE)),
        "max|h| < 1e-3": float(np.mean(h < FEASIBLE)),
        "rollout upright": float(np.mean(plain)),
        "projected: upright": float(np.mean(projected)),
    }, np.asarray(projected)


@jax.jit
def _projected(problem: Problem, starts: Array, knots: Trajectory) -> Array:
    """Controls (N, K, nu) of rollouts from x_init (N, nx) with feedback toward knots (N, K, ...).

    The gains are those of the preconditioned settings at their end, for either flow.
    """
    flow, key = settings.PENDULUM, jax.random.key(0)

    def one(x_init: Array, knots: Trajectory) -> Array:
        own = replace(problem, x_init=x_init)
        state = flow.init(own, knots, key)
        model = flow.model(own, state, flow.weights(2.0), key, False)
        gains = flow.preconditioner.direction(own, model, None, state.memory).gains
        return own.rolled_out(knots, gains)[1]

    return jax.vmap(one)(starts, knots)


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
