"""A replay in the browser: one HTML file with everything in it, which opens from disk.

viser records the scene: bodies are frames that move from knot to knot, and their geoms are meshes
in these frames. The page has a bar to move along time, and a scene tree, in which these parts are
shown and hidden:

    world    what does not move
    replay   the best chain, as its engine replayed it
    plan     the plan at the same time, in blue; hidden at first where the replay keeps to it
    ghosts   some knots of the plan at once, translucent
    path     of the geom that travels farthest, in the replay

Tendons, skins and flexible bodies are left out; textures become their mean color.
"""

from __future__ import annotations

import contextlib
import html
import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, require_whole
from mjx_drax.base.files import complete, file_path, require
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.states import finite
from mjx_drax.solution.replay import OPEN_LOOP
from mjx_drax.solution.solution import Solution
from mjx_drax.view.geoms import Floats, Surface, mean_color, surface_of
from mjx_drax.view.scene import Scene, camera_for, posed
from mjx_drax.view.video import outcome_lines

if TYPE_CHECKING:
    import viser

    from mjx_drax.problem.problem import Problem

GHOSTS = 8
"""So many knots of the plan are shown at once."""

_GHOST_OPACITY, _PLAN_OPACITY = 0.15, 0.5
_PLAN_SCALE = 1.03  # a shell around the replay, where the two coincide
_PLAN_COLOR = np.array([0.12, 0.44, 0.70])
_ALIKE = 1e-2  # a plan from which the replay deviates by less is hidden at first
_PATH_COLOR = (217, 84, 30)
_GEOM, _OBJECT = mujoco.mjtGeom, mujoco.mjtObj
_SMOOTH = (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_ELLIPSOID)
_FLOOR = 20.0  # half side of a floor without end, in extents of the model

_BANNER = """\
<title>{name}</title>
<style>
#drax {{ position: fixed; left: 12px; bottom: 54px; z-index: 10; pointer-events: none;
  padding: 8px 12px; border-radius: 6px; color: #f0f3f7; background: {background};
  font: 13px/1.5 system-ui, sans-serif; white-space: pre }}
</style>"""


def require_viewer(problem: Problem) -> None:
    """Complain about what `save_html` could not show; call it before a long computation.

    Raises:
        DraxError: viser is missing, or the problem has no model.
    """
    if mujoco_model(problem.dynamics) is None:
        raise DraxError(
            f"{problem.name} has no MuJoCo model to show in a browser, its dynamics are a "
            "function: see plot.png, or video.mp4 of tasks that draw themselves."
        )
    require("viser", "html", "a replay in the browser")


def save_html(solution: Solution, path: str | os.PathLike[str], ghosts: int = GHOSTS) -> Path:
    """Write the best chain's replay as one HTML file that any browser opens; returns its path.

    A replay that turns non-finite is shown up to there.

    Args:
        solution: from `solve`, of a problem from MJCF.
        path: where to, ending in .html.
        ghosts: number of knots of the plan that are shown at once, as translucent robots.

    Raises:
        DraxError: viser is not installed, the problem has no model, a number of ghosts below 0, or
            a path that cannot be written.
    """
    require_viewer(solution.problem)
    require_whole("ghosts", ghosts, 0)
    with complete(path, (".html", ".htm")) as partial:
        partial.write_text(_page(solution, _recorded(solution, int(ghosts))), encoding="utf-8")
    return file_path(path)


def _page(solution: Solution, recording: str) -> str:
    """The recording with a title and a few lines about the solution."""
    *lines, _ = outcome_lines(solution)  # without the time
    lines.append("plan, ghosts and path: see the scene tree, below at the right")
    head = _BANNER.format(
        name=html.escape(f"{solution.problem.name}, replayed"),
        background="#0e1219d0" if solution.certified else "#961414e0",
    )
    text = html.escape("\n".join(lines))
    before, after = recording.replace("<title>Viser</title>", "", 1).split("</head>", 1)
    start, end = after.rsplit("</body>", 1)
    return f'{before}{head}</head>{start}<div id="drax">{text}</div></body>{end}'


@contextlib.contextmanager
def _server() -> Iterator[viser.ViserServer]:
    """viser's server, for its scene alone; nobody connects, and what it says is dropped."""
    import viser

    with contextlib.redirect_stdout(io.StringIO()):
        try:
            server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        except OSError as error:
            raise DraxError(
                f"viser could not open a port of this machine to record a scene: {error}"
            ) from error
        try:
            yield server
        finally:
            server.stop()


def _recorded(solution: Solution, ghosts: int) -> str:
    """The scene at all knots as viser's HTML."""
    model = mujoco_model(solution.problem.dynamics)
    assert model is not None  # as checked
    states = finite(solution.replayed[0])
    plan = solution.plans[solution.best_chain].astype(float)
    replayed, planned = _motion(model, states), _motion(model, finite(plan))
    certificate = solution.certificate
    follows = certificate.open_loop if solution.replay_mode == OPEN_LOOP else certificate.feedback
    with _server() as server:
        scene = server.scene
        shapes = _shapes(model, states[:, : model.nq], server)
        for shape in shapes:
            if not shape.moves:
                _add_shape(scene, f"/world/{shape.label}", shape, float(model.stat.extent))
        frames = _add_robot(scene, "replay", shapes, replayed, None)
        frames += _add_robot(scene, "plan", shapes, planned, _PLAN_COLOR)
        scene.add_frame("/plan", show_axes=False, visible=not follows["max_deviation"] < _ALIKE)
        _add_ghosts(scene, shapes, planned, ghosts)
        _add_path(scene, shapes, replayed)
        recorder = server.get_scene_serializer()
        for k in range(1, len(replayed[0])):
            recorder.insert_sleep(float(solution.problem.dynamics.dt))
            for frame, (positions, turns), body in frames:
                at = min(k, len(positions) - 1)
                frame.position, frame.wxyz = positions[at, body], turns[at, body]
        recorder.insert_sleep(float(solution.problem.dynamics.dt))
        return recorder.as_html()


Motion = tuple[Floats, Floats]
"""Positions (T, nbody, 3) and orientations (T, nbody, 4) of all bodies."""


def _motion(model: mujoco.MjModel, states: Floats) -> Motion:
    """Where the bodies are in states (T, nx)."""
    poses = [(d.xpos.copy(), d.xquat.copy()) for d in posed(model, states[:, : model.nq])]
    positions, turns = zip(*poses, strict=True)
    return np.array(positions), np.array(turns)


@dataclass(frozen=True)
class _Shape:
    """A visible geom or site: its body, pose in the frame of that body, surface and color.

    `surface` is None for planes, whose half sides are `size`; a half side of 0 has no end. Surfaces
    that may be open are drawn from both sides.
    """

    label: str
    body: int
    moves: bool
    position: Floats
    wxyz: Floats
    surface: Surface | None
    size: Floats
    smooth: bool
    closed: bool
    rgba: Floats


def _shapes(model: mujoco.MjModel, qpos: Floats, server: viser.ViserServer) -> list[_Shape]:
    """What MuJoCo's viewer shows of the model; the page's camera is that of videos."""
    drawn = Scene(model, camera_for(model, qpos, None, 16 / 9))
    drawn.begin(qpos[0])
    _point_camera(server, drawn.content, model)
    bodies = {
        int(_OBJECT.mjOBJ_GEOM): model.geom_bodyid,
        int(_OBJECT.mjOBJ_SITE): model.site_bodyid,
    }
    found: list[_Shape] = []
    for geom in drawn.content.geoms[: drawn.content.ngeom]:
        surface, rgba = surface_of(model, geom), mean_color(model, geom)
        known = surface is not None or geom.type == _GEOM.mjGEOM_PLANE
        if not known or geom.objtype not in bodies or rgba[3] == 0.0:
            continue
        body = int(bodies[geom.objtype][geom.objid])
        turn = drawn.data.xmat[body].reshape(3, 3)
        wxyz = np.empty(4)
        mujoco.mju_mat2Quat(wxyz, np.ravel(turn.T @ geom.mat.astype(float)))
        shape = _Shape(
            label=f"{len(found)}",
            body=body,
            moves=model.body_weldid[body] != 0,
            position=turn.T @ (geom.pos - drawn.data.xpos[body]),
            wxyz=wxyz,
            surface=surface,
            size=np.array(geom.size, float),
            smooth=geom.type in _SMOOTH,
            closed=geom.type not in (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_HFIELD),
            rgba=rgba,
        )
        found.append(shape)
    return found


def _point_camera(server: viser.ViserServer, scene: mujoco.MjvScene, model: mujoco.MjModel) -> None:
    camera = mujoco.mjv_averageCamera(*scene.camera)
    position, forward = np.array(camera.pos, float), np.array(camera.forward, float)
    distance = max(float((model.stat.center - position) @ forward), 0.1 * model.stat.extent)
    start = server.initial_camera
    start.position, start.look_at = position, position + distance * forward
    start.fov = 2.0 * float(np.arctan(camera.frustum_top / camera.frustum_near))


def _add_robot(
    scene: viser.SceneApi,
    part: str,
    shapes: list[_Shape],
    motion: Motion,
    tint: Floats | None,
) -> list[tuple[Any, Motion, int]]:
    """A copy of all that moves; its frames, with the motion they follow and their body."""
    frames = {}
    for shape in shapes:
        if not shape.moves:
            continue
        name, body = f"/{part}/{shape.body}", shape.body
        if body not in frames:
            position, wxyz = motion[0][0, body], motion[1][0, body]
            frame = scene.add_frame(name, show_axes=False, position=position, wxyz=wxyz)
            frames[body] = (frame, motion, body)
        _add_shape(scene, f"{name}/{shape.label}", shape, 1.0, tint)
    return list(frames.values())


def _add_shape(
    scene: viser.SceneApi, name: str, shape: _Shape, extent: float, tint: Floats | None = None
) -> None:
    rgb, opacity, scale = shape.rgba[:3], float(shape.rgba[3]), 1.0
    if tint is not None:
        rgb, opacity, scale = tint, opacity * _PLAN_OPACITY, _PLAN_SCALE
    if shape.surface is None:
        width, height = np.where(shape.size[:2] > 0.0, 2.0 * shape.size[:2], _FLOOR * extent)
        cell = float(10.0 ** np.round(np.log10(extent / 4.0)))
        scene.add_grid(
            name,
            plane="xy",
            width=float(width),
            height=float(height),
            cell_size=cell,
            section_size=5.0 * cell,
            plane_color=_bytes(rgb),
            cell_color=_bytes(0.85 * rgb),
            section_color=_bytes(0.75 * rgb),
            plane_opacity=opacity,
            position=shape.position,
            wxyz=shape.wxyz,
        )
        return
    vertices, faces = _triangles(shape.surface)
    scene.add_mesh_simple(
        name,
        vertices,
        faces,
        color=_bytes(rgb),
        opacity=None if opacity >= 1.0 else opacity,
        flat_shading=not shape.smooth,
        side="front" if shape.closed else "double",
        scale=scale,
        position=shape.position,
        wxyz=shape.wxyz,
    )


def _add_ghosts(scene: viser.SceneApi, shapes: list[_Shape], plan: Motion, count: int) -> None:
    """Some knots of the plan at once, evenly spread from x_0 to x_K: one batch for each geom."""
    knots = np.unique(np.linspace(0, len(plan[0]) - 1, count).round().astype(int))
    scene.add_frame("/ghosts", show_axes=False)
    for shape in shapes:
        if not shape.moves or shape.surface is None or not len(knots):
            continue
        positions, turns = _placed(shape, (plan[0][knots], plan[1][knots]))
        vertices, faces = _triangles(shape.surface)
        scene.add_batched_meshes_simple(
            f"/ghosts/{shape.label}",
            vertices,
            faces,
            turns,
            positions,
            batched_colors=_bytes(shape.rgba[:3]),
            opacity=_GHOST_OPACITY * float(shape.rgba[3]),
            flat_shading=not shape.smooth,
            cast_shadow=False,
        )


def _add_path(scene: viser.SceneApi, shapes: list[_Shape], motion: Motion) -> None:
    """The path of the geom that travels farthest."""
    paths = [_placed(shape, motion)[0] for shape in shapes if shape.moves]
    if not paths or len(paths[0]) < 2:
        return
    path = max(paths, key=lambda p: float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()))
    segments = np.stack([path[:-1], path[1:]], axis=1)
    scene.add_line_segments("/path", segments, _PATH_COLOR, thickness=2.0, thickness_units="screen")


def _placed(shape: _Shape, motion: Motion) -> Motion:
    """Positions (T, 3) and orientations (T, 4) of a shape in the world."""
    bodies = motion[0][:, shape.body], motion[1][:, shape.body]
    positions, turns = np.empty((len(bodies[0]), 3)), np.empty((len(bodies[0]), 4))
    for k, (position, turn) in enumerate(zip(*bodies, strict=True)):
        mujoco.mju_mulPose(positions[k], turns[k], position, turn, shape.position, shape.wxyz)
    return positions, turns


def _triangles(surface: Surface) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices (V, 3) and faces (F, 3), quadrangles cut in two."""
    faces = surface.faces
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return surface.vertices.astype(np.float32), faces.astype(np.uint32)


def _bytes(rgb: Floats) -> tuple[int, int, int]:
    red, green, blue = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(int).tolist()
    return red, green, blue
