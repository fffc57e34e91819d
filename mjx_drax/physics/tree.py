"""Kinematics and smooth dynamics of a tree of bodies, without a loop over its levels.

MJX loops: it repeats the same few operations for every level of the tree and every kind of joint,
and the time to compile grows with them. (On GPUs it grows faster, because compilers copy what a
level computes into all that reads it.) Here each operation is written once, for all joints or
bodies at once.

Frames are composed by doubling: each frame is given in one of its ancestors; composed with that
ancestor's, it is given in one twice as far up. After log2(depth) rounds it is given in the world.
Velocities, accelerations, forces and inertias add up along the tree. With S[b, d] = 1 where degree
of freedom d moves body b, and 0 elsewhere, sums over all that is above a body are products with S,
and sums over all that is below it are products with S'.

Products of small matrices are written as sums of few terms, because compilers fuse sums, but
neither reductions nor calls of a library.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.physics._mjx import internal, mjx, with_internal
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import BALL, FREE, HINGE, SLIDE, Joints
from mjx_drax.physics.quaternion import matrix, multiply, normalized


@dataclass(frozen=True)
class _Frames:
    """The frames that are composed: the world, one a joint, and one a body that has no joints.

    Attributes:
        parents: the frame that each is given in, (n,).
        bodies: the body whose offset each begins with, (n,); nbody for none.
        joints: the joint whose motion follows, (n,); njnt for none.
        last: the frame that is the body's, (nbody,).
    """

    parents: np.ndarray
    bodies: np.ndarray
    joints: np.ndarray
    last: np.ndarray

    @classmethod
    def of(cls, model: mjx.Model) -> _Frames:
        """The frames of a model."""
        none, fixed = model.nbody, model.njnt
        found, last = [(0, none, fixed)], [0]
        for body in range(1, model.nbody):
            frame, offset = last[model.body_parentid[body]], body
            start, count = model.body_jntadr[body], model.body_jntnum[body]
            for joint in range(start, start + count) if count else [fixed]:
                free = joint < fixed and model.jnt_type[joint] == FREE
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
    pivots = jnp.where(kinds[:, None] == FREE, 0.0, model.jnt_pos)
    move = _padded(slides + pivots - applied(turns, pivots), 0.0)[frames.joints]
    turn = _padded(turns, jnp.eye(3))[frames.joints]
    offsets = _padded(offset, 0.0)[frames.bodies]
    tilts = _padded(matrix(tilt), jnp.eye(3))[frames.bodies]
    pos, mat = offsets + applied(tilts, move), _product(tilts, turn)
    pos, mat = _composed(pos, mat, frames.parents)

    after = np.array([np.flatnonzero(frames.joints == j)[0] for j in range(model.njnt)], int)
    axes = model.jnt_axis
    if (kinds == BALL).any():  # MuJoCo's axis is that before the joint turns; only balls turn it
        before = applied(jnp.swapaxes(turns, 1, 2), axes)
        axes = jnp.where(kinds[:, None] == BALL, before, axes)
    xaxis = applied(mat[after], axes)
    xaxis = jnp.where(kinds[:, None] == FREE, jnp.array([0.0, 0.0, 1.0]), xaxis)
    slid = jnp.where(kinds[:, None] == SLIDE, slides, 0.0)
    xpos, xmat = pos[frames.last], mat[frames.last]

    def placed(body: np.ndarray, pos: Array, quat: Array) -> tuple[Array, Array]:
        """Positions and axes of what is fixed to bodies."""
        return xpos[body] + applied(xmat[body], pos), _product(xmat[body], matrix(quat))

    xipos, ximat = placed(np.arange(model.nbody), model.body_ipos, model.body_iquat)
    geom_xpos, geom_xmat = placed(np.asarray(model.geom_bodyid), model.geom_pos, model.geom_quat)
    site_xpos, site_xmat = placed(np.asarray(model.site_bodyid), model.site_pos, model.site_quat)
    return data.replace(
        qpos=Joints.of(model).normalized(data.qpos),
        xanchor=pos[after] + applied(mat[after], pivots - slid),
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


def frame_derivatives(model: mjx.Model, data: mjx.Data) -> dict[str, Array]:
    """Derivatives of what `kinematics` finds by each degree of freedom, (nv, ...), by name.

    A degree of freedom moves all frames that it carries as one rigid body, by its motion `cdof`.
    """
    sums, bodies, joints = _Sums.of(model), np.arange(model.nbody), Joints.of(model)
    moves = sums.moves > 0
    turning, moving = data.cdof[:, None, :3], data.cdof[:, None, 3:]
    about = data.subtree_com[model.body_rootid]

    def turned(carried: np.ndarray, vectors: Array) -> Array:
        """Of vectors (n, 3), of which each is carried or not, (nv, n)."""
        return jnp.where(carried[:, :, None], jnp.cross(turning, vectors), 0.0)

    def of_points(carried: np.ndarray, body: np.ndarray, points: Array) -> Array:
        return turned(carried, points - about[body]) + jnp.where(carried[:, :, None], moving, 0.0)

    def of_axes(carried: np.ndarray, axes: Array) -> Array:
        return jnp.stack([turned(carried, axes[:, :, k]) for k in range(3)], axis=-1)

    ends = np.append(np.asarray(model.jnt_dofadr)[1:], model.nv) - 1
    before, on = sums.before[ends].T > 0, np.asarray(model.jnt_bodyid)
    fixed = np.asarray(model.jnt_type)[:, None] == FREE
    spin = 0.5 * jnp.pad(turning, ((0, 0), (0, 0), (1, 0)))
    still = jnp.zeros(model.nv, data.qpos.dtype)
    found = {
        "qpos": jax.jacfwd(lambda dq: joints.integrate(data.qpos, dq))(still).T,
        "xanchor": of_points(before, on, data.xanchor),
        "xaxis": jnp.where(fixed, 0.0, turned(before, data.xaxis)),
        "xquat": multiply(jnp.where(moves.T[:, :, None], spin, 0.0), data.xquat),
    }
    for name, body in (
        ("x", bodies),
        ("xi", bodies),
        ("geom_x", model.geom_bodyid),
        ("site_x", model.site_bodyid),
    ):
        carried = moves[np.asarray(body)].T
        found[f"{name}pos"] = of_points(carried, body, getattr(data, f"{name}pos"))
        found[f"{name}mat"] = of_axes(carried, getattr(data, f"{name}mat"))
    return found


def com_pos(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.com_pos`: `data` with centres of mass, inertias and motions about them.

    subtree_com (nbody, 3); cinert (nbody, 10) and cdof (nv, 6), about the centre of mass of all
    bodies of the same kinematic tree; motions are [angular, linear].
    """
    inside = _Sums.of(model).subtrees
    mass = model.body_mass[:, None]
    below = _summed(inside, mass)
    whole = jnp.maximum(below, mujoco.mjMINVAL)
    com = jnp.where(below < mujoco.mjMINVAL, data.xipos, _summed(inside, mass * data.xipos) / whole)
    about = com[model.body_rootid]
    away = data.xipos - about
    inertia = _product(data.ximat * model.body_inertia[:, None], jnp.swapaxes(data.ximat, 1, 2))
    far = jnp.sum(away * away, axis=1)[:, None, None] * jnp.eye(3)
    inertia = inertia + mass[:, :, None] * (far - away[:, :, None] * away[:, None])
    rows, columns = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    cinert = jnp.concatenate([inertia[:, rows, columns], mass * away, mass], axis=1)

    kinds, joint, body = np.asarray(model.jnt_type), model.dof_jntid, model.dof_bodyid
    kind, within = kinds[joint], np.arange(model.nv) - np.asarray(model.jnt_dofadr)[joint]
    moves = (kind == SLIDE) | ((kind == FREE) & (within < 3))
    turns = data.xmat[body, :, within % 3]  # columns of a matrix: the body's own axes
    axes = jnp.where((kind == FREE)[:, None] & moves[:, None], jnp.eye(3)[within % 3], turns)
    axes = jnp.where(np.isin(kind, (SLIDE, HINGE))[:, None], data.xaxis[joint], axes)
    swept = jnp.cross(axes, about[body] - data.xanchor[joint])
    turning = jnp.where(moves[:, None], 0.0, axes)
    cdof = jnp.concatenate([turning, jnp.where(moves[:, None], axes, swept)], axis=1)
    return with_internal(data.replace(subtree_com=com, cdof=cdof), cinert=cinert)


def mass_matrix(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.crb`: `data` with the joint-space inertia M, dense (nv, nv).

    M[i, j] = cdof_j . I_i cdof_i for a degree of freedom j that moves all that i moves, with I_i
    the inertia of all that i moves.
    """
    sums = _Sums.of(model)
    moved = _inertia_times(_summed(sums.moves.T, internal(data).cinert), data.cdof)
    products = _dots(moved, data.cdof)
    below = jnp.where(np.tril(sums.moves[model.dof_bodyid]) > 0, products, 0.0)
    M = below + jnp.tril(below, -1).T + jnp.diag(model.dof_armature)
    return with_internal(data, M=M)


def com_vel(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.com_vel`: `data` with velocities cvel (nbody, 6) and rates of cdof (nv, 6)."""
    sums = _Sums.of(model)
    velocity = data.cdof * data.qvel[:, None]
    above = _summed(np.concatenate([sums.moves, sums.before]), velocity)
    cvel, before = above[: model.nbody], above[model.nbody :]
    return data.replace(cvel=cvel, cdof_dot=_crossed(before, data.cdof))


def accelerations(model: mjx.Model, data: mjx.Data) -> Array:
    """Those of bodies whose joints have none and without gravity, (nbody, 6), as cvel is."""
    return _summed(_Sums.of(model).moves, data.cdof_dot * data.qvel[:, None])


def motions(model: mjx.Model, data: mjx.Data, velocity: Array, bodies: np.ndarray) -> Array:
    """Those of bodies (n,), (n, 6), as cvel is, at a velocity of joints (nv,)."""
    return _summed(_Sums.of(model).moves[bodies], data.cdof * velocity[:, None])


def joint_forces(
    model: mjx.Model, data: mjx.Data, wrenches: Array, bodies: np.ndarray | slice = slice(None)
) -> Array:
    """Forces on joints (nv,) of torques and forces on bodies (n,), (n, 6), about what cvel is."""
    return jnp.sum(data.cdof * _summed(_Sums.of(model).moves[bodies].T, wrenches), axis=1)


def rne(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.rne`: `data` with the forces qfrc_bias (nv,) of gravity and velocities."""
    inertia, acceleration = internal(data).cinert, accelerations(model, data)
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        acceleration = acceleration - jnp.concatenate([jnp.zeros(3), model.opt.gravity])
    momentum = _inertia_times(inertia, data.cvel)
    force = _inertia_times(inertia, acceleration) + _crossed_force(data.cvel, momentum)
    return data.replace(qfrc_bias=joint_forces(model, data, force))


def inverse_derivatives(
    model: mjx.Model, data: mjx.Data, qacc: Array, more: Array
) -> tuple[Array, Array, Array]:
    """Derivatives (nv, nv) of the forces tau = M a + bias of an acceleration a = `qacc` (nv,).

    By positions, by velocities, and that of M w by positions, with w = `more` (nv,); armatures and
    tendons are left out. In closed form (Singh, Russell and Wensing 2022): a degree of freedom j
    turns all that it moves about its axis s_j. With the velocity v and the acceleration a of the
    frame before it, where the world's a is -g,

        s_j' = v x s_j      s_j'' = a x s_j + v x s_j'      s_j* = (velocity behind j) x s_j
        d tau_i / d q_j = s_i . (B_i s_j' + I_i s_j'')        j moves s_i, or is of the same joint
        d tau_i / d q_j = s_i . (B_j s_j' + I_j s_j'' + s_j x f_j)                    i moves s_j
        d tau_i / d v_j = s_i . (B s_j + I (s_j' + s_j*))                  B, I of i or j as above

    B_i, I_i and f_i are sums over all bodies that i moves: of the inertias I, of the matrices that
    take m to v x (I m) - I (v x m) + m x (I v), and of the forces I a + v x (I v). With v = (w, u),
    I = (J, c, mass) and I v = (n, p), of m only its turning m_w counts,

        B m = (Z m_w - n x m_w, -2 p x m_w)      Z = Y + Y'      Y = [w]x J - c u' + (u . c) 1
    """
    sums, S, inertia, velocity = _Sums.of(model), data.cdof, internal(data).cinert, data.cvel
    moves, before, momentum = sums.moves, sums.before, _inertia_times(inertia, velocity)
    above = before + moves[np.asarray(model.dof_bodyid)] * (1 - before) * (1 - before.T)

    (turn, move), off = jnp.split(velocity, 2, axis=1), inertia[:, 6:9]
    Y = jnp.cross(turn[:, None], _tensors(inertia)) - off[:, :, None] * move[:, None]
    Y = Y + jnp.sum(move * off, axis=1)[:, None, None] * jnp.eye(3)
    Z = (Y + jnp.swapaxes(Y, 1, 2)).reshape(-1, 9)
    below = _summed(moves.T, jnp.concatenate([inertia, Z, momentum], axis=1))
    inertias, Z = below[:, :10], below[:, 10:19].reshape(-1, 3, 3)
    twist, push = below[:, 19:22], below[:, 22:]
    turning, moving = jnp.split(S, 2, axis=1)
    moved = _inertia_times(inertias, S)
    swept = applied(Z, turning) - jnp.cross(turning, twist) - 2.0 * jnp.cross(moving, push)

    def derivative(first: Array, second: Array, force: Array) -> Array:
        """s_i . (B s_j' + I s_j'') for such columns (nv, 6), and forces of bodies (nbody, 6)."""
        turns = first[:, :3]
        around = applied(Z, turns) - jnp.cross(twist, turns)
        own = jnp.concatenate([around, -2.0 * jnp.cross(push, turns)], axis=1)
        own = own + _inertia_times(inertias, second) + _crossed_force(S, _summed(moves.T, force))
        by_above = _dots(swept, turns)
        by_above = by_above + _dots(moved, second)
        by_below = _dots(S, own)
        return jnp.where(above > 0, by_above, 0.0) + jnp.where(before.T > 0, by_below, 0.0)

    rate, speed = data.cdof_dot, data.qvel[:, None]
    world = jnp.zeros(6, S.dtype)
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        world = world.at[3:].set(-model.opt.gravity)
    motion = S * qacc[:, None] + rate * speed
    force = _inertia_times(inertia, world + _summed(moves, motion))
    force = force + _crossed_force(velocity, momentum)
    second = _crossed(world + _summed(before, motion), S)
    second = second + _crossed(_summed(before, S * speed), rate)
    behind = _crossed(_summed(above, S * speed), S)
    pushed, none = S * more[:, None], jnp.zeros_like(S)
    return (
        derivative(rate, second, force),
        derivative(S, rate + behind, jnp.zeros_like(force)),
        derivative(
            none,
            _crossed(_summed(before, pushed), S),
            _inertia_times(inertia, _summed(moves, pushed)),
        ),
    )


@dataclass(frozen=True)
class _Sums:
    """Which rows add up, as matrices of zeros and ones.

    Attributes:
        moves: S, which degrees of freedom move a body, (nbody, nv).
        before: which degrees of freedom move the axis of another, (nv, nv).
        subtrees: which bodies a body carries, itself included, (nbody, nbody).
    """

    moves: np.ndarray
    before: np.ndarray
    subtrees: np.ndarray

    @classmethod
    def of(cls, model: mjx.Model) -> _Sums:
        """The sums of a model."""
        subtrees = np.eye(model.nbody)
        for body in reversed(range(1, model.nbody)):
            subtrees[model.body_parentid[body]] += subtrees[body]
        moves = subtrees[np.asarray(model.dof_bodyid, int)].T
        # On the same body, earlier joints; in a free joint, translations come before rotations
        joint, dof = np.asarray(model.dof_jntid, int), np.arange(model.nv)
        begins = np.asarray(model.jnt_dofadr, int)[joint]
        free = np.asarray(model.jnt_type, int)[joint] == FREE
        begins = np.where(free, np.where(dof < begins + 3, 0, begins + 3), begins)
        before = moves[np.asarray(model.dof_bodyid, int)] * (dof < begins[:, None])
        return cls(moves, before, subtrees)


def _summed(which: np.ndarray, rows: Array) -> Array:
    """Sums (m, k) of those rows (n, k) that each row of `which` (m, n) marks.

    CPUs call their library once for all states and directions of a batch: Jacobians of f then take
    20 to 75 % of the time.
    """

    def by_library(rows: Array) -> Array:
        return jnp.asarray(which, rows.dtype) @ rows

    def summed(rows: Array) -> Array:
        return jnp.sum(which[:, :, None].astype(rows.dtype) * rows, axis=1)

    return jax.lax.platform_dependent(rows, cpu=by_library, default=summed)


def _dots(v: Array, w: Array) -> Array:
    """v_i . w_j, (n, m), of vectors (n, 6) and (m, 6): a sum of terms, as those fuse."""
    return reduce(add, [v[:, k, None] * w[:, k] for k in range(v.shape[1])])


def _tensors(inertia: Array) -> Array:
    """The tensors J (n, 3, 3) of inertias (n, 10); mass times centre and mass are the others."""
    return inertia[:, np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]


def _inertia_times(inertia: Array, motion: Array) -> Array:
    """Momenta (n, 6) of bodies with inertias (n, 10) in motions (n, 6)."""
    whole, off, mass = _tensors(inertia), inertia[:, 6:9], inertia[:, 9:]
    turning, moving = motion[:, :3], motion[:, 3:]
    angular = applied(whole, turning) + jnp.cross(off, moving)
    return jnp.concatenate([angular, mass * moving - jnp.cross(off, turning)], axis=1)


def _crossed(v: Array, motion: Array) -> Array:
    """Rates (n, 6) of motions (n, 6) that velocities (n, 6) carry along."""
    (turn, move), (turning, moving) = (jnp.split(a, 2, axis=1) for a in (v, motion))
    along = jnp.cross(move, turning) + jnp.cross(turn, moving)
    return jnp.concatenate([jnp.cross(turn, turning), along], axis=1)


def _crossed_force(v: Array, force: Array) -> Array:
    """Rates (n, 6) of forces or momenta (n, 6) that velocities (n, 6) carry along."""
    (turn, move), (twist, push) = (jnp.split(a, 2, axis=1) for a in (v, force))
    around = jnp.cross(turn, twist) + jnp.cross(move, push)
    return jnp.concatenate([around, jnp.cross(turn, push)], axis=1)


def _of_kind(model: mjx.Model, *kinds: int) -> tuple[np.ndarray, np.ndarray]:
    """The joints of some kinds, and where they begin in qpos, (n,) each."""
    joints = np.flatnonzero(np.isin(model.jnt_type, kinds))
    return joints, np.asarray(model.jnt_qposadr)[joints]


def _slides(model: mjx.Model, qpos: Array) -> Array:
    """How far each joint has slid along its axis, a free one in the world, (njnt, 3)."""
    (free, begins), (slide, at) = _of_kind(model, FREE), _of_kind(model, SLIDE)
    slid = model.jnt_axis[slide] * (qpos - model.qpos0)[at, None]
    still, _ = _of_kind(model, BALL, HINGE)
    floated = qpos[begins[:, None] + np.arange(3)]
    return _sorted([(free, floated), (slide, slid), (still, jnp.zeros((len(still), 3)))])


def _turns(model: mjx.Model, qpos: Array) -> Array:
    """How each joint has turned, a free one in the world, (njnt, 3, 3)."""
    hinge, at = _of_kind(model, HINGE)
    angle, axis = (qpos - model.qpos0)[at, None, None], model.jnt_axis[hinge, None]
    along = axis * jnp.swapaxes(axis, 1, 2)
    across, skew = jnp.eye(3) - along, jnp.cross(jnp.eye(3), axis)
    spun = along + jnp.cos(angle) * across + jnp.sin(angle) * skew
    return _merged(model, qpos, matrix, jnp.eye(3), spun)


def _quaternions(model: mjx.Model, qpos: Array, tilt: Array, frames: _Frames) -> Array:
    """Of the bodies in the world, (nbody, 4); MJX itself reads hardly any."""
    identity = jnp.array([1.0, 0.0, 0.0, 0.0])
    hinge, at = _of_kind(model, HINGE)
    half = 0.5 * (qpos - model.qpos0)[at, None]
    spun = jnp.concatenate([jnp.cos(half), jnp.sin(half) * model.jnt_axis[hinge]], axis=1)
    turns = _merged(model, qpos, lambda quat: quat, identity, spun)
    quat = _padded(tilt, identity)[frames.bodies]
    quat, parents = multiply(quat, _padded(turns, identity)[frames.joints]), frames.parents
    while parents.any():
        quat, parents = _once(multiply(quat[parents], quat)), parents[parents]
    return quat[frames.last]


def _merged(
    model: mjx.Model,
    qpos: Array,
    of_quaternion: Callable[[Array], Array],
    identity: Array,
    of_hinges: Array,
) -> Array:
    """Rotations (njnt, ...) of all joints, from those of hinges and of quaternions in qpos."""
    (free, begins), (ball, at) = _of_kind(model, FREE), _of_kind(model, BALL)
    (slide, _), (hinge, _) = _of_kind(model, SLIDE), _of_kind(model, HINGE)
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
        pos, mat = _once((pos[parents] + applied(above, pos), _product(above, mat)))
        parents = parents[parents]
    return pos, mat


_once = jax.lax.optimization_barrier
"""Of a round of doubling. Compilers for GPUs would compute it again for each number of the next one
that reads it, and in each of those the round before: a hand's cost compiled 4.5 s, not 0.9."""


def applied(A: Array, v: Array) -> Array:
    """A v for matrices (n, i, j) and vectors (n, j)."""
    return reduce(add, [A[:, :, k] * v[:, k, None] for k in range(v.shape[1])])


def _product(A: Array, B: Array) -> Array:
    """A B for matrices (n, 3, 3)."""
    x, y, z = (A[:, :, k, None] * B[:, None, k] for k in range(3))
    return x + y + z
