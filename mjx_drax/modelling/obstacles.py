"""Obstacles for problems without a model: signed distances of points, as JAX functions.

    distance > 0: outside, that far from the surface;   < 0: inside, that deep

Lengths are in your units. `inequality=obstacles.clearance([...], margin=0.2)` keeps a round robot
of radius 0.2 away; in a function of your own write `margin - obstacle(x[:2])`. Numbers may be
traced: an obstacle can move with the state, or be the robot itself: the distance of a rectangular
robot from a circle is `box(x[:2], (0.4, 0.2), x[2])(centre) - radius`.

First and second derivatives, in forward mode, are finite everywhere and those of the formulas.
Where the nearest point jumps the first is that of one side, or a mean; at centres and on axes it is
a unit vector that leads out. The second grows as 1/r at a distance r of a corner or a centre.

Exact are all but `grid` and `image`, which interpolate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from operator import index
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, is_number, require_positive, shown
from mjx_drax.base.numbers import numbers as real_numbers
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.modelling.maps import coefficients, dark_pixels, to_squares
from mjx_drax.modelling.terms import Term
from mjx_drax.physics import quaternion

TINY = 1e-15
"""Lengths below are taken for zero, so that their squares and 1/length can be computed."""


@register_dataclass
@dataclass(frozen=True, eq=False)
class Obstacle:
    """The signed distance of points: function(point, *numbers), made by the functions below.

    Attributes:
        function: the formula, a function of a module.
        dimension: of the points, 2 or 3.
        numbers: places and sizes; traced, so that other ones do not recompile.
    """

    function: Callable[..., Array] = field(metadata=Static)
    dimension: int = field(metadata=Static)
    numbers: tuple[Any, ...]

    def __call__(self, point: ArrayLike) -> Array:
        """Signed distances (...,) of points (..., dimension).

        Raises:
            DraxError: the points have another dimension.
        """
        points = jnp.asarray(point)
        points = points.astype(jnp.result_type(points, float))
        if points.shape[-1:] != (self.dimension,):
            raise DraxError(
                f"an obstacle in {self.dimension} dimensions got a point of shape {points.shape}: "
                f"give {self.dimension} numbers, such as x[:{self.dimension}]."
            )
        own = [jnp.asarray(_fresh(n), points.dtype) for n in self.numbers]
        one = lambda p: self.function(p, *own)  # noqa: E731
        flat = jax.vmap(one)(points.reshape(-1, self.dimension)) if points.ndim > 1 else one(points)
        return flat.reshape(points.shape[:-1])


def circle(centre: ArrayLike, radius: ArrayLike) -> Obstacle:
    """|p - centre| - radius: a circle, or a sphere where centre has three numbers.

    Raises:
        DraxError: wrong shapes, numbers that are not finite, or a negative radius.
    """
    place = _numbers("centre of the circle", centre, (2,), (3,))
    return _obstacle(_circle, place, _sizes("radius of the circle", radius, ()))


def box(centre: ArrayLike, half_sizes: ArrayLike, rotation: ArrayLike | None = None) -> Obstacle:
    """A rectangle or a box.

    Args:
        centre: (2,) or (3,).
        half_sizes: half of its width, height (and depth), as many.
        rotation: in the plane an angle [rad], counterclockwise; in space a quaternion (4,).

    Raises:
        DraxError: wrong shapes, numbers that are not finite, or negative sizes.
    """
    place = _numbers("centre of the box", centre, (2,), (3,))
    plane = len(place) == 2
    if rotation is None:
        rotation = 0.0 if plane else [1.0, 0.0, 0.0, 0.0]
    turn = _numbers("rotation of the box", rotation, () if plane else (4,))
    if isinstance(turn, np.ndarray) and not plane and np.linalg.norm(turn) < 1e-9:
        raise DraxError(f"rotation of the box is {shown(rotation)}: it must not be zero.")
    return _obstacle(_box, place, _sizes("half_sizes of the box", half_sizes, place.shape), turn)


def capsule(a: ArrayLike, b: ArrayLike, radius: ArrayLike) -> Obstacle:
    """All points within radius of the segment from a to b, each (2,) or (3,).

    Raises:
        DraxError: wrong shapes, numbers that are not finite, or a negative radius.
    """
    start = _numbers("a of the capsule", a, (2,), (3,))
    end = _numbers("b of the capsule", b, start.shape)
    return _obstacle(_capsule, start, end, _sizes("radius of the capsule", radius, ()))


def polygon(vertices: ArrayLike) -> Obstacle:
    """A polygon, which need not be convex, from its corners (n, 2) in order, either way round.

    Raises:
        DraxError: fewer than three corners, equal neighbours, edges that cross, or numbers that are
            not finite.
    """
    corners = _array("vertices of the polygon", vertices)
    if isinstance(corners, np.ndarray) and len(corners) > 3 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]  # closed, as files of maps have it
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise DraxError(
            f"vertices of the polygon have shape {corners.shape}: give three points (n, 2) or more."
        )
    if isinstance(corners, np.ndarray):
        _require_simple(corners)
    return _obstacle(_polygon, corners)


def grid(values: ArrayLike, cell: float, origin: ArrayLike) -> Obstacle:
    """Signed distances that are known on a grid, and cubic splines with two derivatives between.

    Outside of the grid it is the value at its border, plus the distance from there.

    Args:
        values: (n, m) or (n, m, l); values[i, j] is the distance at origin + cell * (i, j).
        cell: the distance between neighbours.
        origin: where values[0, 0] is, (2,) or (3,).

    Raises:
        DraxError: wrong shapes, less than two values along an axis, or numbers that are not finite.
    """
    known = _array("values of the grid", values)
    if known.ndim not in (2, 3) or min(known.shape) < 2:
        raise DraxError(
            f"values of the grid have shape {known.shape}: give an array (n, m) or (n, m, l) with "
            "at least 2 values along each axis."
        )
    if not isinstance(known, np.ndarray):
        raise DraxError("values of the grid are traced: make the grid outside of JAX functions.")
    require_positive("cell of the grid", cell)
    place = _numbers("origin of the grid", origin, (known.ndim,))
    return Obstacle(_grid, known.ndim, (coefficients(known), np.asarray(float(cell)), place))


def image(
    picture: str | Path | ArrayLike,
    cell: float,
    origin: ArrayLike = (0.0, 0.0),
    threshold: float = 0.5,
) -> Obstacle:
    """A map from a picture: what is dark is an obstacle. x goes right, y up.

    The distance to the squares of the dark pixels is exact at the centres of all pixels, and
    interpolated by `grid` between. At corners it is wrong by up to about a quarter of a cell.

    Args:
        picture: an image file, or its pixels (rows, columns), the upper row first: brightness from
            0 to 1 (whole numbers: 0 to 255), or truth values that are true for obstacles.
        cell: side of a pixel.
        origin: the lower left corner of the picture, (2,).
        threshold: pixels darker than this share of white are obstacles.

    Raises:
        DraxError: the file cannot be read, or not both dark and bright pixels are there.
    """
    if not is_number(threshold) or not 0 < threshold <= 1:
        raise DraxError(f"threshold is {shown(threshold)}: give a share of white, such as 0.5.")
    require_positive("cell of the image", cell)
    corner = _numbers("origin of the image", origin, (2,))
    dark = dark_pixels(picture, threshold)
    if dark.ndim != 2 or min(dark.shape) < 2:
        raise DraxError(f"the image has shape {dark.shape}: give at least 2 rows and 2 columns.")
    if dark.all() or not dark.any():
        kind = "an obstacle" if dark.all() else "free"
        raise DraxError(f"all pixels of the image are {kind}: change threshold={threshold}.")
    dark = dark[::-1].T
    signed = np.where(dark, -to_squares(~dark), to_squares(dark))
    return grid(cell * signed, cell, corner + 0.5 * cell)


def clearance(
    obstacles: Obstacle | Iterable[Obstacle],
    *,
    margin: ArrayLike = 0.0,
    at: Sequence[int] = (0, 1),
) -> Term:
    """margin - distance, (n,), <= 0 where a point keeps its distance from n obstacles.

    It goes where inequalities go, and adds up with others like terms of `Terms`. Places, sizes and
    margins are traced: other numbers do not recompile. Obstacles of a kind compile once.

    Args:
        obstacles: one or many.
        margin: one number, or (n,); the radius of a round robot, and what is to be kept besides.
        at: where the point is in the state x; three indices in space.

    Raises:
        DraxError: no obstacle, or not as many indices as dimensions.
    """
    listed: list[Any] = list(obstacles) if isinstance(obstacles, Iterable) else [obstacles]
    for one in listed:
        if not isinstance(one, Obstacle):
            raise DraxError(f"an obstacle is {shown(one)}: make it by obstacles.circle and others.")
    if not listed:
        raise DraxError("clearance of no obstacles: give at least one.")
    try:
        place = tuple(index(i) for i in at)
    except TypeError as error:
        raise DraxError(f"at is {shown(at)}: give indices of the state, such as (0, 1).") from error
    if any(one.dimension != len(place) for one in listed):
        dimensions = sorted({one.dimension for one in listed})
        raise DraxError(
            f"at is {place}, and obstacles have {dimensions} dimensions: give one index for each."
        )
    wanted = _array("margin of clearance", margin)
    if wanted.shape not in ((), (len(listed),)):
        raise DraxError(
            f"margin of clearance is {shown(margin)}: give one number, or {len(listed)}."
        )
    groups: dict[Any, list[int]] = {}
    for i, one in enumerate(listed):
        shapes = tuple(np.shape(number) for number in one.numbers)
        groups.setdefault((one.function, shapes), []).append(i)
    order = tuple(int(i) for i in np.argsort(np.concatenate(list(groups.values()))))
    stacked = [jax.tree.map(_stack, *(listed[i] for i in group)) for group in groups.values()]
    return Term(_clearance, (place, order), (wanted, *stacked), jnp.ones(()))


def _clearance(
    x: Any, u: Array | None, where: tuple[Any, ...], margin: Array, *stacked: Obstacle
) -> Array:
    if not hasattr(x, "shape"):
        raise DraxError("obstacles.clearance reads the states of problems without a model: use "
                        "Terms(model).clearance.")  # fmt: skip
    at, order = where
    if min(at) < 0 or max(at) >= len(x):
        raise DraxError(f"at is {at} in clearance, and the state has {len(x)} numbers: give "
                        f"indices from 0 to {len(x) - 1}.")  # fmt: skip
    point = x[jnp.array(at)]
    distances = [jax.vmap(lambda one: one(point))(jax.tree.map(_fresh, s)) for s in stacked]
    return jnp.asarray(_fresh(margin), x.dtype) - jnp.concatenate(distances)[jnp.array(order)]


# The formulas: functions of a point (n,) and of numbers


def _ratio(a: Array, b: Array) -> Array:
    """a / b, and 0 where b is 0, for b >= 0."""
    positive = b > TINY**2
    return jnp.where(positive, a / jnp.where(positive, b, 1.0), 0.0)


def _length(vector: Array) -> Array:
    """|vector|; at zero the derivative is the unit vector of the first axis."""
    square = vector @ vector
    zero = square < TINY**2
    return jnp.where(zero, vector[0], jnp.sqrt(jnp.where(zero, 1.0, square)))


def _rounding(*vectors: Array) -> Array:
    """The square of a length below which what is computed of such vectors has no direction."""
    eps = 8 * jnp.finfo(vectors[0].dtype).eps
    squares = jnp.array([v @ v for v in vectors])
    return lax.stop_gradient(eps**2 * squares.sum() + TINY**2)


def _across(vector: Array) -> Array:
    """A unit vector at a right angle to a vector (n,); some unit vector for zero."""
    axis = jax.nn.one_hot(jnp.argmin(jnp.abs(vector)), len(vector), dtype=vector.dtype)
    rest = axis - _ratio(axis @ vector, vector @ vector) * vector
    return lax.stop_gradient(rest / jnp.sqrt(rest @ rest))


def _circle(point: Array, centre: Array, radius: Array) -> Array:
    return _length(point - centre) - radius


def _box(point: Array, centre: Array, half: Array, rotation: Array) -> Array:
    seen = point - centre
    if rotation.ndim:
        seen = seen @ quaternion.matrix(quaternion.normalized(rotation))
    else:
        c, s = jnp.cos(rotation), jnp.sin(rotation)
        seen = jnp.stack([c * seen[0] + s * seen[1], c * seen[1] - s * seen[0]])
    excess = jnp.where(seen < 0, -seen, seen) - half  # |seen|, with a slope at 0 too
    depth = excess.max()
    return jnp.where(depth > 2 * TINY, _length(jnp.maximum(excess, 0.0)), depth)


def _capsule(point: Array, a: Array, b: Array, radius: Array) -> Array:
    along, seen = b - a, point - a
    t = jnp.clip(_ratio(seen @ along, along @ along), 0.0, 1.0)
    apart = seen - t * along
    on_axis = apart @ apart < _rounding(seen, along)
    sideways = apart @ _across(along)  # its derivative leads away from the axis
    return jnp.where(on_axis, sideways, _length(apart)) - radius


def _polygon(point: Array, corners: Array) -> Array:
    """Beside the nearest edge the distance from its line; at a corner that from the corner."""
    n, edges = len(corners), jnp.roll(corners, -1, axis=0) - corners
    orientation = jnp.where(_cross(corners, jnp.roll(corners, -1, axis=0)).sum() < 0, -1.0, 1.0)

    def nearest(point: Array, corners: Array, edges: Array) -> Array:
        seen = point - corners
        t = jnp.clip(jnp.sum(seen * edges, axis=1) / jnp.sum(edges * edges, axis=1), 0.0, 1.0)
        return jnp.argmin(jnp.sum(jnp.square(seen - t[:, None] * edges), axis=1))

    i = nearest(*lax.stop_gradient((point, corners, edges)))
    before, edge, after = (edges[(i + step) % n] for step in (-1, 0, 1))
    square = edge @ edge
    t = (point - corners[i]) @ edge / square
    side = orientation * _cross(point - corners[i], edge) / jnp.sqrt(square)
    first = t <= 0
    corner = jnp.where(first, corners[i], corners[(i + 1) % n])
    one, other = jnp.where(first, before, edge), jnp.where(first, edge, after)
    turn = orientation * _cross(one, other)
    straight = jnp.abs(turn) <= 1e-6 * jnp.sqrt((one @ one) * (other @ other))
    seen = point - corner
    outside = jnp.where(straight, side >= 0, turn > 0)
    at_corner = jnp.where(outside, 1.0, -1.0) * _length(seen)
    beside = ((t > 0) & (t < 1)) | (seen @ seen < _rounding(edge))
    return jnp.where(beside, side, at_corner)


def _cross(a: Any, b: Any) -> Any:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _grid(point: Array, coefficients: Array, cell: Array, origin: Array) -> Array:
    """Cubic B-splines; coefficients[i + 1, j + 1] belongs to the value (i, j)."""
    last = np.array(coefficients.shape) - 3
    place = (point - origin) / cell
    held = jnp.clip(place, 0.0, last)
    first = jnp.clip(jnp.floor(lax.stop_gradient(held)).astype(int), 0, last - 1)
    t = held - first
    weights = jnp.stack(
        [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3]
    )
    value = lax.dynamic_slice(coefficients, tuple(first), (4,) * len(point))
    for axis in range(len(point)):
        value = jnp.tensordot(weights[:, axis] / 6, value, 1)
    return value + _length(cell * (place - held))


# On the host


def _require_simple(corners: np.ndarray) -> None:
    """Complain about edges of a polygon (n, 2) that have no length, or cross."""
    n, ends = len(corners), np.roll(corners, -1, axis=0)
    same = np.flatnonzero((corners == ends).all(axis=1))
    if same.size:
        raise DraxError(
            f"corners {same[0]} and {(same[0] + 1) % n} of the polygon are equal: remove one."
        )

    def side(points: np.ndarray) -> np.ndarray:
        """On which side of edge i point j is."""
        return np.sign(_cross((ends - corners)[:, None], points[None] - corners[:, None]))

    apart = side(corners) * side(ends)
    cross = np.argwhere((apart < 0) & (apart.T < 0))
    if len(cross):
        i, j = cross[0]
        raise DraxError(
            f"edges {i} and {j} of the polygon cross (edge i begins at corner i): give the corners "
            "in their order around it, or several polygons."
        )
    if abs(_cross(corners, ends).sum()) < 1e-12 * np.square(np.ptp(corners, axis=0)).sum():
        raise DraxError("the polygon has no area: give a capsule of radius 0.")


def _array(label: str, value: Any) -> Any:
    """Finite numbers on the host; traced numbers are taken as they are."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        return jnp.asarray(value, float)
    try:
        array = real_numbers(value)
    except (TypeError, ValueError) as error:
        raise DraxError(f"{label} is {shown(value)}: give numbers.") from error
    if not np.isfinite(array).all():
        raise DraxError(f"{label} is {shown(value)}: give finite numbers.")
    return array


def _numbers(label: str, value: Any, *shapes: tuple[int, ...]) -> Any:
    array = _array(label, value)
    if array.shape not in shapes:
        sizes = " or ".join(str(int(np.prod(shape))) for shape in shapes)
        raise DraxError(f"{label} is {shown(value)}: give {sizes} number(s).")
    return array


def _sizes(label: str, value: Any, shape: tuple[int, ...]) -> Any:
    array = _numbers(label, value, shape)
    if isinstance(array, np.ndarray) and (array < 0).any():
        raise DraxError(f"{label} is {shown(value)}: it must not be negative.")
    return array


def _obstacle(function: Callable[..., Array], place: Any, *more: Any) -> Obstacle:
    return Obstacle(function, place.shape[-1], (place, *more))


def _stack(*leaves: Any) -> Any:
    return (np if all(isinstance(leaf, np.ndarray) for leaf in leaves) else jnp).stack(leaves)


def _fresh(leaf: Any) -> Any:
    """A copy of an array of numpy: JAX remembers such constants in their first precision."""
    return np.array(leaf) if isinstance(leaf, np.ndarray) else leaf
