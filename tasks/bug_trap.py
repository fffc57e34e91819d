"""Unicycle in the paper's bug trap: the way to the goal leads back out of a U of obstacles.

K = 119 by default. The paper states no horizon; at the 4.9 s of its authors' prototype (K = 49)
staying inside is optimal: the way out is about as long as the robot can drive in that time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import Problem, from_function

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DT = 0.1  # [s]
GOAL = np.array([1.0, 0.0])
WALL = np.array(
    [[-1, 1], [-0.5, 1], [0, 1], [0, 0.5], [0, 0], [0, -0.5], [0, -1], [-0.5, -1], [-1, -1]], float
)
CHAINS = 256


def make(horizon: float = 11.9, wall: np.ndarray = WALL, name: str = "bug_trap") -> Problem:
    """From (-1, 0), inside the trap, to (1, 0); x = [x, y, heading], u = [speed, turn rate].

    `wall` holds the centres of the obstacles, (n, 2).
    """
    return from_function(
        step,
        x_init=[-1.0, 0.0, 0.0],
        nu=2,
        dt=DT,
        horizon=horizon,
        running_residual=Partial(running, wall),
        terminal_residual=terminal,
        x_bounds=([-3.0, -3.0, -np.inf], [3.0, 3.0, np.inf]),
        u_bounds=(-1.0, 1.0),
        x_scatter=([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi]),
        goal=lambda x: np.linalg.norm(x[:2] - GOAL) < 0.3,
        x_names=("x [m]", "y [m]", "heading [rad]"),
        u_names=("speed [m/s]", "turn rate [rad/s]"),
        name=name,
    )


def step(x: Array, u: Array) -> Array:
    """Explicit Euler for a unicycle."""
    return x + DT * jnp.array([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])


def running(wall: Array, x: Array, u: Array) -> Array:
    """dt (|u|^2 + 1000 sum_o exp(-5 |p - o|^2)) as half a squared norm, (2 + n,)."""
    distance = jnp.sum(jnp.square(x[:2] - wall), axis=1)
    bumps = np.sqrt(2 * DT * 1000.0) * jnp.exp(-2.5 * distance)
    return jnp.concatenate([np.sqrt(2 * DT) * u, bumps])


def terminal(x: Array) -> Array:
    """Half its squared norm is 10 |p - goal|^2."""
    return np.sqrt(20.0) * (x[:2] - GOAL)


def draw(axes: Axes, states: np.ndarray, wall: np.ndarray = WALL) -> None:
    """Obstacles shaded, the goal as a star, and the motion (K + 1, 3) so far."""
    side = np.linspace(-3.0, 3.0, 121)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    distance = np.sum(np.square(grid[..., None, :] - wall), axis=-1)
    axes.contourf(side, side, np.exp(-5.0 * distance).sum(axis=-1), levels=30, cmap="Greys")
    axes.plot(*GOAL, "*", color="#2a9d5c", markersize=20, zorder=3)
    axes.plot(states[:, 0], states[:, 1], "-", color="#1f6fb2", linewidth=2)
    x, y, heading = states[-1]
    axes.plot(x, y, "o", color="#d9541e", markersize=12, zorder=4)
    axes.plot(
        [x, x + 0.25 * np.cos(heading)], [y, y + 0.25 * np.sin(heading)], color="#d9541e", lw=3
    )
    axes.set(xlim=(-3, 3), ylim=(-3, 3), aspect="equal", xlabel="x [m]", ylabel="y [m]")
