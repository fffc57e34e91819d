"""Connect and weld constraints of bodies that turn: what MJX leaves out of their references.

A constraint of positions r(q) = 0 has an acceleration J a + J' v, with J = dr/dq. The C engine
takes J' v, that of bodies that go on turning as they do, from the reference of J a:

    connect    r = p1 - p2                          J' v = p1'' - p2''
    weld       r = (p1 - p2, s vec(q2* q1))         J' v = (p1'' - p2'', s vec(q2* b q1) / 2)

with points p of both bodies, whose p'' are those without accelerations of joints, quaternions q,
the torque scale s, and b = w1' - w2' + ((w1 - w2) w1 - w2 (w1 - w2)) / 2 of the turning velocities
w1 and w2, as quaternions without a real part.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics import quaternion
from mjx_drax.physics._mjx import internal, mjx, with_internal
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.tree import accelerations

_CONNECT, _WELD = (int(kind) for kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
_SITE = int(mujoco.mjtObj.mjOBJ_SITE)
_OFF = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)


def with_turning(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data`, which has rows of constraints and velocities, with -J' v in their references."""
    kinds = np.asarray(model.eq_type)
    if int(model.opt.disableflags) & _OFF or not np.isin(kinds, (_CONNECT, _WELD)).any():
        return data
    connects, welds = np.flatnonzero(kinds == _CONNECT), np.flatnonzero(kinds == _WELD)
    cacc, anchors = accelerations(model, data), model.eq_data[:, :6]
    rates = [
        _between_points(model, data, cacc, connects, anchors[connects]),
        jnp.concatenate(
            [
                _between_points(model, data, cacc, welds, jnp.roll(anchors[welds], 3, axis=1)),
                _between_frames(model, data, cacc, welds),
            ],
            axis=1,
        ),
    ]
    acting = (data.eq_active[which, None] for which in (connects, welds))
    rate = jnp.concatenate([jnp.ravel(r * on) for r, on in zip(rates, acting, strict=True)])
    aref = internal(data).efc_aref.at[: len(rate)].add(-rate)  # MJX has these rows first
    return with_internal(data, efc_aref=aref)


def _between_points(
    model: mjx.Model, data: mjx.Data, cacc: Array, which: np.ndarray, anchors: Array
) -> Array:
    """p1'' - p2'' of constraints (n,), (n, 3); anchors of both bodies (n, 6), if not of sites."""
    found = []
    for ids, bodies, anchor in zip(*_ends(model, which), jnp.split(anchors, 2, 1), strict=True):
        point = jnp.sum(data.xmat[bodies] * anchor[:, None], axis=-1) + data.xpos[bodies]
        if model.nsite:
            of_site = _of_sites(model, which)
            point = jnp.where(of_site[:, None], data.site_xpos[ids * of_site], point)
        arm = point - data.subtree_com[np.asarray(model.body_rootid)[bodies]]
        w, v = jnp.split(data.cvel[bodies], 2, axis=1)
        turning, moving = jnp.split(cacc[bodies], 2, axis=1)
        velocity = v + jnp.cross(w, arm)
        found.append(moving + jnp.cross(turning, arm) + jnp.cross(w, velocity))
    return found[0] - found[1]


def _between_frames(model: mjx.Model, data: mjx.Data, cacc: Array, which: np.ndarray) -> Array:
    """s vec(q2* b q1) / 2 of weld constraints (n,), (n, 3)."""
    ids, (one, other) = _ends(model, which)
    within = [model.eq_data[which, 6:10], jnp.eye(4)[np.zeros(len(which), int)]]
    if model.nsite:
        of_site = _of_sites(model, which)
        sites = [model.site_quat[i * of_site] for i in ids]
        within = [jnp.where(of_site[:, None], s, q) for s, q in zip(sites, within, strict=True)]
    q1 = quaternion.multiply(data.xquat[one], within[0])
    q2 = quaternion.multiply(data.xquat[other], within[1])
    velocity, acceleration = (jnp.pad(each[:, :3], ((0, 0), (1, 0))) for each in (data.cvel, cacc))
    w1, w2 = velocity[one], velocity[other]
    b = quaternion.multiply(w1 - w2, w1) - quaternion.multiply(w2, w1 - w2)
    b = acceleration[one] - acceleration[other] + 0.5 * b
    turned = quaternion.multiply(quaternion.multiply(quaternion.inverse(q2), b), q1)
    return 0.5 * model.eq_data[which, 10:11] * turned[:, 1:]


def _of_sites(model: mjx.Model, which: np.ndarray) -> np.ndarray:
    """Which of the constraints (n,) are of sites."""
    found: np.ndarray = np.asarray(model.eq_objtype)[which] == _SITE
    return found


def _ends(model: mjx.Model, which: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Numbers of the two sites or bodies of each constraint (n,), and of the two bodies."""
    ids = [np.asarray(each)[which] for each in (model.eq_obj1id, model.eq_obj2id)]
    if not model.nsite:
        return ids, ids
    of_site = _of_sites(model, which)
    return ids, [np.where(of_site, np.asarray(model.site_bodyid)[i * of_site], i) for i in ids]
