"""Arm of seven joints reaches a point behind a pillar, from MJCF: its links keep clear of it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import Problem, from_mjcf
from mjx_drax.mjcf import load
from mjx_drax.models import path
from mjx_drax.tasks._distance import capsules

DT = 0.04  # [s]
DOWN = np.array([0.0, 0.0, -1.0])  # where the hand points at the end
MARGIN = 0.02  # [m]


def make(horizon: float = 2.0) -> Problem:
    """From a bent pose beside the pillar to rest with the tool at the target, pointing down."""
    model = load(path("arm"))
    tool, target = model.site("tool").id, model.site("target").pos
    x_lower, x_upper = scatter(model)
    return from_mjcf(
        model,
        horizon=horizon,
        dt=DT,
        running_residual=effort,
        terminal_residual=Partial(reach, tool, target),
        inequality=Partial(clearance, *spheres(model), capsules(model)),
        contacts=False,  # the constraint keeps the plan clear; the C engine lets things touch
        x_scatter=(x_lower, x_upper),
        goal=lambda data: (
            np.linalg.norm(data.site("tool").xpos - target) < 0.02
            and data.site("tool").xmat[[2, 5, 8]] @ DOWN > np.cos(0.1)
            and np.all(np.abs(data.qvel) < 0.2)
        ),
        name="arm_reach",
    )


def scatter(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Box for initial knots: half the joints' ranges, moderate speeds."""
    half = np.concatenate([0.5 * model.jnt_range[:, 1], np.full(model.nv, 2.0)])
    return -half, half


def effort(data: Any, u: Array) -> Array:
    """Half its squared norm is dt (|u|^2 + |v|^2 / 10)."""
    return np.sqrt(2 * DT) * jnp.concatenate([u, np.sqrt(0.1) * data.qvel])


def reach(tool: int, target: np.ndarray, data: Any) -> Array:
    """Distance to the target, direction of the hand and speed, weighted."""
    off = data.site_xpos[tool] - target
    pointing = data.site_xmat[tool][:, 2] - DOWN
    return jnp.concatenate([50.0 * off, 10.0 * pointing, 5.0 * data.qvel])


def spheres(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Geoms whose middles are kept clear, and how far from the pillar's surface each must be."""
    names = ["upper_roll", "fore", "fore_roll", "wrist", "hand"]
    return np.array([model.geom(name).id for name in names]), np.array([0.09, 0.1, 0.08, 0.08, 0.1])


def clearance(
    geoms: np.ndarray, around: np.ndarray, obstacles: Partial, data: Any, u: Array
) -> Array:
    """How far each sphere is from having its margin to the pillar [m]; <= 0 is clear."""
    return around + MARGIN - obstacles(data.geom_xpos[geoms])[:, 0]
