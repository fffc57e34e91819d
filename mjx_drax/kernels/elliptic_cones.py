"""Forces of contacts whose friction cones are elliptic, for `constraint_solver`.

A contact has a row for its normal and one for each direction of friction. In u = scale y, with
scale = mu for the normal and the friction coefficient for the others, forces are -g scale P with
the projection P of u onto the round cone mu N + |t| <= 0 (N: the normal entry, t: the others), and

    s(y) = 1/2 g |P(u)|^2,     g = D_normal / mu^2     (`_update_constraint` of MJX)

u is in one of three zones: sticking, P = u; open, P = 0; sliding between them, where P is on the
cone, P = w / (1 + mu^2) (1, -mu t / |t|), w = N - mu |t|.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

STICKS, SLIDES, OPEN = 1.0, 2.0, 3.0


class Cones(NamedTuple):
    """Of each row, (m,).

    Attributes:
        of: the number of the contact that the row belongs to, from 1; 0: to none.
        normal: 1 for rows of normals, else 0.
        scale: from y to u; 0 for rows of no contact.
        mu: friction of the normal, of the row's contact.
        weight: g, of the row's contact.
    """

    of: Array
    normal: Array
    scale: Array
    mu: Array
    weight: Array


class Place(NamedTuple):
    """Where u is, by row (..., m): u, N, |t|, the direction t / |t|, the zone and P."""

    u: Array
    N: Array
    T: Array
    along: Array
    zone: Array
    P: Array


Total = Callable[[Array], Array]
"""Sums over the rows of each contact, (m,) -> (m,)."""


def together(cones: Cones) -> Array:
    """Which two rows belong to one contact, (m, m), as 0 and 1."""
    of = cones.of
    same = (of[:, None] == of[None, :]) & (of[:, None] > 0.0)
    return jnp.where(same, jnp.ones((), of.dtype), jnp.zeros((), of.dtype))


def place(cones: Cones, total: Total, y: Array) -> Place:
    """Where y (m,) is."""
    u = cones.scale * y
    tangent = (1.0 - cones.normal) * u
    squared = total(tangent * tangent)
    moves = squared > 0.0  # a root has no derivative at 0
    T = jnp.where(moves, jnp.sqrt(jnp.where(moves, squared, 1.0)), 0.0)
    return placed(cones, u, total(cones.normal * u), T)


def placed(cones: Cones, u: Array, N: Array, T: Array) -> Place:
    """Where u is, with N and |t| of its contact, (..., m)."""
    mu = cones.mu
    along = (1.0 - cones.normal) * u / jnp.where(T > 0.0, T, 1.0)
    w = (N - mu * T) / (1.0 + mu * mu)
    on_cone = jnp.where(cones.normal > 0.0, w, -mu * w * along)
    slides = jnp.where(mu * T > N, SLIDES, OPEN)
    zone = jnp.where(cones.of > 0.0, jnp.where(mu * N + T <= 0.0, STICKS, slides), 0.0)
    P = jnp.where(zone == STICKS, u, jnp.where(zone == SLIDES, on_cone, 0.0))
    return Place(u, N, T, along, zone, P)


def forces(cones: Cones, at: Place) -> Array:
    """-s', by y, (..., m)."""
    return -cones.weight * cones.scale * at.P


def curvature(cones: Cones, at: Place) -> Array:
    """The second derivative of s by y, (m, m)."""
    mu, g, scale = cones.mu, cones.weight, cones.scale
    slides = at.zone == SLIDES
    share = jnp.where(slides, g / (1.0 + mu * mu), 0.0)
    slope = scale * jnp.where(cones.normal > 0.0, 1.0, -mu * at.along)  # of w
    bent = jnp.where(slides, share * mu * (mu * at.T - at.N) / jnp.where(slides, at.T, 1.0), 0.0)
    turned = scale * at.along
    pairs = share[:, None] * slope[:, None] * slope[None, :]
    pairs = together(cones) * (pairs - bent[:, None] * turned[:, None] * turned[None, :])
    own = jnp.where(at.zone == STICKS, g, (1.0 - cones.normal) * bent) * scale * scale
    rows = jnp.arange(len(own))
    return pairs + jnp.where(rows[:, None] == rows[None, :], own[:, None], 0.0)


class Ray(NamedTuple):
    """A direction in which y may go, by row (m,).

    Attributes:
        step: in u.
        N: how fast the normal entry grows.
        turn, square: t'step and |step|^2, of the tangents.
    """

    step: Array
    N: Array
    turn: Array
    square: Array


def ray(cones: Cones, total: Total, at: Place, h: Array) -> Ray:
    """The direction h (m,) of y."""
    step = cones.scale * h
    tangent = (1.0 - cones.normal) * step
    sums = total(cones.normal * step), total(tangent * at.u), total(tangent * tangent)
    return Ray(step, *sums)


def changes(cones: Cones, at: Place, ray: Ray, size: Array) -> tuple[Array, Array]:
    """s(y + h) - s(y) - s'(y) h, by rows whose sum it is, and s'(y + h) - s'(y), (..., m).

    h is `size`, (..., 1) or (), times the direction. With Q = u - P, which is orthogonal to P, the
    former is g (1/2 |dP|^2 - P'Q(y + h)). While a contact slides, dP and P'Q come from how its
    direction turns, not from differences.
    """
    mu, g = cones.mu, cones.weight
    step = size * ray.step
    tangent, more = (1.0 - cones.normal) * step, size * (2.0 * ray.turn + size * ray.square)
    digits = jnp.finfo(at.T.dtype).eps * (at.T * at.T + size * size * ray.square)
    N, T = at.N + size * ray.N, jnp.sqrt(jnp.maximum(at.T * at.T + more, digits))
    new = placed(cones, at.u + step, N, T)
    both = at.T + T
    longer = more / jnp.where(both > 0.0, both, 1.0)
    turn = (tangent - at.along * longer) / jnp.where(T > 0.0, T, 1.0)
    faster = (size * ray.N - mu * longer) / (1.0 + mu * mu)
    w = (at.N - mu * at.T) / (1.0 + mu * mu)
    slid = jnp.where(cones.normal > 0.0, faster, -mu * (faster * new.along + w * turn))
    slides = (at.zone == SLIDES) & (new.zone == SLIDES)
    sticks = (at.zone == STICKS) & (new.zone == STICKS)
    moved = jnp.where(slides, slid, jnp.where(sticks, step, new.P - at.P))
    turned = 0.5 * mu * w * (mu * N + T) / (1.0 + mu * mu) * turn * turn
    inner = jnp.where(slides, turned, at.P * (new.u - new.P))
    return g * (0.5 * moved * moved - inner), g * cones.scale * moved
