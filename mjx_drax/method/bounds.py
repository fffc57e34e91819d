"""Ways to keep every iterate inside its bounds: a base class, and three that are interchangeable.

A handling of your own inherits `Bounds` and has one method, `confine`; `interior` and `barred` have
defaults.

`LogBarrier` adds rho b(z) to the cost, with a weight rho that decays over the solve and

    b(z) = - sum_i [ log(z_i - lower_i) + log(upper_i - z_i) ].

In the noise-free tail the barrier's curvature is that of a primal-dual interior point method: with
a multiplier v for each bound, v / slack instead of rho / slack^2. On the central path v = rho /
slack and the two agree; away from it the first is right about a bound that has just become active,
and Newton's steps stay good while rho falls (S. Wright, Primal-Dual Interior-Point Methods, 1997).

Two measures keep it finite under noise in float32: derivatives see a slack no smaller than a floor
(so that 1/slack^2 cannot overflow), and a step may use up at most a fixed fraction of each
element's own slack, so no element ever leaves its bounds. `Reflection` folds a step that would
leave the box back into it, which keeps the law of free diffusion uniform; `Projection` clips it to
the box. These two add nothing to the cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.problem.trajectory import Box, Trajectory

FOLLOW = 100.0
"""Largest factor between a bound's multiplier and rho / slack."""

Sides = tuple[Trajectory, Trajectory]
"""Numbers of the lower and of the upper ends, shaped like the knots."""


class Bounds:
    """Keeps knots inside a box, and bars the way to those ends of it that have a barrier.

    Without `barred` of its own, a class has no barrier on states and controls. Slack variables
    always have theirs, which is what makes an inequality act before it is violated.
    """

    floor: ArrayLike = 1e-6

    def confine(self, box: Box, old: Trajectory, new: Trajectory) -> Trajectory:
        """`new`, brought into the box; `old` is inside. By default the nearest point of the box."""
        return _inside(box, slacks_confined(box, old, new), 0.0)

    def interior(self, box: Box, trajectory: Trajectory) -> Trajectory:
        """The knots that a chain starts from, brought into the box."""
        return _inside(box, trajectory, 0.0)

    def barred(self, box: Box) -> Box:
        """The box with those ends that have a barrier, the others infinite."""
        ends = (
            (box.x_lower, -jnp.inf),
            (box.x_upper, jnp.inf),
            (box.u_lower, -jnp.inf),
            (box.u_upper, jnp.inf),
        )
        free: Any = (jnp.full_like(end, value) for end, value in ends)
        return Box(*free)

    def value(self, box: Box, trajectory: Trajectory) -> Array:
        """b(z) as one term per knot (u_k, x_{k+1}), (K,)."""

        def log_slacks(z: Array, lower: Array, upper: Array) -> Array:
            below, above = self._slack(z - lower), self._slack(upper - z)
            return jnp.sum(jnp.log(below) + jnp.log(above), axis=-1)

        logs = jax.tree.map(log_slacks, trajectory, *self.barred(box).sides(trajectory))
        knots = logs.x + logs.u
        if logs.start is not None:
            knots = knots.at[0].add(logs.start)
        if logs.slack is not None:
            knots = (knots + logs.slack.stage).at[-1].add(logs.slack.terminal)
        return -knots

    def derivatives(
        self, box: Box, trajectory: Trajectory, weight: ArrayLike, multipliers: Sides | None = None
    ) -> tuple[Trajectory, Trajectory]:
        """Gradient of rho b, and its curvature as a diagonal, each shaped like the trajectory.

        With multipliers v the curvature is v / slack; without, v = rho / slack, it is b's own.
        """
        lower, upper = self.barred(box).sides(trajectory)
        central = self.multipliers(box, trajectory, weight)
        below, above = multipliers or central

        def curvature(z: Array, a: Array, b: Array, v_a: Array, v_b: Array) -> Array:
            return v_a * _inverse(self._slack(z - a), a) + v_b * _inverse(self._slack(b - z), b)

        return (
            jax.tree.map(lambda v_a, v_b: v_b - v_a, *central),
            jax.tree.map(curvature, trajectory, lower, upper, below, above),
        )

    def multipliers(self, box: Box, trajectory: Trajectory, weight: ArrayLike) -> Sides:
        """Multipliers of the lower and the upper ends on the central path, v = rho / slack."""
        lower, upper = self.barred(box).sides(trajectory)
        return (
            jax.tree.map(lambda z, a: weight * _inverse(self._slack(z - a), a), trajectory, lower),
            jax.tree.map(lambda z, b: weight * _inverse(self._slack(b - z), b), trajectory, upper),
        )

    def follow(
        self,
        box: Box,
        old: Trajectory,
        new: Trajectory,
        multipliers: Sides,
        weight: ArrayLike,
        size: ArrayLike,
    ) -> Sides:
        """Multipliers after a step from `old` to `new` of relative size alpha.

        Newton's step for v slack = rho is dv = rho / slack - v - v / slack dslack. v is then held
        within a factor of `FOLLOW` of the central path, so that neither it nor the curvature can
        run away from what the slacks say.
        """

        def side(z: Array, z_new: Array, end: Array, v: Array, sign: float) -> Array:
            slack, after = (self._slack(sign * (a - end)) for a in (z, z_new))
            step = size * (weight / slack - v) - v / slack * sign * (z_new - z)
            central = weight / after
            held = jnp.clip(v + step, central / FOLLOW, central * FOLLOW)
            return jnp.where(jnp.isinf(end), 0.0, held)

        lower, upper = self.barred(box).sides(old)
        return (
            jax.tree.map(partial(side, sign=1.0), old, new, lower, multipliers[0]),
            jax.tree.map(partial(side, sign=-1.0), old, new, upper, multipliers[1]),
        )

    def _slack(self, slack: Array) -> Array:
        """The slack that is differentiated: floored, and 1 (log 1 = 0) where there is no bound."""
        return jnp.where(jnp.isinf(slack), 1.0, jnp.maximum(slack, self.floor))


@register_dataclass
@dataclass(frozen=True)
class LogBarrier(Bounds):
    """The barrier b(z), and a fraction-to-the-boundary rule for steps.

    Attributes:
        floor: smallest slack that derivatives see, in the variable's units.
        fraction: share of an element's slack that one step may use (fraction to the boundary).
    """

    floor: ArrayLike = 1e-6
    fraction: ArrayLike = 0.9

    def confine(self, box: Box, old: Trajectory, new: Trajectory) -> Trajectory:
        """`new`, each element held back so as to keep 1 - fraction of the slack it had in `old`."""
        lower, upper = box.with_room().sides(old)

        def hold(z_old: Array, z_new: Array, a: Array, b: Array) -> Array:
            return jnp.clip(
                z_new, z_old - self.fraction * (z_old - a), z_old + self.fraction * (b - z_old)
            )

        return jax.tree.map(hold, old, new, lower, upper)

    def interior(self, box: Box, trajectory: Trajectory) -> Trajectory:
        """The nearest trajectory at least 1 % of the box's width away from its ends."""
        return _inside(box.with_room(), trajectory, 1e-2)

    def barred(self, box: Box) -> Box:
        """All of it."""
        return box.with_room()


@register_dataclass
@dataclass(frozen=True)
class Projection(Bounds):
    """A step that leaves the box ends at the nearest point of it.

    Meant for `Identity` and `Diagonal`: a Newton step that is clipped afterwards need not descend,
    so with `GaussNewton` and active bounds the log barrier finds better answers.
    """


@register_dataclass
@dataclass(frozen=True)
class Reflection(Bounds):
    """A step that leaves the box is reflected at its walls, as often as it takes."""

    def confine(self, box: Box, old: Trajectory, new: Trajectory) -> Trajectory:
        """`new`, folded back into the box."""

        def fold(z: Array, a: Array, b: Array) -> Array:
            width = jnp.where(jnp.isfinite(b - a) & (b > a), b - a, 1.0)
            turned = jnp.mod(z - a, 2.0 * width)
            both = a + jnp.where(turned > width, 2.0 * width - turned, turned)
            one = jnp.where(jnp.isfinite(a), a + jnp.abs(z - a), b - jnp.abs(b - z))
            free = jnp.isinf(a) & jnp.isinf(b)
            folded = jnp.where(jnp.isfinite(b - a), both, jnp.where(free, z, one))
            return jnp.clip(folded, a, b)  # rounding only

        held = slacks_confined(box, old, new)
        return jax.tree.map(fold, held, *box.sides(new))


def slacks_confined(box: Box, old: Trajectory, new: Trajectory) -> Trajectory:
    """`new`, its slack variables held by the barrier's rule."""
    return replace(new, slack=LogBarrier().confine(box, old, new).slack)


def _inverse(slack: Array, end: Array) -> Array:
    """1 / slack where the bound is finite, else 0."""
    return jnp.where(jnp.isinf(end), 0.0, 1.0 / slack)


def _inside(box: Box, trajectory: Trajectory, margin: float) -> Trajectory:
    """The nearest trajectory that keeps `margin` of the box's width away from its ends."""
    lower, upper = box.sides(trajectory)

    def inside(z: Array, a: Array, b: Array) -> Array:
        gap = margin * jnp.where(jnp.isfinite(b - a), b - a, 1.0)
        return jnp.clip(z, a + gap, b - gap)

    return jax.tree.map(inside, trajectory, lower, upper)
