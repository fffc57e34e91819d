"""Second-order information from first derivatives: a symmetric matrix that each stage learns.

Gauss-Newton's Hessian leaves out the curvature of dynamics and constraints, lambda'd2h, and that of
residuals. What is left out is a sum over stages, so a small matrix B_k at each stage can learn it.
After a step s = (dx_k, du_k), with the stage's Lagrangian l + lambda'f + nu'g at fixed multipliers,

    y = grad_k(z + s) - grad_k(z),    r = y - (H_k + B_k) s,    B_k <- B_k + r r' / (r's)

(the partitioned SR1 update; Griewank and Toint 1982, Bock and Plitt 1984); where that explodes, B_k
changes as little as it can (`symmetric_update`). It needs no derivatives beyond Gauss-Newton's, so
programs compile no longer for it. Far from an optimum what stages have learned is wrong one step
later, so it is used near one only. Where a chain takes long and f is smooth, B_k is measured now
and then (`curvature`), is used wherever the chain is, and learns on.
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

ALIGNED = 0.01
"""Smallest cosine of r and s for a rank-one update, whose size is |r| / |s| over this cosine. What
stages know is otherwise lost by one step: an exact B then differs by third derivatives alone, and r
may point anywhere."""

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
        age: for how many iterations it has been learned.
    """

    B: Array
    J: Array
    g: Array
    x: Array
    u: Array
    age: Array

    @classmethod
    def none(cls, problem: Problem) -> Secant:
        """Nothing learned yet."""
        K, dynamics = problem.horizon, problem.dynamics
        n, rows = dynamics.ndx + dynamics.nu, dynamics.ndx + problem.constraint.rows
        shapes = (K, n, n), (K, rows, n), (K, n), (K, dynamics.nx), (K, dynamics.nu)
        B, J, g, x, u = map(jnp.zeros, shapes)
        return cls(B, J, g, x, u, age=jnp.zeros((), int))

    def updated(
        self,
        problem: Problem,
        knots: Trajectory,
        derivatives: Derivatives,
        multipliers: Multipliers,
        moves: Array,
        learns: Array,
    ) -> Secant:
        """What is known at new knots; B stays where not `learns`.

        `moves` (n,) is how far coordinates move; see `symmetric_update`.
        """
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
        r = y - jnp.einsum("kij,kj->ki", blocks(cost) + self.B, s)
        r = jnp.where((jnp.abs(r) > noise).any(axis=1, keepdims=True), r, 0.0)
        learned = self.B + jax.vmap(symmetric_update, (0, 0, None))(r, s, moves)
        B = jnp.where(learns, learned, self.B)
        return Secant(B, J, g, x, knots.u, self.age)


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


def symmetric_update(r: Array, s: Array, moves: Array) -> Array:
    """A symmetric matrix D (n, n) with D s = r, for r and s (n,).

        r r' / (r's)                                    where r and s are not nearly orthogonal
        (r s' + s r') / (s's) - (r's) s s' / (s's)^2    else: the smallest one (Powell 1970)

    What is orthogonal or small depends on units, so coordinates are measured by how far they move,
    `moves` (n,): above, r stands for r moves, s for s / moves, and D for D moves moves'.
    """
    r, s = r * moves, s / moves
    slope, length = r @ s, s @ s
    aligned = jnp.abs(slope) > ALIGNED * jnp.sqrt((r @ r) * length)
    of_rank_one = jnp.outer(r, r) / jnp.where(aligned, slope, 1.0)
    length = jnp.where(length > 0.0, length, 1.0)
    cross = jnp.outer(r, s) / length
    least = cross + cross.T - (slope / length) * (jnp.outer(s, s) / length)
    return jnp.where(aligned, of_rank_one, least) / jnp.outer(moves, moves)


def blocks(cost: QuadraticCost) -> Array:
    """The Hessians of the running cost in (dx, du), (K, n, n)."""
    upper = jnp.concatenate([cost.Hxx[:-1], jnp.swapaxes(cost.Hux, 1, 2)], axis=2)
    return jnp.concatenate([upper, jnp.concatenate([cost.Hux, cost.Huu], axis=2)], axis=1)
