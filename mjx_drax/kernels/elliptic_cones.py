"""Forces of contacts whose friction cones are elliptic, for `constraint_solver`.

A contact has a row for its normal and one for each direction of friction. In u = scale y, with
scale = mu for the normal and the friction coefficient for the others, forces are -g scale P with
the projection P of u onto the round cone mu N + |t| <= 0 (N: the normal entry, t: the others), and

    s(y) = 1/2 g |P(u)|^2,     g = D_normal / mu^2     (`_update_constraint` of MJX)

u is in one of three zones: sticking, P = u; open, P = 0; sliding between them, where P is on the
cone, P = w / (1 + mu^2) (1, -mu t / |t|), w = N - mu |t|.

Arrays with an entry for each row are (d, c): the normals of c contacts, then their first
directions, and so on. So sums over the rows of a contact are sums over an axis.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

STICKS, SLIDES, OPEN = 1.0, 2.0, 3.0


class Cones(NamedTuple):
    """Contacts, c of them, of d rows each.

    Attributes:
        J: (d, c, nv).
        aref: (d, c).
        scale: from y to u, (d, c).
        mu: friction of the normal, (c,).
        weight: g, (c,).
    """

    J: Array
    aref: Array
    scale: Array
    mu: Array
    weight: Array


class Place(NamedTuple):
    """Where u is, (..., d, c), with N, |t| and the zone (..., c), the direction t / |t| and P."""

    u: Array
    N: Array
    T: Array
    zone: Array
    along: Array
    P: Array


def _is_normal(a: Array) -> Array:
    return lax.broadcasted_iota(jnp.int32, a.shape, a.ndim - 2) == 0


def _normal(a: Array) -> Array:
    """Entries of normals, (..., c). A slice would do, but kernels have none."""
    return jnp.sum(jnp.where(_is_normal(a), a, 0.0), axis=-2)


def _tangents(a: Array) -> Array:
    """The other entries, and 0 for normals, (..., d, c)."""
    return jnp.where(_is_normal(a), 0.0, a)


def _by_row(a: Array) -> Array:
    """What contacts have (..., c), for each of their rows, (..., 1, c)."""
    return jnp.expand_dims(a, -2)


def place(cones: Cones, y: Array) -> Place:
    """Where y (d, c) is."""
    u = cones.scale * y
    squared = jnp.sum(_tangents(u) ** 2, axis=-2)
    moves = squared > 0.0  # a root has no derivative at 0
    return _placed(cones, u, jnp.where(moves, jnp.sqrt(jnp.where(moves, squared, 1.0)), 0.0))


def _placed(cones: Cones, u: Array, T: Array) -> Place:
    """Where u is, with its |t|."""
    mu, N = cones.mu, _normal(u)
    along = _tangents(u) / _by_row(jnp.where(T > 0.0, T, 1.0))
    w = (N - mu * T) / (1.0 + mu * mu)
    on_cone = jnp.where(_is_normal(u), _by_row(w), _by_row(-mu * w) * along)
    zone = jnp.where(mu * T > N, SLIDES, OPEN)
    zone = jnp.where(mu * N + T <= 0.0, STICKS, zone)
    P = jnp.where(_by_row(zone == SLIDES), on_cone, 0.0)
    return Place(u, N, T, zone, along, jnp.where(_by_row(zone == STICKS), u, P))


def forces(cones: Cones, at: Place) -> Array:
    """-s', by y, (..., d, c)."""
    return -cones.weight * cones.scale * at.P


def curved(cones: Cones, at: Place) -> Array:
    """s'' J, (d, c, nv), with the second derivative s'' of s by y.

    Between the rows of a contact it is g where they stick; where they slide, the sum of a diagonal
    and of products of two vectors, of w's slope and of the direction.
    """
    mu, g, J = cones.mu, cones.weight, cones.J
    slides = at.zone == SLIDES
    share = jnp.where(slides, g / (1.0 + mu * mu), 0.0)
    bent = jnp.where(slides, share * mu * (mu * at.T - at.N) / jnp.where(slides, at.T, 1.0), 0.0)
    sticks = jnp.where(at.zone == STICKS, g, 0.0)
    of_w = cones.scale * jnp.where(_is_normal(at.u), 1.0, -mu * at.along)
    turned = cones.scale * at.along
    own = (_tangents(jnp.broadcast_to(bent, turned.shape)) + sticks) * cones.scale**2
    falls, turns = (jnp.sum(a[:, :, None] * J, axis=0) for a in (of_w, turned))
    found = own[:, :, None] * J + (share * of_w)[:, :, None] * falls[None]
    return found - (bent * turned)[:, :, None] * turns[None]


class Ray(NamedTuple):
    """A direction in which y may go.

    Attributes:
        step: in u, (d, c).
        turn, square: t'step and |step|^2, of the tangents, (c,).
    """

    step: Array
    turn: Array
    square: Array


def ray(cones: Cones, at: Place, h: Array) -> Ray:
    """The direction h (d, c) of y."""
    step = cones.scale * h
    tangent = _tangents(step)
    return Ray(step, jnp.sum(tangent * at.u, axis=-2), jnp.sum(tangent**2, axis=-2))


def changes(cones: Cones, at: Place, ray: Ray, size: Array) -> tuple[Array, Array]:
    """s(y + h) - s(y) - s'(y) h by contact, (..., c), and s'(y + h) - s'(y), (..., d, c).

    h is `size`, (...,), times the direction. With Q = u - P, which is orthogonal to P, the former
    is g (1/2 |dP|^2 - P'Q(y + h)). While a contact slides, dP and P'Q come from how its direction
    turns, not from differences.
    """
    mu, g, by_contact = cones.mu, cones.weight, size[..., None]
    step = by_contact[..., None] * ray.step
    more = by_contact * (2.0 * ray.turn + by_contact * ray.square)
    digits = jnp.finfo(at.T.dtype).eps * (at.T**2 + by_contact * by_contact * ray.square)
    T = jnp.sqrt(jnp.maximum(at.T**2 + more, digits))
    new = _placed(cones, at.u + step, T)
    both = at.T + T
    longer = more / jnp.where(both > 0.0, both, 1.0)
    turn = (_tangents(step) - at.along * _by_row(longer)) / _by_row(jnp.where(T > 0.0, T, 1.0))
    faster = (_normal(step) - mu * longer) / (1.0 + mu * mu)
    w = (at.N - mu * at.T) / (1.0 + mu * mu)
    slid = -mu * (_by_row(faster) * new.along + w * turn)
    slid = jnp.where(_is_normal(slid), _by_row(faster), slid)
    slides = (at.zone == SLIDES) & (new.zone == SLIDES)
    sticks = (at.zone == STICKS) & (new.zone == STICKS)
    moved = jnp.where(_by_row(sticks), step, new.P - at.P)
    moved = jnp.where(_by_row(slides), slid, moved)
    turned = 0.5 * mu * w * (mu * new.N + T) / (1.0 + mu * mu) * jnp.sum(turn**2, axis=-2)
    inner = jnp.where(slides, turned, jnp.sum(at.P * (new.u - new.P), axis=-2))
    return g * (0.5 * jnp.sum(moved**2, axis=-2) - inner), g * cones.scale * moved
