"""Unit quaternions q = [w, x, y, z], and rotation vectors, their tangent space.

    exp(v) = [cos(|v|/2), sin(|v|/2) v/|v|]        log(exp(v)) = v for |v| < pi

A rotation vector moves a quaternion in its own frame, q exp(v), as in MuJoCo: an angular velocity
times dt is such a v. Both maps are smooth at the identity, where the defects of a feasible
trajectory are. MJX's own conversions divide by a norm that is cut off there, and their derivatives
are zero or NaN.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

SMALL = 1e-6
"""Squared half-angle [rad^2] below which series replace quotients; the difference is below rounding
in float32 and 1e-13 in float64."""


def multiply(p: Array, q: Array) -> Array:
    """The product p q of quaternions (..., 4): first q's rotation, then p's."""
    pw, px, py, pz = (p[..., i] for i in range(4))
    qw, qx, qy, qz = (q[..., i] for i in range(4))
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def inverse(q: Array) -> Array:
    """The inverse of unit quaternions (..., 4)."""
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def exp(v: Array) -> Array:
    """Unit quaternions (..., 4) of rotation vectors v (..., 3) [rad]."""
    square = 0.25 * jnp.sum(jnp.square(v), axis=-1, keepdims=True)
    small = square < SMALL
    half = jnp.sqrt(jnp.where(small, 1.0, square))
    w = jnp.where(small, 1.0 - square / 2.0, jnp.cos(half))
    ratio = jnp.where(small, 1.0 - square / 6.0, jnp.sin(half) / half)
    return jnp.concatenate([w, 0.5 * ratio * v], axis=-1)


def log(q: Array) -> Array:
    """Rotation vectors (..., 3) [rad], of length up to pi, of unit quaternions q (..., 4)."""
    q = jnp.where(q[..., :1] < 0.0, -q, q)  # q and -q are the same rotation
    w, v = q[..., :1], q[..., 1:]
    square = jnp.sum(jnp.square(v), axis=-1, keepdims=True)
    small = square < SMALL
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    safe = jnp.where(small, w, 1.0)  # w is near 1 there
    ratio = jnp.where(small, (1.0 - square / (3.0 * safe**2)) / safe, jnp.arctan2(sine, w) / sine)
    return 2.0 * ratio * v


def between(p: Array, q: Array) -> Array:
    """Rotation vectors (..., 3) [rad] from p to q, in p's frame, of unit quaternions (..., 4)."""
    return log(multiply(inverse(p), q))


def normalized(q: Array) -> Array:
    """Quaternions (..., 4) scaled to unit length; one of length 0 becomes the identity."""
    square = jnp.sum(jnp.square(q), axis=-1, keepdims=True)
    identity = jnp.zeros_like(q).at[..., 0].set(1.0)
    null = square == 0.0
    return jnp.where(null, identity, q / jnp.sqrt(jnp.where(null, 1.0, square)))


def matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions q (..., 4)."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = (
        (w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
