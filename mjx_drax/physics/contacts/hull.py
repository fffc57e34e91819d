"""Convex hulls of meshes: their own faces, and the polygons that the C engine makes of them."""

# Not with postponed annotations: MJX finds arrays of a class by the types of its fields

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from jax import Array
from scipy.spatial import ConvexHull, QhullError

from mjx_drax.physics._mjx import ConvexMesh
from mjx_drax.physics.engine import mujoco

MOST_CORNERS = 20
"""Corners of a face, at most, as in MJX; from larger faces every second or third is taken."""

Polygon = tuple[np.ndarray, np.ndarray]
"""Numbers of its corners, counterclockwise, and its normal (3,)."""


class Hull(ConvexMesh):
    """A convex polytope, with the polygons that the C engine merges its triangles into.

    Corners of these are up to 0.01 rad out of their planes: depths are found with its own faces.

    Attributes:
        polygon: numbers of corners, counterclockwise, (polygons, most); the last one is repeated.
        polygon_normal: (polygons, 3).
        of_face, of_edge: the polygon of each face, (faces,), and those of each edge, (edges, 2).
        around, before: polygons at each corner, and the corner before it in each,
            (corners, most); the last ones are repeated.
    """

    polygon: Array
    polygon_normal: Array
    of_face: Array
    of_edge: Array
    around: Array
    before: Array


def polytope(points: np.ndarray, polygons: Sequence[Polygon] = ()) -> Hull:
    """The convex hull of points (n, 3), as MJX has it of a mesh.

    MJX itself merges triangles that are nearly in a plane, and leaves out corners of large faces
    before it finds their normals: of 276 meshes of robots, 221 had a corner outside of a face, by
    more than 1/1000 of their size.

    Args:
        points: its corners.
        polygons: those that the C engine has, each the numbers of its corners and its normal; by
            default the faces.
    """
    size = np.abs(points).max()
    try:
        hull = ConvexHull(points / size)
    except QhullError:  # it is flat
        hull = ConvexHull(points / size, qhull_options="QJ")
    planes: dict[tuple[float, ...], list[int]] = {}
    for t, plane in enumerate(hull.equations):
        planes.setdefault(tuple((plane + 0.0).round(5) + 0.0), []).append(t)
    normals = np.array([hull.equations[same[0], :3] for same in planes.values()])
    faces = [
        _around(points, np.unique(hull.simplices[same]), normal)
        for same, normal in zip(planes.values(), normals, strict=True)
    ]
    beside: dict[tuple[int, int], list[int]] = {}
    for f, face in enumerate(faces):
        for pair in zip(face, np.roll(face, -1), strict=True):
            beside.setdefault((int(min(pair)), int(max(pair))), []).append(f)
    beside = {pair: both for pair, both in beside.items() if len(both) == 2}
    polygons = polygons or list(zip(faces, normals, strict=True))
    around: list[list[tuple[int, int]]] = [[] for _ in points]
    for g, (corners, _) in enumerate(polygons):
        for corner, before in zip(corners, np.roll(corners, 1), strict=True):
            around[corner].append((g, int(before)))
    places = _table([at or [(0, 0)] for at in around])
    polygon_normals = np.array([normal for _, normal in polygons])
    of_face = np.array(
        [
            max(
                {g for corner in face for g, _ in around[corner]} or range(len(polygons)),
                key=lambda g: (len(np.intersect1d(face, polygons[g][0])), out @ polygon_normals[g]),
            )
            for face, out in zip(faces, normals, strict=True)
        ]
    )
    both = np.array(list(beside.values()))
    return Hull(
        points,
        points[_table(map(_thinned, faces))],
        normals,
        np.array(list(beside)),
        normals[both],
        _table([_thinned(corners) for corners, _ in polygons]),
        polygon_normals,
        of_face,
        np.sort(of_face[both], axis=1),
        places[..., 0],
        places[..., 1],
    )


def _thinned(corners: np.ndarray) -> np.ndarray:
    """At most `MOST_CORNERS` of the corners of a face."""
    return corners[:: -(-len(corners) // MOST_CORNERS)]


def _table(rows: Iterable[Any]) -> np.ndarray:
    """Rows of different lengths as an array; the last entries are repeated."""
    rows = [np.asarray(row) for row in rows]
    most = max(map(len, rows))
    return np.array([np.concatenate([row, row[[-1] * (most - len(row))]]) for row in rows])


def _around(points: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Corners of a face in counterclockwise order about its normal."""
    out = points[corners] - points[corners].mean(axis=0)
    angle = np.arctan2(np.cross(out[0], out) @ normal, out @ out[0])
    return corners[np.argsort(angle)]


def hull_of(model: mujoco.MjModel, which: int) -> Hull:
    """The hull of a mesh, on the corners and with the polygons that the C engine has."""
    graph = model.mesh_graph[model.mesh_graphadr[which] :]
    own = graph[2 + graph[0] : 2 + 2 * graph[0]]
    vertices = np.asarray(model.mesh_vert[model.mesh_vertadr[which] + own], float)
    place = {int(v): i for i, v in enumerate(own)}
    first = model.mesh_polyadr[which]
    every = slice(first, first + model.mesh_polynum[which])
    polygons = []
    for start, count in zip(
        model.mesh_polyvertadr[every], model.mesh_polyvertnum[every], strict=True
    ):
        corners = model.mesh_polyvert[start : start + count]
        # The C engine measures depths from the last corner
        polygons.append(tuple(place[int(v)] for v in np.roll(corners, 1)))
    normals = np.asarray(model.mesh_polynormal[every], float)
    return _polytope_of(vertices.tobytes(), tuple(polygons), normals.tobytes())


@lru_cache(1000)
def _polytope_of(points: bytes, corners: tuple[tuple[int, ...], ...], normals: bytes) -> Hull:
    """`polytope`, which takes a tenth of a second for a mesh of 500 corners."""
    outs = np.frombuffer(normals).reshape(-1, 3)
    polygons = [(np.array(each), out) for each, out in zip(corners, outs, strict=True)]
    return polytope(np.frombuffer(points).reshape(-1, 3), polygons)
