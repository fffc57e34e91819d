"""Videos of solutions and motions, made without a display.

Models are drawn by OpenGL, or by numpy where there is none (see `renderer`); problems without a
model by a function that the task brings, on matplotlib axes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, require_positive, shown
from mjx_drax.physics.c_engine.states import finite, interpolated
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.problem import Problem
from mjx_drax.solution.solution import Solution, require_solution
from mjx_drax.view.drawing import Canvas, Draw, knot_at
from mjx_drax.view.frames import (
    DARK,
    UNCERTIFIED,
    Frame,
    caption_height,
    captioned,
    even_size,
    write,
)
from mjx_drax.view.geoms import Floats
from mjx_drax.view.renderer import open_renderer
from mjx_drax.view.scene import Arrow, Scene, camera_for

_HOLD = 0.5  # [s] the last frame stays this long
_BETWEEN = 4  # columns of pixels between a plan and its replay


def render(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (640, 480),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Draw | None = None,
    chain: int | None = None,
    plan: bool = False,
    caption: bool = True,
) -> Path:
    """Films a chain's motion as it was replayed, or as it was planned; returns the path.

    Cost, max|h| and the replay's outcome, or what the plan breaks, stand under the picture. A
    motion that turns non-finite is shown up to there.

    Args:
      solution: from `solve`.
      path: where to, ending in .mp4, .gif or .webp; its folder is made if need be.
      fps: frames per second.
      size: (width, height) [pixels].
      camera: the name or index of a camera of the model; "free" for one that sees the whole
        motion, "follow" for one that goes with the robot. Both look along the model's camera
        "main", if there is one. By default "follow" where the robot travels far, else "free".
      speed: of the motion; 0.5 is slow motion.
      draw: draw(axes, states (k + 1, nx)) draws the motion x_0..x_k on matplotlib axes; needed
        for problems without a model (others do not use it).
      chain: the best one by default.
      plan: show the knots of the plan, which need not obey the dynamics: what a chain that failed
        was about to do. By default the better replay is shown.
      caption: whether there is a strip with text.

    Raises:
      DraxError: a path, size, fps, speed, camera or chain that cannot be used, or neither a model
        nor `draw`.
    """
    look: dict[str, Any] = {"size": size, "camera": camera, "speed": speed, "draw": draw}
    return write(path, frames_of(solution, chain, plan, caption, fps=fps, **look), fps)


def frames_of(
    solution: Solution,
    chain: int | None = None,
    plan: bool = False,
    caption: bool = True,
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (640, 480),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Draw | None = None,
) -> Generator[Frame, None, None]:
    """The frames (height, width, 3) uint8 of `render`, whose arguments these are."""
    require_solution(solution)
    check(solution.problem, fps=fps, size=size, camera=camera, speed=speed, draw=draw)
    chain = solution.chain_or_best(chain)
    states = states_of(solution, chain, plan)
    times = solution.times_of(chain)[: len(states)]
    overlay = outcome_lines(solution, chain, plan, brief=True) if caption else []
    model = mujoco_model(solution.problem.dynamics, states[0])
    if model is not None:
        qpos = states[:, : model.nq]
        look: dict[str, Any] = {"size": size, "camera": camera, "speed": speed}
        return motion_frames(model, qpos, times, overlay=overlay, fps=fps, **look)
    assert draw is not None  # as checked
    moments = frame_times(times, fps, speed)
    return _drawn_frames(draw, states, times, moments, overlay, even_size(size))


def render_comparison(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (960, 480),
    camera: str | int | None = None,
    speed: float = 1.0,
    chain: int | None = None,
    caption: bool = True,
) -> Path:
    """Films a chain's plan (left) and its better replay (right) side by side; returns the path.

    The arguments are those of `render`, for problems with a model.

    Raises:
      DraxError: as `render`, or a problem without a model.
    """
    require_solution(solution)
    problem = solution.problem
    check(problem, fps=fps, size=size, camera=camera, speed=speed, compared=True)
    chain = solution.chain_or_best(chain)
    model = mujoco_model(problem.dynamics, solution.plans[chain, 0])
    assert model is not None  # as checked
    width, height = even_size(size)
    overlay = outcome_lines(solution, chain, brief=True) if caption else []
    overlay[1:1] = ["left: plan, right: replay"] * caption
    below = caption_height([overlay], height, width)
    half = (width - _BETWEEN) // 2
    between = np.full((height - below, _BETWEEN, 3), DARK, np.uint8)
    both = [states_of(solution, chain, plan)[:, : model.nq] for plan in (True, False)]
    seen = camera_for(model, np.concatenate(both), camera, half / (height - below))
    times = solution.times_of(chain)
    moments = frame_times(times, fps, speed)

    def frames() -> Generator[Frame, None, None]:
        scene = Scene(model, seen)
        with open_renderer(model, height - below, half) as renderer:
            for time in moments:
                sides = []
                for qpos in both:
                    scene.begin(interpolated(model, qpos, times[: len(qpos)], time))
                    sides.append(renderer.render(scene.content))
                plan, replay = sides
                frame = np.concatenate([plan, between, replay], axis=1)
                yield captioned(frame, overlay, time, below)

    return write(path, frames(), fps)


def check(
    problem: Problem,
    *,
    fps: float = 30.0,
    size: tuple[int, int] = (640, 480),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Draw | None = None,
    compared: bool = False,
) -> None:
    """Complain before a solve about what `render` would refuse after it, such as a wrong camera.

    If `compared`, about what `render_comparison` would, which draws models only.
    """
    frame_times(np.zeros(1), fps, speed)
    even_size(size)
    model = mujoco_model(problem.dynamics)
    if model is not None:
        camera_for(model, model.qpos0[None], camera, 1.0)
    elif compared:
        raise DraxError(
            f"{problem.name} has no MuJoCo model: films side by side (--side-by-side) are of "
            "models only. Leave it out."
        )
    elif draw is None:
        raise DraxError(
            f"{problem.name} has no model to film: pass draw=, a function draw(axes, states) that "
            "draws states x_0..x_k (k + 1, nx) on matplotlib axes (see tasks/bug_trap.py)."
        )


def render_motion(
    model: mujoco.MjModel,
    qpos: npt.ArrayLike,
    times: npt.ArrayLike,
    path: str | os.PathLike[str],
    *,
    fps: float = 30.0,
    **look: Any,
) -> Path:
    """Films a motion as an H.264 mp4 that browsers play, or as .gif or .webp; returns the path.

    The arguments are those of `motion_frames`; the path's folder is made if need be. The file
    appears once it is complete. Raises DraxError before anything is drawn.
    """
    return write(path, motion_frames(model, qpos, times, fps=fps, **look), fps)


def render_frames(
    model: mujoco.MjModel, qpos: npt.ArrayLike, times: npt.ArrayLike, **look: Any
) -> Frame:
    """All frames of `motion_frames`, whose arguments these are: (N, height, width, 3) uint8."""
    return np.stack(list(motion_frames(model, qpos, times, **look)))


def motion_frames(
    model: mujoco.MjModel,
    qpos: npt.ArrayLike,
    times: npt.ArrayLike,
    *,
    overlay: Sequence[str] = (),
    fps: float = 30.0,
    size: tuple[int, int] = (640, 480),
    camera: str | int | None = None,
    speed: float = 1.0,
    arrows: Callable[[float], Sequence[Arrow]] = lambda time: (),
) -> Generator[Frame, None, None]:
    """Frames (height, width, 3) uint8 of a motion, the last one held for half a second.

    Args:
      qpos: positions (T, nq), interpolated between their times (along geodesics for quaternions).
      times: when they are reached (T,) [s], not decreasing.
      overlay: texts in a strip under each frame; `{time}` becomes the frame's time.
      fps: frames per second.
      size: (width, height) [pixels]; odd ones are made even, which players ask for.
      camera: as in `render`.
      speed: of the motion; 0.5 is slow motion.
      arrows: gives what is drawn besides at a time [s], such as pushes.

    Raises:
      DraxError: at once, for positions of the wrong shape or not finite, decreasing times, or an
        unknown camera.
    """
    positions, knot_times = _checked_motion(model, qpos, times)
    moments = frame_times(knot_times, fps, speed)
    if isinstance(overlay, str):
        raise DraxError(f"overlay is {shown(overlay)}: give a list of lines, not one text.")
    width, height = even_size(size)
    below = caption_height([overlay], height, width)
    above = height - below
    scene = Scene(model, camera_for(model, positions, camera, width / above))

    def frames() -> Generator[Frame, None, None]:
        with open_renderer(model, above, width) as renderer:
            for time in moments:
                scene.begin(interpolated(model, positions, knot_times, time))
                scene.add_arrows(arrows(time))
                yield captioned(renderer.render(scene.content), overlay, time, below)

    return frames()


def states_of(solution: Solution, chain: int, plan: bool) -> np.ndarray:
    """States (T, nx) of a chain's plan or better replay, up to where they turn non-finite."""
    if plan:
        return finite(solution.plans[chain].astype(float))
    return finite(solution.replays_in(solution.mode_of(chain)).states[chain])


def outcome_lines(
    solution: Solution, chain: int | None = None, plan: bool = False, brief: bool = False
) -> list[str]:
    """Short texts about a chain, for a caption.

    Args:
      chain: the best one by default.
      plan: say what the plan breaks, not what came of its replay.
      brief: no more than the cost, the verdict, and what came of the replay or the plan breaks.
    """
    chain = solution.best_chain if chain is None else chain
    problem, mode, where = solution.problem, solution.mode_of(chain), None
    cost, defect = float(solution.replay_cost[chain]), float(solution.max_defect[chain])
    ran, has_model = solution.replays_in(mode), mujoco_model(problem.dynamics) is not None
    violation, told = float(ran.max_violation[chain]), ran.outcome(problem, chain)
    made = f"{'MuJoCo C replay' if has_model else 'float64 rollout'}, {mode}:"
    if plan:
        cost, violation = float(solution.cost[chain]), float(solution.max_violation[chain])
        where = solution.where(chain)
        told = "keeps to the dynamics" if where is None else where.told(problem)
        made = f"PLAN of chain {chain}, not a replay:"
    lines = [
        problem.name,
        f"cost {cost:.3g}   max|h| {defect:.1g}",
        f"bound violation {violation:.1g}",
        solution.optimality_of(chain),
        made,
        told,
        "t = {time}",
    ]
    verdict = "certified and optimal" if solution.optimal_chains[chain] else "certified"
    if not solution.certified_chains[chain]:
        reason = "no replay succeeds" if solution.feasible[chain] else "the plan is infeasible"
        verdict = f"{UNCERTIFIED}: {reason}"
        lines.insert(1, verdict)
    if brief:
        if not plan:
            made, told = f"{mode}:", told.partition(",")[0]  # without its distance from the plan
        return [problem.name, "t = {time}", f"cost {cost:.3g}", verdict, f"{made} {told}"]
    return lines


def frame_times(times: Floats, fps: float, speed: float = 1.0) -> Floats:
    """When frames are taken of a motion between times (T,) [s]; its end is held."""
    require_positive("fps", fps)
    require_positive("speed", speed)
    step = speed / fps
    count = int((times[-1] - times[0]) / step + 1e-6) + 1
    moving = times[0] + np.arange(count) * step
    return np.append(moving, np.full(round(_HOLD * fps), times[-1]))


def _drawn_frames(
    draw: Draw,
    states: np.ndarray,
    times: np.ndarray,
    moments: Floats,
    overlay: Sequence[str],
    size: tuple[int, int],
) -> Generator[Frame, None, None]:
    """Frames at some moments [s] of states (T, nx), drawn again at each knot, and the overlay."""
    width, height = size
    below = caption_height([overlay], height, width)
    canvas, drawn = Canvas(height - below, width, layout="constrained"), -1
    for time in moments:
        knot = knot_at(times, time)
        if knot != drawn:
            canvas.figure.clear()
            draw(canvas.figure.add_subplot(), states[: knot + 1])
            canvas.agg.draw()
            drawn = knot
        yield captioned(canvas.pixels(), overlay, time, below)


def _checked_motion(
    model: mujoco.MjModel, qpos: npt.ArrayLike, times: npt.ArrayLike
) -> tuple[Floats, Floats]:
    positions, knot_times = np.asarray(qpos, float), np.asarray(times, float)
    if positions.ndim != 2 or positions.shape[1] != model.nq or len(positions) == 0:
        raise DraxError(
            f"qpos must have the shape (T, nq) = (T, {model.nq}), not {positions.shape}"
        )
    if knot_times.shape != (len(positions),):
        raise DraxError(f"times must have the shape ({len(positions)},), not {knot_times.shape}")
    if not np.all(np.isfinite(positions)):
        row = int(np.argmin(np.isfinite(positions).all(axis=1)))
        raise DraxError(f"qpos must be finite; row {row} is {positions[row]}")
    if not np.all(np.isfinite(knot_times)) or np.any(np.diff(knot_times) < 0.0):
        raise DraxError("times must be finite and must not decrease")
    return positions, knot_times
