"""Arm of seven joints reaches a point behind a pillar, from MJCF: its links keep clear of it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import Problem, from_mjcf
from mjx_drax.modelling.distances import CAPSULE, DISTANCES, SPHERE, Shape
from mjx_drax.models import path
from mjx_drax.physics.source import load

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
        inequality=Partial(clearance, *spheres(model), *pillar(model)),
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


def spheres(model: Any) -> tuple[np.ndarray, Array]:
    """Geoms whose middles are kept clear, and how far from the pillar's surface each must be."""
    radii = {"upper_roll": 0.09, "fore": 0.1, "fore_roll": 0.08, "wrist": 0.08, "hand": 0.1}
    sizes = jnp.array([[radius, 0.0, 0.0] for radius in radii.values()])
    return np.array([model.geom(name).id for name in radii]), sizes


def pillar(model: Any) -> tuple[int, Array]:
    """The obstacle, a capsule, and its size."""
    geom = model.geom("pillar")
    return geom.id, jnp.asarray(geom.size)


def clearance(
    middles: np.ndarray, sizes: Array, capsule: int, size: Array, data: Any, u: Array
) -> Array:
    """How far each sphere is from having its margin to the pillar [m]; <= 0 is clear."""
    obstacle = Shape(data.geom_xpos[capsule], data.geom_xmat[capsule], size)
    spheres = Shape(data.geom_xpos[middles], data.geom_xmat[middles], sizes)
    return MARGIN - jax.vmap(DISTANCES[SPHERE, CAPSULE], (0, None))(spheres, obstacle)
