"""Contacts of cylinders and ellipsoids with convex polytopes (boxes, hulls of meshes).

Along a unit vector d from the polytope B to the curved shape A the gap between them is

    g(d) = min_{a in A} d . a - max_{b in B} d . b

and their signed distance is the largest g. It is sought among the directions in which it is
attained where they touch:

    normals of faces of B                    both
    the axis of the cylinder                 an end of it touches corners of B
    edges of B times the axis                its side touches an edge
    from B to a smaller cylinder inside A    its rim, or a corner of B, touches elsewhere
    normals of A at the point of B that      an ellipsoid touches an edge or a corner
    is nearest, scaled to a sphere

All is in the frame of B. Normals point from A to B, as in MuJoCo.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics._mjx import ConvexMesh, four_of
from mjx_drax.physics.contacts.polytopes import inner_part
from mjx_drax.physics.contacts.spheres import APART, Contacts
from mjx_drax.physics.engine import mujoco

_ANGLES = np.pi / 8 * np.arange(1, 16, 2)
CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Where the C engine puts contacts on the rim of a cylinder that stands, (8, 2)."""

STANDS, LIES = 0.9954, 0.9999
"""|cos| of the angle between axis and normal. Above the first (5.5 degrees) a cylinder stands on
the rim of its end; below the second it touches at the lowest line of its side too, as in C."""

CORE, STEPS = 0.2, 12
"""How much smaller the core of a cylinder is than its smaller size; steps towards it."""

TIE = 1e-7
"""A rim or a corner touches elsewhere only if that gap is larger by this [m]; else by a face."""

SEGMENTS = np.array(list(itertools.combinations(range(4), 2)))
TRIANGLES = np.array(list(itertools.combinations(range(4), 3)))
"""Corners of the edges and faces of a simplex."""


def cylinder(centre: Array, turn: Array, size: Array, hull: ConvexMesh) -> Contacts:
    """Four contacts: distances (4,), positions (4, 3) and their normal (3,).

    Args:
        centre, turn: of the cylinder, (3,) and (3, 3).
        size: radius and half of its height, (3,).
        hull: the polytope.
    """
    radius, half, axis = size[0], size[1], turn[:, 2]

    def lowest(d: Array) -> Array:
        """min d . a over the cylinder, of directions (..., 3)."""
        along = d @ axis
        across = _root(1.0 - along**2)
        return d @ centre - half * jnp.abs(along) - radius * across

    normals, offsets = hull.face_normal, _offsets(hull)
    start, end = hull.vert[hull.edge[:, 0]], hull.vert[hull.edge[:, 1]]
    crossed = _unit(jnp.cross(end - start, axis))
    outside = jnp.sum(crossed * hull.edge_face_normal.sum(axis=1), axis=1, keepdims=True)
    crossed = crossed * jnp.sign(outside)
    few = jnp.stack([axis, -axis, _from_core(centre, turn, size, hull)])
    directions = jnp.concatenate([normals, crossed, few])
    highest = jnp.concatenate(
        [offsets, jnp.sum(crossed * start, axis=1), jnp.max(few @ hull.vert.T, axis=1)]
    )
    edges = _between(crossed, hull.edge_face_normal)
    allowed = jnp.concatenate([jnp.ones(len(normals), bool), edges, jnp.ones(3, bool)])
    gaps = jnp.where(allowed, lowest(directions) - highest, -jnp.inf)
    best = jnp.argmax(gaps.at[-1].add(-TIE))
    d, gap, top = directions[best], gaps[best], highest[best]

    # Points of the cylinder inside of the polytope: on the rim of the lower end, or of its side
    along = d @ axis
    below = centre - half * jnp.where(along < 0, -1.0, 1.0) * axis
    rim = below + radius * (jnp.asarray(CIRCLE, turn.dtype) @ turn[:, :2].T)
    side = centre - radius * _unit(_across(d, axis))
    line = _clipped(side - half * axis, side + half * axis, normals, offsets)
    own = jnp.concatenate([rim, line])
    inside = jnp.all(own @ normals.T <= offsets + 1e-9, axis=1)
    stands = jnp.abs(along) > STANDS
    used = jnp.where(jnp.arange(len(own)) < len(rim), stands, jnp.abs(along) < LIES)
    # Corners of the polytope inside of the cylinder
    far = hull.vert - centre
    across = jnp.sum(_across(far, axis) ** 2, axis=1) <= radius**2
    corners = across & (jnp.abs(far @ axis) <= half)
    # Where an edge crosses the side; or, without any other, the lowest or the highest point
    crosses = (best >= len(normals)) & (best < len(normals) + len(start))
    one = crosses | (best == len(directions) - 1)
    e = jnp.clip(best - len(normals), 0, len(start) - 1)
    lowest_point = below - radius * _unit(_across(d, axis))
    of_rim = (jnp.abs(along) > 1.0 - LIES**2) & (jnp.abs(along) < LIES)
    meeting = jnp.where(
        (best < len(normals)) | of_rim,
        lowest_point - gap * d,
        hull.vert[jnp.argmax(hull.vert @ d)],
    )
    crossing = _nearest_to_line(start[e], end[e], centre, axis)
    meeting = jnp.where(crosses, crossing, meeting)
    points = jnp.concatenate([own, hull.vert, meeting[None]])
    depth = jnp.concatenate([own @ d - top, jnp.broadcast_to(lowest(d), len(far) + 1)])
    depth = depth.at[len(own) :].add(-(points[len(own) :] @ d))
    acts = jnp.concatenate([inside & used, corners, jnp.zeros(1, bool)]) & (depth < 0) & ~one
    acts = acts.at[-1].set(~jnp.any(acts))
    depth = depth.at[-1].set(gap)
    chosen = four_of(points, acts, d)
    repeated = jnp.any(jnp.tril(chosen == chosen[:, None], -1), axis=1)
    dist = jnp.where(acts[chosen] & ~repeated, depth[chosen], APART)
    # Halfway between both surfaces
    of_own = jnp.where(chosen < len(own), -0.5, 0.5)
    return dist, points[chosen] + (of_own * dist)[:, None] * d, -d


def ellipsoid(centre: Array, turn: Array, size: Array, hull: ConvexMesh) -> Contacts:
    """One contact: its distance (1,), position (1, 3) and normal (3,).

    Args:
        centre, turn: of the ellipsoid, (3,) and (3, 3).
        size: half of its axes, (3,).
        hull: the polytope.
    """
    normals, offsets = hull.face_normal, _offsets(hull)

    def scaled(p: Array) -> Array:
        """Points (..., 3), where the ellipsoid is a sphere of radius 1 about 0."""
        return ((p - centre) @ turn) / size

    start, end = scaled(hull.vert[hull.edge[:, 0]]), scaled(hull.vert[hull.edge[:, 1]])
    nearest = _nearest_to_points(start, end)
    point = nearest[jnp.argmin(jnp.sum(nearest**2, axis=1))]
    direction = _unit(turn @ (-_unit(point) / size))
    directions = jnp.concatenate([normals, direction[None]])
    highest = jnp.append(offsets, jnp.max(hull.vert @ direction))
    reach = jnp.linalg.norm((directions @ turn) * size, axis=1)
    gaps = directions @ centre - reach - highest
    best = jnp.argmax(gaps)
    d, gap = directions[best], gaps[best]
    deepest = centre - turn @ (size**2 * (turn.T @ d)) / reach[best]
    return gap[None], (deepest - 0.5 * gap * d)[None], -d


CONTACTS = {
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): cylinder,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ellipsoid,
}


def _offsets(hull: ConvexMesh) -> Array:
    return jnp.sum(hull.face_normal * hull.face[:, 0], axis=1)


def _root(x: Array) -> Array:
    """The square root, with derivative 0 where x <= 0."""
    positive = x > 1e-12
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _unit(v: Array) -> Array:
    """v (..., 3) scaled to length 1; 0 where it is 0."""
    squared = jnp.sum(v**2, axis=-1, keepdims=True)
    sound = squared > 1e-16
    return jnp.where(sound, v / jnp.sqrt(jnp.where(sound, squared, 1.0)), 0.0)


def _across(v: Array, axis: Array) -> Array:
    """The part of v (..., 3) that is perpendicular to a unit vector."""
    return v - (v @ axis)[..., None] * axis


def _from_core(centre: Array, turn: Array, size: Array, hull: ConvexMesh) -> Array:
    """The direction (3,) from the polytope to a smaller cylinder inside of the cylinder.

    The difference of two convex bodies that are apart does not hold 0. Its nearest point to 0 is
    found by going on from a simplex of its points towards 0 (the algorithm of Gilbert, Johnson and
    Keerthi). The direction is not differentiated: where the gap is largest, it does not change it.
    """
    centre, turn, size, vert = jax.lax.stop_gradient((centre, turn, size, hull.vert))
    radius, half = size[:2] - CORE * jnp.min(size[:2])

    def farthest(d: Array) -> Array:
        """The point (3,) of the difference that is farthest in a direction."""
        local = d @ turn
        end = jnp.append(radius * _unit(local[:2]), half * jnp.sign(local[2]))
        return centre + turn @ end - vert[jnp.argmin(vert @ d)]

    def closer(_: int, simplex: Array) -> Array:
        """Three points that span the nearest one, and one beyond it."""
        nearest, kept = _nearest_of(simplex)
        return jnp.concatenate([kept, farthest(-nearest)[None]])

    first = jnp.tile(farthest(-centre), (4, 1))
    return _unit(_nearest_of(jax.lax.fori_loop(0, STEPS, closer, first))[0])


def _nearest_of(simplex: Array) -> tuple[Array, Array]:
    """The point (3,) on the faces of a simplex (4, 3) that is nearest to 0, and those around it."""
    start, end = simplex[SEGMENTS[:, 0]], simplex[SEGMENTS[:, 1]]
    a, b, c = (simplex[TRIANGLES[:, i]] for i in range(3))
    normal = jnp.cross(b - a, c - a)
    squared = jnp.sum(normal**2, axis=1)
    flat = squared < 1e-20
    height = jnp.sum(normal * a, axis=1) / jnp.where(flat, 1.0, squared)
    onto = height[:, None] * normal
    sides = [
        jnp.sum(jnp.cross(q - p, onto - p) * normal, axis=1) for p, q in ((a, b), (b, c), (c, a))
    ]
    inside = ~flat & (jnp.min(jnp.stack(sides), axis=0) >= 0)
    points = jnp.concatenate([_nearest_to_points(start, end), onto])
    distance = jnp.sum(points**2, axis=1)
    distance = distance.at[len(start) :].set(jnp.where(inside, distance[len(start) :], jnp.inf))
    best = jnp.argmin(distance)
    around = np.concatenate([SEGMENTS[:, [0, 1, 1]], TRIANGLES])
    return points[best], simplex[jnp.asarray(around)[best]]


def _between(d: Array, sides: Array) -> Array:
    """Whether d (E, 3), perpendicular to an edge, is between the normals beside it, (E, 2, 3)."""
    one, other = sides[:, 0], sides[:, 1]
    inner = jnp.sum(one * other, axis=1)
    least = inner + 1e-5  # else a tie with a face, and rounding would decide
    return (jnp.sum(d * one, axis=1) > least) & (jnp.sum(d * other, axis=1) > least)


def _clipped(start: Array, end: Array, normals: Array, offsets: Array) -> Array:
    """The ends (2, 3) of the part of a segment that lies in a polytope."""
    shares, _ = inner_part(offsets - normals @ start, normals @ (end - start))
    inward = jnp.array([1e-6, -1e-6])  # not on a face, where rounding would decide
    return start + (shares + inward)[:, None] * (end - start)


def _nearest_to_line(start: Array, end: Array, point: Array, axis: Array) -> Array:
    """The point (3,) of a segment that is nearest to a line."""
    rise, from_line = _across(end - start, axis), _across(start - point, axis)
    squared = jnp.maximum(rise @ rise, 1e-16)
    return start + jnp.clip(-(from_line @ rise) / squared, 0.0, 1.0) * (end - start)


def _nearest_to_points(start: Array, end: Array) -> Array:
    """The points (E, 3) of segments that are nearest to 0."""
    rise = end - start
    squared = jnp.maximum(jnp.sum(rise**2, axis=1), 1e-16)
    share = jnp.clip(-jnp.sum(start * rise, axis=1) / squared, 0.0, 1.0)
    return start + share[:, None] * rise
