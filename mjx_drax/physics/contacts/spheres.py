"""Contacts of spheres with capsules, and of two capsules, as the C engine has them.

MJX adds 1e-6 m^2 to the squared length of a capsule, which counts if that is short.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mjx_drax.physics._mjx import mjx

PARALLEL = 1e-12
"""Squared sine of the angle below which capsules count as parallel."""

APART = 1.0
"""Distance of contacts that do not act [m], as in MJX."""

Contacts = tuple[Array, Array, Array]
"""Distances (n,), positions (n, 3), and normals (n, 3) from the first geom to the second."""


def sphere_capsule(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """The nearest point of the capsule's axis is the centre of a sphere."""
    sphere, capsule = geom.T
    centre, radius = data.geom_xpos[sphere], model.geom_size[sphere, 0]
    middle, half = axis_of(model, data, capsule)
    along = jnp.sum((centre - middle) * half, axis=1) / jnp.sum(half * half, axis=1)
    nearest = middle + jnp.clip(along, -1.0, 1.0)[:, None] * half
    return of_spheres(centre, radius, nearest, model.geom_size[capsule, 0])


def two_capsules(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """Nearest points m + s h of both axes, with -1 <= s <= 1, are centres of spheres."""
    one, other = geom.T
    (m1, h1), (m2, h2) = (axis_of(model, data, g) for g in (one, other))
    points = nearest_points(m1, h1, m2, h2)
    radii = model.geom_size[one, 0], model.geom_size[other, 0]
    return of_spheres(points[0], radii[0], points[1], radii[1])


def nearest_points(m1: Array, h1: Array, m2: Array, h2: Array) -> tuple[Array, Array]:
    """The nearest points (..., 3) of two segments with middles m and halves h, (..., 3)."""
    _, s, t, _ = nearest(m1 - m2, h1, h2)
    return m1 + jnp.clip(s, -1.0, 1.0)[..., None] * h1, m2 + t[..., None] * h2


def nearest(apart: Array, one: Array, other: Array) -> tuple[Array, Array, Array, Array]:
    """Where segments with halves h1, h2 (..., 3), whose middles are m1 - m2 apart, are nearest.

    At first s of the first one is that of the nearest points of two lines, then each segment gets
    the s, of [-1, 1], that is nearest to the point of the other one.

    Returns:
        s of the line of the first segment (...), s and t of both segments, of which s may be
        beyond its ends still, and whether they are parallel, where the first s is 0.
    """
    a, b, c = (jnp.sum(p * q, axis=-1) for p, q in ((one, one), (other, other), (one, other)))
    d, e = jnp.sum(one * apart, axis=-1), jnp.sum(other * apart, axis=-1)
    area = a * b - c * c
    crossing = area > max(PARALLEL, float(jnp.finfo(area.dtype).eps)) * a * b
    of_line = jnp.where(crossing, (c * e - b * d) / jnp.where(crossing, area, 1.0), 0.0)
    t = jnp.clip((c * jnp.clip(of_line, -1.0, 1.0) + e) / b, -1.0, 1.0)
    return of_line, (c * t - d) / a, t, ~crossing


def axis_of(model: mjx.Model, data: mjx.Data, geom: Array) -> tuple[Array, Array]:
    """Where the middle of a capsule or cylinder is, and half of its axis from there, (n, 3)."""
    return data.geom_xpos[geom], data.geom_xmat[geom][..., 2] * model.geom_size[geom, 1, None]


def of_spheres(one: Array, radius: Array, other: Array, its_radius: Array) -> Contacts:
    """Contacts of two spheres, halfway between their surfaces."""
    away = other - one
    far = length(away)
    apart = (far > 0)[:, None]
    normal = jnp.where(apart, away / jnp.where(apart, far[:, None], 1.0), jnp.eye(3)[0])
    dist = far - radius - its_radius
    return dist, one + (radius + 0.5 * dist)[:, None] * normal, normal


def length(v: Array) -> Array:
    """Of vectors (n, 3), with a derivative of zero where it is zero."""
    squared = jnp.sum(v * v, axis=1)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)
