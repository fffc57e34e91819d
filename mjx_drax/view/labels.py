"""Names and units of the entries of states, tangent vectors and controls, as plots show them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco

if TYPE_CHECKING:
    from mjx_drax.problem.dynamics import Dynamics

_JOINT = mujoco.mjtJoint
_UNITS = {_JOINT.mjJNT_SLIDE: "m", _JOINT.mjJNT_HINGE: "rad"}


@dataclass(frozen=True)
class Coordinate:
    """A coordinate of positions in tangent space: its name, and its unit if that is known."""

    name: str
    unit: str

    @property
    def position(self) -> str:
        """Label of its axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def velocity_unit(self) -> str:
        """Unit of its velocity, in brackets."""
        return f" [{self.unit}/s]" if self.unit else ""


def coordinates(dynamics: Dynamics) -> list[Coordinate]:
    """Coordinates of positions in tangent space; of a function's states, those of the first half.

    A joint with several coordinates has its places x, y, z [m] first, then its turns [rad].
    """
    model = mujoco_model(dynamics)
    if model is None:
        return [Coordinate(f"x[{i}]", "") for i in range(dynamics.nx // 2)]
    out: list[Coordinate] = []
    for joint, kind in joints(model):
        if kind == _JOINT.mjJNT_FREE:
            out += [Coordinate(f"{joint} {axis}", "m") for axis in "xyz"]
        if kind in (_JOINT.mjJNT_FREE, _JOINT.mjJNT_BALL):
            out += [Coordinate(f"{joint} turn {axis}", "rad") for axis in "xyz"]
        else:
            out.append(Coordinate(joint, _UNITS[kind]))
    return out


def joints(model: mujoco.MjModel) -> list[tuple[str, mujoco.mjtJoint]]:
    """Name and kind of each joint."""
    return [
        (model.joint(j).name or f"joint {j}", _JOINT(int(model.jnt_type[j])))
        for j in range(model.njnt)
    ]


def tangent_labels(dynamics: Dynamics) -> list[str]:
    """Names of the entries of a tangent vector, (ndx,)."""
    model = mujoco_model(dynamics)
    if model is None:
        return [f"x[{i}]" for i in range(dynamics.ndx)]
    positions = [coordinate.name for coordinate in coordinates(dynamics)]
    velocities = [f"{name}, velocity" for name in positions]
    return [*positions, *velocities, *(f"act[{i}]" for i in range(model.na))]


def state_groups(dynamics: Dynamics) -> dict[str, dict[int, str]]:
    """Kinds of entries of a state, each with the columns that hold it and their labels."""
    model = mujoco_model(dynamics)
    if model is None:
        return {"states": {i: f"x[{i}]" for i in range(dynamics.nx)}}
    positions: dict[int, str] = {}
    orientations: dict[int, str] = {}
    for (joint, kind), column in zip(joints(model), model.jnt_qposadr.tolist(), strict=True):
        if kind in _UNITS:
            positions[column] = f"{joint} [{_UNITS[kind]}]"
            continue
        if kind == _JOINT.mjJNT_FREE:
            positions |= {column + i: f"{joint} {axis} [m]" for i, axis in enumerate("xyz")}
            column += 3
        orientations |= {column + i: f"{joint} q{part}" for i, part in enumerate("wxyz")}
    moving = coordinates(dynamics)
    groups = {
        "positions": positions,
        "orientations": orientations,
        "velocities": {model.nq + i: c.name + c.velocity_unit for i, c in enumerate(moving)},
        "activations": {model.nq + model.nv + i: f"act[{i}]" for i in range(model.na)},
    }
    return {kind: labels for kind, labels in groups.items() if labels}


def control_labels(dynamics: Dynamics) -> list[str]:
    """Names of the entries of a control, (nu,)."""
    model = mujoco_model(dynamics)
    if model is None:
        return [f"u[{i}]" for i in range(dynamics.nu)]
    return [model.actuator(i).name or f"actuator {i}" for i in range(dynamics.nu)]
