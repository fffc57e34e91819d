"""Forces of contacts on joints, without the Jacobian of their rows.

A row of a contact's J turns a velocity of joints into that of a point of one body, seen from the
other, along an edge of the friction cone. So J w and J'f are sums along the tree and over contacts,
and their derivatives by one position are numbers of bodies and contacts; those of J are (rows, nv),
and took half of the time of all Jacobians of a humanoid robot.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.kernels import elliptic_cones as elliptic
from mjx_drax.physics._mjx import constraint, internal, mjx
from mjx_drax.physics.contacts.collision import bodies_in_contact
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.tree import applied, joint_forces, motions


def contact_forces(model: mjx.Model, data: mjx.Data, qacc: Array) -> Array:
    """Forces (nv,) of all contacts at an acceleration (nv,): J' times those of the rows of MJX.

    Args:
        model: the model.
        data: it has contacts, motions about centres of mass, and velocities.
        qacc: the acceleration.
    """
    bodies = bodies_in_contact(model)
    wrenches = jnp.zeros((len(bodies), 6), qacc.dtype)
    for dim in np.unique(internal(data).contact.dim):
        wrenches = wrenches + _wrenches(model, data, qacc, bodies, int(dim))
    return joint_forces(model, data, wrenches, bodies)


def cones(
    model: mjx.Model, friction: Array, J: Array, aref: Array, D_normal: Array
) -> elliptic.Cones:
    """Elliptic cones of c contacts: friction (c, 5), J (d, c, nv), aref (d, c), D_normal (c,)."""
    mu = friction[:, 0] / jnp.sqrt(model.opt.impratio)
    scale = jnp.concatenate([mu[None], friction.T[: len(aref) - 1]])
    return elliptic.Cones(J, aref, scale, mu, D_normal / mu**2)


def _wrenches(model: mjx.Model, data: mjx.Data, qacc: Array, every: np.ndarray, dim: int) -> Array:
    """Torques and forces on bodies `every` (m,), (m, 6), by the n contacts with `dim` dimensions.

    They are about the centres of mass that motions of the bodies are about.
    """
    contact = internal(data).contact
    which = np.flatnonzero(np.asarray(contact.dim) == dim)
    pos, frame, friction = (a[which] for a in (contact.pos, contact.frame, contact.friction))
    both = jnp.asarray(model.geom_bodyid)[contact.geom[which]]  # (n, 2)
    arms = pos[:, None] - data.subtree_com[jnp.asarray(model.body_rootid)[both]]
    is_body = both[..., None] == every
    row, edges = _edges(model, data, friction, dim)
    touches = (row.pos_imp < 0).reshape(len(which), -1)

    def along_edges(velocity: Array) -> Array:
        """J w, (n, rows of a contact)."""
        of_both = motions(model, data, velocity, every)[jnp.argmax(is_body, axis=2)]
        turning, moving = jnp.split(of_both, 2, axis=2)
        moving = moving + jnp.cross(turning, arms)
        seen = [applied(frame, each[:, 1] - each[:, 0]) for each in (moving, turning)]
        return touches * applied(edges, jnp.concatenate(seen, axis=1)[:, :dim])

    k, b, impedance = jax.vmap(partial(constraint._kbi, model))(row.solref, row.solimp, row.pos_imp)
    softness = jnp.maximum(row.invweight * (1 - impedance) / impedance, mujoco.mjMINVAL)
    D, stiff, b = (
        a.reshape(touches.shape) for a in (1 / softness, k * impedance * row.pos_aref, b)
    )
    y = along_edges(qacc) + b * along_edges(data.qvel) + stiff
    if dim > 1 and model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        given = cones(model, friction, jnp.empty(0), y.T, D[:, 0])  # J is not read
        push = elliptic.forces(given, elliptic.place(given, y.T)).T
    else:
        push = -D * jnp.minimum(y, 0.0)
    along = applied(jnp.swapaxes(edges, 1, 2), touches * push)
    halves = jnp.split(jnp.pad(along, ((0, 0), (0, 6 - dim))), 2, axis=1)
    force, torque = (applied(jnp.swapaxes(frame, 1, 2), half)[:, None] for half in halves)
    around = torque + jnp.cross(arms, force)
    wrench = jnp.concatenate([around, jnp.broadcast_to(force, arms.shape)], axis=2)
    on_both = wrench * jnp.array([-1.0, 1.0], wrench.dtype)[:, None]
    return jnp.sum(jnp.where(is_body[..., None], on_both[:, :, None], 0.0), axis=(0, 1))


def _edges(model: mjx.Model, data: mjx.Data, friction: Array, dim: int) -> tuple[Any, Array]:
    """MJX's rows of the n contacts with `dim` dimensions, and what each has of the frame's axes.

    The latter is (n, rows of a contact, dim): after three axes of translation come those of turns.
    """
    dtype = friction.dtype
    if dim == 1:
        ones = jnp.ones((len(friction), 1, 1), dtype)
        return constraint._efc_contact_frictionless(model, data), ones
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        axes = jnp.broadcast_to(jnp.eye(dim, dtype=dtype), (len(friction), dim, dim))
        return constraint._efc_contact_elliptic(model, data, dim), axes
    tilts = jnp.repeat(friction[:, : dim - 1], 2, axis=1) * jnp.tile(
        jnp.array([1.0, -1.0], dtype), dim - 1
    )
    aside = tilts[..., None] * jnp.repeat(jnp.eye(dim - 1, dtype=dtype), 2, axis=0)
    edges = jnp.concatenate([jnp.ones_like(tilts)[..., None], aside], axis=2)
    return constraint._efc_contact_pyramidal(model, data, dim), edges
