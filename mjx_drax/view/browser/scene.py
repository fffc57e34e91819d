"""A solution in viser's scene: what does not move, robots, poses, a path and contact forces.

Bodies are frames that move from knot to knot, and their geoms are meshes in these frames. Tendons,
skins and flexible bodies are left out; textures become their mean color.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import require
from mjx_drax.physics.c_engine.states import converged, finite, set_state
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.solution.replay import OPEN_LOOP
from mjx_drax.view.geoms import Floats, Surface, mean_color, surface_of
from mjx_drax.view.scene import FREE, Scene, camera_for, posed

if TYPE_CHECKING:
    import viser

    from mjx_drax.problem.problem import Problem
    from mjx_drax.solution.solution import Solution

_POSE_OPACITY, _PLAN_OPACITY = 0.15, 0.5
_PLAN_SCALE = 1.03  # a shell around the replay, where the two coincide
_PATH_COLOR = (217, 84, 30)
_GEOM, _OBJECT = mujoco.mjtGeom, mujoco.mjtObj
_SMOOTH = (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_ELLIPSOID)
_PLAN_COLOR = np.array([0.12, 0.44, 0.70])
_FORCE_COLOR = (217, 38, 25)
_ALIKE = 1e-2  # a plan from which the replay deviates by less is hidden at first
_WEIGHT = 0.3  # length of the arrow of a force as large as the model's weight, in extents
_FLOOR = 20.0  # half side of a floor without end, in extents of the model


def require_viewer(problem: Problem) -> None:
    """Complain where viser is missing, or a model to show; call it before a long computation."""
    if mujoco_model(problem.dynamics) is None:
        raise DraxError(
            f"{problem.name} has no MuJoCo model to show in a browser, its dynamics are a "
            "function: see plot.png, or video.mp4 of tasks that draw themselves."
        )
    require("viser", "view", "a replay in the browser")


@contextlib.contextmanager
def server_at(port: int = 0) -> Iterator[viser.ViserServer]:
    """viser's server on a free port of this machine, 0 for any; what it prints is dropped."""
    import viser

    with contextlib.redirect_stdout(io.StringIO()):
        try:
            server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
        except (OSError, OverflowError) as error:
            raise DraxError(f"viser could not open port {port} of this machine: {error}") from error
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class ReplayScene:
    """The best chain of a solution in viser's scene; `show` moves it to a knot.

    Attributes:
        times: of the knots that can be shown [s], (T,).
    """

    def __init__(self, server: viser.ViserServer, solution: Solution, poses: int) -> None:
        states, controls = solution.replayed
        model = mujoco_model(solution.problem.dynamics, states[0])
        assert model is not None  # as `require_viewer` checked
        states = finite(states)
        plan = solution.plans[solution.best_chain].astype(float)
        replayed, planned = motion_of(model, states), motion_of(model, finite(plan))
        certificate = solution.certificate
        open_loop = solution.replay_mode == OPEN_LOOP
        follows = certificate.open_loop if open_loop else certificate.feedback
        self.times = solution.times_of(solution.best_chain)[: len(states)]
        self._forces = _segments(model, contact_forces(model, states, controls))
        scene = server.scene
        shapes = shapes_of(model, states[:, : model.nq], server)
        add_world(scene, shapes, model)
        self.parts: dict[str, Any] = {
            name: scene.add_frame(f"/{name}", show_axes=False)
            for name in ("replay", "plan", "poses")
        }
        self.parts["plan"].visible = not follows["max_deviation"] < _ALIKE
        self._frames = add_robot(scene, "replay", shapes, replayed, None)
        self._frames += add_robot(scene, "plan", shapes, planned, _PLAN_COLOR)
        knots = np.unique(np.linspace(0, len(planned[0]) - 1, poses).round().astype(int))
        add_copies(scene, shapes, (planned[0][knots], planned[1][knots]), _POSE_OPACITY)
        self.parts["path"] = add_path(scene, shapes, replayed)
        width = 0.01 * float(model.stat.extent)
        if any(map(len, self._forces)):
            self.parts["forces"] = self._arrows = scene.add_arrows(
                "/forces",
                self._forces[0],
                _FORCE_COLOR,
                shaft_radius=width,
                head_radius=2.0 * width,
                head_length=4.0 * width,
            )

    def show(self, k: int) -> None:
        """Move everything to knot k."""
        for frame, (positions, turns), body in self._frames:
            at = min(k, len(positions) - 1)
            frame.position, frame.wxyz = positions[at, body], turns[at, body]
        if "forces" in self.parts:
            self._arrows.points = self._forces[k]


def contact_forces(
    model: mujoco.MjModel, states: Floats, controls: Floats
) -> list[list[tuple[Floats, Floats]]]:
    """For each state (T, nx), where contacts are [m] and their forces [N], (3,) each.

    The force is that on the second geom of the contact; on the first where the second is part of
    the world. The last state has the control of the one before.
    """
    model, size = converged(model), model.nq + model.nv + model.na
    data = mujoco.MjData(model)
    found, force = [], np.empty(6)
    for k, state in enumerate(states[:, :size]):
        set_state(model, data, state)
        data.ctrl[:] = controls[min(k, len(controls) - 1), : model.nu]
        mujoco.mj_forward(model, data)
        forces = []
        for i, contact in enumerate(data.contact[: data.ncon]):
            mujoco.mj_contactForce(model, data, i, force)
            world = model.body_weldid[model.geom_bodyid[contact.geom[1]]] == 0
            vector = contact.frame.reshape(3, 3).T @ force[:3]
            forces.append((contact.pos.copy(), -vector if world else vector))
        found.append(forces)
    return found


def _segments(
    model: mujoco.MjModel, forces: list[list[tuple[Floats, Floats]]]
) -> list[npt.NDArray[np.float32]]:
    """Starts and ends of arrows, (n, 2, 3) for each state."""
    weight = float(np.linalg.norm(model.opt.gravity)) * float(model.body_mass.sum())
    scale = _WEIGHT * float(model.stat.extent) / max(weight, 1e-9)
    return [
        np.array([[at, at + scale * force] for at, force in each], np.float32).reshape(-1, 2, 3)
        for each in forces
    ]


Motion = tuple[Floats, Floats]
"""Positions (T, nbody, 3) and orientations (T, nbody, 4) of all bodies."""


def motion_of(model: mujoco.MjModel, states: Floats) -> Motion:
    """Where the bodies are in states (T, nx)."""
    poses = [(d.xpos.copy(), d.xquat.copy()) for d in posed(model, states[:, : model.nq])]
    positions, turns = zip(*poses, strict=True)
    return np.array(positions), np.array(turns)


@dataclass(frozen=True)
class Shape:
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


def shapes_of(model: mujoco.MjModel, qpos: Floats, server: viser.ViserServer) -> list[Shape]:
    """What MuJoCo's viewer shows of the model; the page's camera sees the motion qpos (T, nq).

    One pose says nothing about the motion to come: then it is the camera "main", if there is one.
    """
    main = mujoco.mj_name2id(model, _OBJECT.mjOBJ_CAMERA, "main") >= 0
    wanted = "main" if main and len(qpos) == 1 else FREE
    drawn = Scene(model, camera_for(model, qpos, wanted, 16 / 9))
    drawn.begin(qpos[0])
    _point_camera(server, drawn.content, model)
    bodies = {
        int(_OBJECT.mjOBJ_GEOM): model.geom_bodyid,
        int(_OBJECT.mjOBJ_SITE): model.site_bodyid,
    }
    found: list[Shape] = []
    for geom in drawn.content.geoms[: drawn.content.ngeom]:
        surface, rgba = surface_of(model, geom), mean_color(model, geom)
        known = surface is not None or geom.type == _GEOM.mjGEOM_PLANE
        if not known or geom.objtype not in bodies or rgba[3] == 0.0:
            continue
        body = int(bodies[geom.objtype][geom.objid])
        turn = drawn.data.xmat[body].reshape(3, 3)
        wxyz = np.empty(4)
        mujoco.mju_mat2Quat(wxyz, np.ravel(turn.T @ geom.mat.astype(float)))
        shape = Shape(
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


def add_world(scene: viser.SceneApi, shapes: list[Shape], model: mujoco.MjModel) -> None:
    """All that does not move."""
    for shape in shapes:
        if not shape.moves:
            add_shape(scene, f"/world/{shape.label}", shape, float(model.stat.extent))


def add_robot(
    scene: viser.SceneApi,
    part: str,
    shapes: list[Shape],
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
        add_shape(scene, f"{name}/{shape.label}", shape, 1.0, tint)
    return list(frames.values())


def add_shape(
    scene: viser.SceneApi, name: str, shape: Shape, extent: float, tint: Floats | None = None
) -> None:
    """One shape; a floor without end is as large as so many extents [m] of the model."""
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
            plane_color=rgb_bytes(rgb),
            cell_color=rgb_bytes(0.85 * rgb),
            section_color=rgb_bytes(0.75 * rgb),
            plane_opacity=opacity,
            position=shape.position,
            wxyz=shape.wxyz,
        )
        return
    vertices, faces = triangles(shape.surface)
    scene.add_mesh_simple(
        name,
        vertices,
        faces,
        color=rgb_bytes(rgb),
        opacity=None if opacity >= 1.0 else opacity,
        flat_shading=not shape.smooth,
        side="front" if shape.closed else "double",
        scale=scale,
        position=shape.position,
        wxyz=shape.wxyz,
    )


@dataclass(frozen=True)
class Copies:
    """One shape of all copies of a robot, and viser's handle of them."""

    shape: Shape
    handle: Any

    def move(self, motion: Motion, colors: npt.NDArray[np.uint8]) -> None:
        """Put the copies where the bodies are in a motion (n, ...), in colors (n, 3)."""
        positions, turns = placed(self.shape, motion)
        self.handle.batched_positions = positions.astype(np.float32)
        self.handle.batched_wxyzs = turns.astype(np.float32)
        self.handle.batched_colors = colors


def add_copies(
    scene: viser.SceneApi, shapes: list[Shape], motion: Motion, opacity: float
) -> list[Copies]:
    """Robots at all knots of a motion at once: one batch for each geom."""
    copies = []
    for shape in shapes:
        if not shape.moves or shape.surface is None or not len(motion[0]):
            continue
        positions, turns = placed(shape, motion)
        vertices, faces = triangles(shape.surface)
        handle = scene.add_batched_meshes_simple(
            f"/poses/{shape.label}",
            vertices,
            faces,
            turns,
            positions,
            batched_colors=rgb_bytes(shape.rgba[:3]),
            opacity=opacity * float(shape.rgba[3]),
            flat_shading=not shape.smooth,
            cast_shadow=False,
        )
        copies.append(Copies(shape, handle))
    return copies


def add_path(scene: viser.SceneApi, shapes: list[Shape], motion: Motion) -> Any:
    """The path of the geom that travels farthest; returns viser's handle."""
    paths = [placed(shape, motion)[0] for shape in shapes if shape.moves]
    path = max(
        paths,
        key=lambda p: float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()),
        default=np.zeros((0, 3)),
    )
    segments = np.stack([path[:-1], path[1:]], axis=1)
    return scene.add_line_segments(
        "/path", segments, _PATH_COLOR, thickness=2.0, thickness_units="screen"
    )


def placed(shape: Shape, motion: Motion) -> Motion:
    """Positions (T, 3) and orientations (T, 4) of a shape in the world."""
    bodies = motion[0][:, shape.body], motion[1][:, shape.body]
    positions, turns = np.empty((len(bodies[0]), 3)), np.empty((len(bodies[0]), 4))
    for k, (position, turn) in enumerate(zip(*bodies, strict=True)):
        mujoco.mju_mulPose(positions[k], turns[k], position, turn, shape.position, shape.wxyz)
    return positions, turns


def triangles(surface: Surface) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices (V, 3) and faces (F, 3), quadrangles cut in two."""
    faces = surface.faces
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return surface.vertices.astype(np.float32), faces.astype(np.uint32)


def rgb_bytes(rgb: Floats) -> tuple[int, int, int]:
    """A color with parts from 0 to 255."""
    red, green, blue = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(int).tolist()
    return red, green, blue
