"""Draws a MuJoCo scene with numpy and Pillow alone, for machines without OpenGL.

MuJoCo fills an `MjvScene` without OpenGL. This module draws what is in it:

- sky and planes: one ray for each pixel, cast again only when the camera or a plane has moved;
- other geoms: their front faces, each in one color (Lambert's law plus a highlight), are sorted by
  depth and filled, the far ones first (the painter's algorithm).

There are no shadows, reflections, labels, height fields, skins or flexible bodies. A point p (3,)
in camera coordinates has depth -p_z: x points right, y up, and the camera looks along -z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from mjx_drax.physics.engine import mujoco
from mjx_drax.view.frames import Frame
from mjx_drax.view.geoms import (
    Floats,
    Surface,
    mean_color,
    mesh_index,
    surface_of,
    texture,
    texture_index,
)

_GEOM = mujoco.mjtGeom
_OVERSAMPLE = 2  # faces are filled at twice the size and averaged: smooth edges
_HORIZON = 50.0  # [m] floors fade into the haze by this distance
_MAX_MESH_FACES = 600  # a mesh with more faces is drawn as its convex hull
_NEUTRAL_SKY = np.array([[0.30, 0.36, 0.44], [0.74, 0.78, 0.82]])


@dataclass(frozen=True)
class Pinhole:
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


class SoftwareRenderer:
    """Draws scenes of one model at one frame size."""

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        self._model, self._height, self._width = model, height, width
        self._sky = _sky_colors(model)
        self._meshes: dict[int, Surface] = {}
        self._backdrop_key = b""
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
        self, scene: mujoco.MjvScene, view: Pinhole, planes: list[mujoco.MjvGeom]
    ) -> Frame:
        """Sky and planes (height, width, 3), drawn anew only when one of them has moved."""
        parts = [view.position, view.axes, *(p.pos for p in planes), *(p.mat for p in planes)]
        key = b"".join(np.ascontiguousarray(part, np.float32).tobytes() for part in parts)
        if key != self._backdrop_key:
            self._backdrop = self._cast_backdrop(scene, view, planes)
            self._backdrop_key = key
        return self._backdrop

    def _cast_backdrop(
        self, scene: mujoco.MjvScene, view: Pinhole, planes: list[mujoco.MjvGeom]
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
        index = texture_index(self._model, plane.matid)
        if index < 0:
            return np.broadcast_to(color, (*hit.shape[:-1], 3))
        pixels = texture(self._model, index)
        rows, columns = pixels.shape[0] // 4, pixels.shape[1] // 4
        pair = np.stack([pixels[rows, columns], pixels[rows, 3 * columns]])
        repeat = self._model.mat_texrepeat[plane.matid]  # cells per metre, as OpenGL draws them
        if not self._model.mat_texuniform[plane.matid]:  # repeats per plane, not per metre
            repeat = repeat / np.maximum(plane.size[:2], 1e-6)
        cell = np.floor(hit * repeat).astype(np.int64).sum(axis=-1) % 2
        return pair[cell] * color

    def _draw_solids(
        self,
        image: Image.Image,
        scene: mujoco.MjvScene,
        view: Pinhole,
        geoms: list[mujoco.MjvGeom],
    ) -> None:
        """Fills the front faces of all geoms on the oversampled image, far ones first."""
        depths: list[Floats] = []
        outlines: list[Floats] = []
        colors: list[Floats] = []
        for geom in geoms:
            surface = self._surface(geom)
            if surface is None or geom.rgba[3] == 0.0:
                continue
            vertices = surface.vertices @ geom.mat.T.astype(float) + geom.pos
            corners = vertices[surface.faces]  # (F, 3 or 4, 3)
            middles = corners.mean(axis=1)
            normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            camera = view.to_camera(corners)
            depth = -camera[..., 2]
            facing = np.sum((view.position - middles) * normals, axis=1) > 0.0
            shown = facing & np.all(depth > view.near, axis=1)
            depths.append(depth[shown].mean(axis=1))
            outlines.extend(view.to_pixels(camera[shown]) * _OVERSAMPLE)
            rgba = mean_color(self._model, geom)
            colors.append(_shade(rgba, geom, scene, view, middles, normals)[shown])
        if not outlines:
            return
        fills = np.concatenate(colors)
        draw = ImageDraw.Draw(image, "RGBA" if np.any(fills[:, 3] < 255) else None)
        for index in np.argsort(-np.concatenate(depths), kind="stable"):
            fill = tuple(fills[index].tolist())
            draw.polygon(outlines[index].ravel().tolist(), fill=fill if fill[3] < 255 else fill[:3])

    def _surface(self, geom: mujoco.MjvGeom) -> Surface | None:
        """The geom's surface in its own frame; None for what is not drawn."""
        if geom.type == _GEOM.mjGEOM_HFIELD:
            return None
        if geom.type != _GEOM.mjGEOM_MESH:
            return surface_of(self._model, geom)
        index = mesh_index(geom)
        if index not in self._meshes:
            mesh = surface_of(self._model, geom)
            assert mesh is not None
            self._meshes[index] = _simplified(mesh)
        return self._meshes[index]


def _view(camera: mujoco.MjvGLCamera, height: int, width: int) -> Pinhole:
    forward = np.array(camera.forward, float)
    up = np.array(camera.up, float)
    axes = np.stack([np.cross(forward, up), up, -forward])
    top, bottom, near = camera.frustum_top, camera.frustum_bottom, camera.frustum_near
    focal = height * near / (top - bottom)
    center = (width / 2.0 - 0.5, height * top / (top - bottom) - 0.5)
    return Pinhole(np.array(camera.pos, float), axes, focal, center, near)


def _rays(view: Pinhole, height: int, width: int) -> Floats:
    """World directions (height, width, 3) through the pixels, of unit depth."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    right = (columns - view.center[0]) / view.focal
    up = -(rows - view.center[1]) / view.focal
    return np.stack([right, up, -np.ones_like(right)], axis=-1) @ view.axes


def _gradient(colors: Floats, position: Floats) -> Floats:
    """Colors (N, 3), spread over [0, 1], at positions (...): (..., 3)."""
    knots = np.linspace(0.0, 1.0, len(colors))
    return np.stack([np.interp(position, knots, colors[:, i]) for i in range(3)], axis=-1)


def _sky_colors(model: mujoco.MjModel) -> Floats:
    """Sky colors (N, 3) from low to high: a column of the skybox's front face, if there is one."""
    for index in range(model.ntex):
        if model.tex_type[index] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            pixels = texture(model, index)
            side = pixels.shape[1]
            front = pixels[4 * side : 5 * side] if pixels.shape[0] == 6 * side else pixels
            return front[:: max(1, len(front) // 32), side // 2][::-1]
    return _NEUTRAL_SKY


def _shade(
    rgba: Floats,
    geom: mujoco.MjvGeom,
    scene: mujoco.MjvScene,
    view: Pinhole,
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


def _simplified(mesh: Surface) -> Surface:
    """The mesh, or its convex hull if it has too many faces to draw in time."""
    if len(mesh.faces) <= _MAX_MESH_FACES:
        return mesh
    from scipy.spatial import ConvexHull  # slow to import, and seldom needed

    hull = ConvexHull(mesh.vertices)
    faces = hull.simplices.astype(np.int64)
    corners = mesh.vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.sum(normals * hull.equations[:, :3], axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Surface(mesh.vertices, faces)
