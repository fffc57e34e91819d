"""Hopper jumps one metre forward and lands standing, from MJCF: contacts come and go."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.02  # [s]
STAND = np.array([1.0, 0.785, 0.0, 0.2, -0.4, 0.2])  # where and how it stands at the end


def make(horizon: float = 1.2) -> Problem:
    """From a crouch to standing at rest one metre ahead."""
    return from_mjcf(
        path("hopper"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=landed,
        goal=lambda data: (
            abs(data.qpos[0] - STAND[0]) < 0.15
            and data.qpos[1] > 0.6
            and abs(data.qpos[2]) < 0.2
            and np.all(np.abs(data.qvel) < 1.0)
        ),
        name="hopper_jump",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt (|u|^2 + tilt^2 + |v|^2 / 1000)."""
    return np.sqrt(2 * DT) * jnp.concatenate([u, data.qpos[2:3], np.sqrt(1e-3) * data.qvel])


def landed(data: Any) -> Array:
    """Distance to the pose at the end and speeds, weighted; half its squared norm is the cost."""
    return jnp.concatenate([10.0 * (data.qpos - STAND), data.qvel])
