"""One step of MJX, with derivatives that hold at rest and in contact.

Six things differ from `mjx.step`. Only the last two change values:

- Constraint forces (contacts, limits, dry friction, equalities) minimize a convex function of the
  acceleration, 1/2 |a - a_smooth|^2_M + s(J a - a_ref), with the function s of MJX. Newton's method
  finds the minimum a* without derivatives. One more Newton step, a* - H^{-1} grad(a*), has them:
  where grad = 0 its derivative is that of the implicit function theorem, da = -H^{-1} d grad.
- Positions are integrated by `joints`, whose quaternions have derivatives at rest. The
  semi-implicit integrators end with this, so only their end is replaced; Runge-Kutta integrates at
  every stage and is written here.
- The forces of springs on ball and free joints use the same quaternions.
- Sums along the tree of bodies are computed by `tree`, without a loop over its levels, and the
  inertia M is dense and factorized by `linalg`.
- Boxes on planes have the contacts of the C engine; see `collision`.
- The integrator implicitfast has the C engine's derivative of forces by velocities.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.kernels.linalg import cholesky, solve, symmetric
from mjx_drax.physics._mjx import ConstraintForces, internal, mjx, with_internal
from mjx_drax.physics.collision import collision, make_data
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import BALL, FREE, Joints
from mjx_drax.physics.tree import com_pos, com_vel, kinematics, mass_matrix, rne

ITERATIONS, SIZES = 20, 8
"""Newton's method for constraint forces: most iterations, and how many step sizes it chooses from,
1, 1/2, 1/4, ..."""

LEAST_SHARE = 1e-3
"""Least share of its predicted decrease that a step must achieve for another one to follow. In
float32, or where constraints are about to switch, costs go on decreasing by almost nothing."""

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


def forward(model: mjx.Model, x: Array, u: Array) -> mjx.Data:
    """`mjx.forward`: all that follows from a state (nx,) and a control (nu,), up to accelerations.

    Compiled functions compute only what their caller reads.
    """
    data = data_at(model, x, u)
    turned = np.isin(model.jnt_type, (FREE, BALL))
    if turned.any():
        data = data.replace(qfrc_applied=_springs(model, turned, data.qpos))
        model = model.replace(jnt_stiffness=jnp.where(turned, 0.0, model.jnt_stiffness))
    data = mjx.sensor_pos(model, _at_positions(model, data))
    data = mjx.sensor_vel(model, _at_velocities(model, data))
    data = _accelerated(model, mjx.fwd_actuation(model, data))
    return mjx.sensor_acc(model, _constrained(model, data))


def _at_positions(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_position`, with the sums along the tree of `tree`, and without factors of M."""
    data = mjx.camlight(model, com_pos(model, kinematics(model, data)))
    data = mass_matrix(model, mjx.tendon(model, data))
    data = collision(model, mjx.tendon_armature(model, data))
    if model.ntendon:
        data = with_internal(data, M=jnp.where(_in_inertia(model), internal(data).M, 0.0))
    return mjx.transmission(model, mjx.make_constraint(model, data))


def _at_velocities(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_velocity`, with the sums along the tree of `tree`."""
    data = with_internal(
        data,
        actuator_velocity=internal(data).actuator_moment @ data.qvel,
        ten_velocity=internal(data).ten_J @ data.qvel,
    )
    data = rne(model, mjx.passive(model, com_vel(model, data)))
    return mjx.tendon_bias(model, data)


def _accelerated(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_acceleration`: `data` with the acceleration without constraints."""
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    force = force + data.qfrc_applied + mjx.xfrc_accumulate(model, data)
    qacc = solve(cholesky(internal(data).M), force)
    return data.replace(qfrc_smooth=force, qacc_smooth=qacc)


def _springs(model: mjx.Model, turned: np.ndarray, qpos: Array) -> Array:
    """Forces (nv,) of the springs of ball and free joints, where `turned` is true, (njnt,)."""
    away = Joints.of(model).difference(qpos, model.qpos_spring)
    stiffness = jnp.where(turned, model.jnt_stiffness, 0.0)
    return -stiffness[model.dof_jntid] * away


def _constrained(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data` with the acceleration and the forces under constraints."""
    if internal(data).efc_J.size == 0:
        return data.replace(qacc=data.qacc_smooth)

    def law(model: mjx.Model, data: mjx.Data, qacc: Array) -> tuple[Array, ConstraintForces]:
        """The gradient (nv,) of what the acceleration minimizes, and constraint forces."""
        forces = ConstraintForces.create(model, data.replace(qacc=qacc), grad=False)
        return forces.Ma - data.qfrc_smooth - forces.qfrc_constraint, forces

    given = model, data
    frozen = jax.lax.stop_gradient(given)

    def hessian(qacc: Array) -> Array:
        return symmetric(jax.jacfwd(lambda a: law(*frozen, a)[0])(qacc))

    found = _minimum(partial(law, *frozen), hessian, frozen[1].qacc_smooth)
    qacc = found - solve(cholesky(hessian(found)), law(*given, found)[0])
    _, forces = law(*given, qacc)
    data = data.replace(qacc=qacc, qfrc_constraint=forces.Ma - data.qfrc_smooth)
    return with_internal(data, efc_force=forces.efc_force)


def _minimum(
    law: Callable[[Array], tuple[Array, ConstraintForces]],
    hessian: Callable[[Array], Array],
    start: Array,
) -> Array:
    """The acceleration (nv,) where the gradient of `law` is zero, to rounding, by Newton's method.

    The function is piecewise quadratic where friction cones are pyramids. Once the constraints that
    are active stay the same, a full step ends at the minimum; before, a shorter one may be better.
    """
    sizes = 0.5 ** jnp.arange(SIZES)

    def newton(carry: Any) -> Any:
        count, _, qacc, gradient, cost = carry
        direction = solve(cholesky(hessian(qacc)), gradient)
        tries = qacc - sizes[:, None] * direction
        gradients, forces = jax.vmap(law)(tries)
        best = jnp.argmin(forces.cost)
        rounding = jnp.finfo(cost.dtype).eps * jnp.abs(cost)
        least = jnp.maximum(rounding, LEAST_SHARE * jnp.dot(gradient, direction))
        better = cost - forces.cost[best] > least
        found = tries[best], gradients[best], forces.cost[best]
        kept = jax.tree.map(partial(jnp.where, better), found, (qacc, gradient, cost))
        return count + 1, better, *kept

    gradient, forces = law(start)
    begin = jnp.array(0), jnp.array(True), start, gradient, forces.cost
    end: Any = jax.lax.while_loop(lambda c: (c[0] < ITERATIONS) & c[1], newton, begin)
    return end[2]


def step(model: mjx.Model, x: Array, u: Array) -> Array:
    """The state (nx,) one timestep after x (nx,) under the control u (nu,)."""
    joints, h = Joints.of(model), model.opt.timestep
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return _runge_kutta(model, joints, x, u)
    data = forward(model, x, u)
    dv = h * _implicit(model, data)
    act = mjx.euler(model, data).act if model.na else data.act
    return joints.integrate(x, jnp.concatenate([h * (data.qvel + dv), dv, act - data.act]))


def _implicit(model: mjx.Model, data: mjx.Data) -> Array:
    """The acceleration (nv,) of an integrator that treats damping implicitly."""
    h = model.opt.timestep
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
            return data.qacc
        by_velocity = -jnp.diag(model.dof_damping)
    else:
        by_velocity = _by_velocity(model, data)
    factor = cholesky(symmetric(internal(data).M - h * by_velocity))
    qacc = solve(factor, data.qfrc_smooth + data.qfrc_constraint)
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return qacc
    return _turning(model, data, factor, qacc)


def _by_velocity(model: mjx.Model, data: mjx.Data) -> Array:
    """The derivative of smooth forces by velocities (nv, nv) that the C engine takes.

    It has none of actuators whose force is at an end of its range, no entries between two trees or
    branches, as where a tendon couples them.
    """
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


def _turning(model: mjx.Model, data: mjx.Data, factor: Array, qacc: Array) -> Array:
    """`qacc` (nv,), that of free bodies without other joints changed as by implicit bias forces.

    The C engine treats the gyroscopic forces of these implicitly, and those of all other bodies
    not: (S + h B) a = S qacc, with the matrix S that has this factor, and the derivative B of bias
    forces by velocities. It couples no two bodies.
    """
    starts = np.flatnonzero(np.diff(model.dof_treeid, prepend=-1))
    ends = np.append(starts[1:], model.nv)
    free = np.isin(starts, model.jnt_dofadr[model.jnt_type == FREE]) & (ends - starts == 6)
    entries = starts[free][:, None] + np.arange(6)  # (free bodies, 6)
    if not entries.size:
        return qacc

    def bias(velocity: Array) -> Array:
        return rne(model, com_vel(model, data.replace(qvel=velocity))).qfrc_bias

    units = np.zeros((6, model.nv))
    units[np.arange(6), entries] = 1.0  # of all bodies at once
    rates = [jax.jvp(bias, (data.qvel,), (jnp.asarray(e, qacc.dtype),))[1] for e in units]
    change = model.opt.timestep * jnp.stack([solve(factor, rate) for rate in rates], axis=1)
    wanted = jnp.eye(6) + change[entries]  # (free bodies, 6, 6)
    both = jnp.concatenate([wanted, qacc[entries][..., None]], axis=2)
    for i in range(6):  # elimination; the matrix is close to 1, and needs no other pivots
        row = both[:, i] / both[:, i, i, None]
        both = (both - both[:, :, i, None] * row[:, None]).at[:, i].set(row)
    return qacc.at[entries].set(both[:, :, 6])


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


def _runge_kutta(model: mjx.Model, joints: Joints, x: Array, u: Array) -> Array:
    """MuJoCo's Runge-Kutta step of order 4."""
    h = model.opt.timestep

    def stage(carry: tuple[Array, Array], entry: Array) -> tuple[tuple[Array, Array], None]:
        rate, total = carry
        data = forward(model, joints.integrate(x, h * entry[0] * rate), u)
        rate = jnp.concatenate([data.qvel, data.qacc, data.act_dot])
        return (rate, total + entry[1] * rate), None

    zero = jnp.zeros(2 * model.nv + model.na, x.dtype)
    _, total = jax.lax.scan(stage, (zero, zero), jnp.array(RK4, x.dtype))[0]
    moved = joints.integrate(x, h * total)
    if model.na == 0:
        return moved
    # Activations are integrated as in MuJoCo's Euler step, with exact filters and their ranges
    data = forward(model, x, u).replace(act_dot=total[2 * model.nv :])
    return moved.at[model.nq + model.nv :].set(mjx.euler(model, data).act)
