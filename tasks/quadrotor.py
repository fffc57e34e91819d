"""Quadrotor flies through two gates and past a pillar, from MJCF: keeping clear is a constraint."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import Problem, Terms, from_mjcf
from mjx_drax.mjcf import load
from mjx_drax.models import path

DT = 0.04  # [s]
GOAL = np.array([2.5, 0.0, 1.0])  # [m]
HOVER = 9.81 / 4  # thrust of each rotor that carries a quarter of the weight [N]
MARGIN = 0.02  # between the hull, a sphere about all that flies, and each bar [m]
SIDES = ("left", "right", "below", "above")
BARS = ["pillar", *(f"{gate}_{side}" for gate in ("first", "second") for side in SIDES)]
GATES = np.array([[-1.2, 0.6, 1.4], [1.2, -0.6, 0.9]])  # their middles [m]


def make(horizon: float = 4.0) -> Problem:
    """From hovering on the left, through both gates, to hovering on the right."""
    model = load(path("quadrotor"))
    return from_mjcf(
        model,
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=arrival,
        inequality=Terms(model).clearance("hull", BARS, margin=MARGIN),
        contacts=False,  # the constraint keeps the plan clear; the C engine lets things touch
        goal=lambda data: (
            np.linalg.norm(data.qpos[:3] - GOAL) < 0.1
            and data.xmat[1, 8] > np.cos(0.1)
            and np.all(np.abs(data.qvel) < 0.3)
        ),
        name="quadrotor",
    )


def effort(data: Any, u: Array) -> Array:
    """Thrusts beyond hovering, turning, and being off a gate's middle while near its plane."""
    off = data.qpos[None, 1:3] - GATES[:, 1:]
    near = jnp.exp(-jnp.square((data.qpos[0] - GATES[:, 0]) / 0.3))
    gates = np.sqrt(20.0) * near[:, None] * off
    turning = np.sqrt(0.1) * data.qvel[3:]
    return np.sqrt(2 * DT) * jnp.concatenate([u - HOVER, turning, jnp.ravel(gates)])


def arrival(data: Any) -> Array:
    """Distance to the goal, tilt and speeds, weighted; half its squared norm is the cost."""
    tilt = data.xmat[1][:2, 2]
    return jnp.concatenate([20.0 * (data.qpos[:3] - GOAL), 15.0 * tilt, 6.0 * data.qvel])
