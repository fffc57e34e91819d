"""Whether a model can be planned with: all that is asked of it before a problem is built.

`checked_start` asks what needs no MJX, `require_sensors` whether MJX can trace the sensors, and
`examine` whether its steps are those of MuJoCo's C engine, and what a user should know besides.
For this, both engines take one step in float64 from the same states. What differs by more than
rounding is wrong in every plan, and the certificate would find that only after a solve. A cause is
named if the error is there with it and not without it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.digests import digest
from mjx_drax.base.errors import DraxError, reason, shown
from mjx_drax.base.numbers import vector
from mjx_drax.kernels.compilation import keep_programs, run_once, said_plainly
from mjx_drax.kernels.kept import recall, remember
from mjx_drax.physics import step as one_step
from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.actuators import control_ranges, disabled
from mjx_drax.physics.agreement.differences import PARTS, Change, differences, disabling, set_aside
from mjx_drax.physics.c_engine.states import Engine, integrate, quiet, set_state, stopped_at_once
from mjx_drax.physics.contacts.collision import hulls_of_one_size
from mjx_drax.physics.contacts.pairs import Contacts, contact_pairs, geom_name, touching
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import HINGE, SLIDE, Joints
from mjx_drax.physics.mjx_model import (
    Stops,
    bounded_joints,
    free_ranges,
    has_limits,
    hold_by_inertia,
    put_model,
)
from mjx_drax.physics.source import binary

SINGULAR = 1e-10
"""Least eigenvalue of the inertia, scaled to a diagonal of ones, that can be divided by."""

WORST, WRONG, NOTICEABLE = 1e-1, 1e-2, 1e-6
"""One-step errors of velocities [rad/s, m/s] above which a model is refused, if there is one such
state, or if most states are so, or is warned of. Here and there a body lies on another with one
contact more in the C engine, and the certificate says whether that matters."""

MOMENTS = (0.05, 0.2, 0.6)
"""Times [s] of the states that the engines are compared at, along a motion from x_init."""

OTHER = 1e-3
"""Change of velocities [rad/s, m/s] in one step, by the model's own contact-solver options, above
which they count as other physics."""

ROUNDED = 1e-6
"""Distances, in extents of the model, below which float32 may not tell whether geoms touch."""

BEYOND = 0.01
"""Share of a joint's range by which x_init may lie beyond it unsaid: limits give way a little."""

SHIFT, SPEED = 0.02, 0.5
"""Standard deviations of positions [rad, m] and velocities about x_init, for one more state."""

HAIR = 1e-4
"""Share of these by which x_init itself is moved: of feet that are just on the ground, rounding
decides whether they touch it."""


def checked_start(
    model: mujoco.MjModel, name: str, x_init: ArrayLike | None = None, stops: Stops = False
) -> tuple[np.ndarray, np.ndarray]:
    """x_0 (nx,), and the joints whose range becomes a bound on knots (njnt,); see `bounded_joints`.

    Args:
        model: to plan with.
        name: what errors call it.
        x_init: as given by the user; by default the first keyframe, else the default pose at rest.
        stops: joints that may lean on their limits.

    Raises:
        DraxError: stops cannot be used, the model cannot move, x_init does not fit it, or its
            acceleration cannot be found there.
    """
    _require_movable(model, name)
    x0 = _initial_state(model, name, x_init)
    _require_regular(model, name, x0)
    return x0, bounded_joints(model, x0, stops)


def _require_movable(model: mujoco.MjModel, name: str) -> None:
    """Complain about a model that no control can move."""
    if model.nv == 0:
        raise DraxError(f"{name} has no joints: there is nothing to move; add a <joint>.")
    if model.nu == 0:
        raise DraxError(
            f'{name} has no actuators: give actuators="torque" or {{"position": kp}}, or add an '
            "<actuator>."
        )
    plugins = np.flatnonzero(model.actuator_plugin >= 0)
    if plugins.size:
        names = ", ".join(str(model.actuator(a).name or a) for a in plugins.tolist())
        raise DraxError(
            f"actuators of {name} are plugins ({names}), which MJX does not compute: use <motor>, "
            "<position> or <general> for them."
        )
    if disabled(model).all():
        raise DraxError(
            f"all actuators of {name} are disabled: clear the flag actuation and "
            "actuatorgroupdisable in <option>."
        )


def _initial_state(model: mujoco.MjModel, name: str, x_init: ArrayLike | None) -> np.ndarray:
    """x_0 (nx,) as given, or the first keyframe, or the default pose at rest."""
    if x_init is not None:
        x0 = np.array(vector("x_init", x_init), float)  # a copy: it will be scaled
    elif model.nkey:
        x0 = np.concatenate([model.key_qpos[0], model.key_qvel[0], model.key_act[0]])
    else:
        x0 = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
    nx = model.nq + model.nv + model.na
    if not np.isfinite(x0).all():
        raise DraxError(f"the first keyframe of {name} is {shown(x0.tolist())}: give x_init.")
    if x0.shape != (nx,):
        raise DraxError(
            f"x_init has {x0.shape[0]} numbers; {name} has {nx}: qpos ({model.nq}), "
            f"qvel ({model.nv}), act ({model.na}). Give {nx}."
        )
    for q, _ in Joints.of(model).quaternions:
        if abs(np.linalg.norm(x0[q : q + 4]) - 1.0) > 1e-3:
            raise DraxError(
                f"x_init holds the quaternion {x0[q : q + 4].tolist()} at {q}: "
                "scale it to length 1."
            )
    mujoco.mj_normalizeQuat(model, x0[: model.nq])
    return x0


def _require_regular(model: mujoco.MjModel, name: str, x_init: np.ndarray) -> None:
    """Complain about a model whose acceleration cannot be found at x_init (nx,)."""
    data = mujoco.MjData(model)
    set_state(model, data, x_init)
    with quiet():
        mujoco.mj_forward(model, data)
    M = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    scale = np.sqrt(np.diag(M))
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    if not values[0] > SINGULAR:
        along = vectors[:, 0]
        joints = model.dof_jntid[np.abs(along) > 0.5 * np.abs(along).max()]
        names = ", ".join(str(model.joint(j).name or j) for j in dict.fromkeys(joints.tolist()))
        raise DraxError(
            f"the inertia of {name} is singular, because joints move bodies alike ({names}): leave "
            'one of them out, or give them armature="0.01".'
        )
    if not np.isfinite(data.qacc).all():
        raise DraxError(f"{name} has no finite acceleration at x_init: give another x_init.")


def require_sensors(model: mujoco.MjModel, name: str, planned: mjx.Model) -> None:
    """Complain about sensors that MJX accepts, but fails in when it traces them.

    Raises:
        DraxError: says in what it fails.
    """

    def sensors(x: Array, u: Array) -> Any:
        return one_step.with_sensors(planned, one_step.data_at(planned, x, u))

    with _said_of(name):
        jax.eval_shape(sensors, jnp.zeros(model.nq + model.nv + model.na), jnp.zeros(model.nu))


@contextmanager
def _said_of(name: str) -> Iterator[None]:
    """What MJX raises while it traces a step of the model `name`, as a DraxError."""
    try:
        yield
    except DraxError:
        raise
    except Exception as error:  # of any kind, deep inside MJX
        raise DraxError(
            f"MJX fails in a step of {name} ({reason(error)}): leave out sensors, tendons and "
            "equality constraints, by which it may fail, until it does not."
        ) from error


def _beyond_limits(model: mujoco.MjModel, name: str, x_init: np.ndarray) -> str | None:
    """Says where x_init (nx,) lies outside of the range of a hinge or slide.

    It can be planned from, since the limit's force pushes back, but is hardly ever what is meant.
    """
    single = np.isin(model.jnt_type, (SLIDE, HINGE)) & (model.jnt_limited != 0) & has_limits(model)
    position, (low, high) = x_init[model.jnt_qposadr], model.jnt_range.T
    beyond = np.maximum(low - position, position - high)
    found = [
        f"{model.joint(j).name or j} is at {position[j]:.4g}, its range is {low[j]:.4g} to "
        f"{high[j]:.4g} {'rad' if model.jnt_type[j] == HINGE else 'm'}"
        for j in np.flatnonzero(single & (beyond > BEYOND * (high - low)))
    ]
    if not found:
        return None
    return (
        f"x_init of {name} lies outside of the range of joints ({'; '.join(found)}): move it "
        "inside, or widen the range. (Angles in the file are degrees, unless it says "
        '<compiler angle="radian"/>.)'
    )


def _just_touching(
    engine: Engine, name: str, x_init: np.ndarray, controls: np.ndarray
) -> str | None:
    """Says where geoms touch at x_init (nx,) by so little that rounding decides whether they do.

    The plan, in float32, may then start with other contacts than the replay. That matters where
    controls (n, nu) move the geoms much within a step.
    """
    sides = []
    for sign in (1.0, -1.0):
        side = copy.deepcopy(engine)
        for margin in (side.model.geom_margin, side.model.pair_margin):
            margin += sign * ROUNDED * engine.model.stat.extent
        sides.append(side)
    touch, apart = (side.touching(x_init) for side in sides)
    doubtful = sorted(touch - apart)
    if not doubtful:
        return None
    velocities = slice(engine.model.nq, engine.model.nq + engine.model.nv)
    steps = np.array([[side.step(x_init, u)[velocities] for u in controls] for side in sides])
    change = float(np.abs(steps[0] - steps[1]).max())
    if not change > WORST:
        return None
    a, b = (geom_name(engine.model, g) for g in doubtful[0])
    return (
        f"at the x_init of {name} {a!r} and {b!r} touch by so little that rounding decides whether "
        f"they do, and velocities after a step differ by {change:.1e} for it: move x_init by 1e-4 "
        "m, so that they overlap, or are apart."
    )


def _require_stable(engine: Engine, name: str, x_init: np.ndarray) -> None:
    """Complain about a timestep at which the C engine itself diverges from x_init (nx,).

    Raises:
        DraxError: it does so under a constant control.
    """
    timestep, u = engine.model.opt.timestep, np.clip(0.0, *control_ranges(engine.model))
    steps = max(1, round(MOMENTS[-1] / timestep))
    if np.isfinite(engine.step(x_init, u, steps)).all():
        return
    finer, calmer = copy.deepcopy(engine), copy.deepcopy(engine)
    finer.model.opt.timestep = timestep / 10
    calmer.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    helps = [
        fix
        for other, count, fix in (
            (finer, 10 * steps, f"make its timestep of {timestep:g} s ten times smaller"),
            (calmer, steps, 'set <option integrator="implicitfast"/>'),
        )
        if np.isfinite(other.step(x_init, u, count)).all()
    ]
    fix = " or ".join(helps) or "make stiff springs and servos softer, or masses larger"
    raise DraxError(
        f"{name} diverges in MuJoCo's C engine within {MOMENTS[-1]} s from x_init at control "
        f"{shown(u.tolist())}: {fix}."
    )


@dataclass(frozen=True)
class Samples:
    """States (n, nx), x_init's first, and controls (n, nu) at which the engines are compared."""

    x: np.ndarray
    u: np.ndarray


@dataclass(frozen=True)
class StepErrors:
    """How far one step of MJX is from one of the C engine.

    Attributes:
        velocity: largest error of qvel after one step, (n,) [rad/s, m/s]; x_init comes first.
        jacobian: largest error of an entry of [df/dx df/du] at x_init, in tangent space, relative
            to the largest entry; NaN if it was not asked for. Where f has a kink, as at a limit,
            the derivative to either side counts as right, for each column.
    """

    velocity: np.ndarray
    jacobian: float = np.nan


def samples(engine: Engine, x_init: np.ndarray, bounded: np.ndarray, seed: int = 0) -> Samples:
    """x_init but for a hair, a state close to it, and states along motions under random controls.

    Args:
        engine: which makes the motions.
        x_init: (nx,).
        bounded: joints whose positions are clipped to their ranges, (njnt,).
        seed: of the random numbers.
    """
    model, rng = engine.model, np.random.default_rng(seed)
    nv, scale = model.nv, np.zeros(2 * model.nv + model.na)
    scale[:nv], scale[nv : 2 * nv] = SHIFT, np.where(stopped_at_once(model), 0.0, SPEED)
    u = rng.uniform(*control_ranges(model), (2 + len(MOMENTS), model.nu))
    away = scale * rng.normal(size=scale.shape)
    x = [integrate(model, x_init, share * away) for share in (HAIR, 1.0)]
    for moment, control in zip(MOMENTS, u[2:], strict=True):
        x.append(engine.step(x_init, control, max(1, round(moment / model.opt.timestep))))
    states, where = np.stack(x), model.jnt_qposadr[bounded]
    lower, upper = (end[bounded] for end in free_ranges(model))
    inside = 1e-6 * (upper - lower)  # at the very end rounding decides whether the limit acts
    states[:, where] = np.clip(states[:, where], lower + inside, upper - inside)
    usable = np.isfinite(states).all(axis=1)
    return Samples(states[usable], u[usable])


def compare(
    model: mujoco.MjModel,
    at: Samples,
    contacts: Contacts = True,
    bounded: np.ndarray | None = None,
    derivatives: bool = False,
) -> StepErrors:
    """Compare one step of MJX with one of the C engine. Compiles the step.

    Args:
        model: which is not changed.
        at: states, x_init first, and controls.
        contacts, bounded: as for `put_model`.
        derivatives: whether to compare them as well, at x_init.

    Raises:
        DraxError: MJX does not support the model.
    """
    engine, joints, nv = Engine(model, contacts), Joints.of(model), model.nv
    ndx = 2 * nv + model.na
    with jax.enable_x64(True), hulls_of_one_size():
        on_device = put_model(model, contacts, bounded)

        def reached(model: mjx.Model, x: Array, u: Array) -> Array:
            return one_step.step(model, x, u)

        def slope(model: mjx.Model, x: Array, u: Array) -> tuple[Array, Array]:
            def change(dz: Array) -> tuple[Array, Array]:
                end = reached(model, joints.integrate(x, dz[:ndx]), u + dz[ndx:])
                return joints.difference(end, jax.lax.stop_gradient(end)), end

            jacobian, end = jax.jacfwd(change, has_aux=True)(jnp.zeros(ndx + len(u)))
            return end, jacobian

        one = slope if derivatives else reached

        def of_all(model: mjx.Model, x: Array, u: Array) -> Any:  # one by one, for less memory
            return jax.lax.map(lambda pair: one(model, *pair), (x, u))

        hint = "with fewer contacts (contacts=[...]), or with meshes that have fewer corners"
        with said_plainly("one step of the model", hint):
            found = run_once(of_all, on_device, jnp.asarray(at.x), jnp.asarray(at.u))
        ends, slopes = jax.tree.map(np.asarray, found if derivatives else (found, None))
    wanted = np.stack([engine.step(*pair) for pair in zip(at.x, at.u, strict=True)])
    velocities = slice(model.nq, model.nq + nv)
    error = np.abs(ends - wanted)[:, velocities].max(axis=1)
    if not derivatives:
        return StepErrors(error)
    sides = engine.slopes(at.x[0], at.u[0])
    exact = np.stack([sides.mean(axis=0), *sides])
    off = np.abs(slopes[0] - exact).max(axis=1).min(axis=0)  # of each column
    return StepErrors(error, float(off.max() / np.abs(exact[0]).max()))


@dataclass(frozen=True)
class Findings:
    """What `examine` found.

    Attributes:
        errors: of one step of MJX.
        notes: what a user should know, a sentence each.
        obstacle: why the model cannot be planned with, a sentence; None if it can.
    """

    errors: StepErrors
    notes: tuple[str, ...]
    obstacle: str | None


def examine(
    model: mujoco.MjModel,
    name: str,
    x_init: np.ndarray,
    contacts: Contacts,
    bounded: np.ndarray,
    kept: int | None,
    derivatives: bool = False,
) -> Findings:
    """Compare one step of MJX with one of the C engine, and look for the causes of an error.

    What was found is remembered, also on disk, since the step is compiled for it.

    Args:
        model: which is not changed.
        name: what the sentences call it.
        x_init: (nx,).
        contacts, bounded: as for `put_model`.
        kept: contact points of each friction dimension that a plan keeps; None if all.
        derivatives: whether they are compared too.

    Raises:
        DraxError: the C engine itself diverges.
    """
    arrays = digest(binary(model)), x_init.tobytes(), bounded.tobytes()
    key = digest(repr((name, contacts, kept, derivatives, *arrays)))
    if key not in _EXAMINED:
        keep_programs()
        found = recall(f"findings {key}")
        if found is None:
            found = _examined(model, name, x_init, contacts, bounded, kept, derivatives)
            remember(f"findings {key}", found)
        _EXAMINED[key] = found
    return _EXAMINED[key]


_EXAMINED: dict[str, Findings] = {}


def _examined(
    model: mujoco.MjModel,
    name: str,
    x_init: np.ndarray,
    contacts: Contacts,
    bounded: np.ndarray,
    kept: int | None,
    derivatives: bool,
) -> Findings:
    _require_stable(Engine(model, contacts), name, x_init)
    left_out = set_aside(model)
    model = copy.deepcopy(model)
    hold_by_inertia(model)
    engine = Engine(model, contacts)
    at = samples(engine, x_init, bounded)
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        bounded = np.zeros_like(bounded)  # its stages leave a range that a state is in
    most = max(engine.active_contacts(x) for x in at.x)
    lost = kept is not None and most > kept
    if lost and isinstance(contacts, int):
        contacts = most  # an error shall not be that of contacts left out
    with _said_of(name):
        errors = compare(model, at, contacts, bounded, derivatives)
    error = float(errors.velocity.max())
    notes: list[str | None] = [
        _beyond_limits(model, name, x_init),
        _just_touching(engine, name, x_init, at.u),
        *(f"{name}: {sentence}." for sentence in left_out),
        _other_physics(model, name, at, contacts),
    ]
    if lost:
        notes.append(
            f"{engine.active_contacts(x_init)} contacts of one friction dimension act at the "
            f"x_init of {name} and up to {most} soon after, of which the plan keeps the nearest "
            f"{kept}: give contacts={most}."
        )
    obstacle = None
    if not error <= NOTICEABLE:
        cause = causes(engine, at, contacts, bounded, errors)
        words = (
            f"one step of MJX differs from MuJoCo's C engine by {error:.1e} in the velocities of "
            f"{name}: {cause}."
        )
        usual = float(np.median(errors.velocity))
        if not (usual <= WRONG and error <= WORST):
            obstacle = words
        else:
            notes.append(words)
    return Findings(errors, tuple(note for note in notes if note), obstacle)


def _where_hulls_touch(engine: Engine, at: Samples, errors: StepErrors) -> bool:
    """Whether hulls of meshes touch in all states where a step is off, and in no other."""
    off = errors.velocity > NOTICEABLE
    return bool(
        not off.all()
        and all(engine.hulls_touch(x) == bad for x, bad in zip(at.x, off, strict=True))
    )


def causes(
    engine: Engine,
    at: Samples,
    contacts: Contacts,
    bounded: np.ndarray,
    errors: StepErrors,
) -> str:
    """Why the velocities of a step have an error, as far as comparing without a cause tells.

    Contacts are a cause only where they act in states that have the error.
    """
    model, error = engine.model, float(errors.velocity.max())
    kept = touching(model, contacts)
    off = errors.velocity > max(NOTICEABLE, error / 10)
    acting = {pair for x in at.x[off] for pair in engine.touching(x)}

    def error_without(*changes: Change) -> float:
        changed = copy.deepcopy(model)
        for change in changes:
            change(changed)
        rest = contacts
        if not isinstance(contacts, bool | int | np.integer):  # without those that are gone
            rest = sorted(kept & set(contact_pairs(changed))) or False
        return float(compare(changed, at, rest, bounded).velocity.max())

    known = differences(model, contacts, acting)
    if known:
        rest = error_without(*(each.without for each in known))
        if rest <= max(NOTICEABLE, error / 10):
            if len(known) == 1:
                return known[0].sentence
            alone = [
                error_without(*(other.without for other in known if other is not each))
                for each in known
            ]
            named = [
                f"{each.sentence} (alone {own:.1e})"
                for each, own in zip(known, alone, strict=True)
                if not own <= max(2 * rest, NOTICEABLE)
            ]
            return "; ".join(named or [each.sentence for each in known])
    if _where_hulls_touch(engine, at, errors):
        return (
            "hulls of meshes touch in all states where it does, and in none of the others; choose "
            'contacts=[("foot_*", "floor"), ...] without them, or plan with contacts=False'
        )
    for part, flag in PARTS.items():
        rest = error_without(disabling(flag))
        if rest <= max(NOTICEABLE, error / 10):
            choose = ': choose some, contacts=[("foot_*", "floor"), ...]' * (part == "contacts")
            return f"the reason is not known; without {part} it is {rest:.1e}{choose}"
    return "the reason is not known"


def _other_physics(model: mujoco.MjModel, name: str, at: Samples, contacts: Contacts) -> str | None:
    """Says where the model's own options for the contact solver give other physics."""
    own, sound = Engine(model, contacts, as_given=True), Engine(model, contacts)
    velocities = slice(model.nq, model.nq + model.nv)
    error = max(
        float(np.abs(own.step(x, u) - sound.step(x, u))[velocities].max())
        for x, u in zip(at.x, at.u, strict=True)
    )
    if error <= OTHER:
        return None
    opt = model.opt
    return (
        f"{name} has its contact solver stop early (iterations={opt.iterations}, "
        f"ls_iterations={opt.ls_iterations}, tolerance={opt.tolerance:g}, "
        f"ccd_iterations={opt.ccd_iterations}): velocities after a step are up to {error:.1e} off. "
        "The plan and the certificate have the solver converge; set <option "
        'solver="Newton" iterations="100" ls_iterations="50" ccd_iterations="200"/> to simulate '
        "the same."
    )
