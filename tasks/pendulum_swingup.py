"""Pendulum swing-up with 3 N m against 9.81 N m, from MJCF; it takes several swings."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.05  # [s]


def make(horizon: float = 5.0) -> Problem:
    """From hanging at rest to upright at rest (angle pi)."""
    return from_mjcf(
        path("pendulum"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=upright,
        goal=lambda data: np.cos(data.qpos[0] - np.pi) > np.cos(0.1) and abs(data.qvel[0]) < 0.5,
        name="pendulum_swingup",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt u^2."""
    return np.sqrt(2 * DT) * u


def upright(data: Any) -> Array:
    """Half its squared norm is 100 (1 + cos q) + 10 v^2."""
    q, v = data.qpos[0], data.qvel[0]
    return jnp.array([np.sqrt(400.0) * jnp.cos(q / 2), np.sqrt(20.0) * v])
