"""Many poses of a robot in one scene, and the picture of a motion that they make.

A MuJoCo scene is a list of geoms. Those of one pose after the other are appended to it, with their
colors changed, so that a whole motion is drawn in one frame.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, require_whole
from mjx_drax.base.files import complete
from mjx_drax.physics._mujoco import mujoco
from mjx_drax.physics.states import finite, interpolated
from mjx_drax.view import video as movie
from mjx_drax.view.rendering import FREE, Floats, open_drawer, set_pose, view_of

if TYPE_CHECKING:
    from mjx_drax.solution.solution import Solution

MAXGEOM = 20_000
"""Geoms in one scene; more are left out by MuJoCo."""

_FAINTEST, _STRONGEST = 0.12, 0.65  # opacity of a time-lapse's first and last ghost


class Stage:
    """A scene of one model that poses, points and lines are added to."""

    def __init__(self, model: mujoco.MjModel, view: mujoco.MjvCamera) -> None:
        self.scene = mujoco.MjvScene(model, maxgeom=MAXGEOM)
        self._model, self._view = model, view
        self._data, self._option = mujoco.MjData(model), mujoco.MjvOption()
        self._nothing = mujoco.MjvPerturb()

    def begin(self, qpos: Floats | None) -> None:
        """A new scene: the surroundings, and the robot at qpos (nq,) if there is one."""
        kinds = mujoco.mjtCatBit
        shown = kinds.mjCAT_STATIC if qpos is None else kinds.mjCAT_ALL
        set_pose(self._model, self._data, self._model.qpos0 if qpos is None else qpos)
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._view, shown.value, self.scene
        )

    def add_ghost(self, qpos: Floats, opacity: float, color: npt.ArrayLike | None = None) -> None:
        """What moves, at qpos (nq,), in its own colors or in one (3,)."""
        first, moving = self.scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        set_pose(self._model, self._data, qpos)
        mujoco.mjv_addGeoms(
            self._model, self._data, self._option, self._nothing, moving, self.scene
        )
        for geom in self.scene.geoms[first : self.scene.ngeom]:
            geom.rgba[3] *= opacity
            if color is not None:
                geom.rgba[:3] = color
                geom.matid = -1
                geom.emission, geom.specular, geom.reflectance = 0.1, 0.1, 0.0

    def add_line(self, points: Floats, colors: Floats, width: float) -> None:
        """A line through points (n, 3), whose n - 1 pieces have colors (n - 1, 4).

        width [pixels] with OpenGL; capsules would take ten times as long without a GPU.
        """
        for start, end, color in zip(points[:-1], points[1:], colors, strict=True):
            if self.scene.ngeom >= self.scene.maxgeom:
                return
            geom = self.scene.geoms[self.scene.ngeom]
            kind = mujoco.mjtGeom.mjGEOM_LINE
            mujoco.mjv_initGeom(
                geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.float32(color)
            )
            mujoco.mjv_connector(geom, kind, width, start, end)
            self.scene.ngeom += 1


def travelling_body(model: mujoco.MjModel) -> int | None:
    """The first body that moves in the plane or in space; its path is worth drawing."""
    free, slide = mujoco.mjtJoint.mjJNT_FREE.value, mujoco.mjtJoint.mjJNT_SLIDE.value
    for body in range(1, model.nbody):
        first = model.body_jntadr[body]
        kinds = [int(kind) for kind in model.jnt_type[first : first + model.body_jntnum[body]]]
        if free in kinds or kinds.count(slide) > 1:
            return body
    return None


def places(model: mujoco.MjModel, body: int, qpos: Floats) -> Floats:
    """Where a body's centre of mass is in poses (..., nq), (..., 3)."""
    data, flat = mujoco.MjData(model), qpos.reshape(-1, model.nq)
    out = np.empty((len(flat), 3))
    for place, pose in zip(out, flat, strict=True):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        place[:] = data.xipos[body]
    return out.reshape(*qpos.shape[:-1], 3)


def render_timelapse(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    count: int = 8,
    size: tuple[int, int] = (720, 960),
    camera: str | int | None = None,
) -> Path:
    """One picture of the best chain's motion as it was replayed: ghosts, and the last pose.

    Ghosts are equally far apart in time, and the fainter the earlier.

    Args:
      solution: from `solve`, of a problem with a model.
      path: where to, ending in .png; its folder is made if need be.
      count: number of poses, the last one included.
      size: (height, width) [pixels].
      camera: a camera of the model, see `render_frames`; None frames the motion.

    Raises:
      DraxError: a path, size, count or camera that cannot be used, or no model.
    """
    target = movie.film_path(path, (".png",))
    height, width = movie.even(size)
    require_whole("count", count)
    model = model_of(solution)
    qpos = finite(solution.replayed[0])[:, : model.nq]
    times = solution.problem.times[: len(qpos)]
    view = view_of(model, qpos, FREE if camera is None else camera, width / height)
    at = np.linspace(0.0, times[-1], count)
    stage = Stage(model, view)
    stage.begin(qpos[-1])
    for time, opacity in zip(at[:-1], np.linspace(_FAINTEST, _STRONGEST, count - 1), strict=True):
        stage.add_ghost(interpolated(model, qpos, times, float(time)), float(opacity))
    from PIL import Image

    with open_drawer(model, 2 * height, 2 * width) as drawer:  # and halved, which smooths edges
        frame = drawer.render(stage.scene)
    image = Image.fromarray(frame).resize((width, height), Image.Resampling.BOX)
    with complete(target) as partial:
        image.save(partial)
    return target


def model_of(solution: Solution) -> mujoco.MjModel:
    """The model, or a DraxError where there is none."""
    model = getattr(solution.problem.dynamics, "mj_model", None)
    if model is None:
        raise DraxError(
            f"{solution.problem.name} has no model to show: make the problem with from_mjcf."
        )
    return model
