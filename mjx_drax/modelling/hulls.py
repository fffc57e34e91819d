"""Signed distances from the convex hulls of meshes, as JAX functions of poses [m].

A hull is the intersection of half-spaces n_i . p <= o_i. Inside, the distance of a point is

    max_i (n_i . p - o_i)

outside it is the same over the face that p projects into, else the distance from an edge. Which
values are exact:

    plane, sphere, capsule, mesh    exact
    box                             exact where they overlap; apart, a lower bound of at least
                                    1/sqrt(3) of the distance
    cylinder, ellipsoid             lower bounds: a hull of points on them stands in, less by e,
                                    2 % of a cylinder's radius, 6 % of an ellipsoid's largest one

The hull is the one that the C engine has. If it has more than VERTICES vertices, it is replaced by
the hull of some of them, and distances are less by the largest distance e of the others from it:
lower bounds, at most e too small. For round meshes e is about 5 % of their size.

First and second derivatives are finite everywhere; the nearest point of a capsule's axis is not
differentiated, as in `distances`. A capsule takes about a hundred times as long with a mesh as with
a box, and two meshes look at all pairs of their edges: use primitive shapes where they fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.base.errors import DraxError, reason
from mjx_drax.modelling.distances import (
    BOX,
    CAPSULE,
    CYLINDER,
    PLANE,
    SPHERE,
    Shape,
    nearest_of_segments,
    norm,
)
from mjx_drax.physics.engine import mujoco

MESH, ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
VERTICES = 64
"""Vertices of a hull, at most; it has about twice as many triangles."""

CORNERS = 16
"""Vertices on each rim of the hull that stands in for a cylinder."""

AT_ONCE = 16
"""Vertices or edges of one hull that are compared with another hull at a time."""


class Hull(NamedTuple):
    """A convex polytope of triangles, in the frame of its geom [m].

    Attributes:
        vertices: (n, 3).
        normals: outward unit vectors of the triangles, (m, 3).
        offsets: of their planes, n . p = o, (m,).
        sides: outward vectors of the sides of the triangles, in their planes, (m, 3, 3).
        side_offsets: a point p projects into a triangle if sides . p <= side_offsets, (m, 3).
        starts: of the edges, (l, 3).
        edges: vectors along them, (l, 3).
        arcs: an edge is what lies farthest along a direction n at a right angle to it if both
            arcs . n > 0, (l, 2, 3); they are 0 for edges inside of a face.
        excess: how far the mesh's hull sticks out of this one, at most.
    """

    vertices: Array
    normals: Array
    offsets: Array
    sides: Array
    side_offsets: Array
    starts: Array
    edges: Array
    arcs: Array
    excess: Array


def hull_of(model: mujoco.MjModel, mesh: int) -> Hull:
    """The hull of a mesh of a model, by its number.

    Raises:
        DraxError: the mesh has no volume.
    """
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = np.asarray(model.mesh_vert[start : start + count], float)
    if model.mesh_graphadr[mesh] >= 0:  # those of the hull that the C engine has
        used, _ = _of_graph(model.mesh_graph[model.mesh_graphadr[mesh] :])
        points = points[used]
    hull = _hull(points, model.mesh(mesh).name)
    apart = jax.jit(lambda hull, points: lax.map(partial(_to_hull, hull), points, batch_size=256))
    return hull._replace(excess=jnp.maximum(apart(hull, jnp.asarray(points)).max(), 0.0))


def stand_in(kind: int, size: np.ndarray) -> Hull:
    """The hull of points on a cylinder or on an ellipsoid of MuJoCo's size (3,)."""
    if kind == CYLINDER:
        angle = 2 * np.pi * (np.arange(CORNERS) + 0.5) / CORNERS
        rim = size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        ends = [np.insert(rim, 2, side * size[1], axis=1) for side in (-1, 1)]
        excess = size[0] * (1 - np.cos(np.pi / CORNERS))
        return _hull(np.concatenate(ends), "cylinder")._replace(excess=jnp.asarray(excess))
    k = np.arange(VERTICES)  # evenly spread over the unit sphere
    z, angle = 1 - (2 * k + 1) / VERTICES, np.pi * (1 + np.sqrt(5)) * k
    points = np.stack([np.cos(angle), np.sin(angle), z], axis=-1)
    points[:, :2] *= np.sqrt(1 - z**2)[:, None]
    missing = 1 - _hull(points, "ellipsoid").offsets.min()
    return _hull(points * size, "ellipsoid")._replace(excess=missing * size.max())


def _hull(points: np.ndarray, name: str) -> Hull:
    """The hull of points (n, 3), of which some may be left out."""
    vertices, faces = _triangles(points, name)
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(sides[:, 0], sides[:, 1])
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    wide = areas[:, 0] > 1e-10 * np.square(np.ptp(vertices, axis=0).max())  # others have no normal
    normals = np.where(wide[:, None], normals / np.maximum(areas, 1e-30), 0.0)
    outward = np.cross(sides, normals[:, None])
    offsets = (normals @ vertices.T).max(axis=1)
    planes = normals, offsets, outward, np.sum(outward * corners, axis=2)
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    ends, edge = np.unique(pairs, axis=0, return_inverse=True)
    starts, edges = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]
    one, other = np.moveaxis(normals[(np.argsort(edge.ravel()) // 3).reshape(-1, 2)], 1, 0)
    bend = np.cross(one, other)
    turn = np.sign(np.sum(bend * edges, axis=1, keepdims=True))
    turn *= np.linalg.norm(bend, axis=1, keepdims=True) > 1e-5
    arcs = turn[..., None] * np.stack([np.cross(edges, one), np.cross(other, edges)], axis=1)
    parts = vertices, *(part[wide] for part in planes), starts, edges, arcs, 0.0
    return Hull(*map(jnp.asarray, parts))


def hulls_of(model: mujoco.MjModel, geoms: Sequence[int]) -> Hull:
    """The hulls of geoms of one kind, or their stand-ins: arrays with one more axis in front.

    The last rows of smaller hulls are repeated.

    Raises:
        DraxError: a mesh has no volume.
    """
    kinds = [int(model.geom_type[geom]) for geom in geoms]
    of = [int(model.geom_dataid[g]) if k == MESH else g for g, k in zip(geoms, kinds, strict=True)]
    found = {
        each: hull_of(model, each) if kind == MESH else stand_in(kind, model.geom_size[each])
        for each, kind in dict(zip(of, kinds, strict=True)).items()
    }

    def stack(*parts: Array) -> Array:
        if parts[0].ndim:
            rows = np.arange(max(map(len, parts)))
            parts = tuple(part[np.minimum(rows, len(part) - 1)] for part in parts)
        return jnp.stack(parts)

    return jax.tree.map(stack, *(found[each] for each in of))


def _triangles(points: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of a hull, as MuJoCo makes them of points."""
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="hull", uservert=points.ravel(), maxhullvert=VERTICES)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
    try:
        model = spec.compile()
    except ValueError as error:
        raise DraxError(
            f"mesh {name!r} has no convex hull ({reason(error)}): use a box or a capsule."
        ) from error
    used, faces = _of_graph(model.mesh_graph)
    frame, place = np.zeros(9), np.zeros(len(model.mesh_vert), int)
    mujoco.mju_quat2Mat(frame, model.mesh_quat[0])
    place[used] = np.arange(len(used))
    moved = model.mesh_vert @ frame.reshape(3, 3).T + model.mesh_pos[0]
    return moved[used], place[faces]


def _of_graph(graph: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A hull's vertices (n,) and triangles (m, 3), by their numbers in the mesh, from MuJoCo's."""
    n, m = graph[:2]
    faces = graph[2 + 3 * (n + m) : 2 + 3 * (n + 2 * m)]
    return graph[2 + n : 2 + 2 * n], faces.reshape(m, 3)


def _to_hull(hull: Hull, point: Array) -> Array:
    """Signed distance of a point (3,) in the frame of the hull; convex in the point."""

    def nearest_edge(hull: Hull, point: Array) -> Array:
        seen = point - hull.starts
        t = jnp.sum(seen * hull.edges, axis=1) / jnp.sum(jnp.square(hull.edges), axis=1)
        apart = seen - jnp.clip(t, 0.0, 1.0)[:, None] * hull.edges
        return jnp.argmin(jnp.sum(jnp.square(apart), axis=1))

    heights = hull.normals @ point - hull.offsets
    top = jnp.argmax(lax.stop_gradient(heights))  # of equal ones one: a mean may lead nowhere
    highest = heights[top]
    beside = (hull.sides @ point <= hull.side_offsets).all(axis=1) & (heights > 0)
    i = nearest_edge(*lax.stop_gradient((hull, point)))
    seen, edge = point - hull.starts[i], hull.edges[i]
    apart = norm(seen - jnp.clip(seen @ edge / (edge @ edge), 0.0, 1.0) * edge)
    rounding = 8 * jnp.finfo(point.dtype).eps * jnp.abs(hull.vertices).max()
    by_face = beside.any() | (highest <= rounding)  # on the surface an edge gives no direction
    return jnp.where(by_face, highest, apart)


def _plane_mesh(plane: Shape, mesh: Shape) -> Array:
    normal, hull = plane.frame[:, 2], mesh.size
    lowest = (hull.vertices @ (normal @ mesh.frame)).min()
    return normal @ (mesh.centre - plane.centre) + lowest - hull.excess


def _sphere_mesh(sphere: Shape, mesh: Shape) -> Array:
    centre, _ = sphere.seen_from(mesh)
    return _to_hull(mesh.size, centre) - mesh.size.excess - sphere.size[0]


def _capsule_mesh(capsule: Shape, mesh: Shape) -> Array:
    (centre, frame), hull = capsule.seen_from(mesh), mesh.size
    axis, half = frame[:, 2], capsule.size[1:2]
    nearest = centre + _least_along(*lax.stop_gradient((hull, centre, half * axis))) * half * axis
    gap = _largest_gap(hull, centre, axis[None], half)
    apart = jnp.where(gap > 0, _to_hull(hull, nearest), gap)
    return apart - hull.excess - capsule.size[0]


def _least_along(hull: Hull, centre: Array, half: Array) -> Array:
    """t in [-1, 1] of the point centre + t half that is nearest to a hull which it is outside of.

    That is an end, or the nearest point to an edge.
    """

    def by_edge(start: Array, edge: Array) -> tuple[Array, Array]:
        between = centre - start - edge / 2
        s, t = nearest_of_segments(between, half, edge / 2)
        apart = between + s[:, None] * half - t[:, None] * edge / 2
        square = jnp.sum(jnp.square(apart), axis=1)
        return s[jnp.argmin(square)], square.min()

    ends = jnp.array([-1.0, 1.0])
    by_ends = jax.vmap(lambda t: jnp.square(_to_hull(hull, centre + t * half)))(ends)
    along, squares = jax.vmap(by_edge)(hull.starts, hull.edges)
    return jnp.concatenate([ends, along])[jnp.argmin(jnp.concatenate([by_ends, squares]))]


def _box_mesh(box: Shape, mesh: Shape) -> Array:
    centre, frame = box.seen_from(mesh)
    return _largest_gap(mesh.size, centre, frame.T, box.size) - mesh.size.excess


def _mesh_mesh(one: Shape, other: Shape) -> Array:
    """Apart: from a vertex to the other hull, or between two edges. Else the largest gap."""
    a, b = one.size, _placed(other.size, *other.seen_from(one))
    known = lax.stop_gradient((a, b))
    i, j = (_nearest_vertex(*pair) for pair in (known, known[::-1]))
    (k, m, sign), (p, q, s, t) = _edges_of(*known)
    across = sign * _across(a.edges[k], b.edges[m]) @ (b.starts[m] - a.starts[k])
    gaps = _beyond_faces(a, b), _beyond_faces(b, a), jnp.where(sign == 0, -jnp.inf, across)
    between = a.starts[p] + s * a.edges[p] - b.starts[q] - t * b.edges[q]
    nearest = _to_hull(b, a.vertices[i]), _to_hull(a, b.vertices[j]), norm(between)
    gap, apart = jnp.stack(gaps), jnp.stack(nearest)
    gap = gap[jnp.argmax(lax.stop_gradient(gap))]
    apart = apart[jnp.argmin(lax.stop_gradient(apart))]
    return jnp.where(gap > 0, apart, gap) - a.excess - b.excess


def _placed(hull: Hull, centre: Array, frame: Array) -> Hull:
    """A hull in another frame, in which its own has this centre and these axes."""
    normals, sides = hull.normals @ frame.T, hull.sides @ frame.T
    return Hull(
        hull.vertices @ frame.T + centre,
        normals,
        hull.offsets + normals @ centre,
        sides,
        hull.side_offsets + sides @ centre,
        hull.starts @ frame.T + centre,
        hull.edges @ frame.T,
        hull.arcs @ frame.T,
        hull.excess,
    )


def _beyond_faces(a: Hull, b: Hull) -> Array:
    """Largest distance of a hull b from the plane of a face of a hull a."""
    heights = lax.stop_gradient(b.vertices @ a.normals.T)  # (vertices, faces)
    face = jnp.argmax(heights.min(axis=0) - lax.stop_gradient(a.offsets))
    lowest = jnp.argmin(heights[:, face])
    return a.normals[face] @ b.vertices[lowest] - a.offsets[face]


def _nearest_vertex(a: Hull, b: Hull) -> Array:
    """Number of the vertex of a that is nearest to b."""
    return jnp.argmin(lax.map(partial(_to_hull, b), a.vertices, batch_size=AT_ONCE))


def _edges_of(a: Hull, b: Hull) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Edges of a and of b that span the face with the largest gap, and those that are nearest.

    For the first the sign of their product, which leads from a to b, 0 without such a face; for the
    second where on them the nearest points are, from 0 to 1.
    """

    def with_edge(own: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        start, edge, arcs = own
        normals = jax.vmap(partial(_across, edge))(b.edges)
        of_a, of_b = normals @ arcs.T, jnp.einsum("esk,ek->es", b.arcs, normals)
        ahead = jnp.concatenate([of_a, -of_b], axis=1)
        sign = jnp.where((ahead > 0).all(1), 1.0, jnp.where((ahead < 0).all(1), -1.0, 0.0))
        gaps = sign * jnp.sum(normals * (b.starts - start), axis=1)
        m = jnp.argmax(jnp.where(sign == 0, -jnp.inf, gaps))
        gap = jnp.where(sign[m] == 0, -jnp.inf, gaps[m])

        def between(other: Array, along: Array) -> tuple[Array, Array, Array]:
            w = start + edge / 2 - other - along / 2
            s, t = nearest_of_segments(w, edge / 2, along / 2)
            square = jnp.sum(jnp.square(w + s[:, None] * edge / 2 - t[:, None] * along / 2), axis=1)
            one = jnp.argmin(square)
            return square[one], (1 + s[one]) / 2, (1 + t[one]) / 2

        squares, s, t = jax.vmap(between)(b.starts, b.edges)
        q = jnp.argmin(squares)
        return gap, m, sign[m], squares[q], q, s[q], t[q]

    found = lax.map(with_edge, (a.starts, a.edges, a.arcs), batch_size=AT_ONCE)
    gaps, m, sign, squares, q, s, t = found
    k, p = jnp.argmax(gaps), jnp.argmin(squares)
    return (k, m[k], sign[k]), (p, q[p], s[p], t[p])


def _largest_gap(hull: Hull, centre: Array, axes: Array, sizes: Array) -> Array:
    """Largest distance of a point from the planes of the faces of a sum of shapes.

    They are the hull and the vectors sum_j t_j axes_j with |t_j| <= sizes_j. Faces are spanned by
    those of the hull, by an edge and an axis, or by two axes. Every gap is a lower bound of the
    signed distance; the largest is the distance itself where the shapes overlap.
    """

    def gap(normal: Array) -> Array:
        farthest = hull.vertices[jnp.argmax(lax.stop_gradient(hull.vertices @ normal))]
        return normal @ (centre - farthest) - jnp.abs(axes @ normal) @ sizes

    def largest(hull: Hull, centre: Array, axes: Array, sizes: Array) -> tuple[Array, ...]:
        """Number of a face of the hull, of an axis and an edge, and the sign of their product."""
        faces = hull.normals @ centre - hull.offsets - jnp.abs(hull.normals @ axes.T) @ sizes
        normals = jax.vmap(lambda axis: jax.vmap(partial(_across, axis))(hull.edges))(axes)
        ahead = jnp.einsum("esk,aek->aes", hull.arcs, normals)
        sign = jnp.where((ahead > 0).all(-1), 1.0, jnp.where((ahead < 0).all(-1), -1.0, 0.0))
        gaps = sign * jnp.sum(normals * (centre - hull.starts), axis=-1)
        gaps = jnp.where(sign == 0, -jnp.inf, gaps - jnp.abs(normals @ axes.T) @ sizes)
        axis, edge = jnp.unravel_index(jnp.argmax(gaps), gaps.shape)
        return jnp.argmax(faces), axis, edge, sign[axis, edge]

    face, axis, edge, sign = largest(*lax.stop_gradient((hull, centre, axes, sizes)))
    by_edge = gap(sign * _across(axes[axis], hull.edges[edge]))
    pairs = zip(*np.triu_indices(len(axes), 1), strict=True)
    by_axes = [gap(side * _across(axes[i], axes[j])) for i, j in pairs for side in (1, -1)]
    gaps = jnp.stack([gap(hull.normals[face]), jnp.where(sign == 0, -jnp.inf, by_edge), *by_axes])
    return gaps[jnp.argmax(lax.stop_gradient(gaps))]


def _across(a: Array, b: Array) -> Array:
    """The unit vector along a x b; 0 where they are parallel."""
    product = jnp.cross(a, b)
    length = norm(product)
    parallel = length <= 1e-5 * norm(a) * norm(b)
    return jnp.where(parallel, 0.0, product / jnp.where(parallel, 1.0, length))


HULL_DISTANCES: dict[tuple[int, int], Callable[[Shape, Shape], Array]] = {
    (PLANE, MESH): _plane_mesh,
    (SPHERE, MESH): _sphere_mesh,
    (CAPSULE, MESH): _capsule_mesh,
    (BOX, MESH): _box_mesh,
    (ELLIPSOID, MESH): _mesh_mesh,
    (CYLINDER, MESH): _mesh_mesh,
    (MESH, MESH): _mesh_mesh,
}
"""Like `distances.DISTANCES`, for geoms whose second has a hull, and whose first may have one."""

HULLS = ELLIPSOID, CYLINDER, MESH
"""Kinds of geoms that have a hull beside a mesh."""
