"""Where actuators give their largest force, so that more control changes nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import HINGE, SLIDE

_NO_STATE = int(mujoco.mjtDyn.mjDYN_NONE)
_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_LINEAR = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

UNLIMITED = 1e6
"""So many times their largest forces actuators give in `unlimited`."""

FASTER = 20.0
"""How much faster than `dof_M0` says joints may gain speed: it is that of one posture, without what
hits or carries them. With 2 the swing-up of a servo cost up to 1.3 times as much."""

INSIDE = 1e-3
"""Share of the controls between both ends by which `Ends.held` stays away from these."""


@register_dataclass
@dataclass(frozen=True)
class Ends:
    """Controls at which forces reach their ranges: of motors and servos of hinges and slides.

        u = low, high + by_q q + by_v v

    Attributes:
        actuators: their numbers.
        q, v: where the positions and velocities of their joints are in qpos and qvel.
        low, high, by_q, by_v: (n,).
    """

    actuators: tuple[int, ...] = field(metadata=Static)
    q: tuple[int, ...] = field(metadata=Static)
    v: tuple[int, ...] = field(metadata=Static)
    low: Array
    high: Array
    by_q: Array
    by_v: Array

    def at(self, qpos: Any, qvel: Any) -> tuple[Any, Any]:
        """The ends (..., n)."""
        change = self.by_q * qpos[..., list(self.q)] + self.by_v * qvel[..., list(self.v)]
        return self.low + change, self.high + change

    def passed(self, data: Any, u: Array) -> Array:
        """By how much controls are beyond the ends, (2 n,): positive if they are."""
        low, high = self.at(data.qpos, data.qvel)
        own = u[jnp.array(self.actuators)]
        return jnp.concatenate([own - high, low - own])

    def held(self, nq: int, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The control (nu,) with forces INSIDE their ranges at a state (nx,), on the host.

        A force at the end of its range has no slope: with the implicit integrators its actuator
        then brings no damping, and joints gain speed several times as fast.
        """
        low, high = self.at(x[:nq], x[nq:])
        inside, own = INSIDE * (high - low), list(self.actuators)
        found = np.array(u)
        found[own] = np.clip(found[own], low + inside, high - inside)
        return found


def ends_of(model: mjx.Model, time: float = 0.0) -> Ends | None:
    """Where forces reach their ranges; None if they have none.

        gain u + b_0 + b_1 gear q + b_2 gear v = an end of the range, of the actuator or its joint

    Of a control that is held for some time [s]: where the force is still there at its end. The
    joint has gone on then, and has gained speed by force / `dof_M0`, times FASTER.
    """
    joint = np.asarray(model.actuator_trnid)[:, 0]
    single = np.isin(model.actuator_trntype, _JOINTS)
    joint = np.where(single, joint, 0)
    single &= np.isin(np.asarray(model.jnt_type)[joint], (HINGE, SLIDE)) if model.njnt else False
    single &= np.asarray(model.actuator_dyntype) == _NO_STATE
    single &= np.asarray(model.actuator_gaintype) == _FIXED
    single &= np.isin(model.actuator_biastype, _LINEAR)
    own = np.asarray(model.actuator_forcelimited).astype(bool)
    # Where actuators compensate gravity, the range of the joint is not theirs alone
    limited, lifts = (np.asarray(a, bool) for a in (model.jnt_actfrclimited, model.jnt_actgravcomp))
    theirs = limited & ~lifts
    of_joint = theirs[joint] if model.njnt else own
    (which,) = np.nonzero(single & (own | of_joint))
    if not which.size:
        return None
    joint, own, of_joint = joint[which], own[which, None], of_joint[which, None]
    q, v = np.asarray(model.jnt_qposadr)[joint], np.asarray(model.jnt_dofadr)[joint]
    gear, gain = model.actuator_gear[which, 0], model.actuator_gainprm[which, 0]
    idle = (gain == 0) | (gear == 0)
    gain, across = jnp.where(idle, 1.0, gain), jnp.where(idle, 1.0, gear)
    free = np.asarray(model.actuator_biastype)[which] == _LINEAR[0]
    bias = jnp.where(free[:, None], 0.0, model.actuator_biasprm[which])
    by_q, by_v = (-bias[:, i] * gear / gain for i in (1, 2))

    everything = jnp.array([-jnp.inf, jnp.inf])
    ranges = jnp.where(own, model.actuator_forcerange[which], everything)
    of_joints = jnp.sort(model.jnt_actfrcrange[joint] / across[:, None], axis=1)
    of_joints = jnp.where(of_joint, of_joints, everything)
    low = jnp.where(idle, -jnp.inf, jnp.maximum(ranges[:, 0], of_joints[:, 0]))
    high = jnp.where(idle, jnp.inf, jnp.minimum(ranges[:, 1], of_joints[:, 1]))

    def control(force: Array) -> Array:
        speed = time * FASTER * gear * jnp.where(idle, 0.0, force) / model.dof_M0[v]
        return (force - bias[:, 0]) / gain + by_v * speed

    turned, (one, other) = gain < 0, (control(low), control(high))
    own_numbers, q_places, v_places = (tuple(n.tolist()) for n in (which, q, v))
    return Ends(
        own_numbers,
        q_places,
        v_places,
        low=jnp.where(turned, other, one),
        high=jnp.where(turned, one, other),
        by_q=by_q,
        by_v=by_v + time * by_q,
    )


def finite_ends(model: mjx.Model, time: float = 0.0) -> Ends | None:
    """`ends_of` those that are finite at both ends, on the host; None if none are."""
    ends = ends_of(model, time)
    if ends is None:
        return None
    (some,) = np.nonzero(np.isfinite(ends.low) & np.isfinite(ends.high))
    if not some.size:
        return None
    own, q, v = (tuple(np.array(n)[some].tolist()) for n in (ends.actuators, ends.q, ends.v))
    return Ends(own, q, v, ends.low[some], ends.high[some], ends.by_q[some], ends.by_v[some])


def useful_controls(model: mjx.Model, x: Array) -> tuple[Array, Array] | None:
    """The ends (..., nu) at states (..., nx), infinite where there are none; None if all are."""
    ends = ends_of(model)
    if ends is None:
        return None
    which = np.array(ends.actuators)
    found = ends.at(x[..., : model.nq], x[..., model.nq : model.nq + model.nv])
    blank = jnp.full((*x.shape[:-1], model.nu), jnp.inf)
    return (-blank).at[..., which].set(found[0]), blank.at[..., which].set(found[1])


def unlimited(model: mjx.Model, ends: Ends) -> mjx.Model:
    """The model with UNLIMITED times the ranges of these actuators, and of their joints."""
    which = list(ends.actuators)
    joints = np.asarray(model.actuator_trnid)[which, 0].tolist()

    def scaled(ranges: Array, which: list[int]) -> Array:
        return jnp.asarray(ranges).at[jnp.array(which)].multiply(UNLIMITED)

    return model.replace(
        actuator_forcerange=scaled(model.actuator_forcerange, which),
        jnt_actfrcrange=scaled(model.jnt_actfrcrange, joints),
    )
