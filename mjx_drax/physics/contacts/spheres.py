"""Contacts of spheres and capsules with each other and with cylinders, as the C engine has them.

MJX adds 1e-6 m^2 to the squared length of a capsule, which counts if that is short, and finds
contacts of cylinders by steps of descent: steps of 2 ms were off by up to 0.7 [m/s, rad/s].
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics._mjx import mjx

PARALLEL = 1e-12
"""Squared sine of the angle below which capsules count as parallel."""

FLAT = 0.08
"""Sine of the angle below which a capsule on an end of a cylinder touches it twice, as in C."""

SAMPLES, ROUNDS = np.linspace(0.0, 1.0, 17), 3
"""Where a capsule is looked at between the ends of an interval that is made smaller in rounds."""

APART = 1.0
"""Distance of contacts that do not act [m], as in MJX."""

Contacts = tuple[Array, Array, Array]
"""Distances (n,), positions (n, 3), and normals (n, 3) from the first geom to the second."""


def sphere_capsule(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """The nearest point of the capsule's axis is the centre of a sphere."""
    sphere, capsule = geom.T
    centre, radius = data.geom_xpos[sphere], model.geom_size[sphere, 0]
    middle, half = _axis(model, data, capsule)
    along = jnp.sum((centre - middle) * half, axis=1) / jnp.sum(half * half, axis=1)
    nearest = middle + jnp.clip(along, -1.0, 1.0)[:, None] * half
    return _spheres(centre, radius, nearest, model.geom_size[capsule, 0])


def two_capsules(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """Nearest points m + s h of both axes, with -1 <= s <= 1, are centres of spheres."""
    one, other = geom.T
    (m1, h1), (m2, h2) = (_axis(model, data, g) for g in (one, other))
    points = nearest_points(m1, h1, m2, h2)
    radii = model.geom_size[one, 0], model.geom_size[other, 0]
    return _spheres(points[0], radii[0], points[1], radii[1])


def sphere_cylinder(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """A sphere touches the side, an end or its rim; inside, the nearer one of the first two."""
    sphere, cylinder = geom.T
    centre, radius = data.geom_xpos[sphere], model.geom_size[sphere, 0]
    return _on_cylinder(centre, radius, _Cylinder.of(model, data, cylinder))


def capsule_cylinder(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """Two contacts of each pair, (2 n,), (2 n, 3), (2 n, 3), of spheres on the capsule's axis.

    One is where the axis is nearest to the cylinder. On an end of it a capsule touches at both ends
    of what is above it.
    """
    capsule, other = geom.T
    cylinder = _Cylinder.of(model, data, other)
    centre, half = _axis(model, data, capsule)
    radius, long = model.geom_size[capsule, 0], model.geom_size[capsule, 1]
    first, last = cylinder.above(centre, half)
    up, _, far = cylinder.parts(centre + (0.5 * (first + last))[:, None] * half)
    flat = jnp.abs(jnp.sum(half * cylinder.axis, axis=1)) < FLAT * long
    twice = flat & (first < last) & (far < cylinder.width) & (jnp.abs(up) > cylinder.height)
    along = jnp.where(twice, first, _nearest_to_cylinder(centre, half, cylinder))
    found = [_on_cylinder(centre + t[:, None] * half, radius, cylinder) for t in (along, last)]
    dist = jnp.stack([found[0][0], jnp.where(twice, found[1][0], APART)], axis=1)
    pos, normal = (jnp.stack([one[i] for one in found], axis=1) for i in (1, 2))
    return dist.reshape(-1), pos.reshape(-1, 3), normal.reshape(-1, 3)


class _Cylinder(NamedTuple):
    """Middles (n, 3), unit axes (n, 3), radii (n,) and half heights (n,) of cylinders."""

    middle: Array
    axis: Array
    width: Array
    height: Array

    @classmethod
    def of(cls, model: mjx.Model, data: mjx.Data, geom: Array) -> _Cylinder:
        width, height = model.geom_size[geom, 0], model.geom_size[geom, 1]
        return cls(data.geom_xpos[geom], data.geom_xmat[geom][..., 2], width, height)

    def parts(self, point: Array) -> tuple[Array, Array, Array]:
        """How far points (n, 3) are along the axis (n,), and away from it, (n, 3) and (n,)."""
        up = jnp.sum((point - self.middle) * self.axis, axis=1)
        out = point - self.middle - up[:, None] * self.axis
        return up, out, length(out)

    def outside(self, point: Array) -> Array:
        """From the nearest points of the cylinders to points, (n, 3)."""
        up, out, far = self.parts(point)
        beyond = up - jnp.clip(up, -self.height, self.height)
        share = jnp.maximum(far - self.width, 0.0) / jnp.where(far > 0, far, 1.0)
        return beyond[:, None] * self.axis + share[:, None] * out

    def above(self, centre: Array, half: Array) -> tuple[Array, Array]:
        """Ends (n,) of what of -1 <= t <= 1, in centre + t half, is above or below the ends."""
        _, out, far = self.parts(centre)
        across = half - jnp.sum(half * self.axis, axis=1, keepdims=True) * self.axis
        a, b = jnp.sum(across * across, axis=1), jnp.sum(across * out, axis=1)
        square = b * b - a * (far * far - self.width**2)
        crosses = (square > 0) & (a > 0)
        root, a = jnp.sqrt(jnp.where(crosses, square, 1.0)), jnp.where(crosses, a, 1.0)
        first, last = (jnp.clip((sign * root - b) / a, -1.0, 1.0) for sign in (-1.0, 1.0))
        return first, jnp.where(crosses, last, first)


def _nearest_to_cylinder(centre: Array, half: Array, cylinder: _Cylinder) -> Array:
    """The t (n,) of -1 <= t <= 1 at which centre + t half is nearest to a cylinder.

    The squared distance is convex, so its slope changes its sign once, or is zero for a while: then
    t is in the middle. One Newton step at the end has the derivative of the minimum.
    """

    def slope(t: Array) -> Array:
        return jnp.sum(half * cylinder.outside(centre + t[:, None] * half), axis=1)

    low, high = -jnp.ones_like(half[:, 0]), jnp.ones_like(half[:, 0])
    for _ in range(ROUNDS):
        t = low + jnp.asarray(SAMPLES, low.dtype)[:, None] * (high - low)
        at = jax.vmap(slope)(jax.lax.stop_gradient(t))
        low = jnp.max(jnp.where(at < 0, t, low), axis=0)
        high = jnp.min(jnp.where(at > 0, t, high), axis=0)
    t = 0.5 * (low + high)
    for _ in range(2):
        t = jax.lax.stop_gradient(t)
        value, curve = jax.jvp(slope, (t,), (jnp.ones_like(t),))
        curve = jax.lax.stop_gradient(curve)
        bent = curve > 1e-6 * jnp.sum(half * half, axis=1)
        t = jnp.clip(t - jnp.where(bent, value / jnp.where(bent, curve, 1.0), 0.0), -1.0, 1.0)
    return t


def _on_cylinder(centre: Array, radius: Array, cylinder: _Cylinder) -> Contacts:
    """Contacts (n,) of spheres with cylinders."""
    (middle, axis, width, height), (up, out, far) = cylinder, cylinder.parts(centre)
    between, within = jnp.abs(up) < height, far < width
    nearer = height - jnp.abs(up) < width - far
    side, end = between & ~(within & nearer), within & ~(between & ~nearer)
    top = jnp.where(up > 0, 1.0, -1.0)[:, None] * axis
    rim = middle + height[:, None] * top + out * (width / jnp.where(far > 0, far, 1.0))[:, None]
    core = jnp.where(side[:, None], middle + up[:, None] * axis, rim)
    found = _spheres(centre, radius, core, jnp.where(side, width, 0.0))
    dist = jnp.abs(up) - height - radius
    flat = dist, centre - (radius + 0.5 * dist)[:, None] * top, -top
    return tuple(  # type: ignore[return-value]
        jnp.where(end if one.ndim == 1 else end[:, None], one, other)
        for one, other in zip(flat, found, strict=True)
    )


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


def _axis(model: mjx.Model, data: mjx.Data, geom: Array) -> tuple[Array, Array]:
    """Where the middle of a capsule or cylinder is, and half of its axis from there, (n, 3)."""
    return data.geom_xpos[geom], data.geom_xmat[geom][..., 2] * model.geom_size[geom, 1, None]


def _spheres(one: Array, radius: Array, other: Array, its_radius: Array) -> Contacts:
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
