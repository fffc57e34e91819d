"""Names of the entries of states and controls."""

from __future__ import annotations

import numpy as np

from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.extended import Extended

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_POSITIONS = {_FREE: ("x", "y", "z", "qw", "qx", "qy", "qz"), _BALL: ("qw", "qx", "qy", "qz")}
_ROTATIONS = {_FREE: ("x", "y", "z", "rx", "ry", "rz"), _BALL: ("rx", "ry", "rz")}
_VELOCITIES = {_FREE: ("vx", "vy", "vz", "wx", "wy", "wz"), _BALL: ("wx", "wy", "wz")}


def state_names(dynamics: Dynamics) -> list[str]:
    """Names of the entries of a state, nx of them.

    For a model qpos_JOINT, qvel_JOINT and act_ACTUATOR, in MuJoCo's units; joints with several
    coordinates add _x, _y, _z, _qw, _qx, _qy, _qz, and _vx, _vy, _vz, _wx, _wy, _wz. Otherwise the
    `x_names` of the dynamics, or x0, x1, ... Behind them are the names of what the problem leaves
    open: start_NAME, parameters, step or step_PHASE, and before_NAME of the last controls.
    """
    if isinstance(dynamics, Extended):
        return [*state_names(dynamics.inner), *_further_names(dynamics)]
    model = mujoco_model(dynamics)
    if model is None:
        return list(dynamics.x_names) or [f"x{i}" for i in range(dynamics.nx)]
    return _of_model(model, _POSITIONS)


def _further_names(dynamics: Extended) -> list[str]:
    inner = difference_names(dynamics.inner)
    own = [f"start_{inner[i]}" for i in dynamics.free]
    for name, shape in dynamics.shapes:
        places = np.ndindex(*shape)
        own += ["_".join([name, *map(str, place)]) for place in places]
    phases = len(dynamics.phases)
    own += ["step"] if phases == 1 else [f"step_{i}" for i in range(phases)]
    controls = control_names(dynamics.inner)
    return own + [f"before{i or ''}_{u}" for i in range(dynamics.order) for u in controls]


def difference_names(dynamics: Dynamics) -> list[str]:
    """Names of the entries of a difference of states, ndx of them.

    Those of the state, but for the rotation vectors of ball and free joints, _rx, _ry, _rz.
    """
    if dynamics.nx == dynamics.ndx:
        return state_names(dynamics)
    if isinstance(dynamics, Extended):
        return [*difference_names(dynamics.inner), *_further_names(dynamics)]
    model = mujoco_model(dynamics)
    if model is None:
        return [f"coordinate {i}" for i in range(dynamics.ndx)]
    return _of_model(model, _ROTATIONS)


def control_names(dynamics: Dynamics) -> list[str]:
    """Names of the entries of a control, nu of them: ctrl_ACTUATOR, `u_names`, or u0, u1, ..."""
    if isinstance(dynamics, Extended):
        return control_names(dynamics.inner)
    model = mujoco_model(dynamics)
    if model is None:
        return list(dynamics.u_names) or [f"u{i}" for i in range(dynamics.nu)]
    return [f"ctrl_{model.actuator(i).name or i}" for i in range(model.nu)]


def _of_model(model: mujoco.MjModel, positions: dict[int, tuple[str, ...]]) -> list[str]:
    """Names of positions, velocities and activations."""
    found: list[str] = []
    for kind, parts in (("qpos", positions), ("qvel", _VELOCITIES)):
        for i in range(model.njnt):
            name = f"{kind}_{model.joint(i).name or i}"
            own = parts.get(int(model.jnt_type[i]), ("",))
            found += [f"{name}_{part}" if part else name for part in own]
    for i in range(model.nu):
        name, count = f"act_{model.actuator(i).name or i}", int(model.actuator_actnum[i])
        found += [name] if count == 1 else [f"{name}_{part}" for part in range(count)]
    return found
