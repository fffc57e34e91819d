"""Pictures of one motion: phase portraits of its joints, and the multipliers of its dynamics.

Both are in the tangent space of states, [dq (nv), dv (nv), da (na)]: a quaternion has three
coordinates there, each with its velocity.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from mjx_drax.base.errors import DraxError
from mjx_drax.physics._mujoco import mujoco
from mjx_drax.physics.states import between, finite
from mjx_drax.view.plotting import BLUE, DPI, PANELS, VERMILLION, label_panel, save_figure

if TYPE_CHECKING:
    from mjx_drax.problem.dynamics import Dynamics
    from mjx_drax.solution.solution import Solution

Floats = npt.NDArray[np.floating[Any]]

_COLUMNS = 3
_DIVERGING = "RdBu_r"  # safe for colour-blind readers


@dataclass(frozen=True)
class Coordinate:
    """A coordinate of positions: its name, units of it and of its velocity."""

    name: str
    unit: str

    @property
    def position(self) -> str:
        """Label of its axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def velocity(self) -> str:
        """Label of its velocity's axis."""
        return f"velocity [{self.unit}/s]" if self.unit else "velocity"


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
    shown = coordinates(dynamics)[:PANELS]
    plan = np.asarray(solution.problem.with_start(solution.best), float)
    replay = finite(solution.replayed[0])
    columns = min(_COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    inches = (max(3.2 * columns, 5.2), 2.7 * rows + 0.5)
    figure = Figure(inches, DPI, layout="constrained", facecolor="white")
    motions = [_phases(dynamics, states) for states in (plan, replay)]
    for i, coordinate in enumerate(shown):
        axes = figure.add_subplot(rows, columns, i + 1)
        (x, v), (y, w) = ((q[:, i], dq[:, i]) for q, dq in motions)
        axes.plot(y, w, color=BLUE, lw=2.2, label=f"replay, {solution.replay_mode}")
        axes.plot(x, v, "--", color=VERMILLION, lw=1.1, label="plan")
        for at, marker, word in ((0, "o", "start"), (-1, "s", "end")):
            style: Any = {"color": BLUE, "mec": "white", "ms": 7, "ls": "none", "zorder": 4}
            axes.plot(y[at], w[at], marker, label=word, **style)
        label_panel(axes, coordinate.position, coordinate.position, [])
        axes.set_ylabel(coordinate.velocity, fontsize=8)
    names = figure.axes[0].get_legend_handles_labels()
    figure.legend(*names, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    left = len(coordinates(dynamics)) - len(shown)
    more = f" (and {left} more coordinates)" if left else ""
    figure.suptitle(f"{solution.problem.name}: phase portraits{more}", fontsize=9, parse_math=False)
    return save_figure(figure, path)


def plot_multipliers(solution: Solution, path: str | os.PathLike[str]) -> Path:
    """Draws the multipliers lambda of the best chain's dynamics as a heat map; returns the path.

    One row for each coordinate of the tangent space, over time: where it is dark, the motion is
    dearest bought from the dynamics. Each row has its own scale, written beside it, because units
    differ.

    Args:
        solution: from `solve`.
        path: where to, ending in .png; its folder is made if need be.

    Raises:
        DraxError: the path cannot be written.
    """
    values = np.nan_to_num(solution.multipliers.dynamics[solution.best_chain])
    times, names = solution.problem.times, _tangent_names(solution.problem.dynamics)
    largest = np.abs(values).max(axis=0)
    inches = (7.0, 0.24 * len(names) + 1.7)
    figure = Figure(inches, DPI, layout="constrained", facecolor="white")
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
    """Whether `plot_phase` knows which states are velocities."""
    return hasattr(dynamics, "mj_model") or dynamics.nx == 2


def coordinates(dynamics: Dynamics) -> list[Coordinate]:
    """Coordinates of positions in tangent space; those of a function are its first half."""
    model = getattr(dynamics, "mj_model", None)
    if model is None:
        return [Coordinate(f"x[{i}]", "") for i in range(dynamics.nx // 2)]
    out: list[Coordinate] = []
    kinds = mujoco.mjtJoint
    for j in range(model.njnt):
        name, kind = model.joint(j).name or f"joint {j}", kinds(int(model.jnt_type[j]))
        if kind == kinds.mjJNT_FREE:
            out += [Coordinate(f"{name} {axis}", "m") for axis in "xyz"]
        if kind in (kinds.mjJNT_FREE, kinds.mjJNT_BALL):
            out += [Coordinate(f"{name} turn {axis}", "rad") for axis in "xyz"]
        if kind == kinds.mjJNT_SLIDE:
            out.append(Coordinate(name, "m"))
        if kind == kinds.mjJNT_HINGE:
            out.append(Coordinate(name, "rad"))
    return out


def _tangent_names(dynamics: Dynamics) -> Sequence[str]:
    """Names of the tangent space's coordinates, (ndx,)."""
    model = getattr(dynamics, "mj_model", None)
    if model is None:
        return [f"x[{i}]" for i in range(dynamics.ndx)]
    positions = [coordinate.name for coordinate in coordinates(dynamics)]
    velocities = [f"{name}, velocity" for name in positions]
    return [*positions, *velocities, *(f"act[{i}]" for i in range(model.na))]


def _phases(dynamics: Dynamics, states: Floats) -> tuple[Floats, Floats]:
    """Positions and velocities (T, nv) of states (T, nx), in tangent space."""
    model = getattr(dynamics, "mj_model", None)
    if model is None:
        return states[:, :1], states[:, 1:]
    nq, nv = model.nq, model.nv
    qpos = states[:, :nq]
    positions = np.array([between(model, qpos[0], q) for q in qpos])
    for j in range(model.njnt):  # from the model's zero, not from the first pose, where it can be
        kind, q, v = (
            mujoco.mjtJoint(int(model.jnt_type[j])),
            model.jnt_qposadr[j],
            model.jnt_dofadr[j],
        )
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            positions[:, v : v + 3] = qpos[:, q : q + 3]
        elif kind != mujoco.mjtJoint.mjJNT_BALL:
            positions[:, v] = qpos[:, q]
    return positions, states[:, nq : nq + nv]
