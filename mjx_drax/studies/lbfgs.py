"""Quasi-Newton baselines: L-BFGS and BFGS on the augmented Lagrangian.

The metric M^{-1} is an approximation of the inverse Hessian of L_mu, built from steps s and
gradient changes y: from the last ones (two-loop recursion; Nocedal and Wright, Numerical
Optimization, algorithm 7.4), or in a full matrix (equation 6.17 there). Both are meant for
noise-free use with the line search of the tail,

    Langevin(iterations=0, tail=1000, preconditioner=LBFGS())

which is the classical method of multipliers: `inner` steps at fixed lambda, then
lambda <- lambda + mu h. With noise, the noise is white (M = I).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.method.metrics import Direction, Metric
from mjx_drax.method.model import Model
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory


@register_dataclass
@dataclass(frozen=True)
class Memory:
    """Pairs s, y (pairs, n), the newest last; 1 / s'y (pairs,), 0 where there is none yet.

    `point` and `gradient` (n,) are those of the last step, `count` the steps since lambda changed.
    n counts tangent numbers; `point` is a trajectory.
    """

    s: Array
    y: Array
    curvature: Array
    point: Trajectory
    gradient: Array
    count: Array


@register_dataclass
@dataclass(frozen=True)
class LBFGS(Metric):
    """Drift -M^{-1} grad L_mu with a limited-memory BFGS M.

    Attributes:
        pairs: how many (s, y) are kept.
        inner: steps between two updates of the multipliers.
    """

    full_multiplier_steps: ClassVar = True  # the line search's step size is for the knots only

    pairs: int = field(default=10, metadata=Static)
    inner: int = field(default=20, metadata=Static)

    def memory(self, problem: Problem, trajectory: Trajectory) -> Memory:
        """No pairs yet."""
        zero = ravel_pytree(problem.no_change(trajectory))[0]
        pairs, none = jnp.zeros((self.pairs, zero.shape[0])), jnp.zeros(self.pairs)
        return Memory(pairs, pairs, none, trajectory, zero, jnp.zeros((), jnp.int32))

    def direction(
        self, problem: Problem, model: Model, key: Array | None, memory: Any
    ) -> Direction:
        """The quasi-Newton step; multipliers move in every `inner`-th step only."""
        steepest = super().direction(problem, model, key, memory)
        gradient, back = ravel_pytree(model.gradient)
        memory = self._remember(problem, memory, model.trajectory, gradient)
        drift = back(-self.inverse_times(memory, gradient))
        update = memory.count == self.inner
        rate = jax.tree.map(lambda r: jnp.where(update, 0.5 * r, 0.0), steepest.multipliers)
        memory = replace(
            memory,
            point=model.trajectory,
            gradient=gradient,
            count=jnp.where(update, 0, memory.count),
        )
        return replace(steepest, drift=drift, multipliers=rate, memory=memory)

    def _remember(
        self, problem: Problem, memory: Any, trajectory: Trajectory, gradient: Array
    ) -> Any:
        """The memory with the last step's pair, if lambda stood still and s'y is positive."""
        change = jax.tree.map(jnp.subtract, trajectory, memory.point)
        x = jax.vmap(problem.dynamics.difference)(trajectory.x, memory.point.x)
        s, y = ravel_pytree(replace(change, x=x))[0], gradient - memory.gradient
        product = jnp.dot(s, y)
        good = (memory.count > 0) & (product > 1e-6 * jnp.dot(s, s))
        memory = replace(memory, count=memory.count + 1)
        return self.with_pair(memory, s, y, jnp.where(good, product, 1.0), good)

    def with_pair(self, memory: Any, s: Array, y: Array, product: Array, good: Array) -> Any:
        """The memory with a pair of which s'y is `product`, if it is good."""

        def push(rows: Array, new: Array) -> Array:
            return jnp.where(good, jnp.concatenate([rows[1:], new[None]]), rows)

        return replace(
            memory,
            s=push(memory.s, s),
            y=push(memory.y, y),
            curvature=push(memory.curvature, 1.0 / product),
        )

    def inverse_times(self, memory: Any, gradient: Array) -> Array:
        """M^{-1} times the gradient (n,); without pairs a steepest-descent step of unit length."""
        pairs = memory.curvature.shape[0]
        q, weights = gradient, [jnp.zeros(())] * pairs
        for i in reversed(range(pairs)):
            weights[i] = memory.curvature[i] * jnp.dot(memory.s[i], q)
            q = q - weights[i] * memory.y[i]
        newest = memory.curvature[-1] * jnp.dot(memory.y[-1], memory.y[-1])
        length = jnp.linalg.norm(gradient)
        scale = jnp.where(newest > 0.0, newest, jnp.maximum(length, 1e-12))
        q = q / scale
        for i in range(pairs):
            beta = memory.curvature[i] * jnp.dot(memory.y[i], q)
            q = q + memory.s[i] * (weights[i] - beta)
        return q


@register_dataclass
@dataclass(frozen=True)
class Matrix:
    """M^{-1} (n, n), and its scale s'y / y'y, 0 before the first pair; the rest as in `Memory`."""

    inverse: Array
    scale: Array
    point: Trajectory
    gradient: Array
    count: Array


@register_dataclass
@dataclass(frozen=True)
class BFGS(LBFGS):
    """Drift -M^{-1} grad L_mu with the full matrix M^{-1} of BFGS; `pairs` has no meaning here.

    M^{-1} <- (I - s y'/s'y) M^{-1} (I - y s'/s'y) + s s'/s'y. A chain takes n² numbers.

    Rounding can cost M its positive definiteness: after a step that was no descent M begins anew
    from the identity, of the last pair's scale. The line search takes its smallest step even
    uphill, so steps are no longer than `longest`: from far away multipliers do not come back.

    Attributes:
        longest: the largest norm of a step.
    """

    longest: float = 10.0

    def memory(self, problem: Problem, trajectory: Trajectory) -> Any:
        """The identity."""
        zero = ravel_pytree(problem.no_change(trajectory))[0]
        none = jnp.zeros((), jnp.int32)
        return Matrix(jnp.eye(zero.shape[0]), jnp.zeros(()), trajectory, zero, none)

    def with_pair(self, memory: Any, s: Array, y: Array, product: Array, good: Array) -> Any:
        """The memory with a pair of which s'y is `product`, if it is good; or a new beginning."""
        scale = jnp.where(good, product / jnp.maximum(jnp.dot(y, y), 1e-30), memory.scale)
        anew = (memory.scale == 0.0) | (jnp.dot(s, memory.gradient) > 0.0)
        inverse = jnp.where(anew, scale * jnp.eye(s.shape[0]), memory.inverse)
        moved = inverse @ y
        factor = (1.0 + jnp.dot(y, moved) / product) / product
        cross = jnp.outer(moved, s) / product
        new = inverse + factor * jnp.outer(s, s) - cross - cross.T
        return replace(memory, inverse=jnp.where(good, new, inverse), scale=scale)

    def inverse_times(self, memory: Any, gradient: Array) -> Array:
        """M^{-1} times the gradient, cut to `longest`; before the first pair of unit length."""
        began = memory.scale > 0.0
        step = jnp.where(began, memory.inverse @ gradient, gradient)
        length = jnp.linalg.norm(step)
        most = jnp.where(began, jnp.minimum(length, self.longest), 1.0)
        return step * most / jnp.maximum(length, 1e-12)
