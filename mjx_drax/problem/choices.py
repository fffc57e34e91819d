"""What a user leaves open: x_0, parameters, durations; and what rates of controls are asked for.

`Choices` holds it as given and checked; `extend` makes a problem's parts of it (see `extended`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, DraxWarning, is_number, require_whole, shown
from mjx_drax.base.numbers import numbers, vector
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.problem.cost import Constraint, as_partial, takes_knot
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.extended import Extended, Seen, with_knot
from mjx_drax.problem.trajectory import Box

Pair = tuple[ArrayLike, ArrayLike]


@dataclass(frozen=True)
class Choices:
    """What is left open, as a user gives it.

    Attributes:
        start: (lower, upper) of x_0; entries where the two differ are free.
        parameters: (lower, upper) by name.
        phases: (least, most duration [s], knots) of phases of free duration.
        order: of the rates of controls that functions read: 0, 1 (rate) or 2 (jerk as well).
        u_init: the control before the first knot, (nu,).
        rates: (lower, upper) of (u_k - u_{k-1}) / dt.
    """

    start: Pair | None = None
    parameters: Mapping[str, Pair] | None = None
    phases: tuple[tuple[float, float, int], ...] = ()
    order: int = 0
    u_init: ArrayLike | None = None
    rates: Pair | None = None

    @property
    def any(self) -> bool:
        """Whether anything is."""
        given = self.start, self.parameters, self.u_init, self.rates
        return bool(self.phases or self.order) or any(part is not None for part in given)


class Parts(NamedTuple):
    """The parts of a problem that choices change."""

    dynamics: Dynamics
    given: dict[str, Callable[..., Any] | None]
    x_init: Array
    bounds: Box
    scatter: Box
    free: tuple[tuple[int, ...], ...]


def phases_of(horizon: Any, knots: Any) -> tuple[tuple[float, float, int], ...]:
    """The phases of free duration; () where the horizon is one number."""
    if is_number(horizon):
        return ()
    one = isinstance(horizon, tuple) and len(horizon) == 2 and all(map(is_number, horizon))
    each = [horizon] if one else horizon
    counts = [knots] if one else knots
    try:
        pairs = [tuple(map(float, pair)) for pair in each]
        counts = list(counts)
        good = len(pairs) == len(counts) > 0 and all(len(pair) == 2 for pair in pairs)
    except (TypeError, ValueError):
        good = False
    if not good:
        raise DraxError(
            f"horizon is {shown(horizon)} with knots {shown(knots)}: give seconds, or a pair "
            "(least, most) with knots=K, or a list of pairs with a list of knots, for phases."
        )
    for (least, most), count in zip(pairs, counts, strict=True):
        if count is None:
            raise DraxError(
                f"the duration is free, from {least:g} to {most:g} s, and knots is None: give "
                "knots=K, as the step between them is found with the duration."
            )
        require_whole("knots", count)
        if not (np.isfinite([least, most]).all() and 0 < least < most):
            raise DraxError(
                f"the duration may be from {least} to {most} s: give 0 < least < most, both finite."
            )
    return tuple((*pair, count) for pair, count in zip(pairs, counts, strict=True))


def extend(
    choices: Choices,
    dynamics: Dynamics,
    given: dict[str, Callable[..., Any] | None],
    x_init: Array,
    bounds: Box,
    scatter: Box,
) -> Parts:
    """The parts of the problem with all that is left open in it, if the choices fit."""
    places, lower, upper = _start(choices, dynamics, x_init)
    asked = any(takes_knot(f) for f in given.values() if f is not None)
    steps = np.array([[a / k, b / k] for a, b, k in choices.phases]).reshape(-1, 2)
    require_whole("rates", choices.order, 0)
    order = max(choices.order, int(choices.rates is not None))
    if order > 2:
        raise DraxError(f"rates is {order}: give 1 for the rate of controls, 2 for jerk as well.")
    if choices.u_init is not None and not order:
        raise DraxError("u_init is given, and nothing reads a rate: give rates=1 as well.")
    shapes, low, high = parameter_ends(choices.parameters)
    reach = 0.5 * np.ones(len(places))  # where an end is infinite
    near, far = (np.where(np.isfinite(e), e, s * reach) for e, s in ((lower, -1), (upper, 1)))
    if not (shapes or order or len(steps) or (places and asked)):
        start = _ends(lower, upper), _ends(near, far)
        boxes = _with_start(bounds, start[0]), _with_start(scatter, start[1])
        return Parts(dynamics, given, x_init, *boxes, tuple((place,) for place in places))

    middle = 0.5 * np.concatenate([low + high, steps.sum(axis=1)])
    nominal = np.concatenate([np.zeros(len(places)), middle])
    u_init = np.zeros(dynamics.nu)
    if choices.u_init is not None:
        u_init = np.asarray(vector("u_init", choices.u_init))
        if u_init.shape != (dynamics.nu,):
            raise DraxError(f"u_init has shape {u_init.shape}: give {dynamics.nu} numbers.")
        least, most = (np.atleast_2d(e)[0] for e in (bounds.u_lower, bounds.u_upper))
        if ((u_init < least) | (u_init > most)).any():
            warnings.warn(
                f"u_init is {u_init.tolist()}, outside of the controls' bounds, so the first rate "
                "leads back from there: move it, or widen u_bounds.",
                DraxWarning,
                stacklevel=4,
            )
    counts = tuple(count for *_, count in choices.phases)
    whole = Extended(
        inner=dynamics,
        nominal=jnp.asarray(nominal, x_init.dtype),
        u_init=jnp.asarray(u_init, x_init.dtype),
        free=tuple(places),
        shapes=shapes,
        phases=counts,
        order=order,
        starts_known=choices.u_init is not None,
    )
    constant = np.concatenate([low, steps[:, 0]]), np.concatenate([high, steps[:, 1]])
    ends = [np.concatenate([e, c - middle]) for e, c in zip((lower, upper), constant, strict=True)]
    draws = [np.concatenate([e, c - middle]) for e, c in zip((near, far), constant, strict=True)]
    width = scatter.u_lower, scatter.u_upper
    after = [np.tile(np.ravel(e)[-dynamics.nu :], order) for e in width]
    more = [np.concatenate([e, c, v]) for e, c, v in zip((near, far), constant, after, strict=True)]
    free_of_bounds = [np.full(len(more[0]), s * np.inf) for s in (-1, 1)]
    n, ndx = len(places), dynamics.ndx
    free: tuple[tuple[int, ...], ...] = (
        *((place, ndx + i) for i, place in enumerate(places)),
        *((ndx + n + j,) for j in range(len(middle))),
    )
    functions: dict[str, Callable[..., Any] | None] = {
        name: with_knot(function) for name, function in given.items()
    }
    if choices.rates is not None:
        functions["inequality"] = _with_rates(choices.rates, functions["inequality"], dynamics.nu)
    return Parts(
        whole,
        functions,
        jnp.concatenate([x_init, whole.nominal, jnp.tile(whole.u_init, order)]),
        _with_start(_wider(bounds, free_of_bounds), _ends(*ends)),
        _with_start(_wider(scatter, more), _ends(*draws)),
        free,
    )


def _ends(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Both, or None where x_0 is fixed."""
    return (lower, upper) if len(lower) else None


def _with_start(box: Box, ends: tuple[np.ndarray, np.ndarray] | None) -> Box:
    if ends is None:
        return box
    lower, upper = (jnp.asarray(end, box.x_lower.dtype) for end in ends)
    return replace(box, start_lower=lower, start_upper=upper)


def _wider(box: Box, ends: list[np.ndarray]) -> Box:
    """The box with ends for further states."""

    def joined(x: Array, more: np.ndarray) -> Array:
        tail = jnp.broadcast_to(jnp.asarray(more, x.dtype), (*x.shape[:-1], len(more)))
        return jnp.concatenate([x, tail], axis=-1)

    return replace(box, x_lower=joined(box.x_lower, ends[0]), x_upper=joined(box.x_upper, ends[1]))


def _start(
    choices: Choices, dynamics: Dynamics, x_init: Array
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Free tangent coordinates of x_0, and how far below and above x_init they may be."""
    if choices.start is None:
        return [], np.zeros(0), np.zeros(0)
    nx, x = dynamics.nx, np.asarray(x_init, float)
    try:
        lower, upper = (np.broadcast_to(numbers(end), (nx,)).astype(float) for end in choices.start)
    except (TypeError, ValueError) as error:
        raise DraxError(
            f"x_init_bounds are {shown(choices.start)}: give (lower, upper), each ({nx},) or one "
            "number for all."
        ) from error
    if np.isnan([lower, upper]).any() or (lower > upper).any():
        raise DraxError(f"x_init_bounds are {shown(choices.start)}: give lower <= upper.")
    rounded = 1e-6 * np.maximum(1.0, np.abs(x))  # x_init may be in float32
    if (x < lower - rounded).any() or (x > upper + rounded).any():
        raise DraxError(
            f"x_init = {shown(x.tolist())} lies outside of x_init_bounds: move it inside."
        )
    entry = np.asarray(dynamics.tangent(jnp.arange(1.0, nx + 1)), int) - 1
    free = np.flatnonzero(lower < upper)
    lost = sorted(set(free.tolist()) - set(entry.tolist()))
    if lost:
        raise DraxError(
            f"x_init_bounds leave entries {lost} free, which are quaternions: bound both sides to "
            "x_init there."
        )
    places = [int(np.flatnonzero(entry == e)[0]) for e in free]
    return places, np.minimum(lower - x, 0.0)[free], np.maximum(upper - x, 0.0)[free]


def parameter_ends(
    given: Mapping[str, Pair] | None,
) -> tuple[tuple[tuple[str, tuple[int, ...]], ...], np.ndarray, np.ndarray]:
    """Names and shapes of the parameters, and their finite lower and upper ends in one vector."""
    shapes, low, high = [], [np.zeros(0)], [np.zeros(0)]
    if given is not None and not isinstance(given, Mapping):
        raise DraxError(f"parameters are {shown(given)}: give {{name: (lower, upper)}}.")
    for name, pair in (given or {}).items():
        try:
            lower, upper = np.broadcast_arrays(*(numbers(end).astype(float) for end in pair))
            good = bool(np.isfinite([lower, upper]).all() and (lower < upper).all())
        except (TypeError, ValueError):
            good = False
        if not good or not isinstance(name, str):
            raise DraxError(
                f"the parameter {shown(name)} is {shown(pair)}: give (lower, upper), finite "
                "numbers or arrays of one shape with lower < upper; what is fixed is a number in "
                "your functions."
            )
        shapes.append((name, lower.shape))
        low.append(lower.ravel())
        high.append(upper.ravel())
    return tuple(shapes), np.concatenate(low), np.concatenate(high)


@register_dataclass
@dataclass(frozen=True, eq=False)
class Rates:
    """[g; rate - upper; lower - rate], of the entries of the rate that have such an end."""

    inequality: Partial | None
    lower: Array
    upper: Array
    below: tuple[int, ...] = field(metadata=Static)
    above: tuple[int, ...] = field(metadata=Static)

    def __call__(self, seen: Seen, u: Array) -> Array:
        """All rows, held <= 0."""
        rate, below, above = seen.knot.rate, np.array(self.below, int), np.array(self.above, int)
        own = [] if self.inequality is None else [jnp.ravel(self.inequality(seen, u))]
        rows = rate[above] - self.upper[above], self.lower[below] - rate[below]
        return jnp.concatenate([*own, *rows])


def rated_controls(constraint: Constraint) -> list[int]:
    """The controls whose rates the last rows of the inequality bound, one for each row."""
    parts = jax.tree.leaves(constraint.inequality, is_leaf=lambda part: isinstance(part, Rates))
    return [i for part in parts if isinstance(part, Rates) for i in (*part.above, *part.below)]


def _with_rates(rates: Pair, inequality: Any, nu: int) -> Any:
    try:
        lower, upper = (np.broadcast_to(numbers(end), (nu,)).astype(float) for end in rates)
        good = bool((lower < upper).all())
    except (TypeError, ValueError):
        good = False
    if not good:
        raise DraxError(
            f"rate_bounds are {shown(rates)}: give (lower, upper) [unit of u / s] with lower < "
            f"upper, each ({nu},) or one number for all."
        )
    below, above = (tuple(map(int, np.flatnonzero(np.isfinite(e)))) for e in (lower, upper))
    if not below + above:
        return inequality
    low, high = (jnp.asarray(np.where(np.isfinite(e), e, 0.0), float) for e in (lower, upper))
    return as_partial(Rates(inequality, low, high, below, above))
