"""Problems from MuJoCo models: their bounds, their initial state, and where chains start."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, DraxWarning, require_part, require_positive, shown
from mjx_drax.physics.actuators import control_ranges, inverse_dynamics, middle_control
from mjx_drax.physics.agreement.checks import checked_start, examine, require_sensors
from mjx_drax.physics.c_engine.model_numbers import set_numbers
from mjx_drax.physics.c_engine.states import stopped_at_once
from mjx_drax.physics.contacts.pairs import Contacts
from mjx_drax.physics.dynamics import MjxDynamics
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import HINGE, Joints
from mjx_drax.physics.mjx_model import Stops, free_ranges, kept_contacts, put_model
from mjx_drax.physics.motors import Actuators
from mjx_drax.physics.near import affordable, without_own
from mjx_drax.physics.source import Given, load, model_name, origin_of
from mjx_drax.problem.build import assembled, knots_in, of_phases, require_name, scatter_box
from mjx_drax.problem.choices import Choices, parameter_ends, phases_of
from mjx_drax.problem.differentiators import Differentiator
from mjx_drax.problem.extended import named
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.tracing import plain, require_functions
from mjx_drax.problem.trajectory import Box, Trajectory, box


def from_mjcf(
    model: Given,
    *,
    horizon: float | tuple[float, float] | Sequence[tuple[float, float]],
    knots: int | Sequence[int] | None = None,
    running_cost: Callable[..., Any] | None = None,
    terminal_cost: Callable[..., Any] | None = None,
    running_residual: Callable[..., Any] | None = None,
    terminal_residual: Callable[..., Any] | None = None,
    equality: Callable[..., Any] | None = None,
    inequality: Callable[..., Any] | None = None,
    terminal_equality: Callable[..., Any] | None = None,
    terminal_inequality: Callable[..., Any] | None = None,
    dt: float | None = None,
    x_init: ArrayLike | None = None,
    x_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    u_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    x_scatter: tuple[ArrayLike, ArrayLike] | None = None,
    u_scatter: tuple[ArrayLike, ArrayLike] | None = None,
    contacts: Contacts = True,
    stops: Stops = False,
    actuators: Actuators | None = None,
    derivatives: Differentiator | None = None,
    x_init_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    parameters: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    model_numbers: Callable[[Any, Any], Mapping[str, Array]] | None = None,
    rates: int = 0,
    rate_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    u_init: ArrayLike | None = None,
    data: Any = None,
    goal: Callable[[Any], Any] | None = None,
    guess: Callable[[Array], Trajectory] | None = None,
    name: str | None = None,
) -> Problem:
    """A problem whose dynamics are those of a MuJoCo model.

    Costs see `mjx.Data` after `mjx.forward` (qpos, qvel, site and body positions, sensors, ...);
    what they do not read is not computed; `data.time` is that of the knot [s]. As in
    `mujoco.MjData`, `data.site("tip").xpos` is read by name, and so is what bodies, geoms, joints,
    sensors, ... have, in the same shapes. A parameter `knot` besides receives the `Knot`: its time,
    its number and its data. Joint ranges and control ranges of the model become bounds, which are
    intersected with `x_bounds` and `u_bounds`.

    Args:
        model: MJCF file, XML string, `mujoco.MjSpec` or `mujoco.MjModel`.
        horizon: duration [s]; K = horizon / dt knots, rounded with a warning. Or (least, most) of a
            free one, or a list of such pairs for phases: the model's timestep scales, in the plan
            and in the C engine.
        knots: K of a free duration; for phases the number of each.
        running_cost: l(data, u), a scalar, summed over the knots without a factor dt.
        terminal_cost: phi(data), a scalar.
        running_residual: r(data, u) (n,): adds 1/2 |r|^2 to the running cost.
        terminal_residual: r(data) (n,): adds 1/2 |r|^2 to the terminal cost.
        equality: c(data, u) (m,), held at 0 at every stage k = 0..K-1.
        inequality: g(data, u) (m,), held <= 0 at every stage.
        terminal_equality: c(data) (m,), held at 0 at x_K.
        terminal_inequality: g(data) (m,), held <= 0 at x_K.
        dt: control step [s], a multiple of the model's timestep; by default the multiple that comes
            closest to 0.02 s. With a free duration only the number of physics steps between knots
            is taken from it, by default so many that none is longer than the model's timestep.
        x_init: x_0 = [qpos, qvel, act]; by default the first keyframe, else the default pose.
        x_bounds: (lower, upper) on states, each broadcastable to (nx,).
        u_bounds: (lower, upper) on controls, each broadcastable to (nu,).
        x_scatter: box for initial knots; by default the bounds, and where those are infinite +-pi
            rad for hinges, +-1 m for slides and free joints, +-0.3 for the parts of quaternions and
            +-5 (rad/s or m/s) for velocities about x_init, unless damping ends these within a step
            of physics. Half of the chains then start closer to x_init, by random factors. Where
            contacts, limits or dry friction act, or states hold quaternions, all do, also with a
            box given here: see `Problem.draw`.
        u_scatter: the same for controls; by default their bounds, or +-1 where those are infinite.
            Where contacts, limits or dry friction act, about the controls that hold x_init.
        contacts: how many contact points the plan keeps, of each friction dimension (condim): the
            nearest ones in every state. True keeps at most 32, and where meshes have too many
            corners only those of pairs that come closest in motions from x_init (a warning says
            so). False plans as if nothing could touch, which is right where constraints keep bodies
            apart. Or the pairs that may touch, [("foot_*", "floor"), ...]: names of geoms or
            bodies, * stands for any characters. The C engine that certifies keeps all contacts.
        stops: which driven joints may lean on the ends of their ranges: True, or patterns of names,
            ["knee_*"]. Their limits act in the dynamics as contacts do; the ranges of the others
            are bounds on the knots.
        actuators: for a model that has none, one for each hinge and slide. "torque": motors with
            the limits that joints give by actuatorfrcrange; {"torque": limit} also where they give
            none [N m, N]. {"position": kp}: servos with this gain, critically damped. Numbers
            differ by joint with {pattern of joint names: number}.
        derivatives: of f; by default exact, also in contact. `Smoothed()` fits them to samples,
            which feel a contact that is as far away as the samples are spread.
        x_init_bounds: (lower, upper) of x_0, which is free where they differ; `knot.x_init`
            is what was chosen.
        parameters: {name: (lower, upper)} of numbers that are chosen once for the whole motion;
            functions read `knot.parameters[name]`.
        model_numbers: model_numbers(mjx.Model, parameters) -> {field: array}, for parameters that
            are numbers of the model; the C engine replays the changed model.
        rates: 1 if functions read `knot.rate`, (u_k - u_{k-1}) / dt; 2 if `knot.jerk` as well.
        rate_bounds: (lower, upper) of the rate [unit of u / s].
        u_init: u_{-1}, (nu,); without it the first rate is 0.
        data: numbers for each knot: arrays (K + 1, ...) in any pytree, or a function of a knot's
            time [s] that returns one. Functions with a parameter `knot` read them there.
        goal: goal(mujoco.MjData of the last state) -> bool, what a replay must reach.
        guess: guess(key) -> Trajectory, instead of the scatter boxes.
        name: used in files and tables; by default the model's name.

    Raises:
        DraxError: the model cannot be used (saying which element and why), or arguments misfit; a
            function computes something else when it is traced again.

    Warns:
        DraxWarning: MJX computes the model a little differently from the C engine; the model's
            contact solver stops early; numbers that it has for MJX are set aside; x_init lies
            outside of a joint's range; more contacts act at x_init than the plan keeps; the horizon
            is no multiple of dt.
    """
    given = {
        "running_cost": running_cost,
        "terminal_cost": terminal_cost,
        "running_residual": running_residual,
        "terminal_residual": terminal_residual,
        "equality": equality,
        "inequality": inequality,
        "terminal_equality": terminal_equality,
        "terminal_inequality": terminal_inequality,
    }
    require_functions(**given, goal=goal, guess=guess)
    if derivatives is not None:
        require_part("derivatives", derivatives, "jacobian", "Smoothed()")
    mj_model = load(model, actuators)
    if mj_model is model:  # which the user may change later, for the next problem
        mj_model = copy.deepcopy(model)
    name = model_name(mj_model) if name is None else name
    require_name(name)
    phases = phases_of(horizon, knots)
    substeps = steps_between_knots(mj_model, dt, phases)
    dt = substeps * mj_model.opt.timestep
    if knots is not None and not phases:
        raise DraxError(
            f"knots is {shown(knots)}, and the horizon is {horizon} s: knots are for a free one, "
            "horizon=(least, most); else give dt."
        )
    K, dt = of_phases(phases) if phases else (knots_in(horizon, dt), dt)
    x0, bounded = checked_start(mj_model, name, x_init, stops)
    by_default = contacts is True
    contacts, left_out = affordable(mj_model, name, x0, bounded, contacts)
    planned, origin = put_model(mj_model, contacts, bounded), origin_of(model, mj_model, actuators)
    dynamics = MjxDynamics(planned, dt, mj_model, substeps, derivatives, origin)
    require_sensors(mj_model, name, planned)
    names = fields_of(dynamics, parameters, model_numbers)
    if phases or names:
        dynamics = dynamics.steered(bool(phases), model_numbers, names)
    bounds = _bounds(mj_model, bounded, x_bounds, u_bounds)
    found = examine(mj_model, name, x0, contacts, bounded, kept_contacts(planned))
    if found.obstacle and by_default:
        fewer = without_own(mj_model, name, x0, bounded, contacts)
        if fewer is not None:
            planned, found = fewer
            dynamics = replace(dynamics, model=planned)
    if found.obstacle:
        raise DraxError(found.obstacle)
    for note in (left_out, *found.notes) if left_out else found.notes:
        warnings.warn(note, DraxWarning, stacklevel=2)
    scatter = _scatter(dynamics, bounds, x0, x_scatter, u_scatter)
    near = 0.5 if x_scatter is None else 0.0
    if dynamics.kinked or dynamics.nx != dynamics.ndx:
        near = 1.0
    start = jnp.asarray(x0)
    choices = Choices(x_init_bounds, parameters, phases, rates, u_init, rate_bounds)
    return assembled(
        dynamics,
        given,
        start,
        bounds,
        scatter,
        K,
        near,
        data,
        choices,
        goal=goal,
        guess=guess,
        name=name,
    )


def fields_of(dynamics: MjxDynamics, parameters: Any, numbers: Any) -> list[str]:
    """The fields of the model that `model_numbers` returns, tried between the bounds.

    Raises:
        DraxError: it fails, or returns what is no field, has another shape, or is nothing that the
            C engine can change.
    """
    if numbers is None:
        return []
    require_functions(model_numbers=numbers)
    if not parameters:
        raise DraxError("model_numbers is given without parameters: give parameters=..., or none.")
    shapes, low, high = parameter_ends(parameters)
    # Not in the middle, where numbers may be what they are without parameters
    tried = [named(shapes, jnp.asarray(low + part * (high - low))) for part in (0.25, 0.75)]
    give = "a dictionary of fields of mjx.Model, such as {'body_mass': ...}"
    try:
        found = dict(jax.eval_shape(numbers, dynamics.model, tried[0]))
    except Exception as error:
        raise DraxError(f"model_numbers failed: {plain(error)}. Return {give}.") from error
    for field, value in found.items():
        wanted, shape = (
            getattr(numbers, "shape", None)
            for numbers in (getattr(dynamics.model, field, None), value)
        )
        if wanted is None or shape != wanted or not hasattr(dynamics.mj_model, field):
            has = "no such field" if wanted is None else f"shape {wanted}"
            raise DraxError(
                f"model_numbers returned {field!r} of shape {shape}, and the model has {has}: "
                f"return {give}."
            )
    ends = {"jnt_range", "jnt_margin"} & set(found)
    if ends and (dynamics.mj_model.jnt_limited != np.asarray(dynamics.model.jnt_limited)).any():
        raise DraxError(
            f"model_numbers returned {min(ends)!r}, but the ranges of joints that are driven are "
            "bounds of the plan: give the model wide ranges, and an inequality that reads "
            "knot.parameters."
        )
    for parameters in tried:
        _refuse_missing(dynamics.mj_model, numbers(dynamics.model, parameters))
        set_numbers(copy.copy(dynamics.mj_model), numbers(dynamics.model, parameters))
    return list(found)


def _refuse_missing(model: mujoco.MjModel, numbers: Any) -> None:
    """Complain about numbers of what the model has not, which MJX or the C engine then leaves out.

    Raises:
        DraxError: dry friction or gravity compensation of what has none in the file.
    """
    for field in {"dof_frictionloss", "tendon_frictionloss", "body_gravcomp"} & set(numbers):
        new = np.asarray(numbers[field]) != 0.0
        if (new & (getattr(model, field) == 0.0)).any():
            name = field.partition("_")[2]
            raise DraxError(
                f"model_numbers gives {field!r} to what has none in the file, and would change "
                f'nothing there: write a small one into it, such as {name}="1e-6".'
            )


def steps_between_knots(
    model: mujoco.MjModel, dt: float | None, phases: tuple[tuple[float, float, int], ...] = ()
) -> int:
    """Physics steps in a control step of dt [s], which must be a multiple of the timestep.

    Without dt, as many as make no step of free durations longer than the model's timestep.
    """
    timestep = model.opt.timestep
    if dt is None:
        longest = max((most / count for _, most, count in phases), default=0.02)
        return max(1, math.ceil(longest / timestep - 1e-6) if phases else round(longest / timestep))
    require_positive("dt", dt, "a positive number of seconds")
    substeps = round(dt / timestep)
    if substeps < 1 or abs(substeps * timestep - dt) > 1e-6 * dt:
        raise DraxError(
            f"dt is {dt} s, not a multiple of the model's timestep {timestep} s: "
            f"give {max(1, substeps) * timestep:g}."
        )
    return substeps


def _scatter(
    dynamics: MjxDynamics,
    bounds: Box,
    x_init: np.ndarray,
    x: tuple[ArrayLike, ArrayLike] | None,
    u: tuple[ArrayLike, ArrayLike] | None,
) -> Box:
    """The box that initial knots are drawn from."""
    model = dynamics.mj_model
    if dynamics.kinked and u is None:  # about the controls that hold x_init
        ends = np.asarray(bounds.u_lower, float), np.asarray(bounds.u_upper, float)
        width = np.where(np.isfinite(ends[1] - ends[0]), (ends[1] - ends[0]) / 2, 1.0)
        held, rest = np.stack([x_init, x_init]), np.atleast_2d(middle_control(bounds))[:1]
        hold = np.clip(inverse_dynamics(model, held, dynamics.dt, rest)[0], *ends)
        u = hold - width, hold + width
    positions = np.ones(model.nq)
    positions[model.jnt_qposadr[model.jnt_type == HINGE]] = np.pi
    positions[dynamics.joints.is_quaternion] = 0.3
    velocities = np.where(stopped_at_once(model), 0.0, 5.0)
    half = np.concatenate([positions, velocities, np.ones(model.na)])
    return scatter_box(bounds, jnp.asarray(x_init), jnp.asarray(half), x, u)


def _bounds(
    model: mujoco.MjModel,
    bounded: np.ndarray,
    x_bounds: tuple[ArrayLike, ArrayLike] | None,
    u_bounds: tuple[ArrayLike, ArrayLike] | None,
) -> Box:
    """The ranges of the model's joints and controls, intersected with the user's."""
    nx = model.nq + model.nv + model.na
    x_lower, x_upper = np.full(nx, -np.inf), np.full(nx, np.inf)
    where = model.jnt_qposadr[bounded]
    x_lower[where], x_upper[where] = (end[bounded] for end in free_ranges(model))
    u_lower, u_upper = control_ranges(model, without=np.inf)
    given = box(nx, model.nu, x_bounds, u_bounds)
    quaternions = np.flatnonzero(Joints.of(model).is_quaternion)
    ends = np.asarray(given.x_lower), np.asarray(given.x_upper)
    if any(np.isfinite(end[..., quaternions]).any() for end in ends):
        raise DraxError(
            f"x_bounds are finite at entries {quaternions.tolist()}, which are quaternions: leave "
            "them infinite, and bound orientations by an inequality."
        )
    return box(
        nx,
        model.nu,
        (np.maximum(x_lower, given.x_lower), np.minimum(x_upper, given.x_upper)),
        (np.maximum(u_lower, given.u_lower), np.minimum(u_upper, given.u_upper)),
    )
