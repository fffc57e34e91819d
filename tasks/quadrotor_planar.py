"""Planar quadrotor flies through staggered pillars, from MJCF: keeping clear is a constraint."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path
from mjx_drax.physics.source import load

DT = 0.04  # [s]
GOAL = np.array([2.5, 1.0])  # (x, z) [m]
HOVER = 0.5 * 0.5 * 9.81  # thrust of each rotor that carries half the weight [N]
REACH = 0.22 + 0.03  # radius of the hull, a sphere about all that flies, and a margin [m]
STEEP = 2.0  # slope of the sides of what is kept clear


def make(horizon: float = 4.0) -> Problem:
    """From hovering on the left to hovering on the right."""
    model = load(path("quadrotor_planar"))
    return from_mjcf(
        model,
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=arrival,
        inequality=Partial(clearance, pillars(model)),
        contacts=False,  # the constraint keeps the plan clear; the C engine lets things touch
        x_scatter=([-3.0, 0.5, -0.5, -1.0, -1.0, -1.0], [3.0, 2.5, 0.5, 1.0, 1.0, 1.0]),
        goal=lambda data: (
            np.linalg.norm(data.qpos[:2] - GOAL) < 0.1
            and abs(data.qpos[2]) < 0.1
            and np.all(np.abs(data.qvel) < 0.3)
        ),
        name="quadrotor_planar",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt (|u - hover|^2 + pitch rate^2 / 10)."""
    return np.sqrt(2 * DT) * jnp.concatenate([u - HOVER, np.sqrt(0.1) * data.qvel[2:]])


def arrival(data: Any) -> Array:
    """Distances to a hover at the goal, weighted; half its squared norm is the cost."""
    x, z, pitch = data.qpos
    place = jnp.array([20.0, 12.0]) * (jnp.array([x, z]) - GOAL)
    level = jnp.array([jnp.sin(pitch), 1 - jnp.cos(pitch)])
    return jnp.concatenate([place, 10.0 * level, 6.0 * data.qvel])


def clearance(tips: np.ndarray, data: Any, u: Array) -> Array:
    """How far the hull is inside a tent with steep sides over each pillar's tip, (n,) [m].

    A tent contains the pillar and the room that the hull needs. Its slope says, deep inside too,
    on which side the gap is; the distance to a pillar would push out of it to the left or right.
    """
    x, z = data.qpos[:2]
    beside = jnp.abs(x - tips[:, 0]) - tips[:, 2]
    room = jnp.minimum(REACH, np.sqrt(1 + STEEP**2) * REACH - STEEP * beside)
    return room - tips[:, 3] * (z - tips[:, 1])


def pillars(model: mujoco.MjModel) -> np.ndarray:
    """For each: x and z of its tip, half its width, and 1 if the gap is above it, -1 if below."""
    rows = []
    for name, side in (("left", 1), ("middle", -1), ("right", 1)):
        geom = model.geom(name)
        rows.append([geom.pos[0], geom.pos[2] + side * geom.size[2], geom.size[0], side])
    return np.array(rows)
