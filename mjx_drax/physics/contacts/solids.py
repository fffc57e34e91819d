"""Contacts of spheres and capsules with cylinders and ellipsoids, as the C engine has them.

MJX finds them by steps of descent: steps of 2 ms were off by up to 0.7 [m/s, rad/s].
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.contacts.spheres import APART, Contacts, axis_of, length, of_spheres

FLAT = 0.08
"""Sine of the angle below which a capsule on an end of a cylinder touches it twice, as in C."""

SAMPLES, ROUNDS = np.linspace(0.0, 1.0, 17), 3
"""Where a capsule is looked at between the ends of an interval that is made smaller in rounds."""

STEPS, DEEP = 6, 0.01
"""Newton steps to the nearest point of an ellipsoid, and the part of its least half axis, squared,
that is kept of it for points in the middle, which have many nearest points."""


def sphere_cylinder(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """A sphere touches the side, an end or its rim; inside, the nearer one of the first two."""
    sphere, cylinder = geom.T
    centre, radius = data.geom_xpos[sphere], model.geom_size[sphere, 0]
    return _on_cylinder(centre, radius, Cylinder.of(model, data, cylinder))


def capsule_cylinder(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """Two contacts of each pair, (2 n,), (2 n, 3), (2 n, 3), of spheres on the capsule's axis.

    One is where the axis is nearest to the cylinder. On an end of it a capsule touches at both ends
    of what is above it.
    """
    capsule, other = geom.T
    cylinder = Cylinder.of(model, data, other)
    centre, half = axis_of(model, data, capsule)
    radius, long = model.geom_size[capsule, 0], model.geom_size[capsule, 1]
    first, last = cylinder.above(centre, half)
    up, _, far = cylinder.parts(centre + (0.5 * (first + last))[:, None] * half)
    flat = jnp.abs(jnp.sum(half * cylinder.axis, axis=1)) < FLAT * long
    twice = flat & (first < last) & (far < cylinder.width) & (jnp.abs(up) > cylinder.height)
    along = jnp.where(twice, first, nearest_along(centre, half, cylinder))
    found = [_on_cylinder(centre + t[:, None] * half, radius, cylinder) for t in (along, last)]
    dist = jnp.stack([found[0][0], jnp.where(twice, found[1][0], APART)], axis=1)
    pos, normal = (jnp.stack([one[i] for one in found], axis=1) for i in (1, 2))
    return dist.reshape(-1), pos.reshape(-1, 3), normal.reshape(-1, 3)


def sphere_ellipsoid(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """The point of the ellipsoid's surface that is nearest to the centre."""
    sphere, other = geom.T
    ellipsoid = Ellipsoid.of(model, data, other)
    return _on_ellipsoid(data.geom_xpos[sphere], model.geom_size[sphere, 0], ellipsoid)


def capsule_ellipsoid(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """The same with the sphere on the capsule's axis that is nearest to the ellipsoid."""
    capsule, other = geom.T
    ellipsoid = Ellipsoid.of(model, data, other)
    centre, half = axis_of(model, data, capsule)
    nearest = centre + nearest_along(centre, half, ellipsoid)[:, None] * half
    return _on_ellipsoid(nearest, model.geom_size[capsule, 0], ellipsoid)


class Cylinder(NamedTuple):
    """Middles (n, 3), unit axes (n, 3), radii (n,) and half heights (n,) of cylinders."""

    middle: Array
    axis: Array
    width: Array
    height: Array

    @classmethod
    def of(cls, model: mjx.Model, data: mjx.Data, geom: Array) -> Cylinder:
        """Of geoms (n,)."""
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


class Ellipsoid(NamedTuple):
    """Middles (n, 3), turns (n, 3, 3) and half axes (n, 3) of ellipsoids."""

    middle: Array
    turn: Array
    size: Array

    @classmethod
    def of(cls, model: mjx.Model, data: mjx.Data, geom: Array) -> Ellipsoid:
        """Of geoms (n,)."""
        return cls(data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom])

    def nearest(self, point: Array) -> tuple[Array, Array]:
        """Points of the surfaces nearest to points (n, 3), and unit normals there, (n, 3).

        In the ellipsoid's frame the nearest point to p is q = s^2 p / (s^2 + a), with half axes s
        and the largest a for which sum (q / s)^2 = 1. Newton's method finds it, for the inverse of
        the root of that sum, from an a that is too small. The last step has the derivative.
        """
        p = jnp.einsum("nij,ni->nj", self.turn, point - self.middle)
        square, scaled = self.size**2, self.size * p
        least = (DEEP - 1.0) * jnp.min(square, axis=1)

        def step(a: Array, scaled: Array) -> Array:
            share = scaled / (square + a[:, None])
            total = jnp.sum(share**2, axis=1)
            slope = jnp.sum(share**2 / (square + a[:, None]), axis=1)
            further = (total**1.5 - total) / jnp.where(slope > 0, slope, 1.0)
            return jnp.maximum(a + jnp.where(slope > 0, further, 0.0), least)

        fixed = jax.lax.stop_gradient(scaled)
        a = jnp.maximum(jnp.max(jnp.abs(fixed) - square, axis=1), least)
        for _ in range(STEPS):
            a = step(a, fixed)
        a = step(jax.lax.stop_gradient(a), scaled)
        q = square * p / (square + a[:, None])
        normal = q / square
        far = length(normal)[:, None]
        normal = normal / jnp.where(far > 0, far, 1.0)
        at = self.middle + jnp.einsum("nij,nj->ni", self.turn, q)
        return at, jnp.einsum("nij,nj->ni", self.turn, normal)

    def outside(self, point: Array) -> Array:
        """From the nearest points of the ellipsoids to points, (n, 3)."""
        nearest, normal = self.nearest(point)
        away = jnp.sum((point - nearest) * normal, axis=1)
        return jnp.maximum(away, 0.0)[:, None] * normal


def nearest_along(centre: Array, half: Array, solid: Cylinder | Ellipsoid) -> Array:
    """The t (n,) of -1 <= t <= 1 at which centre + t half is nearest to a solid.

    The squared distance is convex, so its slope changes its sign once, or is zero for a while: then
    t is in the middle. One Newton step at the end has the derivative of the minimum.
    """

    def slope(t: Array) -> Array:
        return jnp.sum(half * solid.outside(centre + t[:, None] * half), axis=1)

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


def _on_cylinder(centre: Array, radius: Array, cylinder: Cylinder) -> Contacts:
    """Contacts (n,) of spheres with cylinders."""
    (middle, axis, width, height), (up, out, far) = cylinder, cylinder.parts(centre)
    between, within = jnp.abs(up) < height, far < width
    nearer = height - jnp.abs(up) < width - far
    side, end = between & ~(within & nearer), within & ~(between & ~nearer)
    top = jnp.where(up > 0, 1.0, -1.0)[:, None] * axis
    rim = middle + height[:, None] * top + out * (width / jnp.where(far > 0, far, 1.0))[:, None]
    core = jnp.where(side[:, None], middle + up[:, None] * axis, rim)
    found = of_spheres(centre, radius, core, jnp.where(side, width, 0.0))
    dist = jnp.abs(up) - height - radius
    flat = dist, centre - (radius + 0.5 * dist)[:, None] * top, -top
    return tuple(  # type: ignore[return-value]
        jnp.where(end if one.ndim == 1 else end[:, None], one, other)
        for one, other in zip(flat, found, strict=True)
    )


def _on_ellipsoid(centre: Array, radius: Array, ellipsoid: Ellipsoid) -> Contacts:
    """Contacts (n,) of spheres with ellipsoids."""
    nearest, normal = ellipsoid.nearest(centre)
    dist = jnp.sum((centre - nearest) * normal, axis=1) - radius
    return dist, nearest + (0.5 * dist)[:, None] * normal, -normal
