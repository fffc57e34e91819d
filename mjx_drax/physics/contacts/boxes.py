"""Contacts of spheres and capsules with boxes, as the C engine has them.

MJX lets a capsule touch a box where its line is clipped by a face; the C engine lets two spheres on
the axis of the capsule touch it: one where the axis is nearest to the box, and one further along,
as far as the box reaches.

All is in the frame of the box, whose half sizes are s: capsules are p + t h, with -1 <= t <= 1.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.contacts.spheres import APART, Contacts, length, nearest

TINY = 1e-15
"""What counts as zero: distances of centres from boxes, differences of squares, as in C."""

ENDS = np.array([-1.0, 1.0])

EDGES = np.array(
    [np.insert(side, axis, 0.0) for axis in range(3) for side in itertools.product(ENDS, ENDS)]
)
"""The middles of a cube's edges, (12, 3): 0 along the edge."""

FAR = 2.0
"""The longest way along a capsule, in half lengths."""


def sphere_box(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """The point of the box that is nearest to the centre; of centres inside, the nearest face."""
    sphere, box = geom.T
    turn, origin = data.geom_xmat[box], data.geom_xpos[box]
    centre = _into(turn, data.geom_xpos[sphere] - origin)
    touch = jax.vmap(_sphere)(centre, model.geom_size[sphere, 0], model.geom_size[box])
    return _out_of(turn, origin, touch)


def capsule_box(model: mjx.Model, data: mjx.Data, geom: Array) -> Contacts:
    """Two contacts of each pair, (2 n,), (2 n, 3), (2 n, 3)."""
    capsule, box = geom.T
    turn, origin = data.geom_xmat[box], data.geom_xpos[box]
    radius, half = model.geom_size[capsule, 0], model.geom_size[capsule, 1, None]
    centre = _into(turn, data.geom_xpos[capsule] - origin)
    axis = _into(turn, data.geom_xmat[capsule][..., 2] * half)
    size = model.geom_size[box]
    first, step, both = jax.vmap(_two)(centre, axis, size)
    along = jnp.stack([first, first + step], axis=1)
    dist, pos, normal = jax.vmap(jax.vmap(_sphere, (0, None, None)))(
        centre[:, None] + along[..., None] * axis[:, None], radius, size
    )
    acts = jnp.stack([jnp.ones_like(both), both], axis=1)
    dist = jnp.where(acts, dist, APART).reshape(-1)
    turn, origin = jnp.repeat(turn, 2, axis=0), jnp.repeat(origin, 2, axis=0)
    return _out_of(turn, origin, (dist, pos.reshape(-1, 3), normal.reshape(-1, 3)))


def _into(turn: Array, v: Array) -> Array:
    return jnp.einsum("nji,nj->ni", turn, v)


def _out_of(turn: Array, origin: Array, touch: Contacts) -> Contacts:
    dist, pos, normal = touch
    rotated = [jnp.einsum("nij,nj->ni", turn, v) for v in (pos, normal)]
    return dist, rotated[0] + origin, rotated[1]


def _sphere(centre: Array, radius: Array, size: Array) -> Contacts:
    """The contact of one sphere: distance (), position (3,) and normal (3,)."""
    nearest = jnp.clip(centre, -size, size)
    away = nearest - centre
    far = length(away[None])[0]
    inside = far <= TINY
    depths = jnp.stack([size + centre, size - centre], axis=1).reshape(6)
    face = jnp.argmin(depths)
    inward = jnp.zeros_like(centre).at[face // 2].set(jnp.where(face % 2, -1.0, 1.0))
    normal = jnp.where(inside, inward, away / jnp.where(inside, 1.0, far))
    dist = jnp.where(inside, -depths[face], far) - radius
    return dist, centre + (radius + 0.5 * dist) * normal, normal


def _two(p: Array, h: Array, s: Array) -> tuple[Array, Array, Array]:
    """Where on the axis the nearest sphere is, t in [-1, 1], how far on the other, and if it is.

    The nearest point of the axis is an end, above a face or inside of the box, or it is nearest to
    an edge. The other point is found along the side of the box to which the axis is more parallel,
    if it leads over the box at all; it may be the same one, and then counts twice.
    """
    ends = p + ENDS[:, None].astype(p.dtype) * h
    out = jnp.abs(ends) > s
    beyond = jnp.sum(jnp.square(ends - jnp.clip(ends, -s, s)), axis=1)
    above = jnp.where(jnp.sum(out, axis=1) <= 1, beyond, jnp.inf)
    end = jnp.argmin(above)

    edges = jnp.asarray(EDGES, p.dtype)
    on_edge, corner, t, apart = jax.vmap(_nearest_on_edge, (0, None, None, None))(edges, p, h, s)
    e = jnp.argmin(apart)
    rounding = jnp.maximum(jnp.finfo(p.dtype).eps * (h @ h), TINY)
    with_edge = apart[e] < above[end] - rounding
    middle = edges[e]
    of_corner = _from_corner(jnp.where(middle == 0, corner[e], middle), t[e], h, s)
    of_edge = _from_edge(middle, on_edge[e], t[e], h, s)
    found = zip(of_corner, of_edge, strict=True)
    step, exists = (jnp.where(corner[e] != 0, *either) for either in found)
    sign = jnp.where(end > 0, 1.0, -1.0)
    over_face = -sign * _over_face(ends[end], -sign * h, s, out[end])
    both = jnp.where(with_edge, exists, jnp.any(out[end]))
    return jnp.where(with_edge, t[e], sign), jnp.where(with_edge, step, over_face), both


def _nearest_on_edge(middle: Array, p: Array, h: Array, s: Array) -> tuple[Array, ...]:
    """Nearest points b of an edge and t of the axis, in [-1, 1], and their squared distance.

    Second comes at which end of the edge its corner counts as nearest, -1, 1, or 0 for none: where
    lines through both are nearest beyond it, even if b is not.
    """
    edge = jnp.where(middle == 0, s, 0.0)
    apart = middle * s - p
    of_line, on_edge, t, parallel = nearest(apart, edge, h)
    beyond = jnp.where(jnp.abs(on_edge) > 1.0, on_edge, of_line)
    corner = jnp.where(jnp.abs(beyond) > 1.0, jnp.sign(beyond), 0.0)
    on_edge = jnp.clip(on_edge, -1.0, 1.0)
    squared = jnp.sum(jnp.square(apart + on_edge * edge - t * h))
    return on_edge, corner, t, jnp.where(parallel, jnp.inf, squared)


def _along(way: Array, h: Array) -> Array:
    """How far along the axis ways (3,) along the sides of the box are; FAR where further."""
    speed = jnp.abs(h)
    near = way < FAR * speed
    return jnp.where(near, way / jnp.where(near, speed, 1.0), FAR)


def _from_corner(corner: Array, t: Array, h: Array, s: Array) -> tuple[Array, Array]:
    """The other point, where a corner of the box is nearest: along an edge or over a face.

    There is none where the axis points to the corner, or away from it, along all three sides.
    """
    differs = (h > 0) != (corner > 0)
    count = jnp.sum(differs)
    odd = jnp.where(count == 1, differs, ~differs)  # the one side that is unlike the others
    sign = jnp.where(count == 1, 1.0, -1.0)
    along_edge = jnp.sum(jnp.where(odd, h, 0.0)) ** 2 > 0.5 * jnp.sum(h * h)
    sign = jnp.where(along_edge, sign, -sign)
    reach = jnp.min(jnp.where(odd == along_edge, _along(2.0 * s, h), FAR))
    step = sign * jnp.minimum(1.0 - sign * t, reach)
    return step, (count == 1) | (count == 2)


def _from_edge(middle: Array, b: Array, t: Array, h: Array, s: Array) -> tuple[Array, Array]:
    """The other point, where the inside of an edge is nearest: over the face beside it.

    There is none where the axis is over no face, or over both.
    """
    edge = middle == 0
    differs = ((h > 0) != (middle > 0)) & ~edge
    # Of the two other sides, the one to which the axis is more parallel, the later one of equals
    flat = jnp.argmax(jnp.where(edge, -1.0, jnp.abs(h)))
    sign = jnp.where(differs[flat], 1.0, -1.0)
    towards = jnp.sum(jnp.where(edge, h, 0.0)) > 0
    left = jnp.where(towards == differs[flat], 1.0 - b, 1.0 + b)
    ahead = _along(s * jnp.where(edge, left, 2.0), h)
    reach = jnp.min(jnp.where(edge | (jnp.arange(3) == flat), ahead, FAR))
    step = sign * jnp.minimum(1.0 - sign * t, reach)
    return step, jnp.sum(differs) == 1


def _over_face(end: Array, onwards: Array, s: Array, out: Array) -> Array:
    """How far the axis goes on over a face from an end above it."""
    way = jnp.where(onwards > 0, s - end, s + end)
    return jnp.min(jnp.where((way > 0) & ~out, _along(way, onwards), FAR))
