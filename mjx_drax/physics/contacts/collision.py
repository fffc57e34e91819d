"""Contacts of MJX, with what it lacks.

- Boxes on planes have the contacts of MuJoCo's C engine. MJX makes contacts at the corners of a box
  that are within 1 mm of the lowest one; the C engine takes all corners of the lower half, so that
  a tilted box has more contacts there.
- Capsules on planes have the C engine's directions of friction, along and across the capsule. MJX
  has others where a capsule is steeper than 60 degrees.
- Spheres and capsules touch each other (`spheres`), cylinders and ellipsoids (`solids`), and boxes
  (`boxes`) where the C engine has it.
- Meshes on planes touch with the face that the C engine has, where MJX takes corners of the whole
  hull.
- Cylinders and ellipsoids meet boxes and meshes (`curved`), and height fields as convex hulls of
  points on them.
- Two polytopes touch where the C engine has it, at every point once, and halfway between their
  faces; hulls of meshes take less memory (`polytopes`).
- Hulls of meshes have the normals of their faces; see `hull`. Pairs of hulls of similar sizes
  are one computation, where MJX has one for each pair, which takes seconds each to compile.
- Pairs of geoms of one kind are one computation, also where their contacts have different friction
  dimensions (condim).
- Pairs of geoms can be left out, by `exclude_signature` of the MJX model.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import threading
from collections.abc import Callable, Collection, Iterator
from contextvars import ContextVar
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial import ConvexHull

from mjx_drax.physics._mjx import (
    COLLISIONS,
    ConvexMesh,
    collision_driver,
    internal,
    make_frame,
    meshes,
    mjx,
    with_internal,
)
from mjx_drax.physics.contacts import boxes, curved, polytopes, solids, spheres
from mjx_drax.physics.contacts.hull import Hull, hull_of, polytope
from mjx_drax.physics.contacts.pairs import numbered_pairs
from mjx_drax.physics.contacts.spheres import APART, Contacts
from mjx_drax.physics.engine import mujoco

_GEOM = mujoco.mjtGeom
PLANE, HFIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(_GEOM, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)

SIDES = 16
"""Sides of the prism that stands for a cylinder. The C engine lets cylinders stand on 8 points at
odd multiples of 22.5 degrees, which are corners of it."""

STEEP, UPRIGHT = 0.1, 1e-6
"""Cosines of a capsule's angle with a plane: below the first its directions of friction count as
constant in derivatives, which grow without bound; below the second they are the plane's."""

TURNS = 4
"""How often three corners of a face move on in turn; with sixteen corners they stop after three."""

_GROWTH = ContextVar("growth", default=4.0)
"""Hulls whose numbers of corners are between the same powers of this are padded to one size."""

SLIPPERY = 1e-7
"""Friction of contacts that have none; with MuJoCo's least, 1e-5, a velocity was off by 7e-4."""

POINTS = 66
"""Points on the hull that stands for an ellipsoid: six, and edges halved twice."""

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""The corners of a cube, (8, 3)."""

_ONE_AT_A_TIME = threading.RLock()

BLIND = np.zeros((9, 9), bool)
"""Kinds of geoms, the lower one first, whose distance MJX knows only where they overlap."""
BLIND[:, MESH] = BLIND[HFIELD] = True
BLIND[[PLANE, ELLIPSOID, CYLINDER], MESH] = False

Pairs = Collection[tuple[int, int]]


@contextlib.contextmanager
def hulls_of_one_size() -> Iterator[None]:
    """Inside of this, all hulls are padded to the size of the largest, and pairs come one by one.

    One program serves all of them then: it compiles in less time, and takes longer to run, though
    it skips pairs that are far apart. For steps that are made a few times: a UR5e's compiles in
    15 s, and not in 42.
    """
    before = _GROWTH.set(np.inf)
    try:
        yield
    finally:
        _GROWTH.reset(before)


@contextlib.contextmanager
def extended(left_out: Pairs = ()) -> Iterator[None]:
    """Inside of this, MJX collides what is listed above.

    MJX has one table of functions for all threads, so one thread at a time does this; the table is
    restored.

    Args:
        left_out: pairs of geoms, beside those that an MJX model leaves out itself.
    """
    with _ONE_AT_A_TIME:
        table, pairs = dict(COLLISIONS), collision_driver.geom_pairs
        groups, convex = collision_driver._geom_groups, meshes.convex

        def kept(model: Any) -> Iterator[tuple[int, int, int]]:
            out = {signature(*pair) for pair in left_out}
            out |= {int(s) for s in model.exclude_signature if s < 0}
            yield from (pair for pair in numbered_pairs(model) if signature(*pair[:2]) not in out)

        COLLISIONS.update(_OWN)
        collision_driver.geom_pairs = kept
        collision_driver._geom_groups = lambda model: _merged(model, groups(model))
        meshes.convex = hull_of
        try:
            yield
        finally:
            COLLISIONS.clear()
            COLLISIONS.update(table)
            collision_driver.geom_pairs = pairs
            collision_driver._geom_groups = groups
            meshes.convex = convex


def _merged(model: Any, groups: dict[Any, list[Any]]) -> dict[Any, list[Any]]:
    """MJX's groups of pairs, those of hulls of similar sizes in one.

    Its `data_ids` then are sizes in place of meshes; -1 stands for a box. Among elliptic cones,
    contacts without friction (condim 1) get one as well.
    """
    if isinstance(model, mujoco.MjModel):  # whose contacts are counted only
        return groups
    merged: dict[Any, list[Any]] = {}
    for key, pairs in groups.items():
        if key.condim == 1 and model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
            key = dataclasses.replace(key, condim=3)  # `collision` takes their friction
        if key.types in _HULLS:
            sizes = tuple(_size(model._impl.mesh_convex[i]) if i >= 0 else -1 for i in key.data_ids)
            key = dataclasses.replace(key, data_ids=sizes)
        merged.setdefault(key, []).extend(pairs)
    # Those of a <pair> come first, as MJX reads them
    return {key: sorted(pairs, key=lambda pair: pair[2] < 0) for key, pairs in merged.items()}


def _size(hull: Hull) -> int:
    """The power of `_GROWTH` that a hull's number of corners is below."""
    return int(np.ceil(np.log(len(hull.vert)) / np.log(_GROWTH.get())))


def _alike(model: mjx.Model, size: int) -> tuple[Hull, np.ndarray]:
    """All hulls of a size, padded and stacked, and the place of each mesh among them (nmesh,).

    Corners, faces and edges are repeated; edges that are have no faces beside them, and so touch
    nothing.
    """
    every = model._impl.mesh_convex
    of_size = [i for i, hull in enumerate(every) if hull is not None and _size(hull) == size]
    hulls = [jax.tree.map(jnp.asarray, every[i]) for i in of_size]
    most = jax.tree.map(lambda *arrays: tuple(np.max([a.shape for a in arrays], axis=0)), *hulls)

    def padded(hull: Hull) -> Hull:
        def pad(array: Array, shape: tuple[int, ...], mode: str = "edge") -> Array:
            missing = [(0, int(n) - m) for n, m in zip(shape, array.shape, strict=True)]
            return jnp.pad(array, missing, mode)

        beside = pad(hull.edge_face_normal, most.edge_face_normal, "constant")
        return jax.tree.map(pad, hull, most).replace(edge_face_normal=beside)

    place = np.zeros(len(every), int)
    place[of_size] = np.arange(len(of_size))
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *map(padded, hulls)), place


def signature(a: int, b: int) -> int:
    """The entry of `exclude_signature` that leaves out a pair of geoms; MuJoCo's are positive."""
    low, high = sorted((int(a), int(b)))
    return -((low << 24) + high) - 1


def left_out(model: mjx.Model) -> set[tuple[int, int]]:
    """The pairs of geoms that an MJX model leaves out."""
    codes = (-(int(s) + 1) for s in model.exclude_signature if s < 0)
    return {(code >> 24, code & 0xFFFFFF) for code in codes}


def make_data(model: mjx.Model) -> mjx.Data:
    """`mjx.make_data`: room for all contacts."""
    with extended():
        return mjx.make_data(model)


def collision(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.collision`: `data` with all contacts.

    Where MJX finds no distances of geoms that are apart, contacts have no margin.
    """
    if not internal(data).contact.dist.size:
        return data
    with extended():
        COLLISIONS.update(_whatever_condim(model, data))
        data = mjx.collision(model, data)
    contact, kinds = internal(data).contact, jnp.asarray(model.geom_type)
    slippery = _slippery(model)
    if slippery.any():
        without = jnp.asarray(slippery)[contact.geom[:, 0], contact.geom[:, 1], None]
        contact = contact.replace(friction=jnp.where(without, SLIPPERY, contact.friction))
        data = with_internal(data, contact=contact)
    if not np.isin(model.geom_type, (HFIELD, MESH)).any():
        return data
    blind = jnp.asarray(BLIND)[kinds[contact.geom[:, 0]], kinds[contact.geom[:, 1]]]
    margin = jnp.where(blind, 0.0, contact.includemargin)
    return with_internal(data, contact=contact.replace(includemargin=margin))


def _whatever_condim(model: mjx.Model, data: mjx.Data) -> dict[tuple[int, int], Any]:
    """Functions for kinds of geoms that MJX would collide once for each condim.

    They know their results. One step of a hand with its derivatives then compiles on a CPU in 60 %
    of the time.
    """
    alike: dict[Any, dict[Any, np.ndarray]] = {}
    for key, pairs in collision_driver._geom_groups(model).items():
        parts = alike.setdefault(dataclasses.replace(key, condim=0), {})
        parts[key] = np.array(pairs)[:, :2]
    known: dict[Any, Contacts] = {}
    for kind, parts in alike.items():
        collide = COLLISIONS[kind.types]
        every = collide(model, data, kind, jnp.concatenate([*parts.values()]))
        ends = np.cumsum([collide.ncon * len(pairs) for pairs in parts.values()])[:-1]
        of_each = zip(*(jnp.split(array, ends) for array in every), strict=True)
        known |= zip(parts, of_each, strict=True)

    def found(_: mjx.Model, __: mjx.Data, key: Any, ___: Array) -> Contacts:
        return known[key]

    return {kind.types: _function(found, COLLISIONS[kind.types].ncon) for kind in alike}


def bodies_in_contact(model: mjx.Model) -> np.ndarray:
    """Numbers of the bodies (n,) that contacts of the model may push."""
    with extended():
        pairs = [pair[:2] for pair in collision_driver.geom_pairs(model)]
    return np.unique(np.asarray(model.geom_bodyid)[np.array(pairs, int).reshape(-1)])


def _slippery(model: mjx.Model) -> np.ndarray:
    """Pairs of geoms whose contacts have a cone and no friction, (ngeom, ngeom)."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        return np.zeros((model.ngeom, model.ngeom), bool)
    own, priority = np.asarray(model.geom_condim), np.asarray(model.geom_priority)
    first = priority[:, None] - priority
    condim = np.where(first < 0, own, np.maximum(own[:, None], own))
    condim = np.where(first > 0, own[:, None], condim)
    for a, b, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True):
        condim[[a, b], [b, a]] = dim
    found: np.ndarray = condim == 1
    return found


def plane_box(model: mjx.Model, data: mjx.Data, _: Any, geom: Array) -> Contacts:
    """Distances (4 n,), positions (4 n, 3) and frames (4 n, 3, 3) of contacts of pairs (n, 2)."""
    plane, box = geom.T
    normal = data.geom_xmat[plane][:, None, :, 2]
    cube = CORNERS.astype(normal.dtype)  # a copy: JAX knows an array by its identity
    from_centre = jnp.sum(
        data.geom_xmat[box][:, None] * (cube * model.geom_size[box][:, None])[:, :, None],
        axis=-1,
    )
    corners = data.geom_xpos[box][:, None] + from_centre
    height = jnp.sum((corners - data.geom_xpos[plane][:, None]) * normal, axis=-1)
    _, lowest = jax.lax.top_k(-height, 4)
    dist = jnp.take_along_axis(height, lowest, axis=1)
    pos = jnp.take_along_axis(corners, lowest[..., None], axis=1) - 0.5 * dist[..., None] * normal
    frame = jnp.repeat(jax.vmap(make_frame)(normal[:, 0]), 4, axis=0)
    return dist.reshape(-1), pos.reshape(-1, 3), frame


plane_box.ncon = 4  # type: ignore[attr-defined]  # contacts of a pair, which MJX reads


def plane_capsule(model: mjx.Model, data: mjx.Data, _: Any, geom: Array) -> Contacts:
    """The same of capsules, (2 n, ...)."""
    plane, capsule = geom.T
    normal, axis = (data.geom_xmat[g][..., 2] for g in (plane, capsule))
    along = axis - jnp.sum(axis * normal, axis=-1, keepdims=True) * normal
    square = jnp.sum(along * along, axis=-1, keepdims=True)
    upright = square < UPRIGHT**2
    along = jnp.where(upright, jax.vmap(make_frame)(normal)[:, 1], along)
    along = along * jax.lax.rsqrt(jnp.where(upright, 1.0, square))
    along = jnp.where(square < STEEP**2, jax.lax.stop_gradient(along), along)
    frame = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    radius, half = model.geom_size[capsule, 0, None], model.geom_size[capsule, 1, None]
    ends = data.geom_xpos[capsule][:, None] + jnp.stack([half * axis, -half * axis], axis=1)
    height = jnp.sum((ends - data.geom_xpos[plane][:, None]) * normal[:, None], axis=-1)
    dist = height - radius
    pos = ends - (radius + 0.5 * dist)[..., None] * normal[:, None]
    return dist.reshape(-1), pos.reshape(-1, 3), jnp.repeat(frame, 2, axis=0)


plane_capsule.ncon = 2  # type: ignore[attr-defined]


def plane_mesh(model: mjx.Model, data: mjx.Data, key: Any, geom: Array) -> Contacts:
    """The same of meshes, (4 n, ...): corners of the face that lies on the plane.

    As in the C engine (as of 3.17), it is the face nearest to parallel of those at the lowest
    corner, and four corners of it where it has more.
    """
    plane, hull = geom.T
    mesh = jax.tree.map(jnp.asarray, internal(model).mesh_convex[key.data_ids[1]])
    pose = [at[g] for g in (plane, hull) for at in (data.geom_xpos, data.geom_xmat)]
    dist, pos, frame = jax.vmap(partial(_on_plane, mesh))(*pose)
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


plane_mesh.ncon = 4  # type: ignore[attr-defined]


def _on_plane(mesh: Hull, origin: Array, turn: Array, centre: Array, own: Array) -> Contacts:
    """Contacts (4, ...) of one hull with one plane: where each is, and how it is turned."""
    normal = turn[:, 2]
    down = -normal @ own
    lowest = mesh.vert[jnp.argmax(mesh.vert @ down)]
    beside = (mesh.face == lowest).all(axis=2).any(axis=1)
    corners = mesh.face[jnp.argmax(mesh.face_normal @ down - 2.0 * ~beside)]
    if len(corners) > 4:
        count = jnp.any(corners[1:] != corners[:-1], axis=1).sum() + 1
        corners = corners[jnp.where(count > 4, _spread(corners, lowest, count), jnp.arange(4))]
    repeated = (corners[:, None] == corners).all(axis=-1) & (np.tri(len(corners), k=-1) > 0)
    corners = jnp.pad(corners, ((0, 4 - len(corners)), (0, 0)))
    absent = jnp.pad(repeated.any(axis=1), (0, 4 - len(repeated)), constant_values=True)
    points = centre + corners @ own.T
    dist = (points - origin) @ normal
    pos = points - 0.5 * dist[:, None] * normal
    frame = jnp.broadcast_to(make_frame(normal), (4, 3, 3))
    return jnp.where(absent, 1.0, dist), pos, frame


def _spread(corners: Array, first: Array, count: Array) -> Array:
    """Which of the `count` corners of a face (n, 3) touch: `first`, and three that span an area.

    The three move on around the face as long as the area grows, each in turn, as in the C engine.
    """
    i = jnp.arange(len(corners))
    start = jnp.argmin(jnp.sum((corners - first) ** 2, axis=1))
    corners = jax.lax.stop_gradient(corners)[(start + i) % count]
    a, b, c, d = (jnp.asarray(k) for k in range(4))

    def onwards(k: Array, area: Array, end: Array) -> Array:
        """The first index from k on, before `end`, behind which the area (n,) does not grow."""
        ends = (i + 1 >= end) | (jnp.roll(area, -1) <= area)
        return jnp.argmax(ends & (i >= k))

    for _ in range(TURNS):
        of_d = jnp.cross(corners[c] - corners[a], corners - corners[b])
        d = onwards(d, jnp.linalg.norm(of_d, axis=1), count)
        of_c = jnp.cross(corners - corners[a], corners[d] - corners[b])
        c = onwards(c, jnp.linalg.norm(of_c, axis=1), d)
        of_b = jnp.cross(corners[c] - corners[a], corners[d] - corners)
        b = onwards(b, jnp.linalg.norm(of_b, axis=1), c)
    return (start + jnp.stack([a, b, c, d])) % count


def corners(model: mujoco.MjModel, g: int) -> int:
    """How many corners the hull of a geom has; 1 where it is none."""
    kind, mesh = int(model.geom_type[g]), int(model.geom_dataid[g])
    if kind != MESH:
        return 8 if kind == BOX else 1
    return int(model.mesh_graph[model.mesh_graphadr[mesh]])


@cache
def _unit_hull(kind: int) -> Hull:
    """A hull for geoms of size 1."""
    points = CORNERS
    if kind == CYLINDER:
        angle = 2 * np.pi * np.arange(SIDES) / SIDES
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = np.concatenate([np.insert(circle, 2, z, axis=1) for z in (-1.0, 1.0)])
    elif kind == ELLIPSOID:
        points = np.concatenate([np.eye(3), -np.eye(3)])
        while len(points) < POINTS:
            triangles = points[ConvexHull(points).simplices]
            halves = (triangles + np.roll(triangles, 1, axis=1)).reshape(-1, 3)
            halves /= np.linalg.norm(halves, axis=1, keepdims=True)
            points = np.unique(np.concatenate([points, halves]).round(12), axis=0)
    return polytope(points)


def _hull(kind: int, size: Array) -> Hull:
    """The hull that stands for a geom of a size (3,)."""
    # Constants of its own for each precision: JAX may take one for the other
    unit = jax.tree.map(
        lambda array: jnp.asarray(array, size.dtype if array.dtype == float else np.int32),
        _unit_hull(kind),
    )
    scale = size[jnp.array([0, 0, 1])] if kind == CYLINDER else size

    def turned(normals: Array) -> Array:
        scaled = normals / scale
        return scaled / jnp.linalg.norm(scaled, axis=-1, keepdims=True)

    return unit.replace(
        vert=unit.vert * scale,
        face=unit.face * scale,
        face_normal=turned(unit.face_normal),
        edge_face_normal=turned(unit.edge_face_normal),
        polygon_normal=turned(unit.polygon_normal),
    )


def on_height_field(model: mjx.Model, data: mjx.Data, key: Any, geom: Array) -> Contacts:
    """Distances (4 n,), positions (4 n, 3), frames (4 n, 3, 3) of contacts of pairs (n, 2)."""
    field, kind = key.types

    def of_pair(pair: Array) -> Contacts:
        hulls = *model._impl.mesh_convex, _hull(int(kind), model.geom_size[pair[1]])
        # MJX looks for cells of the field within the largest size of a hull
        sizes = jnp.tile(model.geom_rbound[:, None], 3)
        with_hull = model.tree_replace({"_impl.mesh_convex": hulls, "geom_size": sizes})
        ids = key.data_ids[0], len(hulls) - 1
        as_mesh = type(key)((field, MESH), ids, key.condim, key.subgrid_size)
        found: Contacts = COLLISIONS[HFIELD, MESH](with_hull, data, as_mesh, pair[None])
        return found

    dist, pos, frame = jax.vmap(of_pair)(geom)
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


on_height_field.ncon = 4  # type: ignore[attr-defined]


def with_corners(model: mjx.Model, data: mjx.Data, key: Any, geom: Array) -> Contacts:
    """The same of cylinders with boxes and meshes, and (n,), ... of ellipsoids with them."""
    smooth, cornered = (int(kind) for kind in key.types)

    def of_pair(pair: Array) -> Contacts:
        one, other = pair
        mesh = model._impl.mesh_convex[key.data_ids[1]] if cornered == MESH else None
        hull = _hull(BOX, model.geom_size[other]) if mesh is None else mesh
        turn, origin = data.geom_xmat[other], data.geom_xpos[other]
        centre = turn.T @ (data.geom_xpos[one] - origin)
        between = curved.CONTACTS[smooth]
        dist, pos, normal = between(
            centre, turn.T @ data.geom_xmat[one], model.geom_size[one], hull
        )
        frame = jnp.repeat(make_frame(turn @ normal)[None], len(dist), axis=0)
        return dist, pos @ turn.T + origin, frame

    dist, pos, frame = jax.vmap(of_pair)(geom)
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


def between_hulls(model: mjx.Model, data: mjx.Data, key: Any, geom: Array) -> Contacts:
    """The same of boxes and meshes, of two boxes (8 n, ...); `key.data_ids` as in `_merged`."""
    stacks = [None if size < 0 else _alike(model, size) for size in key.data_ids]
    boxes = not any(stacks)
    margins = jnp.concatenate([jnp.asarray(model.geom_margin), jnp.asarray(model.pair_margin)])
    reach = jnp.max(margins)

    def hull(place: int, g: Array) -> Hull:
        stack = stacks[place]
        if stack is None:
            return _hull(BOX, model.geom_size[g])
        which = jnp.asarray(stack[1][model.geom_dataid])[g]
        return jax.tree.map(lambda array: array[which], stack[0])

    def of_pair(pair: Array) -> Contacts:
        one, other = pair
        turn, origin = data.geom_xmat[other], data.geom_xpos[other]
        centre, axes = turn.T @ (data.geom_xpos[one] - origin), turn.T @ data.geom_xmat[one]
        placed = polytopes.moved(hull(0, one), centre, axes)
        if boxes:
            found = polytopes.of_boxes(placed, hull(1, other), len(geom), reach)
        else:
            found = polytopes.of_hulls(placed, hull(1, other), len(geom))
        dist, pos, normal = found
        frame = jnp.repeat(make_frame(turn @ normal)[None], len(dist), axis=0)
        return dist, pos @ turn.T + origin, frame

    if _GROWTH.get() < np.inf:
        dist, pos, frame = jax.vmap(of_pair)(geom)
    else:
        dist, pos, frame = _one_by_one(model, data, of_pair, geom, reach)
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


def _one_by_one(
    model: mjx.Model,
    data: mjx.Data,
    of_pair: Callable[[Array], Contacts],
    geom: Array,
    reach: Array,
) -> Contacts:
    """of_pair of all pairs (n, 2), but for those whose bounding spheres are apart by `reach`."""
    dist, pos, frame = jax.eval_shape(of_pair, geom[0])

    def apart(_: Array) -> Contacts:
        return (
            jnp.full(dist.shape, APART, dist.dtype),
            jnp.zeros(pos.shape, pos.dtype),
            jnp.broadcast_to(jnp.eye(3, dtype=frame.dtype), frame.shape),
        )

    def near(pair: Array) -> Contacts:
        one, other = data.geom_xpos[pair]
        gap = jnp.linalg.norm(one - other) - jnp.sum(model.geom_rbound[pair])
        found: Contacts = jax.lax.cond(gap > reach, apart, of_pair, pair)
        return found

    found: Contacts = jax.lax.map(near, geom)
    return found


def _of_spheres(
    collide: Callable[[mjx.Model, mjx.Data, Array], Contacts], contacts: int = 1
) -> Any:
    """A function of `spheres`, `solids` or `boxes`, as MJX calls it."""

    def function(model: mjx.Model, data: mjx.Data, _: Any, geom: Array) -> Contacts:
        dist, pos, normal = collide(model, data, geom)
        return dist, pos, jax.vmap(make_frame)(normal)

    return _function(function, contacts)


def _function(collide: Any, contacts: int) -> Any:
    """A function that says, as MJX reads it, how many contacts it makes of a pair."""

    def function(*arguments: Any) -> Contacts:
        found: Contacts = collide(*arguments)
        return found

    function.ncon = contacts  # type: ignore[attr-defined]
    return function


_HULLS = {(BOX, BOX), (BOX, MESH), (MESH, MESH)}
"""Kinds of geoms that `between_hulls` collides."""

_BETWEEN_HULLS = _function(between_hulls, 4)
_CYLINDERS, _ELLIPSOIDS = _function(with_corners, 4), _function(with_corners, 1)


def _with_plain_hulls(collide: Any) -> Any:
    """A function of MJX, which knows hulls without polygons only."""

    def plain(hull: Hull | None) -> ConvexMesh | None:
        names = [field.name for field in dataclasses.fields(ConvexMesh)]
        return hull and ConvexMesh(**{name: getattr(hull, name) for name in names})

    def function(model: mjx.Model, *arguments: Any) -> Contacts:
        hulls = tuple(map(plain, model._impl.mesh_convex))
        found: Contacts = collide(model.tree_replace({"_impl.mesh_convex": hulls}), *arguments)
        return found

    return _function(function, collide.ncon)


_OWN = {
    **{
        (kind, MESH): _with_plain_hulls(COLLISIONS[kind, MESH])
        for kind in (HFIELD, SPHERE, CAPSULE)
    },
    (PLANE, CAPSULE): plane_capsule,
    (PLANE, BOX): plane_box,
    (PLANE, MESH): plane_mesh,
    (SPHERE, CAPSULE): _of_spheres(spheres.sphere_capsule),
    (SPHERE, CYLINDER): _of_spheres(solids.sphere_cylinder),
    (SPHERE, BOX): _of_spheres(boxes.sphere_box),
    (SPHERE, ELLIPSOID): _of_spheres(solids.sphere_ellipsoid),
    (CAPSULE, CAPSULE): _of_spheres(spheres.two_capsules),
    (CAPSULE, ELLIPSOID): _of_spheres(solids.capsule_ellipsoid),
    (CAPSULE, CYLINDER): _of_spheres(solids.capsule_cylinder, 2),
    (CAPSULE, BOX): _of_spheres(boxes.capsule_box, 2),
    (HFIELD, ELLIPSOID): on_height_field,
    (HFIELD, CYLINDER): on_height_field,
    (ELLIPSOID, BOX): _ELLIPSOIDS,
    (ELLIPSOID, MESH): _ELLIPSOIDS,
    (CYLINDER, BOX): _CYLINDERS,
    (CYLINDER, MESH): _CYLINDERS,
    (BOX, BOX): _function(between_hulls, 8),
    (BOX, MESH): _BETWEEN_HULLS,
    (MESH, MESH): _BETWEEN_HULLS,
}
"""Kinds of geoms, the lower one first, and what collides them in place of MJX."""
