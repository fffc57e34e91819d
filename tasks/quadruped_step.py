"""Quadruped steps 0.3 m forward, from MJCF: position servos, four feet, contacts come and go."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path
from mjx_drax.physics.source import load

DT = 0.02  # [s]
AHEAD = np.array([0.3, 0.0])  # [m]
HEIGHT = 0.325  # of the trunk when it stands [m]
LEGS = np.tile([0.0, 0.7, -1.4], 4)  # angles of the legs when it stands [rad]


def make(horizon: float = 1.2) -> Problem:
    """From standing to standing at rest 0.3 m ahead."""
    stand = load(path("quadruped")).key_qpos[0]
    return from_mjcf(
        path("quadruped"),
        horizon=horizon,
        dt=DT,
        x_init=np.concatenate([stand, np.zeros(18)]),
        running_residual=effort,
        terminal_residual=arrived,
        goal=lambda data: (
            np.linalg.norm(data.qpos[:2] - AHEAD) < 0.06
            and data.qpos[2] > 0.25
            and data.body("trunk").xmat[8] > np.cos(0.2)
            and np.all(np.abs(data.qvel[:6]) < 0.5)
        ),
        name="quadruped_step",
    )


def effort(data: Any, u: Array) -> Array:
    """Controls off the standing angles, tilt, height and speeds; half its squared norm is cost."""
    tilt, height = data.xmat[1][:2, 2], data.qpos[2:3] - HEIGHT
    parts = [u - LEGS, 3.0 * tilt, 10.0 * height, np.sqrt(1e-2) * data.qvel]
    return np.sqrt(2 * DT) * jnp.concatenate(parts)


def arrived(data: Any) -> Array:
    """Distance to the pose at the end and speeds, weighted; half its squared norm is the cost."""
    place = jnp.concatenate([data.qpos[:2] - AHEAD, data.qpos[2:3] - HEIGHT])
    forward, up = data.xmat[1][1:, 0], data.xmat[1][:2, 2]
    parts = [30.0 * place, 10.0 * forward, 10.0 * up, 2.0 * (data.qpos[7:] - LEGS), data.qvel]
    return jnp.concatenate(parts)
