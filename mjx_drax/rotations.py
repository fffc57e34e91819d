"""Rotations as unit quaternions, scalar first, and differences between them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.distances import norm


def product(p: Array, q: Array) -> Array:
    """The quaternion (4,) of the rotation q, then p; (4,) each."""
    vector = p[0] * q[1:] + q[0] * p[1:] + jnp.cross(p[1:], q[1:])
    return jnp.concatenate([(p[0] * q[0] - p[1:] @ q[1:])[None], vector])


def rotation_vector(q: Array, origin: Array) -> Array:
    """The rotation vector (3,) [rad] of origin^-1 q, for quaternions (4,) of any length.

    Its length is pi at most. It is smooth at zero, and jumps where the two are half a turn apart.
    """
    difference = product(origin * np.array([1.0, -1.0, -1.0, -1.0]), q)
    w, v = difference[0], difference[1:]
    w, v = jnp.abs(w), jnp.where(w < 0, -v, v)
    square = v @ v
    small = square < 1e-4 * w**2
    length, above = norm(v), jnp.where(small, w, 1.0)
    near = (2 - 2 / 3 * square / above**2) / above  # 2 arctan(|v| / w) / |v|, to fourth order
    far = 2 * jnp.arctan2(length, w) / jnp.where(small, 1.0, length)
    return jnp.where(small, near, far) * v
