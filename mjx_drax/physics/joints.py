"""States x = [qpos, qvel, act] of a model, and their tangent space [dq (nv), dv (nv), da (na)].

Hinges and slides add. Ball and free joints hold unit quaternions: qpos has a number more than the
tangent for each, and rotations compose (`quaternion`). A free joint's translation adds, in the
world's frame. These are the conventions of MuJoCo's `mj_integratePos` and `mj_differentiatePos`.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics import quaternion
from mjx_drax.physics.engine import mujoco

_BALL, _FREE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_FREE)


@dataclass(frozen=True)
class Joints:
    """Where the quaternions of qpos stand, which is all that tells states from vectors.

    Attributes:
        nq, nv: sizes of qpos and qvel.
        quaternions: (address in qpos, address in qvel) of each, ascending.
    """

    nq: int
    nv: int
    quaternions: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Joints:
        """The joints of a model, MuJoCo's or MJX's."""
        shift = {_BALL: 0, _FREE: 3}  # a free joint's translation comes first
        quaternions = [
            (int(q) + shift[int(kind)], int(v) + shift[int(kind)])
            for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True)
            if int(kind) in shift
        ]
        return cls(int(model.nq), int(model.nv), tuple(sorted(quaternions)))

    def _parts(self) -> list[tuple[slice, slice, bool]]:
        """Parts of qpos and of its tangent, and whether they are a quaternion's."""
        parts, q, v = [], 0, 0
        for at_q, at_v in self.quaternions:
            parts += [(slice(q, at_q), slice(v, at_v), False)]
            parts += [(slice(at_q, at_q + 4), slice(at_v, at_v + 3), True)]
            q, v = at_q + 4, at_v + 3
        return [*parts, (slice(q, self.nq), slice(v, self.nv), False)]

    def integrate(self, x: Array, dx: Array) -> Array:
        """x + dx, for x beginning with qpos (nq,) and dx with its tangent vector (nv,).

        What follows, velocities and activations, adds.
        """
        if not self.quaternions:
            return x + dx
        parts = [
            quaternion.normalized(quaternion.multiply(x[q], quaternion.exp(dx[v])))
            if turning
            else x[q] + dx[v]
            for q, v, turning in self._parts()
        ]
        return jnp.concatenate([*parts, x[self.nq :] + dx[self.nv :]])

    def difference(self, x: Array, y: Array) -> Array:
        """x - y in the tangent space at y, the inverse of `integrate`."""
        if not self.quaternions:
            return x - y
        parts = [
            quaternion.between(y[q], x[q]) if turning else x[q] - y[q]
            for q, _, turning in self._parts()
        ]
        return jnp.concatenate([*parts, x[self.nq :] - y[self.nq :]])

    def normalized(self, x: Array) -> Array:
        """x (..., nx) with quaternions scaled to unit length."""
        for q, _ in self.quaternions:
            x = x.at[..., q : q + 4].set(quaternion.normalized(x[..., q : q + 4]))
        return x

    def tangent(self, numbers: Array) -> Array:
        """Of numbers (..., nx) that go with the entries of x, those of the tangent (..., ndx).

        Rotation vectors, whose axes are not entries of x, get zeros.
        """
        if not self.quaternions:
            return numbers
        parts = [
            jnp.zeros((*numbers.shape[:-1], 3), numbers.dtype) if turning else numbers[..., q]
            for q, _, turning in self._parts()
        ]
        return jnp.concatenate([*parts, numbers[..., self.nq :]], axis=-1)

    @property
    def is_quaternion(self) -> np.ndarray:
        """Whether an entry of qpos belongs to a quaternion, (nq,)."""
        flags = np.zeros(self.nq, bool)
        for q, _ in self.quaternions:
            flags[q : q + 4] = True
        return flags
