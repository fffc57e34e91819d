"""The direction in which a chain moves, under a metric M.

    d = -M^{-1} grad L_mu          drift
    n ~ N(0, M^{-1})               noise
    r = 2 mu h                     rate of the multipliers

A metric of your own inherits `Metric` and has three methods: `at` makes M of the model at an
iterate, `solve` gives M^{-1} g, and `sample` draws n. M is held fixed within a step; the divergence
of a state-dependent metric is dropped. A factorization that gives more (a predicted residual for
the multipliers, feedback gains) replaces `direction`, as `GaussNewton` does.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.model import Model, Multipliers
from mjx_drax.problem.differentiators import Autodiff, Differentiator
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory


@register_dataclass
@dataclass(frozen=True)
class Direction:
    """One step's ingredients, in tangent space.

    Attributes:
        drift: d.
        noise: n, for sigma = 1; None if no noise is asked for.
        multipliers: their rate r, without that of the bounds.
        gains: feedback that comes with the metric, (K, nu, ndx); zeros if none does.
        memory: what the metric wants to see again in the next iteration.
    """

    drift: Trajectory
    noise: Trajectory | None
    multipliers: Multipliers
    gains: Array
    memory: Any = ()


class Metric:
    """M = I, with the gradient by reverse mode; what a metric does not say it takes from here.

    Attributes:
        derivatives: how functions are differentiated; None: the gradient in reverse mode, and
            nothing else is known of the model.
        ladder: step sizes that the tail chooses from, all halvings down to 1/256; the last one is
            0, which stands still.
        has_gains: whether its directions bring feedback gains.
        full_multiplier_steps: whether multipliers take their whole step, whatever size the line
            search chooses for the knots.
        scaled_by_box: whether the default solver takes its direction in coordinates without units
            (`search.scaled`); it then needs `derivatives`.
        polished: whether the default solver polishes what this metric has found, if `derivatives`
            are exact.
    """

    derivatives: Any = None
    ladder: ClassVar[tuple[float, ...]] = (*(0.5**i for i in range(9)), 0.0)
    has_gains: ClassVar[bool] = False
    full_multiplier_steps: ClassVar[bool] = False
    scaled_by_box: ClassVar[bool] = False
    polished: ClassVar[bool] = False

    def at(self, model: Model) -> Any:
        """M at an iterate, in any form that `solve` and `sample` take."""
        return None

    def solve(self, M: Any, gradient: Trajectory) -> Trajectory:
        """M^{-1} g for g in the shape of the knots."""
        return gradient

    def sample(self, M: Any, like: Trajectory, key: Array) -> Trajectory:
        """n ~ N(0, M^{-1}), in the shape of `like`."""
        return white(like, key)

    def memory(self, problem: Problem, trajectory: Trajectory) -> Any:
        """What a chain carries for the metric from the start."""
        return ()

    def direction(
        self, problem: Problem, model: Model, key: Array | None, memory: Any
    ) -> Direction:
        """Drift, multiplier rate, and noise if there is a key to draw it with."""
        M = self.at(model)
        drift = jax.tree.map(jnp.negative, self.solve(M, model.gradient))
        noise = None if key is None else self.sample(M, drift, jax.random.split(key)[1])
        rate = jax.tree.map(lambda h: 2.0 * model.weights.penalty * h, model.h)
        K, nu, ndx = problem.horizon, problem.dynamics.nu, problem.dynamics.ndx
        return Direction(drift, noise, rate, jnp.zeros((K, nu, ndx)), memory)


def white(like: Trajectory, key: Array) -> Trajectory:
    """Standard normal numbers in the shape of a trajectory."""
    leaves, tree = jax.tree.flatten(like)
    keys = jax.random.split(key, len(leaves))
    noise = [jax.random.normal(k, z.shape, z.dtype) for k, z in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(tree, noise)


@register_dataclass
@dataclass(frozen=True)
class Identity(Metric):
    """M = I: the flow of the paper as printed, with alpha = dt / 2.

    X <- X - alpha grad L_mu + sigma sqrt(2 alpha) xi,  lambda <- lambda + 2 alpha mu h.

    The gradient is exact, from one reverse-mode derivative of L_mu in displacements of the knots.
    With sampled derivatives (`derivatives=Smoothed(...)`) it is assembled knot by knot from J and
    the cost's gradient.
    """

    derivatives: Differentiator | None = None


@register_dataclass
@dataclass(frozen=True)
class Diagonal(Metric):
    """M = diag(H + mu J'J) + rho b'' + delta: each variable scaled by its own curvature."""

    derivatives: Differentiator = field(default_factory=Autodiff)

    def at(self, model: Model) -> Trajectory:
        """The diagonal, in the shape of the knots."""
        return jax.tree.map(
            lambda m, c: m + c + model.weights.damping, _diagonal(model), model.barrier[1]
        )

    def solve(self, M: Trajectory, gradient: Trajectory) -> Trajectory:
        """g / M."""
        return jax.tree.map(lambda g, m: g / m, gradient, M)

    def sample(self, M: Trajectory, like: Trajectory, key: Array) -> Trajectory:
        """xi / sqrt(M)."""
        return jax.tree.map(lambda xi, m: xi / jnp.sqrt(m), white(like, key), M)


def _diagonal(model: Model) -> Trajectory:
    """The diagonal of H + mu J'J, in the shape of a trajectory."""
    assert model.derivatives is not None  # for the type checker
    dynamics, cost, stage, terminal = model.derivatives
    penalty, ndx = model.weights.penalty, dynamics.h.shape[-1]
    squares = jnp.sum(jnp.square(stage), axis=1)
    x = jnp.einsum("kii->ki", cost.Hxx)
    x = x.at[1:].add(penalty)  # dh_k / dx_{k+1} = -I
    x = x.at[:-1].add(penalty * (jnp.sum(jnp.square(dynamics.A), axis=1) + squares[:, :ndx]))
    x = x.at[-1].add(penalty * jnp.sum(jnp.square(terminal), axis=0))
    u = jnp.einsum("kii->ki", cost.Huu)
    u = u + penalty * (jnp.sum(jnp.square(dynamics.B), axis=1) + squares[:, ndx:])
    slack = jax.tree.map(lambda s: jnp.full_like(s, penalty), model.gradient.slack)
    start = None if model.start is None else x[0] @ jnp.square(model.start)
    return Trajectory(x[1:], u, slack, start)
