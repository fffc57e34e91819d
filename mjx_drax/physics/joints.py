"""States x = [qpos, qvel, act] of a model, and their tangent space [dq (nv), dv (nv), da (na)].

Positions of hinges and slides add. Ball and free joints hold unit quaternions: for each, qpos has
one number more than the tangent, and rotations compose (`quaternion`). Translations of free joints
add, in the frame of the world. `mj_integratePos` and `mj_differentiatePos` of MuJoCo do the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics import quaternion
from mjx_drax.physics.engine import mujoco

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE")
)


@dataclass(frozen=True)
class Joints:
    """Which entries of qpos are quaternions: all other entries of a state add.

    Attributes:
        nq, nv: sizes of qpos and qvel.
        quaternions: (address in qpos, address in qvel) of each, in ascending order.
    """

    nq: int
    nv: int
    quaternions: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Joints:
        """The joints of a model, MuJoCo's or MJX's."""
        shift = {BALL: 0, FREE: 3}  # a free joint's translation comes first
        quaternions = [
            (int(q) + shift[int(kind)], int(v) + shift[int(kind)])
            for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True)
            if int(kind) in shift
        ]
        return cls(int(model.nq), int(model.nv), tuple(sorted(quaternions)))

    def parts(self) -> list[tuple[slice, slice, bool]]:
        """Slices of qpos and of its tangent, and whether they are those of a quaternion."""
        parts, q, v = [], 0, 0
        for at_q, at_v in self.quaternions:
            parts += [(slice(q, at_q), slice(v, at_v), False)]
            parts += [(slice(at_q, at_q + 4), slice(at_v, at_v + 3), True)]
            q, v = at_q + 4, at_v + 3
        return [*parts, (slice(q, self.nq), slice(v, self.nv), False)]

    def integrate(self, x: Array, dx: Array) -> Array:
        """x + dx, where x begins with qpos (nq,) and dx with its tangent vector (nv,).

        Velocities and activations, which follow, add.
        """
        if not self.quaternions:
            return x + dx
        parts = [
            quaternion.normalized(quaternion.multiply(x[q], quaternion.exp(dx[v])))
            if turning
            else x[q] + dx[v]
            for q, v, turning in self.parts()
        ]
        return jnp.concatenate([*parts, x[self.nq :] + dx[self.nv :]])

    def difference(self, x: Array, y: Array) -> Array:
        """x - y in the tangent space at y, the inverse of `integrate`."""
        if not self.quaternions:
            return x - y
        parts = [
            quaternion.between(y[q], x[q]) if turning else x[q] - y[q]
            for q, _, turning in self.parts()
        ]
        return jnp.concatenate([*parts, x[self.nq :] - y[self.nq :]])

    def normalized(self, x: Array) -> Array:
        """x (..., nx) with quaternions scaled to unit length."""
        for q, _ in self.quaternions:
            x = x.at[..., q : q + 4].set(quaternion.normalized(x[..., q : q + 4]))
        return x

    def tangent(self, numbers: Array) -> Array:
        """Numbers (..., ndx) for the entries of a tangent, from those for entries of x, (..., nx).

        Rotation vectors get zeros, because their entries have no counterpart in x.
        """
        if not self.quaternions:
            return numbers
        parts = [
            jnp.zeros((*numbers.shape[:-1], 3), numbers.dtype) if turning else numbers[..., q]
            for q, _, turning in self.parts()
        ]
        return jnp.concatenate([*parts, numbers[..., self.nq :]], axis=-1)

    @property
    def is_quaternion(self) -> np.ndarray:
        """Whether an entry of qpos belongs to a quaternion, (nq,)."""
        flags = np.zeros(self.nq, bool)
        for q, _ in self.quaternions:
            flags[q : q + 4] = True
        return flags
