"""Actuators for models that have none, such as robots of planners and of learning libraries."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_drax.base.errors import DraxError, is_number, shown
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import HINGE, SLIDE

Actuators = str | Mapping[str, Any]
"""What `add_motors` takes."""

_FORMS = (
    'give "torque", {"torque": limit} or {"position": kp}, where limits [N m, N] and gains '
    "[N m/rad, N/m] are positive numbers or {pattern of joint names: number}"
)


_SETTINGS = ("gear", "group", "armature", "damping", "delay", "nsample")
"""What an actuator has of the file's defaults after it is set to a motor or a servo."""


def add_motors(spec: mujoco.MjSpec, actuators: Actuators, name: str) -> None:
    """Give each hinge and slide an actuator of its own name.

    "torque" makes motors, whose control is the torque [N m] or force [N]. {"position": kp} makes
    servos, whose control is a target q* [rad, m]:

        tau = kp (q* - q) - kv dq/dt,        kv for critical damping at the default pose

    A motor's limit is the range that the joint gives by `actuatorfrcrange` (a URDF's effort), else
    the number given, else there is none. A servo's control has the range of the joint. With
    {pattern: number} only joints whose names fit a pattern get one; the first that fits counts.
    A joint that an equality makes follow another (a URDF's mimic) gets one by its whole name only.

    Args:
        spec: of a model, which is changed.
        actuators: as above.
        name: what errors call the model.

    Raises:
        DraxError: actuators has another form, the model has actuators, or a pattern fits no joint.
    """
    kind, numbers = _parsed(actuators)
    model = spec.compile()
    if model.nu:
        raise DraxError(
            f"actuators is {shown(actuators)}, and {name} has {model.nu} of its own: leave it out."
        )
    fitted, plain = set(), mujoco.MjSpec().add_actuator()
    followers = {
        equality.name1
        for equality in spec.equalities
        if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.active
    }
    for joint in spec.joints:
        j = joint.id
        if model.jnt_type[j] not in (HINGE, SLIDE):
            continue
        pattern = next((p for p in numbers if fnmatch.fnmatchcase(joint.name, p)), None)
        if pattern is None or (joint.name in followers and pattern != joint.name):
            continue
        fitted.add(pattern)
        joint.name = joint.name or f"joint_{j}"
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        number, limit = numbers[pattern], None
        if kind == "position":
            actuator.set_to_position(kp=number, dampratio=1.0)
            limit = model.jnt_range[j] if model.jnt_limited[j] else None
        else:
            actuator.set_to_motor()
            if model.jnt_actfrclimited[j]:
                limit = model.jnt_actfrcrange[j]
            elif number is not None:
                limit = np.array([-number, number])
        for setting in _SETTINGS:  # defaults of the file are for other actuators
            setattr(actuator, setting, getattr(plain, setting))
        actuator.forcelimited, actuator.ctrllimited = 0, int(limit is not None)
        if limit is not None:
            actuator.ctrlrange = limit
    if not fitted or set(numbers) - fitted:
        wrong = ", ".join(map(repr, [p for p in numbers if p not in fitted]))
        names = ", ".join(repr(joint.name) for joint in spec.joints if joint.name)
        raise DraxError(
            f"actuators: no hinge or slide of {name} fits {wrong}: its joints are "
            f"{names or 'none with a name'}."
        )


def _parsed(actuators: Actuators) -> tuple[str, dict[str, float | None]]:
    """The kind of actuators, and the number of each pattern of joint names."""
    given: Any = {actuators: None} if actuators == "torque" else actuators
    if (
        not isinstance(given, Mapping)
        or len(given) != 1
        or not set(given) <= {"torque", "position"}
    ):
        raise DraxError(f"actuators is {shown(actuators)}: {_FORMS}.")
    ((kind, value),) = given.items()
    numbers = dict(value) if isinstance(value, Mapping) else {"*": value}
    if given is actuators and not all(is_number(n) and n > 0 for n in numbers.values()):
        raise DraxError(f"actuators is {shown(actuators)}: {_FORMS}.")
    return kind, numbers
