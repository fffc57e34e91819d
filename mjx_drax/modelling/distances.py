"""Signed distances between two geoms, as JAX functions of their poses.

    distance > 0: they are that far apart;   distance < 0: they overlap by |distance|   [m]

Spheres and capsules are points and segments with a radius. Boxes, segments and their Minkowski sums
are zonotopes, sum_j t_j g_j with |t_j| <= 1, whose faces are spanned by pairs of their generators
g_j. First derivatives exist in forward and reverse mode and are finite everywhere. Where two pairs
of points are equally near (parallel edges) they are those of one pair, or a mean. The positions of
the nearest points are not differentiated: by the envelope theorem that changes nothing.

Which values are exact:

    sphere   with plane, sphere, capsule, cylinder, box    exact
    capsule  with plane, capsule, box                      exact
    plane    with cylinder, box                            exact
    capsule  with cylinder    exact while the axis is outside, else an understated depth
    box      with box         exact where they overlap; apart, a lower bound of at least 1/sqrt(3)
                              of the distance
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels.linalg import product
from mjx_drax.physics.engine import mujoco


class Shape(NamedTuple):
    """A geom: centre (3,) [m], axes as the columns of frame (3, 3), and MuJoCo's size (3,) [m].

    In place of its size a mesh has its `hulls.Hull`.
    """

    centre: Array
    frame: Array
    size: Any

    def seen_from(self, other: Shape) -> tuple[Array, Array]:
        """Centre (3,) and frame (3, 3) in the frame of another shape."""
        # As sums: XLA fails to compile Hessians of products `@` of several pairs (jaxlib 0.10.2)
        back = other.frame.T
        return product(back, self.centre - other.centre), product(back, self.frame)


def norm(vectors: Array) -> Array:
    """Lengths (...,) of vectors (..., n); the derivative at zero is zero."""
    square = jnp.sum(jnp.square(vectors), axis=-1)
    zero = square == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def _ratio(a: Array, b: Array) -> Array:
    """a / b, and 0 where b is not positive."""
    positive = b > 0
    return jnp.where(positive, a / jnp.where(positive, b, 1.0), 0.0)


def _from_plane(reach: Callable[[Array, Array], Array]) -> Callable[[Shape, Shape], Array]:
    """Distance to a half-space; reach(n, size) is a shape's half-width along n in its own frame."""

    def distance(plane: Shape, shape: Shape) -> Array:
        normal = plane.frame[:, 2]
        height = normal @ (shape.centre - plane.centre)
        return height - reach(normal @ shape.frame, shape.size)

    return distance


def _capsule_capsule(one: Shape, other: Shape) -> Array:
    """The nearest points of two segments are inside of both, or one of them is an end point."""
    between = one.centre - other.centre
    a, b = one.size[1] * one.frame[:, 2], other.size[1] * other.frame[:, 2]

    s, t = lax.stop_gradient(nearest_of_segments(between, a, b))
    apart = norm(between + s[:, None] * a - t[:, None] * b)
    return apart.min() - one.size[0] - other.size[0]


def nearest_of_segments(w: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Candidates s, t (5,) for the least |w + s a - t b| with |s|, |t| <= 1."""
    aa, bb, ab, wa, wb = a @ a, b @ b, a @ b, w @ a, w @ b
    inside = _ratio(ab * wb - wa * bb, aa * bb - ab**2)
    s = jnp.clip(jnp.array([inside, -1.0, 1.0]), -1.0, 1.0)
    t = jnp.array([-1.0, 1.0])
    s_of_t, t_of_s = (
        jnp.clip(_ratio(ab * at + shift, square), -1.0, 1.0)
        for at, shift, square in ((t, -wa, aa), (s, wb, bb))
    )
    return jnp.concatenate([s, s_of_t]), jnp.concatenate([t_of_s, t])


def _to_prism(excess: Array) -> Array:
    """Distance of a point by its excess (n,) over the half-widths of a product of intervals."""
    return norm(jnp.maximum(excess, 0.0)) + jnp.minimum(excess.max(), 0.0)


def _to_cylinder(point: Array, size: Array) -> Array:
    """Distance of a point (3,), in the cylinder's frame; convex in the point."""
    return _to_prism(jnp.array([norm(point[:2]) - size[0], jnp.abs(point[2]) - size[1]]))


def _sphere_cylinder(sphere: Shape, cylinder: Shape) -> Array:
    centre, _ = sphere.seen_from(cylinder)
    return _to_cylinder(centre, cylinder.size) - sphere.size[0]


def _capsule_cylinder(capsule: Shape, cylinder: Shape) -> Array:
    """The least distance along the capsule's axis, found by bisection of its slope."""
    centre, frame = capsule.seen_from(cylinder)
    half = capsule.size[1] * frame[:, 2]

    def least(centre: Array, half: Array, size: Array) -> Array:
        def bisect(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            middle = (low + high) / 2
            at = (centre + middle * half,)
            _, slope = jax.jvp(lambda point: _to_cylinder(point, size), at, (half,))
            return jnp.where(slope > 0, low, middle), jnp.where(slope > 0, middle, high)

        low, high = lax.fori_loop(0, 24, bisect, (-jnp.ones(()), jnp.ones(())))
        return (low + high) / 2

    t = least(*lax.stop_gradient((centre, half, cylinder.size)))
    return _to_cylinder(centre + t * half, cylinder.size) - capsule.size[0]


def _capsule_box(capsule: Shape, box: Shape) -> Array:
    """Outside, the nearest point of the axis; inside, the nearest face of box minus segment."""
    centre, frame = capsule.seen_from(box)
    half = capsule.size[1] * frame[:, 2]

    def excess(point: Array, size: Array) -> Array:
        """Vector to a point from the nearest point of the box, both (..., 3)."""
        return point - jnp.clip(point, -size, size)

    def least(centre: Array, half: Array, size: Array) -> Array:
        """Where on the axis the slope of distance^2 / 2, which rises piecewise linearly, is 0."""
        turns = (jnp.array([[-1.0], [1.0]]) * size - centre) / jnp.where(half == 0, jnp.inf, half)
        t = jnp.concatenate([jnp.array([-1.0, 1.0]), jnp.clip(turns.ravel(), -1.0, 1.0)])
        slope = excess(centre + t[:, None] * half, size) @ half
        low = jnp.where(slope <= 0, t, -1.0).max()
        high = jnp.where(slope >= 0, t, 1.0).min()
        down, up = excess(centre + jnp.stack([low, high])[:, None] * half, size) @ half
        flat = up <= down
        return low + (high - low) * jnp.where(flat, 0.5, -down / jnp.where(flat, 1.0, up - down))

    t = least(*lax.stop_gradient((centre, half, box.size)))
    apart = norm(excess(centre + t * half, box.size))
    gap = _zonotope(centre, jnp.concatenate([jnp.diag(box.size), half[None]]))
    return jnp.where(gap > 0, apart, gap) - capsule.size[0]


def _box_box(one: Shape, other: Shape) -> Array:
    centre, frame = other.seen_from(one)
    return _zonotope(centre, jnp.concatenate([jnp.diag(one.size), (frame * other.size).T]))


def _zonotope(point: Array, generators: Array) -> Array:
    """Largest distance of a point (3,) from the planes of the faces of a zonotope.

    Its generators are rows (m, 3). This is the signed distance inside, and a lower bound outside.
    """
    i, j = np.triu_indices(len(generators), 1)
    normals = jnp.cross(generators[i], generators[j])
    lengths, longest = norm(normals), norm(generators[i]) * norm(generators[j])
    face = lengths > 1e-5 * longest  # of parallel generators there is none
    unit = normals / jnp.where(face, lengths, 1.0)[:, None]
    gaps = jnp.abs(unit @ point) - jnp.abs(unit @ generators.T).sum(axis=-1)
    return jnp.where(face, gaps, -jnp.inf).max()


PLANE, SPHERE, CAPSULE, CYLINDER, BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "SPHERE", "CAPSULE", "CYLINDER", "BOX")
)
_capsule_plane = _from_plane(lambda n, size: size[0] + size[1] * jnp.abs(n[2]))

DISTANCES: dict[tuple[int, int], Callable[[Shape, Shape], Array]] = {
    (PLANE, SPHERE): _capsule_plane,
    (PLANE, CAPSULE): _capsule_plane,
    (PLANE, CYLINDER): _from_plane(lambda n, s: s[0] * norm(n[:2]) + s[1] * jnp.abs(n[2])),
    (PLANE, BOX): _from_plane(lambda n, size: jnp.abs(n) @ size),
    (SPHERE, SPHERE): _capsule_capsule,
    (SPHERE, CAPSULE): _capsule_capsule,
    (SPHERE, CYLINDER): _sphere_cylinder,
    (SPHERE, BOX): _capsule_box,
    (CAPSULE, CAPSULE): _capsule_capsule,
    (CAPSULE, CYLINDER): _capsule_cylinder,
    (CAPSULE, BOX): _capsule_box,
    (BOX, BOX): _box_box,
}
"""Distance functions by the kinds of two geoms, in MuJoCo's order; spheres are capsules of size
(radius, 0, 0)."""
