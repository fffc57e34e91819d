"""Signed distances that several tasks keep clear of obstacles with."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.tree_util import Partial


def boxes(model: mujoco.MjModel, axes: str = "xyz") -> Partial:
    """Distance [m] to the collidable, unrotated boxes of a model's world: p (..., n) -> (..., m).

    `axes` are those that count and that p has, "xy" for example if the boxes are walls.
    """
    world = (model.geom_bodyid == 0) & ((model.geom_contype | model.geom_conaffinity) != 0)
    chosen = world & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    which = ["xyz".index(axis) for axis in axes]
    return Partial(to_boxes, model.geom_pos[chosen][:, which], model.geom_size[chosen][:, which])


def to_boxes(centre: np.ndarray, half: np.ndarray, p: Array) -> Array:
    """From p (..., n) to boxes with given centres and half-widths (m, n); negative inside."""
    outside = jnp.abs(p[..., None, :] - centre) - half
    beside = jnp.sum(jnp.square(jnp.maximum(outside, 0.0)), axis=-1)
    return jnp.sqrt(beside + 1e-12) + jnp.minimum(jnp.max(outside, axis=-1), 0.0)


def capsules(model: mujoco.MjModel) -> Partial:
    """Distance [m] to the collidable capsules of a model's world: p (..., 3) -> (..., m)."""
    world = (model.geom_bodyid == 0) & ((model.geom_contype | model.geom_conaffinity) != 0)
    chosen = world & (model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    turn = np.zeros((int(chosen.sum()), 9))
    for row, quat in zip(turn, model.geom_quat[chosen], strict=True):
        mujoco.mju_quat2Mat(row, quat)
    half = model.geom_size[chosen, 1, None] * turn[:, [2, 5, 8]]  # along the axis
    return Partial(to_capsules, model.geom_pos[chosen], half, model.geom_size[chosen, 0])


def to_capsules(middle: np.ndarray, half: np.ndarray, radius: np.ndarray, p: Array) -> Array:
    """From p (..., 3) to capsules about middle +- half (m, 3); negative inside."""
    off = p[..., None, :] - middle
    along = jnp.clip(jnp.sum(off * half, axis=-1) / np.sum(half * half, axis=-1), -1.0, 1.0)
    apart = off - along[..., None] * half
    return jnp.sqrt(jnp.sum(jnp.square(apart), axis=-1) + 1e-12) - radius
