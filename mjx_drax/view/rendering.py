"""Films of solutions and motions without a display.

Models are drawn with OpenGL through EGL or OSMesa, else by the numpy painter; problems without a
model by a function that the task brings, on matplotlib axes.

Importing this module touches neither OpenGL nor the environment. The first frame ever drawn
decides how frames are drawn from then on: EGL (hardware, or Mesa's llvmpipe), then OSMesa, then
`mjx_drax.painter` with one warning that names the missing packages. `MUJOCO_GL=egl` or `osmesa`
restricts the choice to that one, `MUJOCO_GL=off` to the painter.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import platform
import sys
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, require_positive, shown
from mjx_drax.physics._mujoco import APT_EGL, mujoco
from mjx_drax.physics.states import finite, interpolated
from mjx_drax.view import video as movie
from mjx_drax.view.video import Frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mjx_drax.problem.problem import Problem
    from mjx_drax.solution.solution import Solution

Floats = npt.NDArray[np.floating[Any]]

FREE = "free"
"""The camera that frames the whole motion by itself."""

_MARGIN = 1.1  # of the free camera's distance
_HOLD = 0.5  # [s] the last frame stays this long
_DRAWN_INCHES = 5.0  # height of a drawn frame: sets the size of its letters
_GL_OFF = ("off", "0", "false", "disable", "disabled")


class Drawer(Protocol):
    """Turns a scene into a frame (height, width, 3) uint8."""

    def render(self, scene: mujoco.MjvScene) -> Frame:
        """The scene as its camera sees it."""


def render(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (480, 640),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Callable[[Axes, np.ndarray], None] | None = None,
) -> Path:
    """Films the best chain's motion as it was replayed, not as it was planned; returns the path.

    Cost, max|h| and the replay's verdict stand in the picture. A replay that turns non-finite is
    shown up to there.

    Args:
      solution: from `solve`.
      path: where to, ending in .mp4, .gif or .webp; its folder is made if need be.
      fps: frames per second.
      size: (height, width) [pixels].
      camera: a camera of the model, see `render_frames`.
      speed: of the motion; 0.5 is slow motion.
      draw: draw(axes, states (k + 1, nx)) draws the motion x_0..x_k on matplotlib axes; needed
        for problems without a model (others do not use it).

    Raises:
      DraxError: a path, size, fps, speed or camera that cannot be used, or neither a model nor
        `draw`.
    """
    problem = solution.problem
    model = getattr(problem.dynamics, "mj_model", None)
    states = finite(solution.replayed[0])
    times, overlay = problem.times[: len(states)], outcome_lines(solution)
    if model is not None:
        qpos = states[:, : model.nq]
        return render_motion(
            model,
            qpos,
            times,
            path,
            overlay=overlay,
            fps=fps,
            size=size,
            camera=camera,
            speed=speed,
        )
    if draw is None:
        raise DraxError(_no_model(problem))
    frames = _drawn_frames(draw, states, frame_times(times, fps, speed), times, overlay, size)
    return movie.write(path, frames, fps, size)


def check(
    problem: Problem,
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (480, 640),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Callable[[Axes, np.ndarray], None] | None = None,
) -> None:
    """Complain before a solve about what `render` would refuse after it.

    Raises:
      DraxError: a size, fps, speed or camera that cannot be used, or neither a model nor `draw`.
    """
    frame_times(np.zeros(1), fps, speed)
    movie.even(size)
    model = getattr(problem.dynamics, "mj_model", None)
    if model is not None:
        view_of(model, model.qpos0[None], camera, 1.0)
    elif draw is None:
        raise DraxError(_no_model(problem))


def _no_model(problem: Problem) -> str:
    return (
        f"{problem.name} has no model to film: pass draw=, a function draw(axes, states) that "
        "draws states x_0..x_k (k + 1, nx) on matplotlib axes (see tasks/bug_trap.py)."
    )


def outcome_lines(solution: Solution) -> list[str]:
    """Lines of text for a film, short ones, which leave the robot in view."""
    chain, mode = solution.best_chain, solution.replay_mode
    cost, defect, violation = (
        float(a[chain]) for a in (solution.cost, solution.max_defect, solution.max_violation)
    )
    has_model = hasattr(solution.problem.dynamics, "mj_model")
    lines = [
        solution.problem.name,
        f"cost {cost:.3g}   max|h| {defect:.1g}",
        f"bound violation {violation:.1g}",
        f"{'MuJoCo C replay' if has_model else 'float64 rollout'}, {mode}:",
        solution.outcome(mode),
        "t = {time}",
    ]
    if not solution.certified:
        breach = "the plan breaks the dynamics"
        reason = "no replay succeeds" if solution.feasible[chain] else breach
        lines.insert(1, f"{movie.UNCERTIFIED}: {reason}")
    return lines


def render_motion(
    model: mujoco.MjModel,
    qpos: npt.ArrayLike,
    times: npt.ArrayLike,
    path: str | os.PathLike[str],
    *,
    overlay: Sequence[str] = (),
    fps: float = 30.0,
    size: tuple[int, int] = (480, 640),
    camera: str | int | None = None,
    speed: float = 1.0,
) -> Path:
    """Films a motion as an H.264 mp4 that browsers play, or as .gif or .webp; returns the path.

    The arguments are those of `render_frames`; the path's folder is made if need be. The file
    appears once it is complete. Raises DraxError before anything is drawn.
    """
    frames = _frames(model, qpos, times, overlay, fps, size, camera, speed)
    return movie.write(path, frames, fps, size)


def render_frames(
    model: mujoco.MjModel,
    qpos: npt.ArrayLike,
    times: npt.ArrayLike,
    *,
    overlay: Sequence[str] = (),
    fps: float = 30.0,
    size: tuple[int, int] = (480, 640),
    camera: str | int | None = None,
    speed: float = 1.0,
) -> Frame:
    """Frames (N, height, width, 3) uint8 of a motion, the last one held for half a second.

    Args:
      model: what moves.
      qpos: positions (T, nq), interpolated between their times (along geodesics for quaternions).
      times: when they are reached (T,) [s], not decreasing.
      overlay: lines of text drawn on each frame; `{time}` becomes the frame's time.
      fps: frames per second.
      size: (height, width) [pixels]; odd ones are made even, which players ask for.
      camera: a camera's name or index; "free" is one that frames the whole motion by itself. None
        takes the one called "main", or, in a model without one, the free one.
      speed: of the motion; 0.5 is slow motion.

    Raises:
      DraxError: positions of the wrong shape or not finite, decreasing times, unknown camera.
    """
    frames = _frames(model, qpos, times, overlay, fps, size, camera, speed)
    return np.stack(list(frames))


def _frames(
    model: mujoco.MjModel,
    qpos: npt.ArrayLike,
    times: npt.ArrayLike,
    overlay: Sequence[str],
    fps: float,
    size: tuple[int, int],
    camera: str | int | None,
    speed: float,
) -> Generator[Frame, None, None]:
    """Checks everything now, draws one frame at a time later."""
    positions, instants = _checked_motion(model, qpos, times)
    at = frame_times(instants, fps, speed)
    if isinstance(overlay, str):
        raise DraxError(f"overlay is {shown(overlay)}: give a list of lines, not one text.")
    height, width = movie.even(size)
    view = view_of(model, positions, camera, width / height)

    def draw() -> Generator[Frame, None, None]:
        data = mujoco.MjData(model)
        scene = mujoco.MjvScene(model, maxgeom=10_000)
        option = mujoco.MjvOption()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        with open_drawer(model, height, width) as drawer:
            for time in at:
                set_pose(model, data, interpolated(model, positions, instants, time))
                mujoco.mjv_updateScene(model, data, option, None, view, everything, scene)
                yield movie.captioned(drawer.render(scene), overlay, time)

    return draw()


def _drawn_frames(
    draw: Callable[[Axes, np.ndarray], None],
    states: np.ndarray,
    at: Floats,
    times: np.ndarray,
    overlay: Sequence[str],
    size: tuple[int, int],
) -> Generator[Frame, None, None]:
    """Frames at some instants of states (T, nx), drawn anew at each knot, below the overlay."""
    height, width = movie.even(size)

    def frames() -> Generator[Frame, None, None]:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        dpi = height / _DRAWN_INCHES
        top = 1.0 - movie.text_box(overlay, height, width)[1][3] / height
        layout = ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0, top))
        figure = Figure(((width + 0.5) / dpi, (height + 0.5) / dpi), dpi, layout=layout)
        canvas = FigureCanvasAgg(figure)
        drawn, picture = -1, np.zeros((height, width, 3), np.uint8)
        for time in at:
            knot = int(np.searchsorted(times, time + 1e-9, side="right")) - 1
            if knot != drawn:
                figure.clear()
                draw(figure.add_subplot(), states[: knot + 1])
                canvas.draw()
                drawn, picture = knot, np.array(canvas.buffer_rgba())[..., :3]
            yield movie.captioned(picture, overlay, time)

    return frames()


def frame_times(times: Floats, fps: float, speed: float = 1.0) -> Floats:
    """When frames are taken of a motion between times (T,) [s]: its end is held."""
    require_positive("fps", fps)
    require_positive("speed", speed)
    step = speed / fps
    count = int((times[-1] - times[0]) / step + 1e-6) + 1
    at = times[0] + np.arange(count) * step
    return np.append(at, np.full(round(_HOLD * fps), times[-1]))


def _checked_motion(
    model: mujoco.MjModel, qpos: npt.ArrayLike, times: npt.ArrayLike
) -> tuple[Floats, Floats]:
    positions, instants = np.asarray(qpos, float), np.asarray(times, float)
    if positions.ndim != 2 or positions.shape[1] != model.nq or len(positions) == 0:
        raise DraxError(
            f"qpos must have the shape (T, nq) = (T, {model.nq}), not {positions.shape}"
        )
    if instants.shape != (len(positions),):
        raise DraxError(f"times must have the shape ({len(positions)},), not {instants.shape}")
    if not np.all(np.isfinite(positions)):
        row = int(np.argmin(np.isfinite(positions).all(axis=1)))
        raise DraxError(f"qpos must be finite; row {row} is {positions[row]}")
    if not np.all(np.isfinite(instants)) or np.any(np.diff(instants) < 0.0):
        raise DraxError("times must be finite and must not decrease")
    return positions, instants


def set_pose(model: mujoco.MjModel, data: mujoco.MjData, qpos: Floats) -> None:
    """Sets the position and computes what a scene shows; no collisions, no forces."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    mujoco.mj_tendon(model, data)


# Cameras


def view_of(
    model: mujoco.MjModel, qpos: Floats, wanted: str | int | None, aspect: float
) -> mujoco.MjvCamera:
    """The camera asked for, as in `render_frames`, for a motion qpos (T, nq)."""
    names = [model.camera(index).name for index in range(model.ncam)]
    if wanted is None:
        wanted = "main" if "main" in names else FREE
    if wanted == FREE and FREE not in names:
        return _framing_camera(model, qpos, aspect)
    index = names.index(wanted) if wanted in names else wanted
    if not isinstance(index, int | np.integer) or not 0 <= index < model.ncam:
        known = ", ".join(name or f"{i} (unnamed)" for i, name in enumerate(names)) or "none"
        raise DraxError(
            f"no camera {shown(wanted)} in this model: use {FREE!r}, or of its own: {known}"
        )
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.fixedcamid = index
    return view


def _framing_camera(model: mujoco.MjModel, qpos: Floats, aspect: float) -> mujoco.MjvCamera:
    """A free camera that sees every moving geom in every pose of the motion.

    It looks the way the camera called "main" does at first, if there is one.
    """
    data = mujoco.MjData(model)
    sized = model.geom_rbound > 0.0  # planes have none
    moving = sized & (model.body_weldid[model.geom_bodyid] != 0)
    chosen = moving if np.any(moving) else sized
    poses = qpos[np.unique(np.linspace(0, len(qpos) - 1, 240).astype(int))]
    places = np.empty((len(poses), int(chosen.sum()), 3))
    for place, pose in zip(places, poses, strict=True):
        set_pose(model, data, pose)
        place[:] = data.geom_xpos[chosen]
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.azimuth, view.elevation = _direction(model)
    center, bound = model.stat.center, np.array([model.stat.extent])
    if places.size:
        center = (places.min(axis=(0, 1)) + places.max(axis=(0, 1))) / 2.0
        bound = np.tile(model.geom_rbound[chosen], len(places))
    azimuth, elevation = np.radians([view.azimuth, view.elevation])
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([flat[1], -flat[0], 0.0])
    axes = np.array([right, np.cross(right, ahead), ahead])
    across, up, depth = axes @ (places.reshape(-1, 3) - center).T if places.size else np.zeros(3)
    half = np.arctan(np.tan(np.radians(model.vis.global_.fovy) / 2.0) * np.array([aspect, 1.0]))
    distance, shift = 0.0, np.zeros(2)
    for i, (offset, angle) in enumerate(zip((across, up), half, strict=True)):
        low, high = np.min(offset - bound), np.max(offset + bound)
        shift[i] = (low + high) / 2.0
        reach = (np.abs(offset - shift[i]) * np.cos(angle) + bound) / np.sin(angle) - depth
        distance = max(distance, float(reach.max()))
    view.lookat[:] = center + shift @ axes[:2]
    view.distance = _MARGIN * distance
    return view


def _direction(model: mujoco.MjModel) -> tuple[float, float]:
    """Azimuth and elevation [degrees] of the camera called "main", or usual ones."""
    main = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA.value, "main")
    if main < 0:
        return 110.0, -12.0
    data = mujoco.MjData(model)
    set_pose(model, data, model.qpos0)
    ahead = -data.cam_xmat[main].reshape(3, 3)[:, 2]
    azimuth, elevation = np.arctan2(ahead[1], ahead[0]), np.arcsin(np.clip(ahead[2], -1.0, 1.0))
    return float(np.degrees(azimuth)), float(np.degrees(elevation))


# OpenGL


@contextlib.contextmanager
def open_drawer(model: mujoco.MjModel, height: int, width: int) -> Iterator[Drawer]:
    """OpenGL if this machine has it, else the painter."""
    context = _gl_context()
    if context is None:
        from mjx_drax.view.painter import Painter

        yield Painter(model, height, width)
        return
    drawer = _GlDrawer(context, model, height, width)
    try:
        yield drawer
    finally:
        drawer.close()


class _GlDrawer:
    """An offscreen OpenGL buffer of any size; `mujoco.Renderer` picks its platform at import."""

    def __init__(
        self, context: Callable[[int, int], Any], model: mujoco.MjModel, height: int, width: int
    ) -> None:
        self._gl = context(width, height)
        self._gl.make_current()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._cheap = _is_software()
        samples = int(model.vis.quality.offsamples)
        try:
            if self._cheap:  # multisampling doubles a frame's time on a CPU
                model.vis.quality.offsamples = 0
            self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        finally:
            model.vis.quality.offsamples = samples
        mujoco.mjr_resizeOffscreen(width, height, self._mjr)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)

    def render(self, scene: mujoco.MjvScene) -> Frame:
        self._gl.make_current()  # another drawer may have been in between
        if self._cheap:
            scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        frame = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, scene, self._mjr)
        mujoco.mjr_readPixels(frame, None, self._rect, self._mjr)
        return frame[::-1]  # OpenGL counts rows from below

    def close(self) -> None:
        self._gl.make_current()
        self._mjr.free()
        self._gl.free()


def _is_software() -> bool:
    """Whether the current OpenGL context draws on the CPU."""
    from OpenGL import GL

    name = GL.glGetString(GL.GL_RENDERER) or b""
    return any(word in name.lower() for word in (b"llvmpipe", b"softpipe", b"swrast"))


@lru_cache(maxsize=1)
def _gl_context() -> Callable[[int, int], Any] | None:
    """The first kind of OpenGL context that works here; None, with one warning, if none does."""
    failures = []
    for platform_name in _gl_platforms():
        try:
            return _tried_context(platform_name)
        except Exception as error:  # missing libraries raise whatever the bindings tripped over
            failures.append(f"{platform_name}: {error}")
    reason = "; ".join(failures) or f"MUJOCO_GL={os.environ.get('MUJOCO_GL')}"
    warnings.warn(
        f"no OpenGL ({reason}): frames are drawn by a simple painter. On Debian or Ubuntu, "
        f"`{APT_EGL}` gives better ones.",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _gl_platforms() -> tuple[str, ...]:
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in _GL_OFF:
        return ()
    if wanted in ("egl", "osmesa"):
        return (wanted,)
    return {"Darwin": ("cgl",), "Windows": ("glfw",)}.get(platform.system(), ("egl", "osmesa"))


def _tried_context(platform_name: str) -> Callable[[int, int], Any]:
    """A kind of context, once one has been made and used; a failure leaves nothing behind."""
    modules = set(sys.modules)
    variable = os.environ.get("PYOPENGL_PLATFORM")
    try:
        context = importlib.import_module(f"mujoco.{platform_name}").GLContext
        _GlDrawer(context, mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception:
        # PyOpenGL settles on a platform when it is imported: forget it, for the next attempt.
        for name in set(sys.modules) - modules:
            if name.split(".")[0] == "OpenGL" or name.startswith(f"mujoco.{platform_name}"):
                del sys.modules[name]
        raise
    finally:  # mujoco's module sets the variable and does not need it any more
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if variable is not None:
            os.environ["PYOPENGL_PLATFORM"] = variable
    return context
