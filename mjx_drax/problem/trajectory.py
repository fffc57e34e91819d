"""Knot points x_1..x_K, u_0..u_{K-1}, the box that they keep to, and what functions are there.

A knot has a state, a control, and a `Knot`: its time, its number and the user's data for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.base.pytrees import register_dataclass


@register_dataclass
@dataclass(frozen=True)
class Knot:
    """What functions with a parameter `knot` receive; for all knots with a leading axis (K + 1,).

    Attributes:
        time: t_k [s].
        index: k, counted from time 0.
        dt: time from here to the next knot [s].
        data: the user's data for the knot: row k of every array in `data` of the problem.
        x_init: x_0, (nx,).
        parameters: what was chosen for the whole motion, by name; None without.
        rate: (u_k - u_{k-1}) / dt, (nu,), where rates are asked for; None at the end.
        jerk: the same of the rate.
        stage: k, counted from x_0; it differs from `index` where x_0 is not at time 0.
    """

    time: Array
    index: Array
    dt: Array
    data: Any = None
    x_init: Any = None
    parameters: Any = None
    rate: Any = None
    jerk: Any = None
    stage: Any = None

    def at(self, which: Any) -> Knot:
        """One knot of several, or a slice of them."""
        one: Knot = jax.tree.map(lambda a: a[which], self)
        return one


@register_dataclass
@dataclass(frozen=True)
class Stagewise:
    """Numbers that go with constraints: for the stages (..., K, m) and for the end (..., m_end)."""

    stage: Array
    terminal: Array


@register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """Knot points: states x_1..x_K (..., K, nx) and controls u_0..u_{K-1} (..., K, nu).

    What a chain carries also has the slack variables s >= 0 of inequalities; a trajectory that a
    user gives does not. Where x_0 is free, `start` (n0,) is by how much its free coordinates differ
    from x_init.
    """

    x: Array
    u: Array
    slack: Stagewise | None = None
    start: Array | None = None


@register_dataclass
@dataclass(frozen=True)
class Values:
    """What the functions of a problem are at a trajectory.

    Attributes:
        costs: l(x_k, u_k) and phi(x_K), (K + 1,).
        defects: h_k, (K, ndx).
        constraints: [equality; inequality], without slack variables.
    """

    costs: Array
    defects: Array
    constraints: Stagewise

    @property
    def cost(self) -> Array:
        """phi(x_K) + sum_k l(x_k, u_k), scalar."""
        return jnp.sum(self.costs[:-1]) + self.costs[-1]


APART = 4e-5
"""Share of its size by which a number that bounds leave no choice of may move in a plan."""


@register_dataclass
@dataclass(frozen=True)
class Box:
    """Ends of states, (nx,) or (K, nx), and of controls, (nu,) or (K, nu); infinite if free.

    Where x_0 is free, also those of `Trajectory.start`, (n0,). `roomy` is what `with_room` gives,
    if that is known.
    """

    x_lower: Array
    x_upper: Array
    u_lower: Array
    u_upper: Array
    start_lower: Array | None = None
    start_upper: Array | None = None
    roomy: Box | None = None

    def sides(self, trajectory: Trajectory) -> tuple[Trajectory, Trajectory]:
        """The lower and the upper end for every knot of a trajectory, as two trajectories."""
        x, u = trajectory.x, trajectory.u
        zeros = jax.tree.map(jnp.zeros_like, trajectory.slack)
        infinite = jax.tree.map(lambda s: jnp.full_like(s, jnp.inf), trajectory.slack)

        def side(
            of_x: Array, of_u: Array, of_slack: Stagewise | None, of_start: Array | None
        ) -> Trajectory:
            start = None if trajectory.start is None else of_start
            whole = jnp.broadcast_to(of_x, x.shape), jnp.broadcast_to(of_u, u.shape)
            return Trajectory(*whole, of_slack, start)

        lower = side(self.x_lower, self.u_lower, zeros, self.start_lower)
        upper = side(self.x_upper, self.u_upper, infinite, self.start_upper)
        return lower, upper

    def with_room(self) -> Box:
        """The box, equal ends moved apart by `APART`: a barrier needs an interior."""
        if self.roomy is not None:
            return self.roomy
        x, u = _apart(self.x_lower, self.x_upper), _apart(self.u_lower, self.u_upper)
        return replace(self, x_lower=x[0], x_upper=x[1], u_lower=u[0], u_upper=u[1])

    def opened_at(self, x: Array) -> Box:
        """The box, those ends of states moved outwards at which x (nx,) lies.

        A motion that starts on its bound, as a mass at rest at a wall, cannot leave it at once: for
        its first states there is no interior.
        """
        lower, upper = self.x_lower, self.x_upper
        below, above = _room(lower, upper), _room(upper, lower)
        lower = jnp.where(jnp.abs(x - lower) <= below, lower - below, lower)
        upper = jnp.where(jnp.abs(x - upper) <= above, upper + above, upper)
        return replace(self, x_lower=lower, x_upper=upper)

    def violation(self, trajectory: Trajectory) -> Array:
        """Largest distance by which any knot leaves the box `with_room`, 0 if none does, scalar."""
        lower, upper = self.with_room().sides(trajectory)
        out = jax.tree.map(
            lambda z, a, b: jnp.maximum((a - z).max(initial=0.0), (z - b).max(initial=0.0)),
            trajectory,
            lower,
            upper,
        )
        largest = jnp.maximum(out.x, out.u)
        return largest if out.start is None else jnp.maximum(largest, out.start)


def _apart(lower: Array, upper: Array) -> tuple[Array, Array]:
    """The ends, `APART` where they are equal."""
    half = jnp.where(lower == upper, _room(lower, upper), 0.0)
    return lower - half, upper + half


def _room(end: Array, other: Array) -> Array:
    """Half of `APART`, of the end's own size, else of the coordinate's, else of 1."""
    ends = jnp.stack(jnp.broadcast_arrays(jnp.atleast_2d(end), jnp.atleast_2d(other)))
    sizes = jnp.where(jnp.isfinite(ends), jnp.abs(ends), 0.0).max(axis=(0, 1), initial=0.0)
    of_coordinate = jnp.where(sizes > 0.0, sizes, 1.0)
    return 0.5 * APART * jnp.where(end == 0.0, of_coordinate, jnp.abs(end))


def _pair(label: str, ends: Any) -> tuple[ArrayLike, ArrayLike]:
    """(lower, upper) as given, or infinite for None."""
    if ends is None:
        return -np.inf, np.inf
    try:
        lower, upper = ends
    except (TypeError, ValueError) as error:
        raise DraxError(
            f"bounds of {label} are {shown(ends)}: give a pair (lower, upper)."
        ) from error
    return lower, upper


def box(
    nx: int,
    nu: int,
    x: tuple[ArrayLike, ArrayLike] | None = None,
    u: tuple[ArrayLike, ArrayLike] | None = None,
) -> Box:
    """A box from (lower, upper) pairs, scalars or arrays that broadcast to (nx,) and (nu,).

    A pair that is None is free.
    """

    def end(value: ArrayLike, size: int, label: str) -> Array:
        try:
            array = numbers(value)
            if np.isnan(array).any():
                raise ValueError("NaN is no bound")
            if array.ndim and array.shape[-1] != size:
                raise ValueError("one number in a list is meant for one entry")
            return jnp.asarray(np.broadcast_to(array, (*array.shape[:-1], size)))
        except (TypeError, ValueError) as error:
            raise DraxError(
                f"{label} is {shown(value)}: give numbers of shape ({size},), or one for all, and "
                "no NaN; -inf and inf leave it free."
            ) from error

    (xl, xu), (ul, uu) = _pair("x", x), _pair("u", u)
    return Box(
        end(xl, nx, "lower end of x"),
        end(xu, nx, "upper end of x"),
        end(ul, nu, "lower end of u"),
        end(uu, nu, "upper end of u"),
    )
