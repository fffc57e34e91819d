"""Second-order information from first derivatives: a symmetric rank-one update for each stage.

Gauss-Newton's Hessian leaves out the curvature of dynamics and constraints, lambda'd2h, and that of
residuals. What is left out is a sum over stages, so a small matrix B_k at each stage can learn it.
After a step s = (dx_k, du_k), with the stage's Lagrangian l + lambda'f + nu'g at fixed multipliers,

    y = grad_k(z + s) - grad_k(z),    r = y - (H_k + B_k) s,    B_k <- B_k + r r' / (r's)

(the partitioned SR1 update; Griewank and Toint 1982, Bock and Plitt 1984). It needs no derivatives
beyond those that Gauss-Newton has anyway, so programs compile no longer for it. Far from an optimum
what stages have learned is wrong one step later, so it is used near one only. Where a chain stays
close to one for long and f is smooth, B_k is measured now and then (`curvature`), and learns on.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.model import Derivatives, Multipliers, QuadraticCost
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

SKIP = 1e-4
"""Smallest share of sum |r_i s_i| that r's must have: below it r r' / (r's) explodes."""

NOISE = 10.0
"""Changes of slopes below so many roundings of their terms teach nothing."""


@register_dataclass
@dataclass(frozen=True)
class Secant:
    """What stages have learned, and where their derivatives were taken last.

    Attributes:
        B: (K, n, n), n = ndx + nu.
        J: Jacobians of dynamics and constraints in (dx, du), (K, ndx + m, n).
        g: gradient of the running cost, (K, n).
        x, u: x_0..x_{K-1} and controls, (K, nx) and (K, nu).
        close: for how many iterations the chain has been close to an optimum.
    """

    B: Array
    J: Array
    g: Array
    x: Array
    u: Array
    close: Array

    @classmethod
    def none(cls, problem: Problem) -> Secant:
        """Nothing learned yet."""
        K, dynamics = problem.horizon, problem.dynamics
        n, rows = dynamics.ndx + dynamics.nu, dynamics.ndx + problem.constraint.rows
        shapes = (K, n, n), (K, rows, n), (K, n), (K, dynamics.nx), (K, dynamics.nu)
        B, J, g, x, u = map(jnp.zeros, shapes)
        return cls(B, J, g, x, u, close=jnp.zeros((), int))

    def updated(
        self,
        problem: Problem,
        knots: Trajectory,
        derivatives: Derivatives,
        multipliers: Multipliers,
        learns: Array,
    ) -> Secant:
        """What is known at new knots; B stays where not `learns`."""
        dynamics, cost, stage, _ = derivatives
        J = jnp.concatenate([jnp.concatenate([dynamics.A, dynamics.B], axis=2), stage], axis=1)
        g = jnp.concatenate([cost.gx[:-1], cost.gu], axis=1)
        x = problem.with_start(knots)[:-1]
        s = jnp.concatenate(
            [jax.vmap(problem.dynamics.difference)(x, self.x), knots.u - self.u], axis=1
        )
        forces = jnp.concatenate([multipliers.dynamics, multipliers.constraints.stage], axis=1)
        y = g - self.g + jnp.einsum("kij,ki->kj", J - self.J, forces)
        terms = jnp.abs(g) + jnp.einsum("kij,ki->kj", jnp.abs(J), jnp.abs(forces))
        noise = NOISE * jnp.finfo(g.dtype).eps * terms
        learned = jax.vmap(_rank_one)(self.B, blocks(cost) + self.B, s, y, noise)
        B = jnp.where(learns, learned, self.B)
        return Secant(B, J, g, x, knots.u, self.close)


def with_curvature(cost: QuadraticCost, B: Array) -> QuadraticCost:
    """The cost's model with curvature B (K, n, n) added at its stages."""
    ndx = cost.gx.shape[-1]
    return QuadraticCost(
        cost.gx,
        cost.gu,
        cost.Hxx.at[:-1].add(B[:, :ndx, :ndx]),
        cost.Hux + B[:, ndx:, :ndx],
        cost.Huu + B[:, ndx:, ndx:],
    )


def _rank_one(B: Array, H: Array, s: Array, y: Array, noise: Array) -> Array:
    """B + r r' / (r's) with r = y - H s; B where that would explode, or where r is noise."""
    r = y - H @ s
    slope = r @ s
    takes = (jnp.abs(slope) > SKIP * (jnp.abs(r) @ jnp.abs(s))) & (jnp.abs(r) > noise).any()
    return B + jnp.where(takes, 1.0, 0.0) * jnp.outer(r, r) / jnp.where(takes, slope, 1.0)


def blocks(cost: QuadraticCost) -> Array:
    """The Hessians of the running cost in (dx, du), (K, n, n)."""
    upper = jnp.concatenate([cost.Hxx[:-1], jnp.swapaxes(cost.Hux, 1, 2)], axis=2)
    return jnp.concatenate([upper, jnp.concatenate([cost.Hux, cost.Huu], axis=2)], axis=1)
