"""Where actuators give their largest force, so that more control changes nothing."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import HINGE, SLIDE

_NO_STATE = int(mujoco.mjtDyn.mjDYN_NONE)
_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_LINEAR = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def useful_controls(model: mjx.Model, x: Array) -> tuple[Array, Array] | None:
    """Ends (..., nu) of the controls at which forces reach their ranges, at states (..., nx).

        gain u + b_0 + b_1 gear q + b_2 gear v = an end of the range, of the actuator or its joint

    For motors and servos of hinges and slides; infinite for others, and None if there are none.
    """
    joint = np.asarray(model.actuator_trnid)[:, 0]
    single = np.isin(model.actuator_trntype, _JOINTS)
    joint = np.where(single, joint, 0)
    single &= np.isin(np.asarray(model.jnt_type)[joint], (HINGE, SLIDE)) if model.njnt else False
    single &= np.asarray(model.actuator_dyntype) == _NO_STATE
    single &= np.asarray(model.actuator_gaintype) == _FIXED
    single &= np.isin(model.actuator_biastype, _LINEAR)
    own = np.asarray(model.actuator_forcelimited).astype(bool)
    of_joint = np.asarray(model.jnt_actfrclimited).astype(bool)[joint]
    single &= own | of_joint
    if not single.any():
        return None
    gear, gain = model.actuator_gear[:, 0], model.actuator_gainprm[:, 0]
    single = single & (gain != 0) & (gear != 0)
    gain, across = jnp.where(single, gain, 1.0), jnp.where(single, gear, 1.0)
    low, high = jnp.where(own[:, None], model.actuator_forcerange, jnp.array([-jnp.inf, jnp.inf])).T
    ends = model.jnt_actfrcrange[joint] / across[:, None]
    ends = jnp.where(of_joint[:, None], jnp.sort(ends, axis=1), jnp.array([-jnp.inf, jnp.inf]))
    low, high = jnp.maximum(low, ends[:, 0]), jnp.minimum(high, ends[:, 1])
    q = x[..., np.asarray(model.jnt_qposadr)[joint]]
    v = x[..., model.nq + np.asarray(model.jnt_dofadr)[joint]]
    bias = model.actuator_biasprm
    force = bias[:, 0] + gear * (bias[:, 1] * q + bias[:, 2] * v)
    force = jnp.where(np.asarray(model.actuator_biastype) == _LINEAR[0], 0.0, force)
    one, other = (low - force) / gain, (high - force) / gain
    lower = jnp.where(single, jnp.minimum(one, other), -jnp.inf)
    return lower, jnp.where(single, jnp.maximum(one, other), jnp.inf)
