"""Bounds by a logarithmic barrier.

    b(z) = - sum_i [ log(z_i - lower_i) + log(upper_i - z_i) ]

added to the cost with a weight rho that decays over the solve. Two measures keep it finite under
noise in float32: derivatives see a slack no smaller than a floor (so that 1/slack^2 cannot
overflow), and a step may use up at most a fixed fraction of each element's own slack, so no
element ever leaves its bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import register_dataclass
from jax.typing import ArrayLike

from mjx_drax.problem import Box, Trajectory


@register_dataclass
@dataclass(frozen=True)
class LogBarrier:
    """The barrier b(z) and the rule that keeps iterates strictly inside the box.

    Attributes:
        floor: smallest slack that derivatives see, in the variable's units.
        fraction: share of an element's slack that one step may use (fraction to the boundary).
    """

    floor: ArrayLike = 1e-6
    fraction: ArrayLike = 0.9

    def value(self, box: Box, trajectory: Trajectory) -> Array:
        """b(z) as one term per knot (u_k, x_{k+1}), (K,)."""

        def log_slacks(z: Array, lower: Array, upper: Array) -> Array:
            below, above = self._slack(z - lower), self._slack(upper - z)
            return jnp.sum(jnp.log(below) + jnp.log(above), axis=-1)

        logs = jax.tree.map(log_slacks, trajectory, *box.sides(trajectory))
        return -(logs.x + logs.u)

    def derivatives(self, box: Box, trajectory: Trajectory) -> tuple[Trajectory, Trajectory]:
        """Gradient and diagonal of the Hessian of b, each shaped like the trajectory."""
        lower, upper = box.sides(trajectory)

        def gradient(z: Array, a: Array, b: Array) -> Array:
            return _inverse(self._slack(b - z), b) - _inverse(self._slack(z - a), a)

        def curvature(z: Array, a: Array, b: Array) -> Array:
            return _inverse(self._slack(b - z), b) ** 2 + _inverse(self._slack(z - a), a) ** 2

        return (
            jax.tree.map(gradient, trajectory, lower, upper),
            jax.tree.map(curvature, trajectory, lower, upper),
        )

    def confine(self, box: Box, old: Trajectory, new: Trajectory) -> Trajectory:
        """`new`, each element held back so as to keep 1 - fraction of the slack it had in `old`."""
        lower, upper = box.sides(old)

        def hold(z_old: Array, z_new: Array, a: Array, b: Array) -> Array:
            return jnp.clip(
                z_new, z_old - self.fraction * (z_old - a), z_old + self.fraction * (b - z_old)
            )

        return jax.tree.map(hold, old, new, lower, upper)

    def interior(self, box: Box, trajectory: Trajectory, margin: float = 1e-2) -> Trajectory:
        """The nearest trajectory at least `margin` of the box's width away from its ends."""
        lower, upper = box.sides(trajectory)

        def inside(z: Array, a: Array, b: Array) -> Array:
            gap = margin * jnp.where(jnp.isfinite(b - a), b - a, 1.0)
            return jnp.clip(z, a + gap, b - gap)

        return jax.tree.map(inside, trajectory, lower, upper)

    def _slack(self, slack: Array) -> Array:
        """The slack that is differentiated: floored, and 1 (log 1 = 0) where there is no bound."""
        return jnp.where(jnp.isinf(slack), 1.0, jnp.maximum(slack, self.floor))


def _inverse(slack: Array, end: Array) -> Array:
    """1 / slack where the bound is finite, else 0."""
    return jnp.where(jnp.isinf(end), 0.0, 1.0 / slack)
