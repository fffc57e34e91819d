"""The picture of a motion: several poses of the robot in one frame."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mjx_drax.base.errors import DraxError, require_whole
from mjx_drax.base.files import complete, file_path
from mjx_drax.physics.c_engine.states import interpolated
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.solution.solution import Solution, require_solution
from mjx_drax.view.drawing import Canvas, Draw
from mjx_drax.view.frames import even_size
from mjx_drax.view.renderer import open_renderer
from mjx_drax.view.scene import FREE, Scene, camera_for
from mjx_drax.view.video import states_of

_FIRST_OPACITY, _LAST_OPACITY = 0.12, 0.65  # of the poses before the last one, which is opaque


def render_timelapse(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    count: int = 8,
    size: tuple[int, int] = (960, 720),
    camera: str | int | None = None,
    chain: int | None = None,
    plan: bool = False,
    draw: Draw | None = None,
) -> Path:
    """One picture of a chain's motion as it was replayed: earlier poses, and the last one.

    Earlier poses are translucent, equally far apart in time, the fainter the earlier.

    Args:
      solution: from `solve`.
      path: where to, ending in .png; its folder is made if need be.
      count: number of poses, the last one included.
      size: (width, height) [pixels].
      camera: as in `render`; None frames the motion.
      chain, plan: as in `render`: the best chain by default, and its plan instead of the replay.
      draw: as in `render`, for problems without a model: the picture is what it draws of the whole
        motion, and `count` and `camera` have no meaning.

    Raises:
      DraxError: a path, size, count, camera or chain that cannot be used, or neither a model nor
        `draw`.
    """
    from PIL import Image

    require_solution(solution)
    width, height = even_size(size)
    require_whole("count", count)
    which = solution.chain_or_best(chain)
    states = states_of(solution, which, plan)
    model = mujoco_model(solution.problem.dynamics, states[0])
    if model is None:
        if draw is None:
            raise DraxError(
                f"{solution.problem.name} has no model to show: make the problem with from_mjcf, "
                "or give draw=."
            )
        canvas = Canvas(height, width, layout="constrained")
        draw(canvas.figure.add_subplot(), states)
        canvas.agg.draw()
        with complete(path, (".png",)) as partial:
            Image.fromarray(canvas.pixels()).save(partial)
        return file_path(path)
    qpos = states[:, : model.nq]
    times = solution.times_of(which)[: len(qpos)]
    seen_by = camera_for(model, qpos, FREE if camera is None else camera, width / height)
    scene = Scene(model, seen_by)
    scene.begin(qpos[-1])
    opacities = np.linspace(_FIRST_OPACITY, _LAST_OPACITY, count - 1)
    for time, opacity in zip(np.linspace(times[0], times[-1], count)[:-1], opacities, strict=True):
        scene.add_robot(interpolated(model, qpos, times, time), opacity)
    with complete(path, (".png",)) as partial:
        with open_renderer(model, 2 * height, 2 * width) as renderer:  # and halved: smooth edges
            frame = renderer.render(scene.content)
        Image.fromarray(frame).resize((width, height), Image.Resampling.BOX).save(partial)
    return file_path(path)
