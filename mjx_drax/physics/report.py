"""What is planned with for a model, and how far MJX is from MuJoCo's C engine: `mjx-drax check`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.actuators import control_ranges, largest_moment_arms
from mjx_drax.physics.agreement.checks import Findings, checked_start, examine, require_sensors
from mjx_drax.physics.agreement.differences import differences
from mjx_drax.physics.contacts.pairs import Contacts, contact_pairs
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjcf import steps_between_knots
from mjx_drax.physics.mjx_model import (
    constraint_rows,
    contact_points,
    has_limits,
    kept_contacts,
    put_model,
)
from mjx_drax.physics.motors import Actuators
from mjx_drax.physics.near import affordable, parts_differ, without_own
from mjx_drax.physics.source import Given, load, model_name

Report = dict[str, Any]


def check(
    source: Given,
    progress: Callable[[str], None] = lambda line: None,
    contacts: Contacts = True,
    actuators: Actuators | None = None,
) -> Report:
    """What `mjx-drax check` prints, as numbers and words that JSON can hold.

    Args:
        source: MJCF file, XML string, `mujoco.MjSpec` or `mujoco.MjModel`.
        progress: called with a line before what takes long.
        contacts, actuators: as for `from_mjcf`.

    Returns:
        `sizes`, `timing`, `joints`, `actuators`, `contact_pairs`, `contact_points` (`all`, those
        that a plan has `kept`, and of how many it keeps `nearest` of each friction dimension, None
        if all), `differences` (what MJX computes differently, whether or not a step shows it),
        `agreement` (None where the step could not be compiled), `notes` (what `from_mjcf` warns
        of) and `obstacle`: a sentence, or None if the model can be used.

    Raises:
        DraxError: the file is missing or MuJoCo cannot compile it.
    """
    model = load(source, actuators)
    name = model_name(model)
    steps = steps_between_knots(model, None)
    report: Report = {
        "model": name,
        "sizes": {
            "nq": model.nq,
            "nv": model.nv,
            "nu": model.nu,
            "na": model.na,
            "ndx": 2 * model.nv + model.na,
            "constraint_rows": None,
        },
        "timing": {
            "timestep": model.opt.timestep,
            "dt": steps * model.opt.timestep,
            "integrator": mujoco.mjtIntegrator(model.opt.integrator).name[6:],
        },
        "joints": [],
        "actuators": [_actuator(model, a) for a in range(model.nu)],
        "contact_pairs": sum(1 for _ in contact_pairs(model)),
        "contact_points": {"all": None, "kept": None, "nearest": None},
        "differences": [],
        "agreement": None,
        "notes": [],
        "obstacle": None,
    }
    try:
        x_init, bounded = checked_start(model, name)
        report["joints"] = _joints(model, bounded)
        by_default = contacts is True
        contacts, left_out = affordable(model, name, x_init, bounded, contacts)
        report["notes"] = [left_out] if left_out else []
        report["differences"] = [each.sentence for each in differences(model, contacts)]
        planned = put_model(model, contacts, bounded)
        report["contact_points"]["all"] = len(contact_points(put_model(model, np.iinfo(int).max)))
        _count(report, planned)
        progress(f"{name}: compiling one step of MJX and its derivatives ...")
        require_sensors(model, name, planned)
        kept = kept_contacts(planned)
        look = partial(examine, model, name, x_init, contacts, bounded, kept)
        # Derivatives take most of the time, and the model may not be planned with as it is
        doubted = by_default and parts_differ(model, x_init, bounded, contacts)
        found, fewer = look(derivatives=not doubted), None
        if found.obstacle and by_default:
            fewer = without_own(model, name, x_init, bounded, contacts, derivatives=True)
        if fewer is not None:
            planned, found = fewer
            _count(report, planned)
        elif doubted:
            found = look(derivatives=True)
        report["agreement"] = _agreement(found)
        report["notes"] += found.notes
        report["obstacle"] = found.obstacle
    except DraxError as error:
        report["obstacle"] = str(error)
    return report


def _count(report: Report, planned: mjx.Model) -> None:
    """Write down the constraints and contacts of a plan."""
    report["sizes"]["constraint_rows"] = constraint_rows(planned)
    report["contact_points"] |= {
        "kept": len(contact_points(planned)),
        "nearest": kept_contacts(planned),
    }


def _agreement(found: Findings) -> Report:
    return {
        "velocity_error": float(found.errors.velocity.max()),
        "velocity_error_at_x_init": float(found.errors.velocity[0]),
        "states": len(found.errors.velocity),
        "jacobian_error_at_x_init": found.errors.jacobian,
    }


def _joints(model: mujoco.MjModel, bounded: np.ndarray) -> list[Report]:
    """Every joint: what drives it, and whether its range is a bound or a limit in the dynamics."""
    pulls, found = largest_moment_arms(model) > 0, []
    for j in range(model.njnt):
        limited = bool(model.jnt_limited[j]) and has_limits(model)
        actuators = np.flatnonzero(pulls[:, model.dof_jntid == j].any(axis=1))
        range_ = model.jnt_range[j].tolist() if limited else None
        found.append(
            {
                "name": _name(model.joint(j), f"joint {j}"),
                "type": mujoco.mjtJoint(model.jnt_type[j]).name[6:].lower(),
                "range": range_,
                "range_is": "none" if not limited else "bound" if bounded[j] else "physics",
                "driven_by": [_name(model.actuator(a), f"actuator {a}") for a in actuators],
            }
        )
    return found


def _actuator(model: mujoco.MjModel, a: int) -> Report:
    kind = "motor"
    if model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE:
        kind = "muscle"
    elif model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
        kind = "servo"
    elif model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_AFFINE:
        kind = "damper"
    if model.actuator_actnum[a]:
        kind += " with state"
    transmission = mujoco.mjtTrn(model.actuator_trntype[a]).name[6:].lower()
    target = int(model.actuator_trnid[a, 0])
    of = {"joint": model.joint, "jointinparent": model.joint, "tendon": model.tendon,
          "site": model.site, "body": model.body}.get(transmission)  # fmt: skip
    named = _name(of(target), str(target)) if of else str(target)
    ends = [float(end[a]) for end in control_ranges(model, without=np.inf)]
    return {
        "name": _name(model.actuator(a), f"actuator {a}"),
        "kind": kind,
        "drives": f"{transmission} {named}",
        "range": ends if np.isfinite(ends).all() else None,
    }


def _name(element: Any, otherwise: str) -> str:
    return str(element.name or otherwise)


def text(report: Report) -> str:
    """The report for a person."""
    sizes, timing = report["sizes"], report["timing"]
    rows, points = sizes["constraint_rows"], report["contact_points"]
    if points["kept"] == points["all"]:
        kept = "all of them in a plan"
    elif points["nearest"] is None:  # those of other pairs are left out
        kept = f"a plan keeps {points['kept']}"
    else:
        kept = f"a plan keeps {points['kept']}, the nearest {points['nearest']} of each condim"
    lines = [
        f"model        {report['model']}",
        "sizes        " + ", ".join(f"{k} {sizes[k]}" for k in ("nq", "nv", "nu", "na", "ndx")),
        f"constraints  {'unknown' if rows is None else rows} rows, "
        f"{report['contact_pairs']} pairs of geoms that may touch",
        "contacts     " + ("unknown" if rows is None else f"{points['all']} points, {kept}"),
        f"time         timestep {timing['timestep']:g} s, dt {timing['dt']:g} s, "
        f"integrator {timing['integrator']}",
    ]
    words = {"bound": "a bound on knots", "physics": "a limit in the dynamics"}
    for joint in report["joints"]:
        where = words.get(joint["range_is"])
        range_ = f"range {_range(joint['range'])} is {where}" if where else "no range"
        driven = (
            "driven by " + ", ".join(joint["driven_by"]) if joint["driven_by"] else "not driven"
        )
        lines.append(f"joint        {joint['name']}: {joint['type']}, {range_}, {driven}")
    for actuator in report["actuators"]:
        range_ = _range(actuator["range"]) if actuator["range"] else "without limits"
        lines.append(
            f"actuator     {actuator['name']}: {actuator['kind']} on {actuator['drives']}, "
            f"control {range_}"
        )
    found = report["agreement"]
    if found:
        lines += [
            f"one step     velocities within {found['velocity_error']:.1e} of MuJoCo's C engine "
            f"in {found['states']} states ({found['velocity_error_at_x_init']:.1e} at x_init)",
            f"derivatives  within {found['jacobian_error_at_x_init']:.1e} of the C engine's finite "
            "differences at x_init, relative to the largest",
        ]
    lines += [f"may differ   {sentence}" for sentence in report["differences"]]
    lines += [f"note         {sentence}" for sentence in report["notes"]]
    obstacle = report["obstacle"]
    return "\n".join([*lines, "CAN BE USED" if obstacle is None else f"CANNOT BE USED: {obstacle}"])


def _range(ends: list[float]) -> str:
    return f"{ends[0]:.4g} to {ends[1]:.4g}"
