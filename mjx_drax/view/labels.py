"""Names and units of the entries of states, tangent vectors and controls, as plots show them."""

from __future__ import annotations

from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.solution.names import control_names, state_names

_FREE = mujoco.mjtJoint.mjJNT_FREE
_UNITS = {mujoco.mjtJoint.mjJNT_SLIDE: "m", mujoco.mjtJoint.mjJNT_HINGE: "rad"}


def coordinates(dynamics: Dynamics) -> list[tuple[str, str]]:
    """Name and unit of the coordinates of positions in tangent space, (nv,).

    A free joint moves along x, y, z [m]; it and a ball joint turn about x, y, z [rad]. Without a
    model none are known.
    """
    model = mujoco_model(dynamics)
    if model is None:
        return []
    found: list[tuple[str, str]] = []
    for joint, kind in _joints(model):
        if kind == _FREE:
            found += [(f"{joint} {axis}", "m") for axis in "xyz"]
        if kind in _UNITS:
            found.append((joint, _UNITS[kind]))
        else:
            found += [(f"{joint} turn {axis}", "rad") for axis in "xyz"]
    return found


def state_groups(dynamics: Dynamics) -> dict[str, dict[int, str]]:
    """Kinds of entries of a state, each with the columns that hold it and their labels."""
    model = mujoco_model(dynamics)
    if model is None:
        return {"states": dict(enumerate(state_names(dynamics)))}
    positions: dict[int, str] = {}
    orientations: dict[int, str] = {}
    for (joint, kind), column in zip(_joints(model), model.jnt_qposadr.tolist(), strict=True):
        if kind in _UNITS:
            positions[column] = f"{joint} [{_UNITS[kind]}]"
            continue
        if kind == _FREE:
            positions |= {column + i: f"{joint} {axis} [m]" for i, axis in enumerate("xyz")}
            column += 3
        orientations |= {column + i: f"{joint} q{part}" for i, part in enumerate("wxyz")}
    velocities = [f"{name} [{unit}/s]" for name, unit in coordinates(dynamics)]
    of_model = model.nq + model.nv + model.na
    groups = {
        "positions": positions,
        "orientations": orientations,
        "velocities": dict(enumerate(velocities, model.nq)),
        "activations": {model.nq + model.nv + i: f"act[{i}]" for i in range(model.na)},
        "left open": dict(enumerate(state_names(dynamics)[of_model:], of_model)),
    }
    return {kind: labels for kind, labels in groups.items() if labels}


def control_labels(dynamics: Dynamics) -> list[str]:
    """Names of the entries of a control, (nu,)."""
    model = mujoco_model(dynamics)
    if model is None:
        return control_names(dynamics)
    return [model.actuator(i).name or f"actuator {i}" for i in range(dynamics.nu)]


def _joints(model: mujoco.MjModel) -> list[tuple[str, mujoco.mjtJoint]]:
    kinds = map(mujoco.mjtJoint, model.jnt_type.tolist())
    return [(model.joint(j).name or f"joint {j}", kind) for j, kind in enumerate(kinds)]
