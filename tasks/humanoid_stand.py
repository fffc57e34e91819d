"""Humanoid stands up from a crouch, from MJCF: 21 servos, two feet, balance."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.02  # [s]
HEIGHT = 0.88  # of the pelvis when it stands [m]


def make(horizon: float = 1.2) -> Problem:
    """From a crouch to standing upright at rest."""
    return from_mjcf(
        path("humanoid"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=standing,
        goal=lambda data: (
            data.body("pelvis").xpos[2] > 0.8
            and data.body("torso").xmat[8] > np.cos(0.2)
            and np.all(np.abs(data.qvel[:6]) < 0.5)
        ),
        name="humanoid_stand",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt (|u - q|^2 + |v|^2 / 11), u - q what servos push with."""
    parts = [u - data.qpos[7:], 0.3 * data.qvel]
    return np.sqrt(2 * DT) * jnp.concatenate(parts)


def standing(data: Any) -> Array:
    """Height, upright trunk and pelvis, straight joints and rest; half its squared norm is cost."""
    upright = jnp.concatenate([data.xmat[1][:2, 2], data.xmat[2][:2, 2]])
    parts = [30.0 * (data.qpos[2:3] - HEIGHT), 10.0 * upright, data.qpos[7:], data.qvel]
    return jnp.concatenate(parts)
