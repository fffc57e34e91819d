"""One step of MJX, with derivatives that hold at rest and in contact.

Seven things differ from `mjx.step`. Only the last three change values:

- Constraint forces (contacts, limits, dry friction, equalities) minimize a convex function of the
  acceleration, 1/2 |a - a_smooth|^2_M + s(J a - a_ref), with the function s of MJX. Newton's method
  finds the minimum a* without derivatives. One more Newton step, a* - H^{-1} grad(a*), has them:
  where grad = 0 its derivative is that of the implicit function theorem, da = -H^{-1} d grad.
  A whole step has that derivative at once, with all parts in closed form that have one.
- Positions are integrated by `joints`, whose quaternions have derivatives at rest. The
  semi-implicit integrators end with this, so only their end is replaced; Runge-Kutta integrates at
  every stage and is written here.
- The forces of springs on ball and free joints use the same quaternions.
- Sums along the tree of bodies are computed by `tree`, without a loop over its levels, and the
  inertia M is dense and factorized by `linalg`.
- Contacts are those of `contacts.collision`.
- The integrator implicitfast has the C engine's derivative of forces by velocities.
- Connect and weld constraints have the C engine's references while bodies turn; see `equalities`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike

from mjx_drax.kernels.constraint_solver import (
    Constraints,
    constrained_minimum,
    excess,
    forces,
    pulled,
)
from mjx_drax.kernels.elliptic_cones import Cones
from mjx_drax.kernels.linalg import product, solve_implicitly, solve_positive, symmetric
from mjx_drax.kernels.pruning import pruned
from mjx_drax.physics._mjx import internal, mjx, with_internal
from mjx_drax.physics.contacts.collision import collision, make_data
from mjx_drax.physics.contacts.forces import cones, contact_forces
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.equalities import with_turning
from mjx_drax.physics.joints import BALL, FREE, Joints
from mjx_drax.physics.mjx_model import has_constraints
from mjx_drax.physics.tree import (
    com_pos,
    com_vel,
    frame_derivatives,
    inverse_derivatives,
    kinematics,
    mass_matrix,
    rne,
)

MANY = 6
"""Contacts from which on their Jacobian is not differentiated. Jacobians of f then take 92 to 50 %
of the time on an H200 (6 and 28 contacts), 105 to 54 % on CPUs; with 4 on CPUs it was 126 %."""

RK4 = ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6))
"""Of each stage: the share of the timestep that it goes along the rate of the stage before, and its
weight in the sum of rates."""


def state(data: mjx.Data) -> Array:
    """x = [qpos, qvel, act], (nx,)."""
    return jnp.concatenate([data.qpos, data.qvel, data.act])


def data_at(model: mjx.Model, x: Array, u: Array) -> mjx.Data:
    """`mjx.Data` holding a state (nx,) and a control (nu,)."""
    qpos, qvel, act = jnp.split(x, [model.nq, model.nq + model.nv])
    return make_data(model).replace(qpos=qpos, qvel=qvel, act=act, ctrl=u)


def forward(
    model: mjx.Model, x: Array, u: Array, time: ArrayLike | None = None
) -> tuple[mjx.Data, tuple[Array, ...]]:
    """`mjx.forward`: all that follows from a state (nx,) and a control (nu,), up to accelerations.

    Also `sensordata` with the sensors of each of `kinds_of_sensors` alone: one array of all would
    make compiled functions, which compute only what their caller reads, compute all of them.
    """
    data = data_at(model, x, u)
    data = data if time is None else data.replace(time=time)
    return with_sensors(model, _constrained(model, _smooth(model, kinematics(model, data))))


def with_sensors(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, tuple[Array, ...]]:
    """`data` with all sensors, and each kind alone."""
    readings, every = [], data.sensordata
    for kind in kinds_of_sensors(model):
        mine = model.sensor_type == kind
        only = model.replace(sensor_needstage=np.where(mine, model.sensor_needstage, -1))
        found = mjx.sensor_vel(only, mjx.sensor_pos(only, data))
        readings.append(mjx.sensor_acc(only, found).sensordata)
        entries = np.repeat(mine, model.sensor_dim)
        every = jnp.where(entries, readings[-1], every)
    return data.replace(sensordata=every), tuple(readings)


def kinds_of_sensors(model: mjx.Model) -> list[int]:
    """The types of sensors that a model has, each once."""
    kinds: list[int] = np.unique(model.sensor_type).tolist()
    return kinds


def _smooth(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data`, which has frames, with all that comes before constraint forces."""
    turned = np.isin(model.jnt_type, (FREE, BALL))
    if turned.any():
        data = data.replace(qfrc_applied=_springs(model, turned, data.qpos))
    return _driven(model, _at_positions(model, data))


def _driven(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`_smooth` for `data` that has all that positions alone decide."""
    data = mjx.make_constraint(model, data)
    turned = np.isin(model.jnt_type, (FREE, BALL))
    if turned.any():  # their springs have pulled
        model = model.replace(jnt_stiffness=jnp.where(turned, 0.0, model.jnt_stiffness))
    data = mjx.fwd_actuation(model, with_turning(model, _at_velocities(model, data)))
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_applied
    qacc = solve_positive(internal(data).M, force)
    return data.replace(qfrc_smooth=force, qacc_smooth=qacc)


def _at_positions(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_position` from frames on, with the sums of `tree`, and without factors of M."""
    data = mjx.camlight(model, com_pos(model, data))
    data = mass_matrix(model, mjx.tendon(model, data))
    data = collision(model, mjx.tendon_armature(model, data))
    if model.ntendon:
        data = with_internal(data, M=jnp.where(_in_inertia(model), internal(data).M, 0.0))
    return mjx.transmission(model, data)


def _at_velocities(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_velocity`, with the sums along the tree of `tree`."""
    data = with_internal(
        data,
        actuator_velocity=internal(data).actuator_moment @ data.qvel,
        ten_velocity=internal(data).ten_J @ data.qvel,
    )
    data = rne(model, mjx.passive(model, com_vel(model, data)))
    return mjx.tendon_bias(model, data)


def _springs(model: mjx.Model, turned: np.ndarray, qpos: Array) -> Array:
    """Forces (nv,) of the springs of ball and free joints, where `turned` is true, (njnt,)."""
    away = Joints.of(model).difference(qpos, model.qpos_spring)
    stiffness = jnp.where(turned, model.jnt_stiffness, 0.0)
    return -stiffness[model.dof_jntid] * away


def _constraints(model: mjx.Model, data: mjx.Data) -> Constraints:
    """What the acceleration under constraints minimizes."""
    rows = internal(data)
    loss, D = rows.efc_frictionloss, rows.efc_D
    slides = loss / jnp.where(D > 0.0, D, 1.0)
    always = np.arange(len(D)) < rows.ne + rows.nf
    held = jnp.where(always, jnp.inf, 0.0).astype(D.dtype)
    lower = jnp.where(loss > 0.0, -slides, -jnp.inf)
    upper = jnp.where(loss > 0.0, slides, held)
    rest = D, rows.efc_aref, lower, upper, data.qacc_smooth
    given = Constraints(rows.M, rows.efc_J, *rest)
    if not (in_cones := _rows_of_cones(model, data)):
        return given
    others = _others(len(D), in_cones)
    by_row = {name: getattr(given, name)[others] for name in ("J", "D", "aref", "lower", "upper")}
    return given._replace(**by_row, cones=tuple(_cones(model, data, at) for at in in_cones))


def _forces(model: mjx.Model, data: mjx.Data, qacc: Array) -> tuple[Array, Array]:
    """Forces of constraints at an acceleration: of all rows (m,), and on joints (nv,)."""
    given = _constraints(model, data)
    found = forces(given, excess(given, qacc))
    pull = pulled(given, found)
    if not (in_cones := _rows_of_cones(model, data)):
        return found[0], pull
    by_row = jnp.zeros_like(internal(data).efc_D)
    places = _others(len(by_row), in_cones), *in_cones
    for place, force in zip(places, found, strict=True):
        by_row = by_row.at[place].set(force)
    return by_row, pull


def _pull(model: mjx.Model, data: mjx.Data, qacc: Array) -> Array:
    """Those on joints (nv,); of many contacts with cheap derivatives: see `contact_forces`."""
    if len(internal(data).contact.dim) < MANY:
        return _forces(model, data, qacc)[1]
    none = internal(data).contact.replace(dim=np.empty(0, int))
    rest = mjx.make_constraint(model, with_internal(data, contact=none))
    pull = contact_forces(model, data, qacc)
    if internal(rest).efc_J.size:
        pull = pull + _forces(model, with_turning(model, rest), qacc)[1]
    return pull


def _solution(model: mjx.Model, data: mjx.Data) -> tuple[Array, Array]:
    """The acceleration under constraints (nv,), and H there, (nv, nv); without derivatives."""
    return constrained_minimum(_constraints(*jax.lax.stop_gradient((model, data))))


def _rows_of_cones(model: mjx.Model, data: mjx.Data) -> list[np.ndarray]:
    """Numbers of the rows of elliptic friction cones, (d, contacts), for each d that there is."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        return []
    contact = internal(data).contact
    sizes, starts = np.asarray(contact.dim), np.asarray(contact.efc_address)
    return [np.arange(d)[:, None] + starts[sizes == d] for d in np.unique(sizes[sizes > 1])]


def _others(count: int, in_cones: list[np.ndarray]) -> np.ndarray:
    """Numbers of the rows that belong to no cone."""
    return np.setdiff1d(np.arange(count), np.concatenate([at.ravel() for at in in_cones]))


def _cones(model: mjx.Model, data: mjx.Data, at: np.ndarray) -> Cones:
    """The elliptic friction cones of contacts with those rows, (d, contacts)."""
    rows = internal(data)
    friction = rows.contact.friction[np.asarray(rows.contact.dim) == len(at)]
    return cones(model, friction, rows.efc_J[at], rows.efc_aref[at], rows.efc_D[at[0]])


def _constrained(
    model: mjx.Model,
    data: mjx.Data,
    solution: tuple[Array, Array] | None = None,
    derivatives: bool = True,
) -> mjx.Data:
    """`data` with the acceleration and the forces under constraints, and if asked, derivatives."""
    if internal(data).efc_J.size == 0:
        return data.replace(qacc=data.qacc_smooth)
    qacc, H = solution or _solution(model, data)
    M = internal(data).M
    if derivatives:
        pull = _forces(model, data, qacc)[1]
        qacc = qacc - solve_positive(H, M @ qacc - data.qfrc_smooth - pull)
    data = data.replace(qacc=qacc, qfrc_constraint=M @ qacc - data.qfrc_smooth)
    return with_internal(data, efc_force=_forces(model, data, qacc)[0])


def step(model: mjx.Model, x: Array, u: Array, by_operations: bool = False) -> Array:
    """The state (nx,) one timestep after x (nx,) under the control u (nu,).

    Args:
        model: the model.
        x: state.
        u: control.
        by_operations: whether it is differentiated operation by operation, not in closed form:
            where scalar arithmetic leaves out what is zero. Not for models with constraints.
    """
    joints, h = Joints.of(model), model.opt.timestep
    rates = _rates_of if by_operations else _rates
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return _runge_kutta(model, joints, rates, x, u)
    qacc, change = jnp.split(rates(model, x, u), [model.nv])
    dv = h * qacc
    velocity = x[model.nq : model.nq + model.nv] + dv
    return joints.integrate(x, jnp.concatenate([h * velocity, dv, change]))


def _rates_of(model: mjx.Model, x: Array, u: Array, derivatives: bool = True) -> Array:
    """The acceleration that is integrated (nv,), and rates of activations.

    Differentiated operation by operation, if at all.
    """
    data = _smooth(model, kinematics(model, data_at(model, x, u)))
    data = _constrained(model, data, derivatives=derivatives)
    return jnp.concatenate([_implicit(model, data), _activation_rates(model, data)])


def _derivatives(model: mjx.Model, x: Array, u: Array) -> tuple[Array, Array]:
    """`_rates` (nv + na,) and their Jacobian in the tangent space, (nv + na, ndx + nu).

    The acceleration a, and the one that is integrated, b, obey

        M a + bias - f = 0        f: all other forces, those of constraints for a
        W b - M a = 0             see `_implicit`

    By the implicit function theorem, with derivatives of the left sides at fixed a and b,
    H da = -d(M a + bias - f) and W db = M da - d(W b - M a). `inverse_derivatives` has those of M
    and bias. Those of f are taken apart for positions, velocities, and activations and controls:
    only positions move bodies and contacts.
    """
    smooth = jax.jit(partial(_smooth, model))  # so that it is traced once
    start = kinematics(model, data_at(model, x, u))
    data = smooth(start)
    placed, held = data, has_constraints(model)
    M = internal(data).M
    solution = _solution(model, data) if held else (data.qacc_smooth, M)
    data = _constrained(model, data, solution)
    a, b, explicit = data.qacc, _implicit(model, data), _explicit(model)

    @pruned
    def sides(changed: dict[str, Array]) -> Array:
        moved = by_q.keys() <= changed.keys()
        if moved:
            at = smooth(start.replace(**changed))
        else:
            at = _driven(model, placed.replace(**changed))
        pushed = at.qfrc_passive + at.qfrc_actuator + at.qfrc_applied
        if held:
            pushed += _pull(model, at, a) if moved else _forces(model, at, a)[1]
        left, later = _tendon_bias(model, at, a) - pushed, data.qvel[:0]
        if not explicit:
            later = _tendon_inertia_times(model, at, b - a) + _damping_times(model, at, b)
        return jnp.concatenate([left, _activation_rates(model, at), later])

    def derivatives(directions: dict[str, Array]) -> Array:
        """Columns of derivatives for directions (n, ...) of some of the data."""
        at = {name: getattr(start, name) for name in directions}

        def of_one(direction: dict[str, Array]) -> Array:
            rest = whole if by_q.keys() <= at.keys() else driven
            return jax.jvp(lambda part: sides(rest | part), (at,), (direction,))[1]

        return jax.vmap(of_one, out_axes=1)(directions)

    by_q = frame_derivatives(model, data)
    sizes = {"qvel": model.nv, "act": model.na, "ctrl": model.nu}
    driven = {name: getattr(start, name) for name in sizes}
    whole = driven | {name: getattr(start, name) for name in by_q}
    columns = [derivatives(by_q)]
    columns += [
        derivatives({name: jnp.eye(size, dtype=a.dtype)}) for name, size in sizes.items() if size
    ]
    ends = [model.nv, model.nv + model.na]
    left, rates, later = jnp.split(jnp.concatenate(columns, axis=1), ends)
    bias_by_q, bias_by_v, more_by_q = inverse_derivatives(model, data, a, b - a)
    left = left.at[:, : 2 * model.nv].add(jnp.concatenate([bias_by_q, bias_by_v], axis=1))
    # scalar arithmetic, for models without constraints, has to see the operations of a small one
    d = -(solve_implicitly if held else solve_positive)(solution[1], left)
    if not explicit:
        later = later.at[:, : model.nv].add(more_by_q)
        d = _solve_implicit(model, data, M @ d - later)
    value = jnp.concatenate([b, _activation_rates(model, data)])
    return value, jnp.concatenate([d, rates])


def with_jacobian(
    function: Callable[..., Array],
    jacobian: Callable[..., tuple[Array, Array]],
    by_operations: Callable[..., Array],
) -> Callable[..., Array]:
    """A function of a model, a state and a control, differentiated by its Jacobian.

    What depends on no tangent is computed once for all of them, and so is the Jacobian.

    Args:
        function: (model, x, u) -> (m,).
        jacobian: (model, x, u) -> its value, and its Jacobian in the tangent space, (m, ndx + nu).
        by_operations: the same function, for derivatives where numbers of the model change too.
    """
    new = jax.custom_jvp(function)

    @partial(new.defjvp, symbolic_zeros=True)
    def jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
        (model, x, u), (of_model, *of_rest) = primals, tangents
        if not all(isinstance(d, SymbolicZero) for d in jax.tree.leaves(of_model)):
            return jax.jvp(by_operations, primals, jax.tree.map(_as_array, tangents))
        value, J = jacobian(model, x, u)
        dx, du = map(_as_array, of_rest)
        _, dx = jax.jvp(lambda y: Joints.of(model).difference(y, x), (x,), (dx,))
        return value, product(J, jnp.concatenate([dx, du]))

    return new


def _as_array(tangent: Any) -> Any:
    if isinstance(tangent, SymbolicZero):
        return np.zeros(tangent.shape, tangent.dtype)
    return tangent


_rates = with_jacobian(partial(_rates_of, derivatives=False), _derivatives, _rates_of)
"""`_rates_of`, differentiated in closed form."""


def _tendon_inertia_times(model: mjx.Model, data: mjx.Data, qacc: Array) -> Array:
    """What armatures of tendons add to M qacc, (nv,)."""
    if not model.ntendon:
        return jnp.zeros_like(qacc)
    arms = internal(data).ten_J
    added = arms.T @ (model.tendon_armature[:, None] * arms)
    return jnp.where(_in_inertia(model), added, 0.0) @ qacc


def _tendon_bias(model: mjx.Model, data: mjx.Data, qacc: Array) -> Array:
    """What armatures of tendons add to M qacc and bias forces, (nv,)."""
    none = data.replace(qfrc_bias=jnp.zeros_like(qacc))
    added: Array = mjx.tendon_bias(model, none).qfrc_bias
    return added + _tendon_inertia_times(model, data, qacc)


def _activation_rates(model: mjx.Model, data: mjx.Data) -> Array:
    """Of Runge-Kutta rates (na,), else what the integrator adds in a timestep."""
    if model.na == 0 or model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return data.act_dot
    return mjx.euler(model, data).act - data.act


def _explicit(model: mjx.Model) -> bool:
    """Whether the integrator treats no damping implicitly."""
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    return bool(model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4)


def _implicit(model: mjx.Model, data: mjx.Data) -> Array:
    """The acceleration b (nv,) of an integrator that treats damping implicitly.

    W b = M a, with W = M - h D, and D (nv, nv) the derivative of forces by velocities. For free
    bodies without other joints W = M - h D + h B, with the derivative B of their bias forces: the
    C engine treats gyroscopic forces implicitly there, and nowhere else. B couples no two bodies.
    """
    if _explicit(model):
        return data.qacc
    return _solve_implicit(model, data, data.qfrc_smooth + data.qfrc_constraint)


def _damping_times(model: mjx.Model, data: mjx.Data, qacc: Array) -> Array:
    """(W - M) qacc, (nv,)."""
    found = -_by_velocity(model, data) @ qacc
    lone = _turning_implicitly(model)
    if lone.size:
        found = found.at[lone].add(_bias_rate(model, data, qacc)[lone])
    return model.opt.timestep * found


def _solve_implicit(model: mjx.Model, data: mjx.Data, forces: Array) -> Array:
    """W^{-1} forces, for forces (nv,) or (nv, n)."""
    h, lone = model.opt.timestep, _turning_implicitly(model)
    inertia = symmetric(internal(data).M - h * _by_velocity(model, data))
    if not lone.size:
        return solve_positive(inertia, forces)
    units = np.zeros((6, model.nv))
    units[np.arange(6), lone] = 1.0  # of all bodies at once
    rates = [_bias_rate(model, data, jnp.asarray(unit, forces.dtype)) for unit in units]
    columns = forces.reshape(model.nv, -1)
    found = solve_positive(inertia, jnp.concatenate([jnp.stack(rates, axis=1), columns], axis=1))
    both = found[lone].at[:, :, :6].multiply(h).at[:, :, :6].add(jnp.eye(6))
    for i in range(6):  # elimination; the matrix is close to 1, and needs no other pivots
        row = both[:, i] / both[:, i, i, None]
        both = (both - both[:, :, i, None] * row[:, None]).at[:, i].set(row)
    return found[:, 6:].at[lone].set(both[:, :, 6:]).reshape(forces.shape)


def _bias_rate(model: mjx.Model, data: mjx.Data, direction: Array) -> Array:
    """The derivative of bias forces (nv,) by velocities, in a direction (nv,)."""

    def bias(velocity: Array) -> Array:
        return rne(model, com_vel(model, data.replace(qvel=velocity))).qfrc_bias

    return jax.jvp(bias, (data.qvel,), (direction,))[1]


def _by_velocity(model: mjx.Model, data: mjx.Data) -> Array:
    """The derivative of smooth forces by velocities (nv, nv) that the C engine takes.

    Euler's integrator takes that of joints' damping. The other one has none of actuators whose
    force is at an end of its range, and no entries between two trees or branches, as where a tendon
    couples them.
    """
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return -jnp.diag(model.dof_damping)
    off = int(model.opt.disableflags)
    found = jnp.zeros((model.nv, model.nv), data.qvel.dtype)
    if model.nu and not off & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        moment = internal(data).actuator_moment
        found += moment.T @ (_force_slopes(model, data)[:, None] * moment)
    if not off & mujoco.mjtDisableBit.mjDSBL_DAMPER:
        found -= jnp.diag(model.dof_damping)
        if model.ntendon:
            arms = internal(data).ten_J
            found -= arms.T @ (model.tendon_damping[:, None] * arms)
    return jnp.where(_in_line(model), found, 0.0)


def _turning_implicitly(model: mjx.Model) -> np.ndarray:
    """Degrees of freedom of each free body without other joints, (bodies, 6); none for Euler."""
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return np.zeros((0, 6), int)
    starts = np.flatnonzero(np.diff(model.dof_treeid, prepend=-1))
    ends = np.append(starts[1:], model.nv)
    free = np.isin(starts, model.jnt_dofadr[model.jnt_type == FREE]) & (ends - starts == 6)
    return starts[free][:, None] + np.arange(6)


def _in_line(model: mjx.Model) -> np.ndarray:
    """Of which pairs of degrees of freedom one is above the other in the tree, (nv, nv)."""
    above = np.eye(model.nv, dtype=bool)
    for dof, parent in enumerate(model.dof_parentid):
        if parent >= 0:
            above[dof] |= above[parent]
    return above | above.T


def _in_inertia(model: mjx.Model) -> np.ndarray:
    """Entries of M that the C engine stores, (nv, nv); not all of a free body's."""
    stored = np.zeros((model.nv, model.nv), bool)
    stored[np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind] = True
    return stored | stored.T


def _force_slopes(model: mjx.Model, data: mjx.Data) -> Array:
    """The derivative of each actuator's force by its velocity, (nu,).

    Ranges of an actuator's force make it zero; those of tendons and joints do not.
    """
    free = model.replace(
        actuator_forcelimited=np.zeros_like(model.actuator_forcelimited),
        tendon_actfrclimited=np.zeros_like(model.tendon_actfrclimited),
    )

    def force(velocity: Array) -> Array:
        moving = with_internal(data, actuator_velocity=velocity)
        return mjx.fwd_actuation(free, moving).actuator_force

    velocity = internal(data).actuator_velocity
    _, slope = jax.jvp(force, (velocity,), (jnp.ones_like(velocity),))
    low, high = model.actuator_forcerange.T
    inside = (low < data.actuator_force) & (data.actuator_force < high)
    return jnp.where(inside | ~model.actuator_forcelimited.astype(bool), slope, 0.0)


def _runge_kutta(
    model: mjx.Model, joints: Joints, rates: Callable[..., Array], x: Array, u: Array
) -> Array:
    """MuJoCo's Runge-Kutta step of order 4."""
    h = model.opt.timestep

    def stage(carry: tuple[Array, Array], entry: Array) -> tuple[tuple[Array, Array], None]:
        rate, total = carry
        x_at = joints.integrate(x, h * entry[0] * rate)
        rate = jnp.concatenate([x_at[model.nq : model.nq + model.nv], rates(model, x_at, u)])
        return (rate, total + entry[1] * rate), None

    zero = jnp.zeros(2 * model.nv + model.na, x.dtype)
    _, total = jax.lax.scan(stage, (zero, zero), jnp.array(RK4, x.dtype))[0]
    moved = joints.integrate(x, h * total)
    if model.na == 0:
        return moved
    # Activations are integrated as in MuJoCo's Euler step, with exact filters and their ranges
    data = forward(model, x, u)[0].replace(act_dot=total[2 * model.nv :])
    return moved.at[model.nq + model.nv :].set(mjx.euler(model, data).act)
