"""Cart-pole swing-up in two seconds, from MJCF: the cart stays on its rail."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path

DT = 0.02  # [s]


def make(horizon: float = 2.0) -> Problem:
    """From hanging at rest to upright at rest in the middle of the rail; pole angle pi is up."""
    return from_mjcf(
        path("cartpole"),
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=upright,
        goal=lambda data: (
            np.cos(data.qpos[1] - np.pi) > np.cos(0.1) and np.all(np.abs(data.qvel) < 0.5)
        ),
        name="cartpole_swingup",
    )


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt u^2."""
    return np.sqrt(2 * DT) * u


def upright(data: Any) -> Array:
    """Position, pole direction and velocities, weighted; half its squared norm is the cost."""
    (x, angle), velocity = data.qpos, data.qvel
    direction = jnp.array([1 + jnp.cos(angle), jnp.sin(angle)])
    return jnp.concatenate([jnp.sqrt(20.0) * x[None], 10.0 * direction, np.sqrt(20.0) * velocity])
