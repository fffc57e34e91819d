"""Pendulum swing-up of the paper: explicit Euler, 1 N m against m g l = 9.81 N m.

Explicit Euler at this step multiplies the amplitude of a free swing by 1.048 a step, which is what
brings so weak a motor upright in 4.9 s. Dynamics, dt and costs are as printed; the paper states no
horizon, mass, length or initial state: those of its authors' prototype are taken (K = 49).
`pendulum_swingup` is the pendulum whose physics keeps energy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, from_function

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DT = 0.1  # [s]
CHAINS = 256


def make(horizon: float = 4.9) -> Problem:
    """From rest near the bottom to rest at the top; x = [angle from upright, velocity]."""
    return from_function(
        step,
        x_init=[3.1, 0.0],
        nu=1,
        dt=DT,
        horizon=horizon,
        running_residual=running,
        terminal_residual=terminal,
        u_bounds=(-1.0, 1.0),
        x_scatter=(-6.0, 6.0),
        goal=lambda x: abs(x[0]) < 0.1 and abs(x[1]) < 0.5,
        x_names=("angle [rad]", "velocity [rad/s]"),
        u_names=("torque [N m]",),
        name="pendulum",
    )


def step(x: Array, u: Array) -> Array:
    """Explicit Euler for m = l = 1, g = 9.81; angle 0 is upright."""
    return x + DT * jnp.array([x[1], u[0] + 9.81 * jnp.sin(x[0])])


def running(x: Array, u: Array) -> Array:
    """Half its squared norm is 0.01 dt u^2."""
    return np.sqrt(2 * 0.01 * DT) * u


def terminal(x: Array) -> Array:
    """Half its squared norm is 10 angle^2 + velocity^2."""
    return jnp.sqrt(jnp.array([20.0, 2.0])) * x


def draw(axes: Axes, states: np.ndarray) -> None:
    """The phase portrait: velocity over angle so far (K + 1, 2), and upright as a star."""
    axes.plot(0.0, 0.0, "*", color="#2a9d5c", markersize=20, zorder=3)
    axes.plot(states[:, 0], states[:, 1], "-", color="#1f6fb2", linewidth=2)
    axes.plot(*states[-1], "o", color="#d9541e", markersize=12, zorder=4)
    axes.set(xlim=(-7, 7), ylim=(-7, 7), xlabel="angle [rad]", ylabel="velocity [rad/s]")
