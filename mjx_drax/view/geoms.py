"""Surfaces and colors of the geoms in a MuJoCo scene, as numpy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from mjx_drax.physics.engine import mujoco

Floats = npt.NDArray[np.floating[Any]]

_GEOM = mujoco.mjtGeom


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) and polygons (F, 3 or 4) of vertex indices, which face outwards."""

    vertices: Floats
    faces: npt.NDArray[np.int64]

    def scaled(self, *factors: float) -> Surface:
        """The surface with x, y and z stretched."""
        return Surface(self.vertices * factors, self.faces)


def surface_of(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Surface | None:
    """The geom's surface in its own frame; None for planes and whatever has no surface here."""
    if geom.type == _GEOM.mjGEOM_MESH:
        return _mesh(model, mesh_index(geom))
    if geom.type == _GEOM.mjGEOM_HFIELD:
        return _height_field(model, int(geom.dataid))
    x, y, z = (float(value) for value in geom.size)
    if geom.type in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
        return _capsule(0.0).scaled(x, y, z)
    if geom.type == _GEOM.mjGEOM_CAPSULE:
        return _capsule(round(z / x, 6)).scaled(x, x, x)
    if geom.type == _GEOM.mjGEOM_CYLINDER:
        return _cylinder(24).scaled(x, y, z)
    if geom.type in (_GEOM.mjGEOM_LINE, _GEOM.mjGEOM_ARROW, _GEOM.mjGEOM_ARROW1):
        # MuJoCo's connectors run from their position along z, over the length in size[2]; the
        # width of lines is in pixels.
        line = geom.type == _GEOM.mjGEOM_LINE
        half = 1e-3 * model.stat.extent * x if line else max(x, 1e-3)
        rod = _cylinder(8).scaled(half, half, z / 2.0)
        return Surface(rod.vertices + np.array([0.0, 0.0, z / 2.0]), rod.faces)
    if geom.type == _GEOM.mjGEOM_BOX:
        return _box().scaled(x, y, z)
    return None


def mesh_index(geom: mujoco.MjvGeom) -> int:
    """Which of the model's meshes a geom of a scene shows."""
    return int(geom.dataid) // 2  # MuJoCo stores 2 * mesh, or 2 * mesh + 1 for its convex hull


def mean_color(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Floats:
    """The geom's rgba (4,), times the mean color of its texture if it has one."""
    rgba = np.array(geom.rgba, float)
    index = texture_index(model, geom.matid)
    if index >= 0:
        rgba[:3] *= texture(model, index).mean(axis=(0, 1))
    return rgba


def texture_index(model: mujoco.MjModel, material: int) -> int:
    """The color texture of a material, -1 if there is none."""
    if material < 0:
        return -1
    return int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])


def texture(model: mujoco.MjModel, index: int) -> Floats:
    """The texture's pixels (rows, columns, 3) in [0, 1]."""
    rows, columns = int(model.tex_height[index]), int(model.tex_width[index])
    channels, start = int(model.tex_nchannel[index]), int(model.tex_adr[index])
    data = model.tex_data[start : start + rows * columns * channels]
    pixels = data.reshape(rows, columns, channels)[..., :3].astype(float) / 255.0
    return np.broadcast_to(pixels, (rows, columns, 3))


def _mesh(model: mujoco.MjModel, index: int) -> Surface:
    start, count = int(model.mesh_vertadr[index]), int(model.mesh_vertnum[index])
    vertices = model.mesh_vert[start : start + count].astype(float)
    start, count = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    return Surface(vertices, model.mesh_face[start : start + count].astype(np.int64))


def _height_field(model: mujoco.MjModel, index: int) -> Surface:
    """The upper side of a height field."""
    rows, columns = int(model.hfield_nrow[index]), int(model.hfield_ncol[index])
    start = int(model.hfield_adr[index])
    x_half, y_half, height, _ = model.hfield_size[index]
    heights = height * model.hfield_data[start : start + rows * columns].astype(float)
    x, y = np.meshgrid(np.linspace(-x_half, x_half, columns), np.linspace(-y_half, y_half, rows))
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    corner = (row * columns + column).ravel()
    faces = np.stack([corner, corner + 1, corner + columns + 1, corner + columns], axis=-1)
    return Surface(np.stack([x.ravel(), y.ravel(), heights], axis=-1), faces)


@lru_cache(maxsize=256)
def _capsule(half_length: float) -> Surface:
    """A capsule of radius 1 along z; a sphere if its half length is zero."""
    sides = 24 if half_length > 0.0 else 36  # balls are larger, their facets easier to see
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, sides // 2 + 1)
    if half_length > 0.0:  # the equator twice: the cylinder lies between
        latitude = np.sort(np.append(latitude, 0.0))
    lift = np.where(np.arange(len(latitude)) < len(latitude) / 2.0, -half_length, half_length)
    return _revolved(np.cos(latitude), np.sin(latitude) + lift, sides)


@lru_cache(maxsize=8)
def _cylinder(sides: int) -> Surface:
    """A cylinder of radius 1 and half length 1 along z."""
    return _revolved(np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0]), sides)


def _revolved(radii: Floats, heights: Floats, sides: int) -> Surface:
    """The surface of a profile (P,) turned about z."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    x, y = np.outer(radii, np.cos(angle)), np.outer(radii, np.sin(angle))
    z = np.broadcast_to(heights[:, None], x.shape)
    ring, side = np.meshgrid(np.arange(len(radii) - 1), np.arange(sides), indexing="ij")
    following = (side + 1) % sides
    low, high = ring * sides, (ring + 1) * sides
    faces = np.stack([low + side, low + following, high + following, high + side], axis=-1)
    return Surface(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces.reshape(-1, 4))


@lru_cache(maxsize=1)
def _box() -> Surface:
    """The cube of half side 1, its faces in 4 x 4 parts so that they sort well by depth."""
    count = 4
    grid = np.linspace(-1.0, 1.0, count + 1)
    u, v = (part.ravel() for part in np.meshgrid(grid, grid, indexing="ij"))
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    patch = np.stack([first, first + count + 1, first + count + 2, first + 1], axis=-1)
    vertices: list[Floats] = []
    faces: list[npt.NDArray[np.int64]] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            corner = np.empty((u.size, 3))
            corner[:, axis] = sign
            corner[:, (axis + 1) % 3], corner[:, (axis + 2) % 3] = u, v
            faces.append((patch if sign > 0.0 else patch[:, ::-1]) + u.size * len(vertices))
            vertices.append(corner)
    return Surface(np.concatenate(vertices), np.concatenate(faces))
