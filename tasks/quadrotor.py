"""Quadrotor flies through two gates and past a pillar, from MJCF: keeping clear is a constraint."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import Problem, Terms, Trajectory, from_mjcf, guesses
from mjx_drax.models import path
from mjx_drax.physics.source import load

DT = 0.04  # [s]
GOAL = np.array([2.5, 0.0, 1.0])  # [m]
HOVER = 9.81 / 4  # thrust of each rotor that carries a quarter of the weight [N]
MARGIN = 0.02  # between the hull, a sphere about all that flies, and each bar [m]
SIDES = ("left", "right", "below", "above")
BARS = ["pillar", *(f"{gate}_{side}" for gate in ("first", "second") for side in SIDES)]
GATES = np.array([[-1.2, 0.6, 1.4], [1.2, -0.6, 0.9]])  # their middles [m]
SCATTER = 0.2  # of initial knots about the way [m, rad, m/s, rad/s, N]
OPEN = 0.15  # how far from its middle a gate may be passed [m]
DEPTH = 0.3  # of the funnels before and behind a gate [m]


def make(horizon: float = 4.0) -> Problem:
    """From hovering on the left, through both gates, to hovering on the right."""
    model = load(path("quadrotor"))
    problem = from_mjcf(
        model,
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=arrival,
        inequality=Terms(model).clearance("hull", BARS, margin=MARGIN) + funnels,
        contacts=False,  # the constraint keeps the plan clear; the C engine lets things touch
        goal=lambda data: (
            np.linalg.norm(data.qpos[:3] - GOAL) < 0.1
            and data.xmat[1, 8] > np.cos(0.1)
            and np.all(np.abs(data.qvel) < 0.3)
        ),
        name="quadrotor",
    )
    guess = Partial(about, problem, through_gates(problem))
    return replace(problem, guess=guess)


def through_gates(problem: Problem) -> Trajectory:
    """Straight from the start to the gates' middles and on to the goal; no quadrotor can do it."""
    level = [1.0, 0.0, 0.0, 0.0]
    stops = [*GATES, GOAL]
    times = float(problem.times[-1]) * np.array([0.35, 0.65, 1.0])
    poses = [np.concatenate([stop, level]) for stop in stops]
    return guesses.waypoints(problem, zip(times, poses, strict=True))


def about(problem: Problem, along: Trajectory, key: Array) -> Trajectory:
    """Knots scattered about a trajectory."""
    key_x, key_u = jax.random.split(key)
    away = SCATTER * jax.random.normal(key_x, (problem.horizon, problem.dynamics.ndx))
    push = SCATTER * jax.random.normal(key_u, along.u.shape)
    return problem.displaced(along, Trajectory(away, push))


def effort(data: Any, u: Array) -> Array:
    """Thrusts beyond hovering, and turning."""
    return np.sqrt(2 * DT) * jnp.concatenate([u - HOVER, np.sqrt(0.1) * data.qvel[3:]])


def funnels(data: Any, u: Array) -> Array:
    """Through each gate leads a funnel, as wide as `OPEN` in its plane [m^2]; <= 0 is inside."""
    off = jnp.sum(jnp.square(data.qpos[None, 1:3] - GATES[:, 1:]), axis=1)
    near = jnp.exp(-jnp.square((data.qpos[0] - GATES[:, 0]) / DEPTH))
    return near * off - OPEN**2


def arrival(data: Any) -> Array:
    """Distance to the goal, tilt and speeds, weighted; half its squared norm is the cost."""
    tilt = data.xmat[1][:2, 2]
    return jnp.concatenate([20.0 * (data.qpos[:3] - GOAL), 15.0 * tilt, 6.0 * data.qvel])
