"""Finger pushes a box to a pose on a table, from MJCF: where and when it touches is to be found."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.04  # [s]
POSE = np.array([0.35, 0.1, 0.5])  # x, y [m] and yaw [rad] of the box at the end


def make(horizon: float = 2.0) -> Problem:
    """From rest with the finger behind the box to rest with the box at its pose."""
    return from_mjcf(
        path("box_push"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=placed,
        goal=lambda data: (
            np.linalg.norm(data.qpos[:2] - POSE[:2]) < 0.03
            and abs(data.qpos[2] - POSE[2]) < 0.15
            and np.all(np.abs(data.qvel[:3]) < 0.2)
        ),
        name="box_push",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt (|u|^2 + 10 d^2), d from the finger to the box."""
    finger = data.qpos[3:] + np.array([-0.2, 0.0])
    return np.sqrt(2 * DT) * jnp.concatenate([u, np.sqrt(10.0) * (finger - data.qpos[:2])])


def placed(data: Any) -> Array:
    """Distance of the box to its pose and its speed; half its squared norm is the cost."""
    off = data.qpos[:3] - POSE
    return jnp.concatenate([np.array([60.0, 60.0, 15.0]) * off, 3.0 * data.qvel[:3]])
