"""Quantities that are chosen once for a motion, and rates of controls, as further states.

A motion with parameters p, with phases of free duration, with costs or constraints that refer to a
free x_0, or to how fast controls change, is a motion of a larger system:

    x' = [x, w, p, h, v],    w, p and h do not change,    v_{k+1} = [u_k, v_k's first entries]

w is by how much the free coordinates of x_0 differ from x_init, h holds the step of each phase [s],
v the controls of the last knots. x'_0 is free in w, p and h, within bounds. Functions receive all
this by their `Knot`: x_init, parameters, dt and time, rate and jerk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.problem import rollout
from mjx_drax.problem.cost import as_partial, at_knot
from mjx_drax.problem.dynamics import Dynamics, Unlimited
from mjx_drax.problem.trajectory import Knot, Trajectory


class Seen(NamedTuple):
    """What `Extended.observe` gives: what the inner system gives, and the whole knot."""

    seen: Any
    knot: Knot


class Extras(NamedTuple):
    """The further states of x': w (n0,), p (np,), h (phases,) and v (order nu,)."""

    w: Any
    p: Any
    h: Any
    v: Any


def _of_inner(name: str) -> Any:
    """What the inner system has under this name: a number, or a method."""
    return property(attrgetter(f"inner.{name}"))


@register_dataclass
@dataclass(frozen=True)
class Extended(Dynamics):
    """A system with further states.

    Attributes:
        inner: the system that a user gave.
        nominal: w, p and h of x'_init, (n0 + np + phases,).
        u_init: control before the first knot, (nu,).
        starts_known: whether u_init counts, traced; else the first rate is 0.
        free: the tangent coordinates of x_0 that w moves.
        shapes: names and shapes of the parameters.
        phases: numbers of knots of the phases of free duration; () where dt is fixed.
        order: of the rates that knots know: 0 none, 1 rate, 2 jerk as well.
        knot: the one that `at` has bound this to.
    """

    inner: Dynamics
    nominal: Array
    u_init: Array
    starts_known: bool
    free: tuple[int, ...] = field(metadata=Static)
    shapes: tuple[tuple[str, tuple[int, ...]], ...] = field(metadata=Static)
    phases: tuple[int, ...] = field(metadata=Static)
    order: int = field(metadata=Static)
    knot: Knot | None = None

    given_nx, nu, dt, engine = map(_of_inner, ("nx", "nu", "dt", "engine"))
    kinked, constraint_rows = map(_of_inner, ("kinked", "constraint_rows"))
    twice, checked = map(_of_inner, ("twice", "checked"))
    state_damping, fingerprint = map(_of_inner, ("state_damping", "fingerprint"))
    differentiator = _of_inner("differentiator")
    step_differentiator = _of_inner("step_differentiator")

    @property
    def sizes(self) -> Extras:
        """How many numbers each kind of the further states has."""
        p = sum(int(np.prod(shape)) for _, shape in self.shapes)
        return Extras(len(self.free), p, len(self.phases), self.order * self.nu)

    @property
    def nx(self) -> int:  # type: ignore[override]
        """Numbers in x'."""
        return self.inner.nx + sum(self.sizes)

    @property
    def ndx(self) -> int:
        """Numbers in a difference of x'."""
        return self.inner.ndx + sum(self.sizes)

    def extras(self, x: Any) -> Extras:
        """The further states of x' (..., nx), or those of a tangent vector (..., ndx)."""
        ends = np.cumsum(self.sizes[:-1])
        own = x[..., x.shape[-1] - sum(self.sizes) :]
        return Extras(*(own[..., a:b] for a, b in zip([0, *ends], [*ends, None], strict=True)))

    def parameters(self, p: Any) -> dict[str, Any]:
        """The parameters by name, of p (..., np)."""
        return named(self.shapes, p)

    def at(self, knot: Knot) -> Self:
        """The same at one knot."""
        return replace(self, knot=knot)

    def useful_controls(self, x: Array) -> tuple[Array, Array] | None:
        """Those of the inner dynamics."""
        return self.inner.useful_controls(self.inner_state(x))

    def unlimited(self) -> Unlimited[Extended] | None:
        """With the inner system's, at the inner state."""
        own = self.inner.unlimited()
        if own is None:
            return None
        at_once, all_along = with_knot(own.at_once), with_knot(own.all_along)
        assert at_once is not None  # for the type checker
        assert all_along is not None
        return Unlimited(
            replace(self, inner=own.dynamics),
            useful=lambda x: own.useful(self.inner_state(x)),
            at_once=at_once,
            all_along=all_along,
            rows=own.rows,
            held=own.held,
        )

    def here(self, x: Array, u: Array) -> Knot:
        """The knot of (x', u), with all that functions may ask it for."""
        knot, own = self.knot, self.extras(x)
        assert knot is not None  # for the type checker: `at` comes first
        k, time, dt = knot.stage, knot.time, knot.dt
        if self.phases:
            count = np.array(self.phases)
            starts = np.cumsum(count) - count
            past = jnp.clip(k - starts, 0, count)
            time = knot.time - k * knot.dt + jnp.dot(own.h, past.astype(own.h.dtype))
            dt = own.h[jnp.maximum(jnp.sum(k >= starts) - 1, 0)]
        change = jnp.zeros(self.inner.ndx).at[np.array(self.free, int)].set(own.w)
        start = self.inner_state(knot.x_init)
        first = self.inner.integrate(start, change) if self.free else start
        here = replace(knot, time=time, dt=dt, x_init=first, parameters=self.parameters(own.p))
        if not self.order:
            return here
        before = own.v.reshape(self.order, self.nu)
        known = self.starts_known | (k > 0)
        rate = jnp.where(known, (u - before[0]) / dt, 0.0)
        if self.order == 1:
            return replace(here, rate=rate)
        known = self.starts_known | (k > 1)
        jerk = jnp.where(known, (rate - (before[0] - before[1]) / dt) / dt, 0.0)
        return replace(here, rate=rate, jerk=jerk)

    def inner_state(self, x: Any) -> Any:
        """x of x' (..., nx)."""
        return x[..., : self.inner.nx]

    def _joined(self, inner: Array, x: Array) -> Array:
        """x' with another x."""
        return jnp.concatenate([inner, x[..., x.shape[-1] - sum(self.sizes) :]], axis=-1)

    def step(self, x: Array, u: Array) -> Array:
        """f(x', u)."""
        own = self.extras(x)
        moved = self.inner.at(self.here(x, u)).step(self.inner_state(x), u)
        v = jnp.concatenate([u, own.v])[: len(own.v)]
        return jnp.concatenate([moved, own.w, own.p, own.h, v])

    def difference(self, x: Array, y: Array) -> Array:
        """x' - y' in the tangent space at y'."""
        off = self.inner.difference(self.inner_state(x), self.inner_state(y))
        return jnp.concatenate([off, x[self.inner.nx :] - y[self.inner.nx :]])

    def integrate(self, x: Array, dx: Array) -> Array:
        """x' + dx'."""
        moved = self.inner.integrate(self.inner_state(x), dx[: self.inner.ndx])
        return jnp.concatenate([moved, x[self.inner.nx :] + dx[self.inner.ndx :]])

    def valid(self, x: Array) -> Array:
        """The state next to numbers (..., nx)."""
        return self._joined(self.inner.valid(self.inner_state(x)), x)

    def tangent(self, numbers: Array) -> Array:
        """Of numbers for x' (..., nx), those for its tangent (..., ndx)."""
        return self._joined(self.inner.tangent(self.inner_state(numbers)), numbers)

    def consistent(self, knots: Trajectory) -> Trajectory:
        """The knots with further states that agree with `start` and with the controls."""
        K = knots.u.shape[-2]
        begins = self.nominal if knots.start is None else self.nominal + knots.start
        still = jnp.broadcast_to(begins[..., None, :], (*knots.u.shape[:-1], len(self.nominal)))
        before = jnp.broadcast_to(self.u_init, knots.u.shape)[..., :1, :]
        past = [knots.u, jnp.concatenate([before, knots.u], axis=-2)[..., :K, :]][: self.order]
        x = [self.inner_state(knots.x), still, *past]
        return replace(knots, x=jnp.concatenate(x, axis=-1))

    def observe(self, x: Array, u: Array) -> Seen:
        """What the inner system shows, and the knot."""
        here = self.here(x, u)
        return Seen(self.inner.at(here).observe(self.inner_state(x), u), here)

    def in_float64(self) -> Extended:
        """The same system, for float64."""
        return replace(self, inner=self.inner.in_float64())

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        knots: Knot,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run the plans in the inner system's engine, each with its own parameters and steps."""
        first = self.extras(plan[:, 0])
        stepper = self.inner.stepper(self.inner_state(plan[:, 0]))
        if stepper is None:
            return rollout.replay(self, plan, u, gains, limits, knots)
        parameters = self.parameters(first.p)
        steps = None
        if self.phases:
            phase = np.repeat(np.arange(len(self.phases)), self.phases)
            stages = np.broadcast_to(np.asarray(knots.stage, int), u.shape[:2])
            steps = np.take_along_axis(first.h, phase[stages], axis=1)

        def advance(k: int, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if steps is not None or k == 0:
                dt = np.full(len(u), float(self.dt)) if steps is None else steps[:, k]
                self.inner.configured(stepper, dt, parameters if k == 0 else None)
            moved, applied = stepper(u)
            own = self.extras(x)
            v = np.concatenate([u, own.v], axis=1)[:, : own.v.shape[1]]
            return np.concatenate([moved, own.w, own.p, own.h, v], axis=1), applied

        with stepper:
            return rollout.replay_by(advance, self.host_difference, plan, u, gains, limits)

    def host_difference(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """`difference` of states (..., nx) on the host, in float64."""
        n = self.inner.nx
        off = self.inner.host_difference(x[..., :n], y[..., :n])
        return np.concatenate([off, x[..., n:] - y[..., n:]], axis=-1)

    def host_integrate(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """`integrate` of states (..., nx) on the host, in float64."""
        moved = self.inner.host_integrate(x[..., : self.inner.nx], dx[..., : self.inner.ndx])
        return np.concatenate([moved, x[..., self.inner.nx :] + dx[..., self.inner.ndx :]], axis=-1)

    def inner_at(self, x: np.ndarray) -> Dynamics:
        """The inner system on the host, with the parameters of a state (nx,)."""
        return self.inner.of_parameters(self.parameters(np.asarray(self.extras(x).p, float)))

    def observe_replayed(self, x: np.ndarray, time: float) -> Any:
        """What goal functions receive: as from the inner system."""
        return self.observer()(x, time)

    def left_out(self, states: np.ndarray) -> tuple[int, str] | None:
        """As of the inner system."""
        return self.inner_at(states[0]).left_out(states[:, : self.inner.nx])

    def observer(self) -> Callable[[np.ndarray, float], Any]:
        """`observe_replayed` for many states, of the inner system with their parameters."""
        last: tuple[Any, Callable[[np.ndarray, float], Any]] = None, self.inner.observer()

        def observe(x: np.ndarray, time: float) -> Any:
            nonlocal last
            p = np.asarray(self.extras(x).p)
            if last[0] is None or not np.array_equal(p, last[0]):
                inner = self.inner_at(x)
                last = p, last[1] if inner is self.inner else inner.observer()
            return last[1](self.inner_state(x), time)

        return observe

    def times(self, states: np.ndarray, t_init: float) -> np.ndarray:
        """Times of x'_0..x'_K (K + 1, nx), (K + 1,) [s]."""
        if not self.phases:
            return super().times(states, t_init)
        steps = np.repeat(np.asarray(self.extras(states[0]).h, float), self.phases)
        return t_init + np.concatenate([[0.0], np.cumsum(steps)])


def named(shapes: tuple[tuple[str, tuple[int, ...]], ...], p: Any) -> dict[str, Any]:
    """Parameters by name, of their numbers p (..., np) one after the other."""
    found, start = {}, 0
    for name, shape in shapes:
        end = start + int(np.prod(shape))
        found[name] = p[..., start:end].reshape((*p.shape[:-1], *shape))
        start = end
    return found


def with_knot(function: Callable[..., Any] | None) -> Partial | None:
    """A user's function as one of `Seen`."""
    return None if function is None else Partial(_of_seen, as_partial(function))


def _of_seen(function: Partial, seen: Seen, u: Array | None = None) -> Any:
    if u is None:  # at the end, where there is no control
        return at_knot(function, replace(seen.knot, rate=None, jerk=None))(seen.seen)
    return at_knot(function, seen.knot)(seen.seen, u)
