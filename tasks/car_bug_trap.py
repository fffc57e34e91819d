"""Skid-steered car gets out of a bug trap, from MJCF: the walls are real in MuJoCo."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import Problem, from_mjcf
from mjx_drax.models import path
from mjx_drax.tasks import bug_trap

DT = 0.1  # [s]
GOAL = np.array([1.0, 0.0])  # [m]


def make(
    horizon: float = 11.9, maze: str = "car_bug_trap", along: np.ndarray = bug_trap.WALL
) -> Problem:
    """From inside the trap to rest at the goal behind it.

    `maze` is a model with walls, and `along` (n, 2) are points of them to keep away from.
    """
    return from_mjcf(
        path(maze),
        horizon=horizon,
        dt=DT,
        running_residual=Partial(effort, along),
        terminal_residual=arrival,
        contacts=False,  # the cost keeps the plan clear; in the C engine walls are walls
        x_scatter=([-3.0, -3.0, -np.pi, -0.5, -0.5, -0.5], [3.0, 3.0, np.pi, 0.5, 0.5, 0.5]),
        goal=lambda data: (
            np.linalg.norm(data.qpos[:2] - GOAL) < 0.3 and np.all(np.abs(data.qvel) < 0.2)
        ),
        name=maze,
    )


def effort(along: np.ndarray, data: Any, u: Array) -> Array:
    """Half its squared norm is dt (|u|^2 + 1000 sum_o exp(-5 |p - o|^2)), as in bug_trap."""
    distance = jnp.sum(jnp.square(data.qpos[:2] - along), axis=1)
    bumps = np.sqrt(1000.0) * jnp.exp(-2.5 * distance)
    return np.sqrt(2 * DT) * jnp.concatenate([u, bumps])


def arrival(data: Any) -> Array:
    """Half its squared norm is 100 |p - goal|^2 + 10 |v|^2."""
    place = data.qpos[:2] - GOAL
    return jnp.concatenate([np.sqrt(200.0) * place, np.sqrt(20.0) * data.qvel])
