"""What is drawn of a MuJoCo model: one or many poses of it, lines, and the camera that sees them.

A MuJoCo scene is a list of geoms. Those of several poses can be appended to it, each in its own
color, so that one frame shows a whole motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.physics.engine import mujoco
from mjx_drax.view.geoms import Floats

MAX_GEOMS = 20_000
"""Geoms in one scene; MuJoCo leaves out what would be more."""

FREE, FOLLOW = "free", "follow"
"""The camera that sees the whole motion, and the one that goes with the robot."""

Arrow = tuple[Floats, Floats]
"""A point and a vector from it, (3,) each [m]."""

_MARGIN = 1.1  # factor on the free camera's distance
_ROOM = 2.0  # the same for one that follows, so that one sees where the robot goes
_AROUND = 1.3  # the free camera's distance grows at most so much to see what stands still
_FAR = 8.0  # a robot travels far if its way is so many times its size
_SUN = np.array([0.4, 0.5, -1.0])  # direction of the light of models without a directional one
_RED = np.array([0.85, 0.15, 0.1, 1.0])
_GROUPS = 3  # geoms of the groups 0, 1 and 2 are drawn
_POSES = 240  # so many poses of a motion decide where the free camera stands


class Scene:
    """A scene of one model, as a camera sees it; `data` holds the pose that was added last."""

    def __init__(self, model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
        self.content = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self.data = mujoco.MjData(model)
        self._model, self._camera = model, camera
        self._option, self._perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()

    def begin(self, qpos: Floats | None) -> None:
        """A new scene: what does not move, and the robot at qpos (nq,), if given."""
        kinds = mujoco.mjtCatBit
        kind = kinds.mjCAT_STATIC if qpos is None else kinds.mjCAT_ALL
        set_pose(self._model, self.data, self._model.qpos0 if qpos is None else qpos)
        # First the camera: planes without end are centred on the one that was there before.
        mujoco.mjv_updateCamera(self._model, self.data, self._camera, self.content)
        mujoco.mjv_updateScene(
            self._model, self.data, self._option, None, self._camera, kind.value, self.content
        )
        if not (self._model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value).any():
            self._add_sun()

    def _add_sun(self) -> None:
        """A directional light, weaker beside spotlights, which leave most of a floor dark."""
        light = self.content.lights[self.content.nlight]
        light.headlight, light.castshadow = 0, 1
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
        light.dir[:] = _SUN / np.linalg.norm(_SUN)
        light.pos[:] = -10.0 * _SUN * max(float(self._model.stat.extent), 1.0)
        strength = 0.3 if self._model.nlight else 0.5
        light.ambient[:], light.diffuse[:], light.specular[:] = 0.1, strength, 0.1
        self.content.nlight += 1

    def add_arrows(self, arrows: Sequence[Arrow]) -> None:
        """Red arrows, such as forces."""
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        for start, vector in arrows:
            width, end = 0.08 * float(np.linalg.norm(vector)), start + 2.0 * vector
            self._connect(kind, width, start, end, _RED)  # draws half of it

    def add_robot(self, qpos: Floats, opacity: float, color: npt.ArrayLike | None = None) -> None:
        """One more robot, translucent, at qpos (nq,), in its own colors or in one (3,)."""
        first, moving = self.content.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        set_pose(self._model, self.data, qpos)
        mujoco.mjv_addGeoms(
            self._model, self.data, self._option, self._perturbation, moving, self.content
        )
        for geom in self.content.geoms[first : self.content.ngeom]:
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
            self._connect(mujoco.mjtGeom.mjGEOM_LINE, width, start, end, color)

    def _connect(
        self, kind: mujoco.mjtGeom, width: float, start: Floats, end: Floats, color: Floats
    ) -> None:
        """A geom from one point to another, if the scene has room for it."""
        if self.content.ngeom < self.content.maxgeom:
            geom = self.content.geoms[self.content.ngeom]
            zero, turn = np.zeros(3), np.eye(3).ravel()
            mujoco.mjv_initGeom(geom, kind, zero, zero, turn, np.float32(color))
            mujoco.mjv_connector(geom, kind, width, start, end)
            self.content.ngeom += 1


# Poses


def set_pose(model: mujoco.MjModel, data: mujoco.MjData, qpos: Floats) -> None:
    """Set the position and compute what a scene shows; no collisions, no forces."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    mujoco.mj_tendon(model, data)


def posed(model: mujoco.MjModel, qpos: Floats) -> Iterator[mujoco.MjData]:
    """The same data at each of the positions (T, nq), with the poses of bodies and geoms."""
    data = mujoco.MjData(model)
    for position in qpos:
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        yield data


def travelling_body(model: mujoco.MjModel) -> int | None:
    """The first body that moves in the plane or in space, whose path tells much; None if none."""
    free, slide = mujoco.mjtJoint.mjJNT_FREE.value, mujoco.mjtJoint.mjJNT_SLIDE.value
    for body in range(1, model.nbody):
        first = model.body_jntadr[body]
        kinds = [int(kind) for kind in model.jnt_type[first : first + model.body_jntnum[body]]]
        if free in kinds or kinds.count(slide) > 1:
            return body
    return None


def body_positions(model: mujoco.MjModel, body: int, qpos: Floats) -> Floats:
    """The centre of mass of a body in positions (..., nq), (..., 3)."""
    flat = qpos.reshape(-1, model.nq)
    centres = np.array([data.xipos[body].copy() for data in posed(model, flat)])
    return centres.reshape(*qpos.shape[:-1], 3)


# Cameras


def camera_for(
    model: mujoco.MjModel, qpos: Floats, wanted: str | int | None, aspect: float
) -> mujoco.MjvCamera:
    """The camera asked for, for a motion qpos (T, nq) in frames of an aspect, width / height.

    `wanted` is a camera's name or index, `FREE` or `FOLLOW`; None is `FREE`, or `FOLLOW` where a
    robot travels far that actuators drive.

    Raises:
      DraxError: there is no such camera.
    """
    names = [model.camera(index).name for index in range(model.ncam)]
    if wanted is None:
        wanted = FOLLOW if _travels_far(model, qpos) else FREE
    if wanted in (FREE, FOLLOW) and wanted not in names:
        return _free_camera(model, qpos, aspect, follows=wanted == FOLLOW)
    index = names.index(wanted) if wanted in names else wanted
    if not isinstance(index, int | np.integer) or not 0 <= index < model.ncam:
        known = ", ".join(name or f"{i} (unnamed)" for i, name in enumerate(names)) or "none"
        raise DraxError(
            f"no camera {shown(wanted)} in this model: use {FREE!r}, {FOLLOW!r}, or of its own: "
            f"{known}"
        )
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    camera.fixedcamid = index
    return camera


def _travels_far(model: mujoco.MjModel, qpos: Floats) -> bool:
    """Whether a robot that moves in the plane or in space goes far, beside its size."""
    body = travelling_body(model)
    if body is None or (model.nu and not _is_driven(model, body, qpos[0])):
        return False
    way = np.ptp(body_positions(model, body, qpos), axis=0).max()
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
    places = next(posed(model, qpos[:1])).geom_xpos[own & (model.geom_rbound > 0.0)]
    bound = model.geom_rbound[own & (model.geom_rbound > 0.0)]
    if not len(places):
        return False
    size = np.max(np.ptp(places, axis=0) + 2.0 * bound.max())
    return bool(way > _FAR * size)


def _is_driven(model: mujoco.MjModel, body: int, qpos: Floats) -> bool:
    """Whether actuators act on the tree of a body; on that of a ball that is thrown, none do."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    entries = zip(data.moment_rowadr, data.moment_rownnz, strict=True)
    dofs = [dof for first, count in entries for dof in data.moment_colind[first : first + count]]
    roots = model.body_rootid[model.dof_bodyid[dofs]] if dofs else []
    return bool(model.body_rootid[body] in roots)


def _free_camera(
    model: mujoco.MjModel, qpos: Floats, aspect: float, follows: bool = False
) -> mujoco.MjvCamera:
    """A camera that sees every moving geom in every pose of the motion.

    It also sees geoms that stand still, such as obstacles, if it need not go much farther for them.
    One that follows keeps its distance and direction from the centre of mass of the body that
    travels, and sees every geom of that robot.

    It looks in the direction of the camera "main" at qpos0, if there is one.
    """
    sized = model.geom_rbound > 0.0  # planes have none
    moving = sized & (model.body_weldid[model.geom_bodyid] != 0)
    body = travelling_body(model) if follows else None
    if body is not None:
        moving &= model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
    chosen = moving if np.any(moving) else sized
    poses = qpos[np.unique(np.linspace(0, len(qpos) - 1, _POSES).astype(int))]
    points = np.array([data.geom_xpos[chosen] for data in posed(model, poses)])
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    if body is not None:
        points = points - body_positions(model, body, poses)[:, None, :]
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, body
    points = points.reshape(-1, 3)
    camera.azimuth, camera.elevation = _direction(model)
    center, bound = model.stat.center, np.array([model.stat.extent])
    if points.size:
        center = (points.min(axis=0) + points.max(axis=0)) / 2.0
        bound = np.tile(model.geom_rbound[chosen], len(poses))
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([flat[1], -flat[0], 0.0])
    axes = np.array([right, np.cross(right, ahead), ahead])
    offsets = axes @ (points - center).T if points.size else np.zeros((3, 1))
    half = np.arctan(np.tan(np.radians(model.vis.global_.fovy) / 2.0) * np.array([aspect, 1.0]))
    distance, shift = _fitted(offsets, bound, half)
    still = sized & ~chosen & (model.geom_group < _GROUPS) if body is None else []
    most = _AROUND * distance
    for corners in _corners(model, np.flatnonzero(still)):
        more = np.hstack([offsets, axes @ (corners - center).T])
        radii = np.append(bound, np.zeros(8))
        farther, aside = _fitted(more, radii, half)
        if farther < most:
            offsets, bound, distance, shift = more, radii, farther, aside
    camera.lookat[:] = center + shift @ axes[:2]
    camera.distance = (_MARGIN if body is None else _ROOM) * distance
    return camera


def _fitted(offsets: Floats, bound: Floats, half: Floats) -> tuple[float, Floats]:
    """How far away a camera sees balls at offsets (3, n), and how far right and up it looks (2,).

    With axes right, up and ahead, a ball of radius b at (x, y, z) is within a half angle a of the
    frame if the camera stands (|x| cos a + b) / sin a - z or more before the middle.
    """
    distance, shift = 0.0, np.zeros(2)
    for i, (offset, angle) in enumerate(zip(offsets[:2], half, strict=True)):
        low, high = np.min(offset - bound), np.max(offset + bound)
        shift[i] = (low + high) / 2.0
        reach = (np.abs(offset - shift[i]) * np.cos(angle) + bound) / np.sin(angle) - offsets[2]
        distance = max(distance, float(reach.max()))
    return distance, shift


def _corners(model: mujoco.MjModel, chosen: npt.NDArray[np.int64]) -> Floats:
    """Corners of the boxes about some geoms that stand still, (n, 8, 3)."""
    data = next(posed(model, model.qpos0[None]))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    boxes, turns = model.geom_aabb[chosen], data.geom_xmat[chosen].reshape(-1, 3, 3)
    inside = boxes[:, None, :3] + signs * boxes[:, None, 3:]
    return data.geom_xpos[chosen][:, None] + inside @ turns.transpose(0, 2, 1)


def _direction(model: mujoco.MjModel) -> tuple[float, float]:
    """Azimuth and elevation [degrees] of the camera "main", or usual ones."""
    main = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA.value, "main")
    if main < 0:
        return 110.0, -12.0
    data = mujoco.MjData(model)
    set_pose(model, data, model.qpos0)
    ahead = -data.cam_xmat[main].reshape(3, 3)[:, 2]
    azimuth, elevation = np.arctan2(ahead[1], ahead[0]), np.arcsin(np.clip(ahead[2], -1.0, 1.0))
    return float(np.degrees(azimuth)), float(np.degrees(elevation))
