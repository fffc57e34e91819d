"""What actuators do: their ranges, the joints that they drive, the controls that a motion needs."""

from __future__ import annotations

import copy

import numpy as np

from mjx_drax.physics.c_engine.states import quiet, set_state
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.trajectory import Box


def disabled(model: mujoco.MjModel) -> np.ndarray:
    """Actuators that are switched off, by their group or all, (nu,)."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        return np.ones(model.nu, bool)
    groups, off = model.actuator_group, int(model.opt.disableactuator)
    return np.array([0 <= g < 31 and bool(off >> int(g) & 1) for g in groups], bool)


def control_ranges(model: mujoco.MjModel, without: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Ends of controls, (nu,) each: the model's, 0 and 1 of muscles, +-`without` of others."""
    limited = model.actuator_ctrllimited.astype(bool)[:, None]
    muscle = (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE)[:, None]
    own = np.where(muscle, [0.0, 1.0], [-without, without])
    lower, upper = np.where(limited, model.actuator_ctrlrange, own).T
    return lower, upper


def middle_control(bounds: Box) -> np.ndarray:
    """Middle of the control bounds, or 0 clipped to them where an end is infinite."""
    low, high = (np.asarray(end, float) for end in (bounds.u_lower, bounds.u_upper))
    with np.errstate(invalid="ignore"):
        half = (low + high) / 2
    return np.where(np.isfinite(half), half, np.clip(0.0, low, high))


def moment_arms(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Moment arms (nu, nv): generalized forces are their transpose times the actuators' forces."""
    moment, at = np.zeros((model.nu, model.nv)), (data.moment_rownnz, data.moment_rowadr)
    mujoco.mju_sparse2dense(moment, data.actuator_moment, *at, data.moment_colind)
    return moment


def largest_moment_arms(model: mujoco.MjModel) -> np.ndarray:
    """Largest |moment arm| of every actuator on every velocity, (nu, nv); 0 of disabled ones.

    Over the default pose and two random ones, because moment arms depend on the pose.
    """
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    largest = np.zeros((model.nu, model.nv))
    for _ in range(3):
        with quiet():
            mujoco.mj_forward(model, data)
        largest = np.maximum(largest, np.abs(moment_arms(model, data)))
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    largest[disabled(model)] = 0.0
    return largest


def driven(model: mujoco.MjModel) -> np.ndarray:
    """Joints that an actuator has a moment arm on, in one of three poses, (njnt,)."""
    joints = np.zeros(model.njnt, bool)
    joints[model.dof_jntid[largest_moment_arms(model).sum(axis=0) > 0]] = True
    return joints


def inverse_dynamics(
    model: mujoco.MjModel, x: np.ndarray, dt: float | np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """The controls (K, nu) that the C engine's inverse dynamics finds for states x (K + 1, nx).

        min |A (u - rest) - b|,        A = d tau / d u,
                                       b = tau(q_k, v_k, (v_{k+1} - v_k) / dt) - tau(rest)

    The answer with the least change from rest, (nu,) or (K, nu), which stays where there is none.
    dt is a number, or one for each stage, (K,).
    Limits of forces and controls are left out, so that tau is affine in u.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    model.actuator_forcelimited[:] = 0
    model.tendon_actfrclimited[:] = 0
    by_actuators = model.jnt_actgravcomp[model.dof_jntid]
    data = mujoco.MjData(model)
    out = np.broadcast_to(rest, (len(x) - 1, model.nu)).copy()
    nq, nv, steps = model.nq, model.nv, np.broadcast_to(dt, len(out))
    for k, u in enumerate(out):
        set_state(model, data, x[k])
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        at_rest, above = (_forces(model, data, u + more) for more in (0.0, 1.0))
        data.qacc[:] = (x[k + 1, nq : nq + nv] - x[k, nq : nq + nv]) / steps[k]
        mujoco.mj_inverse(model, data)
        moment = moment_arms(model, data)
        wanted = data.qfrc_inverse - by_actuators * data.qfrc_gravcomp  # which comes by itself
        A, b = moment.T * (above - at_rest), wanted - moment.T @ at_rest
        if np.isfinite(A).all() and np.isfinite(b).all():
            out[k] = u + np.linalg.lstsq(A, b, rcond=None)[0]
    return out


def _forces(model: mujoco.MjModel, data: mujoco.MjData, u: np.ndarray) -> np.ndarray:
    """Forces of the actuators (nu,) under u (nu,)."""
    data.ctrl[:] = u
    mujoco.mj_fwdActuation(model, data)
    return data.actuator_force.copy()
