"""Terms and constraints that hold at chosen times only.

>>> equality = mjx_drax.at_time(lambda x, u: x[:2] - gate, 0.8)       # a waypoint
>>> inequality = mjx_drax.between(clear, 0.5, 1.5, idle=-1.0)         # an obstacle for a while

What is returned is a function with a parameter `knot`, and goes where such functions go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from jax.typing import ArrayLike

from mjx_drax.base.errors import DraxError, is_number, shown
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.modelling.terms import Term, sum_of
from mjx_drax.problem.cost import as_partial, at_knot
from mjx_drax.problem.trajectory import Knot

ROUNDING = 1e-3
"""Share of a control step by which a knot may lie outside of a window."""


@register_dataclass
@dataclass(frozen=True, eq=False)
class Windowed:
    """A function at the knots from `begin` to `end` [s], and the number `idle` at all others."""

    function: Partial
    begin: Array
    end: Array
    idle: Array
    takes_knot = True

    def __call__(self, *arguments: Any, knot: Knot) -> Array:
        """The function's value, or `idle` for each of its entries."""
        return jnp.where(self.active(knot), at_knot(self.function, knot)(*arguments), self.idle)

    def __add__(self, other: Callable[..., Any] | int) -> Term:
        """Both vectors in one, as terms are added: for several waypoints."""
        return sum_of(self, other)

    def __radd__(self, other: Callable[..., Any] | int) -> Term:
        """The same, the other one's first."""
        return sum_of(other, self)

    def active(self, knot: Knot) -> Array:
        """Whether the function counts at a knot."""
        return self.holds(knot.time, knot.dt)

    def holds(self, time: Any, dt: Any) -> Array:
        """Whether the window, with control steps of dt about it, holds a time [s]."""
        slop = ROUNDING * dt
        return (time >= self.begin - slop) & (time <= self.end + slop)

    def check_knots(self, label: str, times: np.ndarray) -> None:
        """Complain about a window without a knot, where x_0..x_K are at `times` [s]."""
        at_end = label.startswith("terminal")
        own, step = times[-1:] if at_end else times[:-1], times[1] - times[0]
        begin, end = float(self.begin), float(self.end)
        if not self.holds(own, step).any():
            last = "" if at_end else "; for x_K there are the terminal functions"
            window = f"at {begin:g} s" if begin == end else f"from {begin:g} to {end:g} s"
            raise DraxError(
                f"{label} holds {window}, where it has no knot: its knots lie from {own[0]:g} to "
                f"{own[-1]:g} s{last}."
            )


@register_dataclass
@dataclass(frozen=True, eq=False)
class AtTime(Windowed):
    """The same at the one knot that is nearest to `begin` = `end`."""

    once = True  # a motion that ends before has skipped it

    def holds(self, time: Any, dt: Any) -> Array:
        """Whether the knot at a time is the nearest; halfway between two it is the first."""
        off = (time - self.begin) / dt + ROUNDING  # float32 cannot tell which is nearer
        return (off >= -0.5) & (off < 0.5)


def at_time(function: Callable[..., Any], time: ArrayLike, *, idle: float = 0.0) -> Windowed:
    """The function at the knot nearest to a time [s], and `idle` at all others.

    Args:
        function: a residual, a cost, an equality or an inequality of a stage.
        time: [s]; traced, so that another one does not recompile.
        idle: for each entry elsewhere: 0 for costs and equalities, a negative number of the usual
            size of g for an inequality g <= 0.

    Raises:
        DraxError: no function, or no finite numbers; from_function and from_mjcf complain of times
            outside of the horizon.
    """
    return AtTime(*_window(function, time, time, idle))


def between(
    function: Callable[..., Any], begin: ArrayLike, end: ArrayLike, *, idle: float = 0.0
) -> Windowed:
    """The function at all knots from one time to another [s], and `idle` at the others.

    Args and errors are those of `at_time`.
    """
    return Windowed(*_window(function, begin, end, idle))


def _window(function: Any, begin: Any, end: Any, idle: Any) -> tuple[Any, Array, Array, Array]:
    if not callable(function):
        raise DraxError(f"{shown(function)} is no function: give a cost, residual or constraint.")
    for label, value in (("begin", begin), ("end", end), ("idle", idle)):
        if not is_number(value):
            raise DraxError(f"{label} is {shown(value)}: give a finite number.")
    if begin > end:
        raise DraxError(f"the window begins at {begin} s and ends at {end} s: swap them.")
    first, last, other = (jnp.asarray(value, float) for value in (begin, end, idle))
    return as_partial(function), first, last, other
