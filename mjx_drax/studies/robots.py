"""Small tasks for robots of other packages, from their files as they are shipped.

    python -m mjx_drax.studies.robots [NAME ...] [--path DIR] [--chains N] [--seeds N]
                                      [--attempts N] [--seconds S]

A file is sought by its path inside of its package (`TASKS`), as in hydrax/models/walker/scene.xml:
below DIR, or where the package is installed. Nothing of a package is imported. The table is that
of `studies.answers`; a model that is refused stands below it, with the reason.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError, require_positive, require_whole
from mjx_drax.modelling.terms import Terms
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjcf import from_mjcf
from mjx_drax.physics.motors import Actuators, add_motors
from mjx_drax.physics.source import load
from mjx_drax.problem.problem import Problem
from mjx_drax.search.restarts import Restarts
from mjx_drax.studies.answers import answers, start


def double_cart_pole(path: Path) -> Problem:
    """Swings up."""
    on = Terms(load(path))
    upright = {"slider": 0.0, "hinge_1": math.pi, "hinge_2": 0.0}
    return from_mjcf(
        on.model,
        horizon=3.0,
        dt=0.03,
        running_residual=on.control(weight=1e-2),
        terminal_residual=on.posture(upright, weight=100.0) + on.velocity(weight=10.0),
        goal=lambda data: data.site("tip").xpos[2] > 3.95 and np.abs(data.qvel).max() < 0.5,
    )


def walker(path: Path) -> Problem:
    """Ends 0.4 m further, with its torso upright."""
    on = Terms(load(path))
    wanted = {"rootx": 0.4, "rootz": 0.0, "rooty": 0.0}
    return from_mjcf(
        on.model,
        horizon=1.0,
        dt=0.02,
        running_residual=on.control(weight=1e-2) + on.velocity(weight=1e-4),
        terminal_residual=on.posture(wanted, weight=100.0) + on.velocity(weight=0.1),
        goal=lambda data: np.abs(data.qpos[:3] - [0.0, 0.4, 0.0]).max() < 0.1,
    )


def crane(path: Path) -> Problem:
    """Puts its payload onto the target."""
    on = Terms(load(path))
    target = on.model.body("target").pos
    return from_mjcf(
        on.model,
        horizon=3.0,
        dt=0.05,
        running_residual=on.control(weight=1e-3),
        terminal_residual=on.site("payload_end", target, weight=100.0) + on.velocity(weight=1.0),
        goal=lambda data: np.linalg.norm(data.site("payload_end").xpos - target) < 0.05,
    )


def pusht(path: Path) -> Problem:
    """Pushes the T back by 3 cm and turns it by 0.3 rad."""
    on = Terms(load(path))
    wanted = {"T_x": 0.0, "T_y": 0.0, "T_z": 0.0}
    return from_mjcf(
        on.model,
        horizon=1.5,
        dt=0.03,
        x_init=np.concatenate([[0.0, 0.03, 0.3, 0.0, 0.0], np.zeros(5)]),
        running_residual=on.control(weight=1e-3),
        terminal_residual=on.posture(wanted, weight=[1e3, 1e3, 10.0]),
        goal=lambda data: np.all(np.abs(data.qpos[:3]) < [0.015, 0.015, 0.15]),
    )


def arm(path: Path, hand: str = "right_hand", start: Sequence[float] | None = None) -> Problem:
    """Turns its hand by 70 degrees about the base, around a ball in the middle of the way.

    From the first keyframe if no start is given. Of motors torques cost most; controls of servos
    are angles, and velocities cost.
    """
    model = load(path)
    home = np.array(model.key_qpos[0] if start is None else start)
    turned = home + np.eye(len(home))[0] * np.deg2rad(70)
    (_, middle, end), on = _poses(model, hand, np.linspace(home, turned, 3)), Terms(model)
    if (model.actuator_biastype != 0).any():
        running = on.velocity(weight=1e-2)
    else:
        half = 0.5 * np.ptp(model.actuator_ctrlrange, axis=1)
        running = on.control(weight=1e-2 / half**2) + on.velocity(weight=1e-3)
    links = tuple(range(2, model.nbody))

    def there(data: mujoco.MjData) -> bool:
        off = np.linalg.norm(data.body(hand).xpos - end[0])
        along = data.body(hand).xmat[[2, 5, 8]] @ _axes(end[1])[:, 2]
        return bool(off < 0.02 and along > 0.99 and np.abs(data.qvel).max() < 0.3)

    return from_mjcf(
        model,
        horizon=1.2,
        dt=0.02,
        x_init=np.concatenate([home, np.zeros(model.nv)]),
        running_residual=running,
        terminal_residual=on.body(hand, *end, weight=1e3) + on.velocity(weight=10.0),
        inequality=Partial(_too_near, links, middle[0]),
        contacts=False,
        goal=there,
    )


def _too_near(links: tuple[int, ...], ball: np.ndarray, data: Any, u: Array) -> Array:
    """How much nearer than 0.15 m to a ball the frames of links are [m], about."""
    squared = jnp.sum((data.xpos[jnp.array(links)] - ball) ** 2, axis=1)
    return (0.15**2 - squared) / 0.3


def _poses(
    model: mujoco.MjModel, body: str, postures: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Position and quaternion of a body in each posture (n, nq)."""
    data, found = mujoco.MjData(model), []
    for data.qpos[:] in postures:
        mujoco.mj_kinematics(model, data)
        found.append((data.body(body).xpos.copy(), data.body(body).xquat.copy()))
    return found


def _axes(quaternion: np.ndarray) -> np.ndarray:
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, quaternion)
    return turn.reshape(3, 3)


def legs(
    posture: Mapping[str, float],
    feet: str,
    path: Path,
    forward: float = 0.0,
    bends: tuple[float, float] = (1.0, 1.0),
    actuators: Actuators | None = None,
) -> Problem:
    """From a posture on the floor to the same, some way ahead; legs are bent `bends` times."""
    spec = mujoco.MjSpec.from_file(str(path))
    if actuators is not None:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # for stiff servos
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    spec.option.gravity = [0, 0, -9.81]  # robosuite's files have none
    if actuators is not None:
        add_motors(spec, actuators, spec.modelname)
    model = spec.compile()
    start, end = (_standing(model, posture, feet, by) for by in bends)
    end[0] += forward
    on = Terms(model)
    weights = np.append(np.full(6, 300.0), np.full(model.nv - 6, 3.0))

    def there(data: mujoco.MjData) -> bool:
        upright = data.body(int(model.jnt_bodyid[0])).xmat[8] > 0.95
        return bool(upright and np.abs(data.qpos[:3] - end[:3]).max() < 0.08)

    return from_mjcf(
        model,
        horizon=0.8,
        dt=0.02,
        x_init=np.concatenate([start, np.zeros(model.nv)]),
        running_residual=on.posture(end, weight=1e-3 * weights) + on.velocity(weight=1e-3),
        terminal_residual=on.posture(end, weight=weights) + on.velocity(weight=1.0),
        contacts=[(feet, "ground")],
        goal=there,
    )


def _standing(
    model: mujoco.MjModel, posture: Mapping[str, float], feet: str, by: float
) -> np.ndarray:
    """qpos (nq,) with `by` times the angles of joints whose names end so, feet on the ground.

    They are 0.1 mm in it: where they just touch, rounding would decide whether the ground pushes.
    """
    data, ground = mujoco.MjData(model), model.geom("ground").id
    for j in range(1, model.njnt):
        angle = next((a for end, a in posture.items() if model.joint(j).name.endswith(end)), 0.0)
        data.qpos[model.jnt_qposadr[j]] = by * angle
    data.qpos[2] = 2.0
    mujoco.mj_kinematics(model, data)
    names = [(model.geom(g).name, model.body(b).name) for g, b in enumerate(model.geom_bodyid)]
    touches = (model.geom_contype | model.geom_conaffinity) != 0
    down = [g for g in np.flatnonzero(touches) if any(fnmatch(n, feet) for n in names[g])]
    data.qpos[2] -= min(mujoco.mj_geomDistance(model, data, g, ground, 9.0, None) for g in down)
    data.qpos[2] -= 1e-4
    return data.qpos.copy()


def fetch(path: Path) -> Problem:
    """Pushes the block on the table 8 cm ahead, with servos in the arm."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:2] = 0.405, 0.48  # where the base stands
    model.eq_data[0, 3:10] = np.eye(7)[3]  # the gripper goes to where the mocap body is
    data.mocap_pos[0], data.mocap_quat[0] = (1.22, 0.75, 0.44), (1.0, 0.0, 1.0, 0.0)
    mujoco.mj_step(model, data, 1500)
    spec.delete(spec.equalities[0])
    parts = ("shoulder", "upperarm", "elbow", "forearm", "wrist")
    add_motors(spec, {"position": {f"robot0:{part}*": 300.0 for part in parts}}, "fetch")
    on = Terms(spec.compile())
    block, target = np.array([1.27, 0.75, 0.425]), np.array([1.35, 0.75, 0.425])
    return from_mjcf(
        on.model,
        horizon=1.0,
        dt=0.02,
        x_init=np.concatenate([data.qpos[:15], block, np.eye(4)[0], np.zeros(model.nv)]),
        running_residual=on.velocity(weight=1e-3),
        terminal_residual=on.site("object0", target, weight=1e3) + on.velocity(weight=0.1),
        contacts=[("robot0:*_gripper_finger_link", "object0"), ("object0", "table0")],
        goal=lambda data: np.linalg.norm(data.site("object0").xpos - target) < 0.03,
    )


def hand(path: Path) -> Problem:
    """Turns the cube on its palm by 90 degrees about the vertical."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.delete(spec.body("target"))  # which shows what is wanted
    on = Terms(spec.compile())
    data, turned = mujoco.MjData(on.model), np.empty(4)
    mujoco.mj_step(on.model, data, 500)  # the cube falls onto the palm
    place, quarter = data.body("object").xpos.copy(), np.array([1.0, 0.0, 0.0, 1.0]) / 2**0.5
    mujoco.mju_mulQuat(turned, quarter, data.body("object").xquat)

    def there(data: mujoco.MjData) -> bool:
        off = np.linalg.norm(data.body("object").xpos - place)
        cosines = np.sum(_axes(turned) * data.body("object").xmat.reshape(3, 3), axis=0)
        return bool(off < 0.04 and cosines.min() > 0.9)

    return from_mjcf(
        on.model,
        horizon=2.0,
        dt=0.02,
        x_init=np.concatenate([data.qpos, np.zeros(on.model.nv)]),
        running_residual=on.velocity(weight=1e-3),
        terminal_residual=on.body("object", place, turned, weight=[300.0] * 3 + [30.0] * 3),
        contacts=[("robot0:C_*", "object")],
        goal=there,
    )


PANDA = (0.0, 0.2, 0.0, -2.2, 0.0, 2.4, 0.8)
UR5E = (-0.47, -1.73, 2.3, -2.2, -1.59, 0.0)
IIWA = (0.0, 0.65, 0.0, -1.6, 0.0, 0.8, 0.0)
GO1 = {"_thigh_joint": 0.9, "_calf_joint": -1.8}
SPOT = {"_hy_leg_joint": 0.8, "_kn_leg_joint": -1.6}
G1 = {"_hip_pitch_joint": -0.31, "_knee_joint": 0.67, "_ankle_pitch_joint": -0.36}
H1 = {"_hip_pitch": -0.4, "_knee": 0.8, "_ankle": -0.4}

_ARMS, _LEGS = "robosuite/models/assets/robots", "mjlab/asset_zoo/robots"
_GYM = "gymnasium_robotics/envs/assets"
_go1 = partial(legs, GO1, "*_foot_collision", actuators={"position": 60.0})
_spot = partial(legs, SPOT, "??_lleg")  # of which not the feet alone come down
_g1 = partial(legs, G1, "*_foot*_collision", actuators={"position": 200.0})
_h1 = partial(legs, H1, "*_ankle_link")

TASKS: dict[str, tuple[str, Callable[[Path], Problem]]] = {
    "double_cart_pole": ("hydrax/models/double_cart_pole/scene.xml", double_cart_pole),
    "walker": ("hydrax/models/walker/scene.xml", walker),
    "crane": ("hydrax/models/crane/scene.xml", crane),
    "pusht": ("hydrax/models/pusht/scene.xml", pusht),
    "panda": (f"{_ARMS}/panda/robot.xml", partial(arm, start=PANDA)),
    "ur5e": (f"{_ARMS}/ur5e/robot.xml", partial(arm, start=UR5E)),
    "iiwa": (f"{_ARMS}/iiwa/robot.xml", partial(arm, start=IIWA)),
    "panda_servos": ("mujoco_menagerie/franka_emika_panda/panda.xml", partial(arm, hand="hand")),
    "ur5e_servos": (
        "mujoco_menagerie/universal_robots_ur5e/ur5e.xml",
        partial(arm, hand="wrist_3_link"),
    ),
    "xarm7_servos": (
        "mujoco_menagerie/ufactory_xarm7/xarm7_nohand.xml",
        partial(arm, hand="link7"),
    ),
    "kinova_servos": (
        "mujoco_menagerie/stanford_tidybot/tidybot.xml",
        partial(arm, hand="bracelet_link"),
    ),
    "go1_servos": (
        "mujoco_menagerie/unitree_go1/go1.xml",
        partial(legs, GO1, "??", forward=0.3),
    ),
    "go1_stand": (f"{_LEGS}/unitree_go1/xmls/go1.xml", _go1),
    "go1_forward": (f"{_LEGS}/unitree_go1/xmls/go1.xml", partial(_go1, forward=0.3)),
    "spot_stand": (f"{_ARMS}/spot/robot.xml", _spot),
    "spot_forward": (f"{_ARMS}/spot/robot.xml", partial(_spot, forward=0.3)),
    "g1_stand_up": (f"{_LEGS}/unitree_g1/xmls/g1.xml", partial(_g1, bends=(1.8, 1.0))),
    "g1_squat": (f"{_LEGS}/unitree_g1/xmls/g1.xml", partial(_g1, bends=(1.0, 1.8))),
    "g1_step": (f"{_LEGS}/unitree_g1/xmls/g1.xml", partial(_g1, forward=0.2)),
    "h1_stand_up": ("mujoco_menagerie/unitree_h1/h1.xml", partial(_h1, bends=(1.8, 1.0))),
    "h1_squat": ("mujoco_menagerie/unitree_h1/h1.xml", partial(_h1, bends=(1.0, 1.8))),
    "h1_step": ("mujoco_menagerie/unitree_h1/h1.xml", partial(_h1, forward=0.2)),
    "fetch_push": (f"{_GYM}/fetch/push.xml", fetch),
    "hand_turn": (f"{_GYM}/hand/manipulate_block.xml", hand),
}
"""The file of each task, by its path from the package's name on, and what makes the problem."""


def model_file(inside: str, folder: Path | None = None) -> Path:
    """Where a file of a package is: below a folder, or where the package is installed."""
    package, rest = inside.split("/", 1)
    if folder is None:
        spec = importlib.util.find_spec(package)
        places = spec.submodule_search_locations if spec else None
        found = [Path(place) / rest for place in places or []]
    else:
        found = sorted(folder.rglob(inside))
    for path in found:
        if path.is_file():
            return path
    raise DraxError(
        f"there is no {inside} {f'below {folder}' if folder else 'installed'}: pip install "
        f"{package}, or unpack it and give --path the folder that holds {package}/."
    )


def named(name: str, folder: Path | None = None, **settings: Any) -> Problem:
    """The problem of a task of `TASKS`, whose file lies below a folder, or is installed.

    Of another name, that of a task of this project, with these settings.
    """
    if name not in TASKS:
        return tasks.load(name).make(**settings)
    inside, make = TASKS[name]
    return replace(make(model_file(inside, folder)), name=name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Solve and print the table; 0 if every best chain is certified."""
    parser = argparse.ArgumentParser(prog="python -m mjx_drax.studies.robots", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(TASKS)}")
    parser.add_argument("--path", type=Path, metavar="DIR", help="where the packages' files lie")
    parser.add_argument("--chains", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="solves of each task")
    parser.add_argument("--attempts", type=int, default=5, metavar="N", help="default 5")
    parser.add_argument("--seconds", type=float, metavar="S", help="end each solve after so long")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in TASKS]
    if unknown:
        print(f"there is no task {', '.join(unknown)}: use {', '.join(TASKS)}.", file=sys.stderr)
        return 2
    try:
        for count in ("chains", "seeds", "attempts"):
            require_whole(f"--{count}", getattr(options, count))
        if options.seconds is not None:
            require_positive("--seconds", options.seconds)
    except DraxError as error:
        print(error, file=sys.stderr)
        return 2
    print(start(), flush=True)
    certified, refused = True, []
    settings = {"solver": Restarts(attempts=options.attempts), "max_seconds": options.seconds}
    for name in options.names or TASKS:
        try:
            problem = named(name, options.path)
        except DraxError as error:
            refused.append(f"{name}: {error}")
            continue
        for row, solution in answers(problem, options.chains, options.seeds, **settings):
            print(row, flush=True)
            certified = certified and solution.certified
    print("\n".join(["", *refused]))
    return 0 if certified and not refused else 1


if __name__ == "__main__":
    sys.exit(main())
