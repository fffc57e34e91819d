"""Plots of one motion: velocity against position of its joints, multipliers of its dynamics.

Both are in the tangent space of states, [dq (nv), dv (nv), da (na)]: a quaternion has three
coordinates there, each with its velocity.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mjx_drax.base.errors import DraxError
from mjx_drax.physics.c_engine.states import between, finite
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.extended import Extended
from mjx_drax.solution.names import difference_names, state_names
from mjx_drax.solution.solution import Solution
from mjx_drax.view.geoms import Floats
from mjx_drax.view.labels import coordinates
from mjx_drax.view.plotting import (
    BLUE,
    PANELS,
    VERMILLION,
    label_panel,
    new_figure,
    panel_figure,
    save_figure,
)

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_DIVERGING = "RdBu_r"  # safe for colour-blind readers


def plot_phase(solution: Solution, path: str | os.PathLike[str]) -> Path:
    """Draws velocity against position of each joint of the best chain; returns the path.

    The plan is dashed and the replay solid, from the circle to the square. Rotations in space are
    rotation vectors from the first pose. At most `PANELS` coordinates are shown.

    Args:
        solution: from `solve`, of a problem with a model, or with two states.
        path: where to, ending in .png; its folder is made if need be.

    Raises:
        DraxError: no model and not two states, or the path cannot be written.
    """
    dynamics = solution.problem.dynamics
    if not has_phases(dynamics):
        raise DraxError(
            f"{solution.problem.name} has no model and {dynamics.nx} states: which of them are "
            "velocities is unknown. Give one with a model, or with two states."
        )
    plan = solution.plans[solution.best_chain].astype(float)
    phases = [phases_of(dynamics, states) for states in (plan, finite(solution.replayed[0]))]
    known = [(f"{name} [{unit}]", f"velocity [{unit}/s]") for name, unit in coordinates(dynamics)]
    if not known:  # a problem without a model
        place, velocity = state_names(dynamics)
        known = [(place, velocity)]
    panels = [
        partial(_draw_phase, labels=labels, motions=[(q[:, i], v[:, i]) for q, v in phases])
        for i, labels in enumerate(known[:PANELS])
    ]
    figure = panel_figure(panels, 3, (3.2, 2.7), legend=4)
    left = len(known) - len(panels)
    more = f" (and {left} more coordinates)" if left else ""
    title = f"{solution.problem.name}: phase plots{more}, replayed {solution.replay_mode}"
    figure.suptitle(title, fontsize=9, parse_math=False)
    return save_figure(figure, path)


def _draw_phase(
    axes: Axes, labels: tuple[str, str], motions: list[tuple[np.ndarray, np.ndarray]]
) -> None:
    """Velocity against position of a coordinate: the plan, and the replay."""
    plan, (position, velocity) = motions
    axes.plot(position, velocity, color=BLUE, lw=2.2, label="replay")
    axes.plot(*plan, "--", color=VERMILLION, lw=1.1, label="plan")
    for at, marker, word in ((0, "o", "start"), (-1, "s", "end")):
        style: Any = {"color": BLUE, "mec": "white", "ms": 7, "ls": "none", "zorder": 4}
        axes.plot(position[at], velocity[at], marker, label=word, **style)
    place, velocity_name = labels
    label_panel(axes, place, place, [])
    axes.set_ylabel(velocity_name, fontsize=8)


def plot_multipliers(solution: Solution, path: str | os.PathLike[str]) -> Path:
    """Draws the multipliers lambda of the best chain's dynamics as a heat map; returns the path.

    One row for each coordinate of the tangent space, over time. Where it is dark, |lambda| is
    large: there the cost would change most if the dynamics were a little different. Each row has
    its own scale, written beside it, because units differ.

    Args:
        path: where to, ending in .png; its folder is made if need be.

    Raises:
        DraxError: the path cannot be written.
    """
    values = np.nan_to_num(solution.multipliers.dynamics[solution.best_chain])
    times, names = solution.times, difference_names(solution.problem.dynamics)
    largest = np.abs(values).max(axis=0)
    figure = new_figure(7.0, 0.24 * len(names) + 1.7)
    axes = figure.add_subplot()
    image = axes.imshow(
        (values / np.maximum(largest, 1e-30)).T,
        extent=(float(times[0]), float(times[-1]), len(names) - 0.5, -0.5),
        aspect="auto",
        interpolation="nearest",
        cmap=_DIVERGING,
        vmin=-1.0,
        vmax=1.0,
    )
    axes.set_yticks(range(len(names)), names, fontsize=7, parse_math=False)
    beside = axes.get_yaxis_transform()
    for row, size in enumerate(largest):
        axes.text(1.01, row, f"{size:.2g}", transform=beside, va="center", fontsize=7)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("time [s]", fontsize=8)
    bar = figure.colorbar(image, ax=axes, pad=0.09, ticks=[-1.0, 0.0, 1.0], aspect=25)
    bar.ax.set_yticklabels(["-largest", "0", "largest"], fontsize=7)
    figure.suptitle(
        f"{solution.problem.name}: multipliers of the dynamics; at the right, each row's largest",
        fontsize=9,
        parse_math=False,
    )
    return save_figure(figure, path)


def has_phases(dynamics: Dynamics) -> bool:
    """Whether `plot_phase` can draw it: a model, or two states, of which one may be a velocity."""
    two = dynamics.nx == 2 and not isinstance(dynamics, Extended)
    return mujoco_model(dynamics) is not None or two


def phases_of(dynamics: Dynamics, states: Floats) -> tuple[Floats, Floats]:
    """Positions and velocities (T, nv) of states (T, nx), in tangent space."""
    model = mujoco_model(dynamics)
    if model is None:
        return states[:, :1], states[:, 1:]
    nq, nv = model.nq, model.nv
    qpos = states[:, :nq]
    positions = np.array([between(model, qpos[0], q) for q in qpos])
    # Where there is a zero position, positions count from it, not from the first pose
    sizes = {_FREE: 3, _BALL: 0}
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        size = sizes.get(int(kind), 1)
        positions[:, v : v + size] = qpos[:, q : q + size]
    return positions, states[:, nq : nq + nv]
