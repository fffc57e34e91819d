"""The MJX model that is made of a MuJoCo model: it plans what the MuJoCo model certifies.

MJX computes the same physics from the same `mujoco.MjModel`, with exceptions. Where an equal model
exists that MJX supports (another solver, flag or group), it gets that one. What MJX refuses is said
in an error, with the fix. Some things it computes differently without saying so: `differences`
knows those that a model has, and `checks` measures whether they matter.
"""

from __future__ import annotations

import copy
import fnmatch
import re
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.kernels.linalg import product
from mjx_drax.physics._mjx import COLLISIONS, internal, mjx
from mjx_drax.physics.actuators import disabled, driven
from mjx_drax.physics.contacts.collision import extended, make_data, signature
from mjx_drax.physics.contacts.pairs import (
    Contacts,
    Pair,
    geom_name,
    left_out,
    numbered_pairs,
)
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import HINGE, SLIDE

Stops = bool | Sequence[str]
"""Which driven joints may lean on their limits: all, none, or patterns of names."""

_DISABLE, _ENABLE, _GEOM = mujoco.mjtDisableBit, mujoco.mjtEnableBit, mujoco.mjtGeom
_SENSORS = {int(kind) for kind in mjx.SensorType}
_TOUCHED = (mujoco.mjtSensor.mjSENS_TOUCH, mujoco.mjtSensor.mjSENS_CONTACT)
NOT_COMPUTED = -1
"""First integer parameter of a sensor that MJX does not compute, so that no cost reads it."""

_ALL, _NET_FORCE = 0, 3
"""How contact sensors say reduce="none" and reduce="netforce"."""

MOST_CONTACTS = 32
"""Contact points of each friction dimension (condim) that a plan keeps by default: as many as eight
boxes on the floor have. A step with half as many takes as long."""

IMPLICIT = (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_DISCRETE)
"""Integrators that are planned with as "implicitfast"."""

HELD = 1e5
"""Damping, in M / timestep, above which a joint stays where it is, as a base does that a file holds
by a damping of 1e11. In a plan inertia holds it: the force of such damping on a velocity that is a
rounding error would move everything else.
"""

LIMIT, PAIRS = "max_contact_points", "max_geom_pairs"
"""Custom numbers of a model that tell MJX how many contact points and pairs of geoms to keep."""


def put_model(
    model: mujoco.MjModel, contacts: Contacts = True, bounded: np.ndarray | None = None
) -> mjx.Model:
    """The MJX model of a MuJoCo model.

    Args:
        model: which is not changed.
        contacts: False leaves contacts out; a number keeps so many contact points of each friction
            dimension (condim), the nearest ones in every state; True keeps `MOST_CONTACTS`, and so
            do pairs of names, of the contacts between these geoms or bodies.
        bounded: joints whose ranges are bounds of the knots, (njnt,). Inside of its range the force
            of a limit is zero, so its constraint row is left out; the C engine keeps it.

    Raises:
        DraxError: MJX does not support the model; says what and what to do.
    """
    without = left_out(model, contacts)
    supported = copy.deepcopy(model)
    if bounded is not None:
        supported.jnt_limited[bounded] = 0
    if not contacts:
        supported.opt.disableflags |= int(_DISABLE.mjDSBL_CONTACT)
        without = set()
    _make_supported(supported, without)
    try:
        with extended(without):
            on_device = mjx.put_model(supported, device=jax.local_devices()[0], impl="jax")
        put_back = ("geom_margin", "pair_margin", "geom_condim", "pair_dim")
        on_device = on_device.replace(**{name: getattr(model, name) for name in put_back})
        if without:
            signatures = sorted(signature(*pair) for pair in without)
            excluded = np.append(on_device.exclude_signature, signatures)
            on_device = on_device.replace(exclude_signature=excluded)
        on_device = _with_contact_limit(on_device, contacts)
    except (NotImplementedError, ValueError) as error:
        raise DraxError(_refusal(supported, without, str(error))) from error
    if not model.nmat:  # MJX's rangefinders read materials, also where there are none
        on_device = on_device.replace(mat_rgba=np.ones((1, 4), np.float32))
    # MJX commits its arrays to a device, and so all that is computed from them. A loop that gets
    # its own output would then be compiled a second time, so they are put there uncommitted.
    # (`jnp.asarray` would compile a program for every shape.)
    placed: mjx.Model = jax.device_put(_with_springs(jax.tree.map(np.asarray, on_device)))
    return placed


def _with_contact_limit(model: mjx.Model, contacts: Contacts) -> mjx.Model:
    """The model, told to keep only the nearest contact points if it has more than it should.

    MJX reads how many to keep from a custom number of the model. It is added here, not in the MJCF,
    because a model may come compiled, and those of the model are set aside: they suit whoever wrote
    it. MJX's other number, `max_geom_pairs`, is not used: MJX then chooses pairs of geoms by their
    bounding spheres, before it knows distances, and loses contacts.
    """
    none = np.zeros(0, int)
    model = model.replace(
        nnumeric=0, numeric_adr=none, name_numericadr=none, numeric_data=np.zeros(0)
    )
    points = MOST_CONTACTS
    if isinstance(contacts, int | np.integer) and contacts is not True:
        points = int(contacts)
    if np.bincount(contact_points(model), minlength=1).max() <= points:
        return model
    return model.replace(
        nnumeric=1,
        numeric_data=np.array([float(points)]),
        numeric_adr=np.array([0]),
        name_numericadr=np.array([len(model.names)]),
        names=model.names + LIMIT.encode() + b"\0",
    )


def _with_springs(model: mjx.Model) -> mjx.Model:
    """The model, whose tendon springs have a derivative at their rest length too.

    MJX finds no force in a tendon that is neither longer nor shorter than its spring, and so no
    stiffness either. The rest length is made shorter by the last digit.
    """
    lower, upper = model.tendon_lengthspring.T
    upper = np.where(lower == upper, np.nextafter(upper, upper.dtype.type(-np.inf)), upper)
    return model.replace(tendon_lengthspring=np.stack([lower, upper], axis=1))


def _make_supported(model: mujoco.MjModel, without: set[Pair]) -> None:
    """Change a model into one that MJX supports and that moves alike, up to `differences`.

    Args:
        model: to change.
        without: pairs of geoms that are left out.
    """
    opt = model.opt
    opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)  # the inertia as `tree` computes it
    opt.solver = int(mujoco.mjtSolver.mjSOL_NEWTON)  # all solvers find the same minimum
    if opt.integrator in IMPLICIT:
        opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    if opt.density == 0.0 and opt.viscosity == 0.0:
        opt.wind[:] = 0.0  # of which MuJoCo takes no notice then, and MJX does
    opt.enableflags &= ~int(_ENABLE.mjENBL_ENERGY | _ENABLE.mjENBL_FWDINV | _ENABLE.mjENBL_SLEEP)
    springs, dampers = int(_DISABLE.mjDSBL_SPRING), int(_DISABLE.mjDSBL_DAMPER)
    if opt.disableflags & springs:
        model.jnt_stiffness[:] = 0.0
        model.tendon_stiffness[:] = 0.0
    if opt.disableflags & dampers:
        model.dof_damping[:] = 0.0
        model.tendon_damping[:] = 0.0
    if not (opt.disableflags & springs and opt.disableflags & dampers):
        # MJX leaves out all passive forces where one of the two flags is set, MuJoCo where both are
        opt.disableflags &= ~(springs | dampers)
    if opt.disableflags & (_DISABLE.mjDSBL_CONTACT | _DISABLE.mjDSBL_CONSTRAINT):
        # Otherwise MJX refuses geoms that it cannot collide
        model.geom_contype[:] = 0
        model.geom_conaffinity[:] = 0
    hold_by_inertia(model)
    touching = _pairs(model, without)
    if not touching or max([*model.geom_condim, *model.pair_dim]) == 1:
        # No contact has friction, and MJX fails if elliptic cones are asked for and there are none
        opt.cone = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
    # `put_model` and `collision` care for what MJX refuses: margins of meshes and height fields,
    # and among elliptic cones contacts without friction
    model.geom_margin[:], model.pair_margin[:] = 0.0, 0.0
    if opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        model.geom_condim[model.geom_condim == 1] = 3
        model.pair_dim[model.pair_dim == 1] = 3
    if not touching:  # MJX fails in these sensors, because there is no array of contacts
        touch = np.isin(model.sensor_type, [int(kind) for kind in _TOUCHED])
        model.sensor_type[touch] = int(mujoco.mjtSensor.mjSENS_CLOCK)  # 0 in every state, too
    model.actuator_gainprm[disabled(model)] = 0.0
    model.actuator_biasprm[disabled(model)] = 0.0
    model.actuator_dyntype[disabled(model)] = int(mujoco.mjtDyn.mjDYN_NONE)  # states stay
    unknown = unknown_sensors(model)
    model.sensor_type[unknown] = int(mujoco.mjtSensor.mjSENS_CLOCK)
    model.sensor_intprm[unknown, 0] = NOT_COMPUTED  # clocks have none


def with_subtree_masses(model: mjx.Model) -> mjx.Model:
    """The model with the masses of subtrees that follow from those of its bodies."""
    below = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):
        below[model.body_parentid[body]] += below[body]
    return model.replace(body_subtreemass=product(jnp.asarray(below), model.body_mass))


def held_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Degrees of freedom that damping holds where they are, as `HELD` says, (nv,)."""
    return np.asarray(model.dof_damping * model.opt.timestep > HELD * model.dof_M0)


def hold_by_inertia(model: mujoco.MjModel) -> None:
    """Change a model, so that inertia holds what damping held, as the integrator does."""
    held = held_dofs(model)
    model.dof_armature[held] += model.opt.timestep * model.dof_damping[held]
    model.dof_damping[held] = 0.0


def _pairs(model: mujoco.MjModel, without: set[Pair]) -> list[tuple[int, int, int]]:
    """Pairs of geoms that a plan has contacts of, each with the number of its <pair>, or -1."""
    return [pair for pair in numbered_pairs(model) if pair[:2] not in without]


_UNSEEN = (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_SDF)
"""Geoms that rays of MJX pass through."""


def unknown_sensors(model: mujoco.MjModel) -> np.ndarray:
    """Sensors that MJX does not compute, or not as the C engine does, (nsensor,).

    Those that read late are among them, lists of contacts (reduce="none"), whose order differs,
    rays where there are geoms that they pass through, and forces beside spatial tendons.
    """
    unknown = np.array([int(kind) not in _SENSORS for kind in model.sensor_type], bool)
    unknown |= (model.sensor_delay > 0) | (model.sensor_interval[:, 0] > 0)
    between = np.stack([model.sensor_objtype, model.sensor_reftype], axis=1)
    body = (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY)
    refused = np.isin(between, [int(kind) for kind in body]).any(axis=1)
    refused |= np.isin(model.sensor_intprm[:, 1], (_ALL, _NET_FORCE))
    unknown |= refused & (model.sensor_type == int(mujoco.mjtSensor.mjSENS_CONTACT))
    touch = np.flatnonzero(model.sensor_type == int(mujoco.mjtSensor.mjSENS_TOUCH))
    cylinders = model.site_type[model.sensor_objid[touch]] == int(mujoco.mjtGeom.mjGEOM_CYLINDER)
    unknown[touch[cylinders]] = True
    of = mujoco.mjtSensor
    if (model.wrap_type[model.tendon_adr] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
        # what a spatial tendon pulls with is missing in MJX's forces between bodies
        unknown |= np.isin(model.sensor_type, [int(of.mjSENS_FORCE), int(of.mjSENS_TORQUE)])
    if np.isin(model.geom_type, [int(kind) for kind in _UNSEEN]).any():
        unknown |= model.sensor_type == int(of.mjSENS_RANGEFINDER)
    return unknown


def _refusal(model: mujoco.MjModel, without: set[Pair], reason: str) -> str:
    """What MJX said, with the elements that it means and what to do about them."""
    if "collisions not implemented" in reason:
        return _not_collided(model, without)
    if "fluid drag" in reason:
        return (
            f'{reason.rstrip(".")}: set <option integrator="Euler"/>, or no density and viscosity.'
        )
    if "Flex" in reason:
        return "the model has flexible bodies (flex), which MJX does not simulate: remove them."
    for names, fix in (
        (("mjtTrn",), "drive joints, tendons or sites instead"),
        (("mjtDyn", "mjtGain", "mjtBias"), "use motors, position or velocity servos, or muscles"),
        (("mjtEq",), "remove these equality constraints"),
        (("mjtWrap",), "route tendons over spheres and cylinders"),
        (("mjtEnableBit", "mjENBL"), "clear this flag"),
    ):
        if any(name in reason for name in names):
            meant = ", ".join(re.findall(r"mj[A-Z]+_\w+", reason)) or reason
            return f"MJX does not support {meant}: {fix}."
    return f"MJX does not support this model: {reason}"


def _not_collided(model: mujoco.MjModel, without: set[Pair]) -> str:
    """All that MJX cannot collide: of each two types of geoms one pair, and how many there are."""
    found: dict[tuple[str, str], list[str]] = {}
    with extended():
        known = set(COLLISIONS)
    for a, b, _ in _pairs(model, without):
        types = int(model.geom_type[a]), int(model.geom_type[b])
        if types not in known:
            one, other = (_GEOM(kind).name[len("mjGEOM_") :].lower() for kind in types)
            names = f"{geom_name(model, a)!r} and {geom_name(model, b)!r}"
            found.setdefault((one, other), []).append(names)
    counts = {k: f", one of {len(v)} such pairs" if len(v) > 1 else "" for k, v in found.items()}
    listed = ", ".join(f"{v[0]} ({k[0]} with {k[1]}{counts[k]})" for k, v in found.items())
    return (
        f"MJX cannot collide geoms {listed}: make them capsules, spheres, boxes or meshes, choose "
        "other pairs by contacts=[...], or plan with contacts=False."
    )


OTHER_CONTACTS = {
    tuple(int(getattr(_GEOM, f"mjGEOM_{kind}")) for kind in pair.split())
    for pair in (
        *("PLANE MESH", "CAPSULE MESH"),
        *("CAPSULE CYLINDER", "ELLIPSOID CYLINDER", "CYLINDER CYLINDER"),
        *("CAPSULE ELLIPSOID", "ELLIPSOID ELLIPSOID"),
        *("HFIELD SPHERE", "HFIELD CAPSULE", "HFIELD BOX", "HFIELD MESH"),
        *("HFIELD ELLIPSOID", "HFIELD CYLINDER", "ELLIPSOID BOX", "ELLIPSOID MESH"),
        *("CYLINDER BOX", "CYLINDER MESH"),
    )
}
"""Types of geoms whose contacts MJX computes differently: one-step velocity errors up to 1."""


def constraint_rows(model: mjx.Model) -> int:
    """Rows that constraint forces are solved for in a step, whether they are active or not."""
    return int(internal(_data_of(model)).efc_J.shape[0])


def contact_points(model: mjx.Model) -> np.ndarray:
    """Friction dimensions (condim) of the contact points in a step, (n,), active or not."""
    return np.asarray(internal(_data_of(model)).contact.dim, int)


def kept_contacts(model: mjx.Model) -> int | None:
    """How many contact points of each friction dimension a step keeps; None if it keeps all."""
    i = mjx.name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, LIMIT)
    return int(model.numeric_data[i]) if i >= 0 and model.numeric_data[i] >= 0 else None


def has_constraints(model: mjx.Model) -> bool:
    """Whether a step of the model solves for constraint forces."""
    return constraint_rows(model) > 0


def _data_of(model: mjx.Model) -> mjx.Data:
    """The data of a model: shapes, and what depends on no state."""
    return jax.eval_shape(make_data, model)


def free_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Ends of joint ranges, within which no limit's force acts, (njnt,) each."""
    return model.jnt_range[:, 0] + model.jnt_margin, model.jnt_range[:, 1] - model.jnt_margin


def bounded_joints(model: mujoco.MjModel, x_init: np.ndarray, stops: Stops = False) -> np.ndarray:
    """Joints whose range becomes a bound on knots, (njnt,).

    Those are hinges and slides that an actuator drives and that start inside of their range, but
    for `stops`. Where a joint rests on its limit, or starts beyond it, the limit's force must stay
    in the dynamics.

    Raises:
        DraxError: stops has another form, or a pattern fits no joint with a range.
    """
    single = np.isin(model.jnt_type, (SLIDE, HINGE)) & (model.jnt_limited != 0)
    start = x_init[model.jnt_qposadr]
    lower, upper = free_ranges(model)
    inside = (start > lower) & (start < upper)
    return has_limits(model) & single & driven(model) & inside & ~_stopping(model, stops)


def _stopping(model: mujoco.MjModel, stops: Stops) -> np.ndarray:
    """Joints that may lean on their limits, (njnt,)."""
    if isinstance(stops, bool):
        return np.full(model.njnt, stops)
    if isinstance(stops, str) or not all(isinstance(pattern, str) for pattern in stops):
        raise DraxError(
            f"stops is {shown(stops)}: give True, False or patterns of names of joints, such as "
            '["knee_*"].'
        )
    limited = [model.joint(j).name for j in np.flatnonzero(model.jnt_limited)]
    for pattern in stops:
        if not fnmatch.filter(limited, pattern):
            raise DraxError(
                f"stops names {pattern!r}, which no joint with a range is called: those are "
                f"{', '.join(map(repr, limited)) or 'none'}."
            )
    return np.array(
        [
            any(fnmatch.fnmatchcase(model.joint(j).name, pattern) for pattern in stops)
            for j in range(model.njnt)
        ],
        bool,
    )


def has_limits(model: mujoco.MjModel) -> bool:
    """Whether no flag of the model disables the limits of its joints."""
    return not model.opt.disableflags & (_DISABLE.mjDSBL_LIMIT | _DISABLE.mjDSBL_CONSTRAINT)
