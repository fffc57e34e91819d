"""Contacts of two convex polytopes: boxes and hulls of meshes.

As in MJX, if no face separates the polytopes, the face with the least overlap is clipped with the
one that it meets, or two edges touch. MJX compares all edges of one with all of
the other and differentiates all comparisons, which takes gigabytes for a state where hulls have
a thousand corners. Here what touches is found without derivatives, and only its distances are
differentiated. Faces are looked at in blocks. Of the edges those count whose neighbouring faces
have normals near the direction of least overlap. In 168 random poses of robots' meshes that
overlap by up to 3 mm, the least overlap was within 1e-6 m of the exact one.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from mjx_drax.physics._mjx import (
    ConvexMesh,
    closest_segment_to_segment_points,
    contact_manifold,
)

AT_ONCE = 1 << 16
"""Pairs of a face and a corner that are compared at a time, for one state."""

EDGES, ROUNDS = 48, 2
"""Edges of each polytope that are compared; and how often, each time about the best direction."""

DIFFERENT, SAME = 0.95, 1e-6
"""Cosine of the angle of two normals that are clearly different, and depths that are not [m]."""

PARALLEL = 1e-3
"""Sine of the angle below which two edges count as parallel."""

APART = 1.0
"""Distance of contacts that do not act [m], as in MJX."""

Contacts = tuple[Array, Array, Array]


def contacts(
    one: ConvexMesh, other: ConvexMesh, alike: int = 1, boxes: bool = False, reach: ArrayLike = 0.0
) -> Contacts:
    """Four contacts: distances (4,), positions (4, 3), and their normal (3,) from one to other.

    Args:
        one, other: in the same frame.
        alike: so many pairs of a state are computed at once, by `jax.vmap`.
        boxes: whether both are boxes, which the C engine has functions of their own for.
        reach: how far apart boxes still touch [m]; others touch where they overlap.
    """
    one, other = jax.tree.map(jnp.asarray, (one, other))
    a, b = lax.stop_gradient((one, other))
    at_once = AT_ONCE // alike
    gaps = jnp.concatenate([_gaps(a, b.vert, at_once), _gaps(b, a.vert, at_once)])
    best = jnp.argmax(gaps)
    of_one, count = best < len(a.face), len(a.face)
    axis = jnp.where(
        of_one,
        one.face_normal[jnp.minimum(best, count - 1)],
        -other.face_normal[jnp.maximum(best - count, 0)],
    )
    direction = lax.stop_gradient(axis)
    i, j = jnp.argmax(a.face_normal @ direction), jnp.argmin(b.face_normal @ direction)
    most = max(one.face.shape[1], other.face.shape[1])
    faces = _padded(one.face[i], most), _padded(other.face[j], most)
    normals = one.face_normal[i], other.face_normal[j]
    clipping, subject = (jnp.where(of_one, *pair) for pair in (faces, faces[::-1]))
    out, facing = (jnp.where(of_one, *pair) for pair in (normals, normals[::-1]))
    # What is in front of the face that clips is not found, so that face is moved ahead
    dist, pos, _ = contact_manifold(clipping + reach * out, subject, out, facing, -axis)
    dist, pos = dist + reach, pos - reach * out

    def round_(_: int, found: tuple[Array, ...]) -> tuple[Array, ...]:
        p, q, gap = _edges(a, b, found[0])
        return jnp.where(jnp.isfinite(gap), _normal(a, b, p, q), found[0]), p, q, gap

    none = jnp.zeros((), jnp.int32)
    _, p, q, gap = lax.fori_loop(0, ROUNDS, round_, (direction, none, none, gaps[0]))
    across, least = _normal(one, other, p, q), jnp.max(lax.stop_gradient(dist))
    beside = lax.stop_gradient(across @ axis) < DIFFERENT
    nearer = gap > jnp.max(gaps) + SAME
    if not boxes:
        nearer &= beside
        nearer |= jnp.where(least < 0, gap > least - SAME, (gap < 0) & jnp.isfinite(gap))
    # As in the C engine, faces touch halfway between both, those of boxes along the normal of the
    # face with the least overlap, others along that of the second one
    normal = axis if boxes else -normals[1]
    pos = pos + jnp.where(of_one, 0.5, -0.5) * dist[:, None] * normal
    (start, end), (first, last) = one.vert[one.edge[p]], other.vert[other.edge[q]]
    points = closest_segment_to_segment_points(start, end, first, last)
    alone = jnp.full_like(dist, APART).at[0].set(across @ (first - start))
    dist = jnp.where(nearer, alone, dist)
    pos = jnp.where(nearer, 0.5 * (points[0] + points[1]), pos)
    apart = jnp.max(gaps) > (reach if boxes else 0.0)
    return jnp.where(apart, APART, dist), pos, jnp.where(nearer, across, normal)


def moved(hull: ConvexMesh, centre: Array, turn: Array) -> ConvexMesh:
    """A polytope in another frame, in which its own has this centre and these axes."""
    return hull.replace(
        vert=hull.vert @ turn.T + centre,
        face=hull.face @ turn.T + centre,
        face_normal=hull.face_normal @ turn.T,
        edge_face_normal=hull.edge_face_normal @ turn.T,
    )


def _padded(face: Array, most: int) -> Array:
    return jnp.pad(face, ((0, most - len(face)), (0, 0)), "edge")


def _gaps(a: ConvexMesh, points: Array, at_once: int) -> Array:
    """How far the lowest of points (n, 3) is above each face of a polytope, (faces,)."""

    def above(normal: Array, corner: Array) -> Array:
        return jnp.min(jnp.matmul(points, normal, precision="highest")) - normal @ corner

    block = max(1, at_once // len(points))
    planes = a.face_normal, a.face[:, 0]
    if block >= len(a.face):
        return jax.vmap(above)(*planes)
    return lax.map(lambda plane: above(*plane), planes, batch_size=block)


def _edges(a: ConvexMesh, b: ConvexMesh, direction: Array) -> tuple[Array, Array, Array]:
    """Numbers of the edges of a and of b with the largest gap, and the gap; -inf if none meet."""
    own, others = _nearest_arcs(a, direction), _nearest_arcs(b, -direction)
    one = a.edge_face_normal[own][:, None]
    other = -b.edge_face_normal[others][None]
    p, q = jnp.meshgrid(own, others, indexing="ij")
    normal = _normal(a, b, p, q)
    gap = jnp.sum(normal * (b.vert[b.edge[q, 0]] - a.vert[a.edge[p, 0]]), axis=-1)
    meet = _meet(one[..., 0, :], one[..., 1, :], other[..., 0, :], other[..., 1, :])
    gap = jnp.where(meet & (jnp.sum(normal**2, axis=-1) > 0), gap, -jnp.inf)
    best = jnp.argmax(gap)
    return p.ravel()[best], q.ravel()[best], gap.ravel()[best]


def _nearest_arcs(hull: ConvexMesh, direction: Array) -> Array:
    """Edges (n,) between whose neighbouring faces' normals a direction is, or nearly is."""
    one, other = hull.edge_face_normal[:, 0], hull.edge_face_normal[:, 1]
    along = jnp.cross(one, other)
    squared = jnp.sum(along**2, axis=1)
    height = along @ direction / jnp.sqrt(jnp.maximum(squared, 1e-16))
    inner = jnp.sum(jnp.cross(along, one) * direction, axis=1) > 0
    inner &= jnp.sum(jnp.cross(other, along) * direction, axis=1) > 0
    ends = jnp.maximum(one @ direction, other @ direction)
    cosine = jnp.where(inner, jnp.sqrt(jnp.maximum(1.0 - height**2, 0.0)), ends)
    return lax.top_k(cosine, min(EDGES, len(cosine)))[1]


def _normal(a: ConvexMesh, b: ConvexMesh, p: Array, q: Array) -> Array:
    """Unit vectors (..., 3) across edges p of a and q of b, out of a; 0 where they are parallel."""
    (start, end), (first, last) = (
        jnp.moveaxis(hull.vert[hull.edge[e]], -2, 0) for hull, e in ((a, p), (b, q))
    )
    one, other = end - start, last - first
    lengths = jnp.linalg.norm(one, axis=-1) * jnp.linalg.norm(other, axis=-1)
    across = jnp.cross(one, other) / lengths[..., None]
    outward = jnp.sum(across * a.edge_face_normal[p].sum(axis=-2), axis=-1, keepdims=True)
    return _unit(across) * jnp.sign(lax.stop_gradient(outward))


def _unit(v: Array) -> Array:
    """v (..., 3) scaled to length 1; 0 where it is short."""
    squared = jnp.sum(v**2, axis=-1, keepdims=True)
    sound = squared > PARALLEL**2
    return jnp.where(sound, v * lax.rsqrt(jnp.where(sound, squared, 1.0)), 0.0)


def _meet(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Whether arcs of great circles from a to b and from c to d (..., 3) meet."""
    ab, cd = jnp.cross(a, b), jnp.cross(c, d)
    to_c, to_d = jnp.sum(c * ab, axis=-1), jnp.sum(d * ab, axis=-1)
    to_a, to_b = jnp.sum(a * cd, axis=-1), jnp.sum(b * cd, axis=-1)
    return (to_c * to_d < 0) & (to_a * to_b < 0) & (to_c * to_b > 0)
