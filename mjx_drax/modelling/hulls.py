"""Signed distances from the convex hulls of meshes, as JAX functions of poses [m].

A hull is the intersection of half-spaces n_i . p <= o_i. Inside, the distance of a point is

    max_i (n_i . p - o_i)

outside it is the same over the face that p projects into, else the distance from an edge. Which
values are exact:

    plane, sphere, capsule    exact
    box                       exact where they overlap; apart, a lower bound of at least 1/sqrt(3)
                              of the distance

The hull is the one that the C engine has. If it has more than VERTICES vertices, it is replaced by
the hull of some of them, and distances are less by the largest distance e of the others from it:
lower bounds, at most e too small. For round meshes e is about 5 % of their size.

First and second derivatives are finite everywhere; the nearest point of a capsule's axis is not
differentiated, as in `distances`. A capsule takes about a hundred times as long with a mesh as with
a box: use primitive shapes where they fit.
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
    PLANE,
    SPHERE,
    Shape,
    nearest_of_segments,
    norm,
)
from mjx_drax.physics.engine import mujoco

MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
VERTICES = 64
"""Vertices of a hull, at most; it has about twice as many triangles."""


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
    vertices, faces = _triangles(points, model.mesh(mesh).name)
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
    hull = Hull(*map(jnp.asarray, parts))
    apart = jax.jit(lambda hull, points: lax.map(partial(_to_hull, hull), points, batch_size=256))
    return hull._replace(excess=jnp.maximum(apart(hull, jnp.asarray(points)).max(), 0.0))


def hulls_of(model: mujoco.MjModel, geoms: Sequence[int]) -> Hull:
    """The hulls of geoms that are meshes: arrays with one more axis, before their own.

    The last rows of smaller hulls are repeated.

    Raises:
        DraxError: a mesh has no volume.
    """
    meshes = [int(model.geom_dataid[geom]) for geom in geoms]
    made = {mesh: hull_of(model, mesh) for mesh in set(meshes)}

    def stack(*parts: Array) -> Array:
        if parts[0].ndim:
            rows = np.arange(max(map(len, parts)))
            parts = tuple(part[np.minimum(rows, len(part) - 1)] for part in parts)
        return jnp.stack(parts)

    return jax.tree.map(stack, *(made[mesh] for mesh in meshes))


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
}
"""Like `distances.DISTANCES`, for geoms whose second is a mesh with a hull."""
