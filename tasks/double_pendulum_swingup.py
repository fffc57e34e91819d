"""Swing-up of a double pendulum on a cart, from MJCF: one force, two free links."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.02  # [s]


def make(horizon: float = 3.0) -> Problem:
    """From hanging at rest to both links upright at rest in the middle of the rail."""
    return from_mjcf(
        path("double_pendulum"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=upright,
        goal=lambda data: (
            np.all(np.cos(data.qpos[1:] - np.array([np.pi, 0.0])) > np.cos(0.1))
            and np.all(np.abs(data.qvel) < 0.5)
        ),
        name="double_pendulum_swingup",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt u^2."""
    return np.sqrt(2 * DT) * u


def upright(data: Any) -> Array:
    """Position, directions of both links and velocities; half its squared norm is the cost."""
    x, first, second = data.qpos
    direction = jnp.array(
        [1 + jnp.cos(first), jnp.sin(first), 1 - jnp.cos(second), jnp.sin(second)]
    )
    return jnp.concatenate(
        [np.sqrt(20.0) * x[None], np.sqrt(200.0) * direction, np.sqrt(20.0) * data.qvel]
    )
