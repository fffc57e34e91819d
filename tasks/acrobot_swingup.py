"""Acrobot swing-up in three seconds, from MJCF: only the elbow is driven."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.02  # [s]


def make(horizon: float = 3.0) -> Problem:
    """From hanging at rest to both links upright at rest; shoulder pi and elbow 0."""
    return from_mjcf(
        path("acrobot"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=upright,
        goal=lambda data: (
            np.all(np.cos(data.qpos - np.array([np.pi, 0.0])) > np.cos(0.1))
            and np.all(np.abs(data.qvel) < 0.5)
        ),
        name="acrobot_swingup",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt u^2."""
    return np.sqrt(2 * DT) * u


def upright(data: Any) -> Array:
    """Directions of both links and velocities, weighted; half its squared norm is the cost."""
    shoulder, elbow = data.qpos
    direction = jnp.array(
        [1 + jnp.cos(shoulder), jnp.sin(shoulder), 1 - jnp.cos(elbow), jnp.sin(elbow)]
    )
    return jnp.concatenate([np.sqrt(200.0) * direction, np.sqrt(20.0) * data.qvel])
