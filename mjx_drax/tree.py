"""Kinematics of a tree of bodies, without a walk along the tree.

MJX walks: it repeats the same few operations for every level of the tree and every kind of joint,
and compilers need time in proportion. Here each is written once, for all joints or bodies. Frames
are composed by doubling: each knows its place in an ancestor's; composed with that of the ancestor,
it knows its place in one twice as far up. After log2(depth) rounds that is the world.

Products of small matrices are sums of three terms: compilers fuse these, but neither reductions nor
calls of a library.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax._mjx import mjx
from mjx_drax._mujoco import mujoco
from mjx_drax.joints import Joints
from mjx_drax.quaternion import matrix, multiply, normalized

_FREE, _BALL, _SLIDE, _HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE")
)


@dataclass(frozen=True)
class _Frames:
    """The frames that are composed: the world's, one after each joint, one of each other body.

    Attributes:
        parents: the frame that each is in at first, (n,).
        bodies: whose offset comes first in each, or nbody for none, (n,).
        joints: whose motion follows, or njnt for none, (n,).
        last: of each body, (nbody,).
    """

    parents: np.ndarray
    bodies: np.ndarray
    joints: np.ndarray
    last: np.ndarray

    @classmethod
    def of(cls, model: mjx.Model) -> _Frames:
        """Those of a model."""
        none, still = model.nbody, model.njnt
        found, last = [(0, none, still)], [0]
        for body in range(1, model.nbody):
            frame, offset = last[model.body_parentid[body]], body
            start, count = model.body_jntadr[body], model.body_jntnum[body]
            for joint in range(start, start + count) if count else [still]:
                free = joint < still and model.jnt_type[joint] == _FREE
                found.append((frame, none if free else offset, joint))
                frame, offset = len(found) - 1, none
            last.append(frame)
        parents, bodies, joints = np.array(found, int).T
        return cls(parents, bodies, joints, np.array(last, int))


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.kinematics`: `data` with the frames of bodies, joints, geoms and sites."""
    frames, kinds = _Frames.of(model), np.asarray(model.jnt_type)
    offset, tilt = model.body_pos, model.body_quat
    if model.nmocap:
        mocap = np.flatnonzero(np.asarray(model.body_mocapid) >= 0)
        which = np.asarray(model.body_mocapid)[mocap]
        offset = offset.at[mocap].set(data.mocap_pos[which])
        tilt = tilt.at[mocap].set(normalized(data.mocap_quat[which]))
    slides, turns = _slides(model, data.qpos), _turns(model, data.qpos)
    pivots = jnp.where(kinds[:, None] == _FREE, 0.0, model.jnt_pos)
    move = _padded(slides + pivots - _applied(turns, pivots), 0.0)[frames.joints]
    turn = _padded(turns, jnp.eye(3))[frames.joints]
    offsets = _padded(offset, 0.0)[frames.bodies]
    tilts = _padded(matrix(tilt), jnp.eye(3))[frames.bodies]
    pos, mat = offsets + _applied(tilts, move), _product(tilts, turn)
    pos, mat = _composed(pos, mat, frames.parents)

    after = np.array([np.flatnonzero(frames.joints == j)[0] for j in range(model.njnt)], int)
    axes = model.jnt_axis
    if (kinds == _BALL).any():  # an axis is that before its joint turns, which only a ball's feels
        before = _applied(jnp.swapaxes(turns, 1, 2), axes)
        axes = jnp.where(kinds[:, None] == _BALL, before, axes)
    xaxis = _applied(mat[after], axes)
    xaxis = jnp.where(kinds[:, None] == _FREE, jnp.array([0.0, 0.0, 1.0]), xaxis)
    slid = jnp.where(kinds[:, None] == _SLIDE, slides, 0.0)
    xpos, xmat = pos[frames.last], mat[frames.last]

    def placed(body: np.ndarray, pos: Array, quat: Array) -> tuple[Array, Array]:
        """Positions and axes of what is fixed to bodies."""
        return xpos[body] + _applied(xmat[body], pos), _product(xmat[body], matrix(quat))

    xipos, ximat = placed(np.arange(model.nbody), model.body_ipos, model.body_iquat)
    geom_xpos, geom_xmat = placed(np.asarray(model.geom_bodyid), model.geom_pos, model.geom_quat)
    site_xpos, site_xmat = placed(np.asarray(model.site_bodyid), model.site_pos, model.site_quat)
    return data.replace(
        qpos=Joints.of(model).normalized(data.qpos),
        xanchor=pos[after] + _applied(mat[after], pivots - slid),
        xaxis=xaxis,
        xpos=xpos,
        xquat=_quaternions(model, data.qpos, tilt, frames),
        xmat=xmat,
        xipos=xipos,
        ximat=ximat,
        geom_xpos=geom_xpos,
        geom_xmat=geom_xmat,
        site_xpos=site_xpos,
        site_xmat=site_xmat,
    )


def _of_kind(model: mjx.Model, *kinds: int) -> tuple[np.ndarray, np.ndarray]:
    """The joints of some kinds, and where they begin in qpos, (n,) each."""
    joints = np.flatnonzero(np.isin(model.jnt_type, kinds))
    return joints, np.asarray(model.jnt_qposadr)[joints]


def _slides(model: mjx.Model, qpos: Array) -> Array:
    """How far each joint has slid along its axis, a free one in the world, (njnt, 3)."""
    (free, begins), (slide, at) = _of_kind(model, _FREE), _of_kind(model, _SLIDE)
    slid = model.jnt_axis[slide] * (qpos - model.qpos0)[at, None]
    still, _ = _of_kind(model, _BALL, _HINGE)
    floated = qpos[begins[:, None] + np.arange(3)]
    return _sorted([(free, floated), (slide, slid), (still, jnp.zeros((len(still), 3)))])


def _turns(model: mjx.Model, qpos: Array) -> Array:
    """How each joint has turned, a free one in the world, (njnt, 3, 3)."""
    hinge, at = _of_kind(model, _HINGE)
    angle, axis = (qpos - model.qpos0)[at, None, None], model.jnt_axis[hinge, None]
    along = axis * jnp.swapaxes(axis, 1, 2)
    across, skew = jnp.eye(3) - along, jnp.cross(jnp.eye(3), axis)
    spun = along + jnp.cos(angle) * across + jnp.sin(angle) * skew
    return _merged(model, qpos, matrix, jnp.eye(3), spun)


def _quaternions(model: mjx.Model, qpos: Array, tilt: Array, frames: _Frames) -> Array:
    """Of the bodies in the world, (nbody, 4); MJX itself reads hardly any."""
    identity = jnp.array([1.0, 0.0, 0.0, 0.0])
    hinge, at = _of_kind(model, _HINGE)
    half = 0.5 * (qpos - model.qpos0)[at, None]
    spun = jnp.concatenate([jnp.cos(half), jnp.sin(half) * model.jnt_axis[hinge]], axis=1)
    turns = _merged(model, qpos, lambda quat: quat, identity, spun)
    quat = _padded(tilt, identity)[frames.bodies]
    quat, parents = multiply(quat, _padded(turns, identity)[frames.joints]), frames.parents
    while parents.any():
        quat, parents = multiply(quat[parents], quat), parents[parents]
    return quat[frames.last]


def _merged(
    model: mjx.Model,
    qpos: Array,
    of_quaternion: Callable[[Array], Array],
    identity: Array,
    of_hinges: Array,
) -> Array:
    """Rotations (njnt, ...) of all joints, from those of hinges and of quaternions in qpos."""
    (free, begins), (ball, at) = _of_kind(model, _FREE), _of_kind(model, _BALL)
    (slide, _), (hinge, _) = _of_kind(model, _SLIDE), _of_kind(model, _HINGE)
    at = np.concatenate([begins + 3, at])[:, None] + np.arange(4)
    turning = of_quaternion(normalized(qpos[at]))
    still = jnp.broadcast_to(identity, (len(slide), *identity.shape))
    return _sorted([(np.concatenate([free, ball]), turning), (slide, still), (hinge, of_hinges)])


def _sorted(parts: Sequence[tuple[np.ndarray, Array]]) -> Array:
    """Rows of several parts, each with the places (n,) of its rows, at these places."""
    order = np.argsort(np.concatenate([places for places, _ in parts]))
    rows = [rows for places, rows in parts if len(places)] or [parts[0][1]]
    joined = jnp.concatenate(rows) if len(rows) > 1 else rows[0]
    return joined if (order == np.arange(len(order))).all() else joined[order]


def _padded(rows: Array, last: ArrayLike) -> Array:
    """The rows, and one more."""
    return jnp.concatenate([rows, jnp.broadcast_to(last, (1, *rows.shape[1:])).astype(rows.dtype)])


def _composed(pos: Array, mat: Array, parents: np.ndarray) -> tuple[Array, Array]:
    """Frames (n, 3) and (n, 3, 3) in the world, from those in their parents (n,)."""
    while parents.any():
        above = mat[parents]
        pos, mat = pos[parents] + _applied(above, pos), _product(above, mat)
        parents = parents[parents]
    return pos, mat


def _applied(A: Array, v: Array) -> Array:
    """A v for matrices (n, 3, 3) and vectors (n, 3)."""
    x, y, z = (A[:, :, k] * v[:, k, None] for k in range(3))
    return x + y + z


def _product(A: Array, B: Array) -> Array:
    """A B for matrices (n, 3, 3)."""
    x, y, z = (A[:, :, k, None] * B[:, None, k] for k in range(3))
    return x + y + z
