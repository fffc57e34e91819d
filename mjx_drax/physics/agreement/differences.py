"""What MJX is known to compute differently from MuJoCo's C engine, or to leave out.

Each difference can be taken out of a model, so that `checks` can measure what it does: it compares
the engines with it and without it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_drax.physics.contacts.pairs import Contacts, Pair, geom_name, of_hulls, touching
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjx_model import (
    IMPLICIT,
    LIMIT,
    OTHER_CONTACTS,
    PAIRS,
    held_dofs,
    unknown_sensors,
)

_DISABLE = mujoco.mjtDisableBit

Change = Callable[[mujoco.MjModel], None]


@dataclass(frozen=True)
class Difference:
    """Something in a model.

    Attributes:
        sentence: what it is, and what to do.
        without: takes it out of a model, which it changes.
    """

    sentence: str
    without: Change


def setting(names: str, value: Any, where: Any = ...) -> Change:
    """Gives arrays of a model, named in one text, another value."""

    def change(model: mujoco.MjModel) -> None:
        for name in names.split():
            getattr(model, name)[where] = value

    return change


def option(name: str, value: Any) -> Change:
    """Gives a model another option."""
    return lambda model: setattr(model.opt, name, value)


def disabling(flag: mujoco.mjtDisableBit) -> Change:
    """Switches something off in a model."""

    def change(model: mujoco.MjModel) -> None:
        model.opt.disableflags |= int(flag)

    return change


def differences(
    model: mujoco.MjModel, contacts: Contacts = True, acting: Collection[Pair] | None = None
) -> list[Difference]:
    """What MJX computes differently in this model.

    Found by comparing one step of both engines in many models: each changed velocities by 2e-5 to
    5. Of contacts only those of pairs that are `acting` count, by default all that may touch.
    """
    pairs = sorted(touching(model, contacts))
    if acting is not None:
        both = {*acting, *((b, a) for a, b in acting)}
        pairs = [pair for pair in pairs if pair in both]
    integrator = mujoco.mjtIntegrator(model.opt.integrator).name[len("mjINT_") :].lower()
    cases: list[tuple[Any, str, Change]] = [
        (
            model.opt.integrator in IMPLICIT,
            f'integrator "{integrator}" is planned with as "implicitfast": choose that, or "Euler"',
            option("integrator", int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)),
        ),
        (
            model.opt.noslip_iterations,
            "noslip_iterations are not made: set them to 0",
            option("noslip_iterations", 0),
        ),
        (
            np.any(model.jnt_stiffnesspoly) or np.any(model.tendon_stiffnesspoly),
            "polynomial stiffness is left out: use linear springs",
            setting("jnt_stiffnesspoly tendon_stiffnesspoly", 0.0),
        ),
        (
            np.any(model.dof_dampingpoly) or np.any(model.tendon_dampingpoly),
            "polynomial damping is left out: use linear dampers",
            setting("dof_dampingpoly tendon_dampingpoly", 0.0),
        ),
        (
            model.actuator_actearly,
            "early activation (actearly) is left out: set it to false",
            setting("actuator_actearly", False),
        ),
        (
            model.actuator_delay,
            "actuators' delays are left out: remove them",
            setting("actuator_delay", 0.0),
        ),
        (
            np.any(model.actuator_damping) or np.any(model.actuator_armature),
            "actuators' own damping and armature are left out: give them to the joints",
            setting("actuator_damping actuator_armature", 0.0),
        ),
        (
            model.geom_fluid[:, 0],
            "the ellipsoid fluid model differs: use the inertia box",
            setting("geom_fluid", 0.0),
        ),
        (
            model.jnt_limited * (2 * model.jnt_margin > np.ptp(model.jnt_range, axis=1)),
            "where a joint is within its margin of both ends of its range, MJX has one limit act "
            "and MuJoCo two: make the margin less than half of the range",
            setting("jnt_margin", 0.0),
        ),
        (
            model.nplugin,
            "plugins are left out: remove them",
            setting("body_plugin geom_plugin actuator_plugin sensor_plugin", -1),
        ),
        (
            [model.geom_margin[list(pair)].any() and of_hulls(model, pair) for pair in pairs],
            "hulls of meshes touch where they overlap, and not at a margin: set it to 0",
            setting("geom_margin", 0.0),
        ),
    ]
    found = [Difference(text, without) for condition, text, without in cases if np.any(condition)]
    for a, b in pairs:
        if (int(model.geom_type[a]), int(model.geom_type[b])) in OTHER_CONTACTS:
            sentence = (
                f"contacts like that of {geom_name(model, a)!r} with {geom_name(model, b)!r} "
                "differ: use spheres, capsules and planes, or choose contacts without them, "
                'contacts=[("foot_*", "floor"), ...]'
            )
            return [*found, Difference(sentence, disabling(_DISABLE.mjDSBL_CONTACT))]
    return found


PARTS = {
    "contacts": _DISABLE.mjDSBL_CONTACT,
    "equality constraints": _DISABLE.mjDSBL_EQUALITY,
    "limits": _DISABLE.mjDSBL_LIMIT,
    "dry friction": _DISABLE.mjDSBL_FRICTIONLOSS,
    "actuators": _DISABLE.mjDSBL_ACTUATION,
}
"""Parts of a model that can be switched off, where nothing that is known explains an error."""


def set_aside(model: mujoco.MjModel) -> list[str]:
    """What a model asks for and does not get, a sentence each; no step shows it."""
    found = []
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        found.append("bodies do not fall asleep in a plan: clear the flag sleep")
    held = held_dofs(model)
    if held.any():
        joints = [str(model.joint(j).name or j) for j in np.unique(model.dof_jntid[held])]
        found.append(
            f"damping holds {', '.join(joints)}, and in a plan inertia does: when the load changes "
            "quickly, forces of limits and equality constraints differ until it has settled"
        )
    customs = [model.numeric(i).name for i in range(model.nnumeric)]
    given = " and ".join(name for name in (PAIRS, LIMIT) if name in customs)
    if given:
        found.append(
            f"the model's own {given} for MJX {'are' if ' and ' in given else 'is'} set aside: "
            "contacts=... says how many contacts a plan keeps"
        )
    found += [
        f"sensor {model.sensor(int(i)).name!r} is unknown to MJX: a cost cannot read it"
        for i in np.flatnonzero(unknown_sensors(model))
    ]
    bodies = np.flatnonzero(model.body_mocapid >= 0)
    if model.nkey and bodies.size:
        which = model.body_mocapid[bodies]
        there = model.key_mpos[0].reshape(-1, 3)[which], model.key_mquat[0].reshape(-1, 4)[which]
        here = model.body_pos[bodies], model.body_quat[bodies]
        moved = [np.abs(a - b).max(axis=1) > 1e-6 for a, b in zip(here, there, strict=True)]
        found += [
            f"mocap body {model.body(int(i)).name!r} stays where the file has it, and not where "
            "the first keyframe does: give the body the keyframe's pos and quat"
            for i in bodies[moved[0] | moved[1]]
        ]
    return found
