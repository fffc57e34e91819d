"""Draws a MuJoCo scene with numpy and Pillow alone, for machines without any OpenGL.

`mjv_updateScene` fills an `MjvScene` without a GL context. This module projects what is in it:

- sky and planes are ray-cast per pixel, once for as long as the camera stays where it is;
- every other geom becomes a small closed mesh in world coordinates; its front faces are shaded
  flat (Lambert's law plus a highlight), sorted from far to near and filled (painter's algorithm).

There are no shadows, reflections, labels, skins or flexible bodies. A camera point p (3,) has
depth -p_z: x points right, y up, and the camera looks along -z, as in MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from mjx_drax.physics._mujoco import mujoco

Floats = npt.NDArray[np.floating[Any]]
Frame = npt.NDArray[np.uint8]

_GEOM = mujoco.mjtGeom
_OVERSAMPLE = 2  # faces are filled at twice the size and averaged: smooth edges
_HORIZON = 50.0  # [m] floors fade into the haze by this distance
_MAX_MESH_FACES = 600  # a mesh with more faces is drawn as its convex hull
_NEUTRAL_SKY = np.array([[0.30, 0.36, 0.44], [0.74, 0.78, 0.82]])


@dataclass(frozen=True)
class Mesh:
    """A closed surface: vertices (V, 3) and outward polygons (F, 3 or 4) of vertex indices."""

    vertices: Floats
    faces: npt.NDArray[np.int64]


@dataclass(frozen=True)
class View:
    """A pinhole camera: position (3,), rows right, up, back (3, 3), pixels per unit slope."""

    position: Floats
    axes: Floats
    focal: float
    center: tuple[float, float]
    near: float

    def to_camera(self, points: Floats) -> Floats:
        """World points (..., 3) in camera coordinates (..., 3)."""
        return (points - self.position) @ self.axes.T

    def to_pixels(self, points: Floats) -> Floats:
        """Camera points (..., 3) in pixels (..., 2), y down; points must be before the camera."""
        slope = points[..., :2] / np.maximum(-points[..., 2:], self.near)
        return slope * (self.focal, -self.focal) + self.center


class Painter:
    """Draws scenes of one model at one frame size; `render` gives (height, width, 3) uint8."""

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        self._model = model
        self._height = height
        self._width = width
        self._sky = _sky_colors(model)
        self._meshes: dict[int, Mesh] = {}
        self._backdrop_key: bytes = b""
        self._backdrop: Frame = np.zeros((height, width, 3), np.uint8)

    def render(self, scene: mujoco.MjvScene) -> Frame:
        """One frame (height, width, 3) of the scene, from between its two (stereo) cameras."""
        camera = mujoco.mjv_averageCamera(*scene.camera)
        view = _view(camera, self._height, self._width)
        geoms = scene.geoms[: scene.ngeom]
        planes = [geom for geom in geoms if geom.type == _GEOM.mjGEOM_PLANE]
        solids = [geom for geom in geoms if geom.type != _GEOM.mjGEOM_PLANE]
        background = Image.fromarray(self._draw_backdrop(scene, view, planes))
        size = (self._width * _OVERSAMPLE, self._height * _OVERSAMPLE)
        image = background.resize(size, Image.Resampling.NEAREST)
        self._draw_solids(image, scene, view, solids)
        return np.asarray(image.reduce(_OVERSAMPLE))

    def _draw_backdrop(
        self, scene: mujoco.MjvScene, view: View, planes: list[mujoco.MjvGeom]
    ) -> Frame:
        """Sky and planes (height, width, 3), drawn anew only when one of them has moved."""
        parts = [view.position, view.axes, *(p.pos for p in planes), *(p.mat for p in planes)]
        key = b"".join(np.ascontiguousarray(part, np.float32).tobytes() for part in parts)
        if key != self._backdrop_key:
            self._backdrop = self._cast_backdrop(scene, view, planes)
            self._backdrop_key = key
        return self._backdrop

    def _cast_backdrop(
        self, scene: mujoco.MjvScene, view: View, planes: list[mujoco.MjvGeom]
    ) -> Frame:
        rays = _rays(view, self._height, self._width)
        # The sky's color changes with elevation; its lowest color is also the haze.
        slope = rays[..., 2] / np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-6)
        colors = _gradient(self._sky, 0.5 + 0.5 * np.clip(slope, -1.0, 1.0))
        nearest = np.full(rays.shape[:2], np.inf)
        haze = _gradient(self._sky, np.array(0.5))
        for plane in planes:
            rotation, position = plane.mat, plane.pos
            start = (view.position - position) @ rotation
            if start[2] <= 0.0:  # seen from below: a plane has one side
                continue
            down = rays @ rotation
            distance = start[2] / np.maximum(-down[..., 2], 1e-6)  # above the horizon: far away
            hit = start[:2] + distance[..., None] * down[..., :2]
            inside = (down[..., 2] < 0.0) & (distance < nearest)
            for axis in range(2):
                if plane.size[axis] > 0.0:  # zero means infinite
                    inside &= np.abs(hit[..., axis]) <= plane.size[axis]
            light = _shade(np.ones(4), plane, scene, view, position[None], rotation[None, :, 2])
            fade = np.clip(distance / _HORIZON, 0.0, 1.0)[..., None]
            tint = self._plane_colors(plane, hit) * (light[0, :3] / 255.0)
            tint = tint * (1.0 - fade) + haze * fade
            opacity = float(plane.rgba[3])
            blend = opacity * tint + (1.0 - opacity) * colors
            colors = np.where(inside[..., None], blend, colors)
            nearest = np.where(inside, distance, nearest)
        return (255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)

    def _plane_colors(self, plane: mujoco.MjvGeom, hit: Floats) -> Floats:
        """Colors (..., 3) at plane coordinates (..., 2): a checker if the texture is one."""
        color = plane.rgba[:3].astype(float)
        texture = _texture_id(self._model, plane.matid)
        if texture < 0:
            return np.broadcast_to(color, (*hit.shape[:-1], 3))
        pixels = _texture(self._model, texture)
        rows, columns = pixels.shape[0] // 4, pixels.shape[1] // 4
        pair = np.stack([pixels[rows, columns], pixels[rows, 3 * columns]])
        repeat = self._model.mat_texrepeat[plane.matid]  # cells per metre: OpenGL's look
        if not self._model.mat_texuniform[plane.matid]:  # repeats per plane, not per metre
            repeat = repeat / np.maximum(plane.size[:2], 1e-6)
        cell = np.floor(hit * repeat).astype(np.int64).sum(axis=-1) % 2
        return pair[cell] * color

    def _draw_solids(
        self,
        image: Image.Image,
        scene: mujoco.MjvScene,
        view: View,
        geoms: list[mujoco.MjvGeom],
    ) -> None:
        """Fills the front faces of all geoms on the oversampled image, far ones first."""
        depths: list[Floats] = []
        outlines: list[Floats] = []
        colors: list[Floats] = []
        for geom in geoms:
            mesh = self._mesh(geom)
            if mesh is None or geom.rgba[3] == 0.0:
                continue
            vertices = mesh.vertices @ geom.mat.T.astype(float) + geom.pos
            corners = vertices[mesh.faces]  # (F, 3 or 4, 3)
            middles = corners.mean(axis=1)
            normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            camera = view.to_camera(corners)
            depth = -camera[..., 2]
            facing = np.sum((view.position - middles) * normals, axis=1) > 0.0
            shown = facing & np.all(depth > view.near, axis=1)
            depths.append(depth[shown].mean(axis=1))
            outlines.extend(view.to_pixels(camera[shown]) * _OVERSAMPLE)
            colors.append(
                _shade(color(self._model, geom), geom, scene, view, middles, normals)[shown]
            )
        if not outlines:
            return
        fills = np.concatenate(colors)
        draw = ImageDraw.Draw(image, "RGBA" if np.any(fills[:, 3] < 255) else None)
        for index in np.argsort(-np.concatenate(depths), kind="stable"):
            fill = tuple(fills[index].tolist())
            draw.polygon(outlines[index].ravel().tolist(), fill=fill if fill[3] < 255 else fill[:3])

    def _mesh(self, geom: mujoco.MjvGeom) -> Mesh | None:
        """The geom's surface in its own frame, or None for what this painter cannot draw."""
        if geom.type == _GEOM.mjGEOM_MESH:
            index = mesh_of(geom)
            if index not in self._meshes:
                self._meshes[index] = _drawable(model_mesh(self._model, index))
            return self._meshes[index]
        return primitive(self._model, geom)


def color(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Floats:
    """The geom's rgba (4,), times the mean color of its texture if it has one."""
    rgba = np.array(geom.rgba, float)
    texture = _texture_id(model, geom.matid)
    if texture >= 0:
        rgba[:3] *= _texture(model, texture).mean(axis=(0, 1))
    return rgba


def mesh_of(geom: mujoco.MjvGeom) -> int:
    """Which of the model's meshes a geom of a scene shows."""
    return int(geom.dataid) // 2  # MuJoCo stores 2 * mesh, or 2 * mesh + 1 for its hull


def primitive(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Mesh | None:
    """The surface of a geom that is given by its size, in its own frame; None for others."""
    x, y, z = (float(value) for value in geom.size)
    if geom.type in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
        return _scaled(_capsule(0.0), (x, y, z))
    if geom.type == _GEOM.mjGEOM_CAPSULE:
        return _scaled(_capsule(round(z / x, 6)), (x, x, x))
    if geom.type == _GEOM.mjGEOM_CYLINDER:
        return _scaled(_prism(24), (x, y, z))
    if geom.type in (_GEOM.mjGEOM_LINE, _GEOM.mjGEOM_ARROW, _GEOM.mjGEOM_ARROW1):
        # MuJoCo's connectors run from their position along z, over the length in size[2]; the
        # width of lines is in pixels.
        line = geom.type == _GEOM.mjGEOM_LINE
        half = 1e-3 * model.stat.extent * x if line else max(x, 1e-3)
        return _shifted(_scaled(_prism(8), (half, half, z / 2.0)), z / 2.0)
    if geom.type == _GEOM.mjGEOM_BOX:
        return _scaled(_box(), (x, y, z))
    return None


def _view(camera: mujoco.MjvGLCamera, height: int, width: int) -> View:
    forward = np.array(camera.forward, float)
    up = np.array(camera.up, float)
    axes = np.stack([np.cross(forward, up), up, -forward])
    top, bottom, near = camera.frustum_top, camera.frustum_bottom, camera.frustum_near
    focal = height * near / (top - bottom)
    center = (width / 2.0 - 0.5, height * top / (top - bottom) - 0.5)
    return View(np.array(camera.pos, float), axes, focal, center, near)


def _rays(view: View, height: int, width: int) -> Floats:
    """World directions (height, width, 3) through the pixels, of unit depth."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    right = (columns - view.center[0]) / view.focal
    up = -(rows - view.center[1]) / view.focal
    return np.stack([right, up, -np.ones_like(right)], axis=-1) @ view.axes


def _gradient(colors: Floats, position: Floats) -> Floats:
    """Colors (N, 3), spread over [0, 1], at positions (...): (..., 3)."""
    knots = np.linspace(0.0, 1.0, len(colors))
    return np.stack([np.interp(position, knots, colors[:, i]) for i in range(3)], axis=-1)


def _texture(model: mujoco.MjModel, index: int) -> Floats:
    """The texture's pixels (rows, columns, 3) in [0, 1]."""
    rows, columns = int(model.tex_height[index]), int(model.tex_width[index])
    channels = int(model.tex_nchannel[index])
    start = int(model.tex_adr[index])
    data = model.tex_data[start : start + rows * columns * channels]
    pixels = data.reshape(rows, columns, channels)[..., :3].astype(float) / 255.0
    return np.broadcast_to(pixels, (rows, columns, 3))


def _texture_id(model: mujoco.MjModel, material: int) -> int:
    """The color texture of a material, -1 if there is none."""
    if material < 0:
        return -1
    return int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])


def _sky_colors(model: mujoco.MjModel) -> Floats:
    """Sky colors (N, 3) from low to high: a column of the skybox's front face, if there is one."""
    for index in range(model.ntex):
        if model.tex_type[index] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            pixels = _texture(model, index)
            side = pixels.shape[1]
            front = pixels[4 * side : 5 * side] if pixels.shape[0] == 6 * side else pixels
            return front[:: max(1, len(front) // 32), side // 2][::-1]
    return _NEUTRAL_SKY


def _shade(
    rgba: Floats,
    geom: mujoco.MjvGeom,
    scene: mujoco.MjvScene,
    view: View,
    middles: Floats,
    normals: Floats,
) -> npt.NDArray[np.int64]:
    """Colors (F, 4) in 0..255 of faces at middles (F, 3) with normals (F, 3)."""
    light_sum = np.full((len(normals), 3), float(geom.emission))
    shine = np.zeros((len(normals), 3))
    to_eye = _unit(view.position - middles)
    for light in scene.lights[: scene.nlight]:
        if light.type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
            to_light = -_unit(np.array(light.dir, float))[None, :]
        else:
            to_light = _unit(np.array(light.pos, float) - middles)
        cosine = np.clip(np.sum(normals * to_light, axis=1), 0.0, 1.0)[:, None]
        light_sum += np.array(light.ambient) + cosine * np.array(light.diffuse)
        half = np.clip(np.sum(normals * _unit(to_light + to_eye), axis=1), 0.0, 1.0)[:, None]
        shine += half ** (1.0 + 60.0 * geom.shininess) * geom.specular * np.array(light.specular)
    color = np.clip(rgba[:3] * light_sum + shine, 0.0, 1.0)
    alpha = np.full((len(normals), 1), rgba[3])
    return np.rint(255.0 * np.concatenate([color, alpha], axis=1)).astype(np.int64)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _scaled(mesh: Mesh, scale: tuple[float, float, float]) -> Mesh:
    return Mesh(mesh.vertices * scale, mesh.faces)


def _shifted(mesh: Mesh, height: float) -> Mesh:
    return Mesh(mesh.vertices + np.array([0.0, 0.0, height]), mesh.faces)


@lru_cache(maxsize=256)
def _capsule(half_length: float) -> Mesh:
    """A capsule of radius 1 along z; a sphere if its half length is zero."""
    sides = 24 if half_length > 0.0 else 36  # balls are larger, their facets easier to see
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, sides // 2 + 1)
    if half_length > 0.0:  # the equator twice: the cylinder lies between
        latitude = np.sort(np.append(latitude, 0.0))
    lift = np.where(np.arange(len(latitude)) < len(latitude) / 2.0, -half_length, half_length)
    return _revolved(np.cos(latitude), np.sin(latitude) + lift, sides)


@lru_cache(maxsize=8)
def _prism(sides: int) -> Mesh:
    """A cylinder of radius 1 and half length 1 along z."""
    return _revolved(np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0]), sides)


def _revolved(radii: Floats, heights: Floats, sides: int) -> Mesh:
    """The surface of a profile (P,) turned about z."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    x, y = np.outer(radii, np.cos(angle)), np.outer(radii, np.sin(angle))
    z = np.broadcast_to(heights[:, None], x.shape)
    ring, side = np.meshgrid(np.arange(len(radii) - 1), np.arange(sides), indexing="ij")
    following = (side + 1) % sides
    low, high = ring * sides, (ring + 1) * sides
    faces = np.stack([low + side, low + following, high + following, high + side], axis=-1)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces.reshape(-1, 4))


@lru_cache(maxsize=1)
def _box() -> Mesh:
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
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def model_mesh(model: mujoco.MjModel, index: int) -> Mesh:
    """A mesh of the model."""
    start, count = int(model.mesh_vertadr[index]), int(model.mesh_vertnum[index])
    vertices = model.mesh_vert[start : start + count].astype(float)
    start, count = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    return Mesh(vertices, model.mesh_face[start : start + count].astype(np.int64))


def _drawable(mesh: Mesh) -> Mesh:
    """The mesh, or its convex hull if it has too many faces to draw in time."""
    if len(mesh.faces) <= _MAX_MESH_FACES:
        return mesh
    vertices = mesh.vertices
    from scipy.spatial import ConvexHull  # slow to import, and seldom needed

    hull = ConvexHull(vertices)
    faces = hull.simplices.astype(np.int64)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.sum(normals * hull.equations[:, :3], axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices, faces)
