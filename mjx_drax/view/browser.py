"""A replay in the browser: one HTML file with everything in it, which opens from disk.

viser records the scene: bodies are frames that move from knot to knot, their geoms are meshes that
hang on them. The viewer that comes with the recording has a bar to scrub along time, and a scene
tree, in which these parts are shown and hidden:

    world    what does not move
    replay   the best chain, as its engine replayed it
    plan     the plan at the same time, in blue; hidden at first where the replay keeps to it
    ghosts   some knots of the plan at once, translucent
    path     of the geom that travels farthest, in the replay

Tendons, skins and flexible bodies are left out; textures become their mean colour.
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
from mjx_drax.base.files import complete, require
from mjx_drax.physics._mujoco import mujoco
from mjx_drax.physics.states import finite, set_state
from mjx_drax.solution.solution import OPEN_LOOP, TRACKED, Solution
from mjx_drax.view.painter import Mesh, color, mesh_of, model_mesh, primitive

if TYPE_CHECKING:
    import viser

    from mjx_drax.problem.problem import Problem

Floats = npt.NDArray[np.floating[Any]]

GHOSTS = 8
"""So many knots of the plan are shown at once."""

_GHOST_OPACITY, _PLAN_OPACITY = 0.15, 0.5
_PLAN_SCALE = 1.03  # a shell around the replay, where the two coincide
_PLAN_COLOR = np.array([0.12, 0.44, 0.70])
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
    if not hasattr(problem.dynamics, "mj_model"):
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
        ghosts: number of knots of the plan that are shown at once, translucent.

    Raises:
        DraxError: viser is not installed, the problem has no model, a number of ghosts below 0, or
            a path that cannot be written.
    """
    require_viewer(solution.problem)
    require_whole("ghosts", ghosts, 0)
    with complete(path, (".html", ".htm")) as partial:
        partial.write_text(_page(solution, _recorded(solution, int(ghosts))), encoding="utf-8")
    return Path(path).expanduser()


def _page(solution: Solution, recording: str) -> str:
    """The recording with a title and a few lines about the solution."""
    chain, mode = solution.best_chain, solution.replay_mode
    lines = [
        solution.problem.name,
        f"cost {solution.cost[chain]:.4g}, max|h| {solution.max_defect[chain]:.1g}",
        f"{solution.engine}, {mode}:",
        solution.outcome(mode),
        "plan, ghosts and path: see the scene tree, below at the right",
    ]
    if not solution.certified:
        lines.insert(1, "NOT CERTIFIED")
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
    model = solution.problem.dynamics.mj_model  # type: ignore[attr-defined]
    states = solution.replayed[0]
    plan = np.asarray(solution.problem.with_start(solution.best), float)
    replayed, planned = _motion(model, states), _motion(model, plan)
    certificate = solution.certificate
    follows = certificate.open_loop if solution.replay_mode == OPEN_LOOP else certificate.feedback
    with _server() as server:
        scene = server.scene
        shapes = _shapes(model, states[: len(replayed[0])], server)
        _add_world(scene, shapes, model)
        frames = _add_robot(scene, "replay", shapes, replayed, None)
        frames += _add_robot(scene, "plan", shapes, planned, _PLAN_COLOR)
        scene.add_frame("/plan", show_axes=False, visible=not follows["max_deviation"] < TRACKED)
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
    """Where the bodies are, for states (K+1, nx) up to the first that is not finite."""
    data = mujoco.MjData(model)
    states = finite(states)
    count = len(states)
    positions, turns = np.empty((count, model.nbody, 3)), np.empty((count, model.nbody, 4))
    for k, x in enumerate(states):
        set_state(model, data, x)
        mujoco.mj_kinematics(model, data)
        positions[k], turns[k] = data.xpos, data.xquat
    return positions, turns


@dataclass(frozen=True)
class _Shape:
    """A visible geom or site: its body, pose in the frame of that body, surface and colour.

    `mesh` is None for planes, whose half sides are `size`; a half side of 0 has no end. Surfaces
    that may be open are drawn from both sides.
    """

    label: str
    body: int
    moves: bool
    position: Floats
    wxyz: Floats
    mesh: Mesh | None
    size: Floats
    smooth: bool
    closed: bool
    rgba: Floats


def _shapes(model: mujoco.MjModel, states: Floats, server: viser.ViserServer) -> list[_Shape]:
    """What MuJoCo's viewer shows of the model; points the camera as films do."""
    from mjx_drax.view import rendering

    data = mujoco.MjData(model)
    set_state(model, data, states[0])
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, maxgeom=10_000)
    view = rendering.view_of(model, states[:, : model.nq], None, 16 / 9)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, everything, scene)
    _point_camera(server, scene, model)
    found: list[_Shape] = []
    for geom in scene.geoms[: scene.ngeom]:
        mesh = _surface(model, geom)
        bodies = {
            int(_OBJECT.mjOBJ_GEOM): model.geom_bodyid,
            int(_OBJECT.mjOBJ_SITE): model.site_bodyid,
        }
        if geom.objtype not in bodies or (mesh is None and geom.type != _GEOM.mjGEOM_PLANE):
            continue
        body = int(bodies[geom.objtype][geom.objid])
        turn = data.xmat[body].reshape(3, 3)
        wxyz = np.empty(4)
        mujoco.mju_mat2Quat(wxyz, np.ravel(turn.T @ geom.mat.astype(float)))
        found.append(
            _Shape(
                label=f"{len(found)}",
                body=body,
                moves=model.body_weldid[body] != 0,
                position=turn.T @ (geom.pos - data.xpos[body]),
                wxyz=wxyz,
                mesh=mesh,
                size=np.array(geom.size, float),
                smooth=geom.type in _SMOOTH,
                closed=geom.type not in (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_HFIELD),
                rgba=color(model, geom),
            )
        )
    return [shape for shape in found if shape.rgba[3] > 0.0]


def _surface(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Mesh | None:
    """The geom's surface in its own frame, or None."""
    if geom.type == _GEOM.mjGEOM_MESH:
        return model_mesh(model, mesh_of(geom))
    if geom.type == _GEOM.mjGEOM_HFIELD:
        return _terrain(model, int(geom.dataid))
    return primitive(model, geom)


def _terrain(model: mujoco.MjModel, index: int) -> Mesh:
    """The upper side of a height field."""
    rows, columns = int(model.hfield_nrow[index]), int(model.hfield_ncol[index])
    start = int(model.hfield_adr[index])
    x_half, y_half, height, _ = model.hfield_size[index]
    heights = height * model.hfield_data[start : start + rows * columns].astype(float)
    x, y = np.meshgrid(np.linspace(-x_half, x_half, columns), np.linspace(-y_half, y_half, rows))
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    corner = (row * columns + column).ravel()
    faces = np.stack([corner, corner + 1, corner + columns + 1, corner + columns], axis=-1)
    return Mesh(np.stack([x.ravel(), y.ravel(), heights], axis=-1), faces)


def _point_camera(server: viser.ViserServer, scene: mujoco.MjvScene, model: mujoco.MjModel) -> None:
    camera = mujoco.mjv_averageCamera(*scene.camera)
    position, forward = np.array(camera.pos, float), np.array(camera.forward, float)
    distance = max(float((model.stat.center - position) @ forward), 0.1 * model.stat.extent)
    start = server.initial_camera
    start.position, start.look_at = position, position + distance * forward
    start.fov = 2.0 * float(np.arctan(camera.frustum_top / camera.frustum_near))


def _add_world(scene: viser.SceneApi, shapes: list[_Shape], model: mujoco.MjModel) -> None:
    extent = float(model.stat.extent)
    for shape in shapes:
        if not shape.moves:
            _add_shape(scene, f"/world/{shape.label}", shape, extent)


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
    if shape.mesh is None:
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
    vertices, faces = _triangles(shape.mesh)
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
        if not shape.moves or shape.mesh is None or not len(knots):
            continue
        positions, turns = _placed(shape, (plan[0][knots], plan[1][knots]))
        vertices, faces = _triangles(shape.mesh)
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


def _triangles(mesh: Mesh) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices (V, 3) and faces (F, 3), quadrangles cut in two."""
    faces = mesh.faces
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return mesh.vertices.astype(np.float32), faces.astype(np.uint32)


def _bytes(rgb: Floats) -> tuple[int, int, int]:
    red, green, blue = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(int).tolist()
    return red, green, blue
