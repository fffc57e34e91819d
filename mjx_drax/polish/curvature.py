"""The exact Hessian of the Lagrangian, stage by stage, where f is cheap to differentiate twice.

    H_k = d2/dz2 [ l + lambda'h_k + nu'g ]    at z = (dx_k, du_k)
    H_K = d2/dx2 [ phi + nu'g ]               at the end

in tangent space, at fixed multipliers. It may be indefinite.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.method.model import Multipliers, QuadraticCost
from mjx_drax.problem.differentiators import Differentiator
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Knot, Trajectory


def with_exact_hessian(
    problem: Problem,
    knots: Trajectory,
    multipliers: Multipliers,
    cost: QuadraticCost,
    by: Differentiator,
) -> QuadraticCost:
    """The cost's model with the Lagrangian's Hessian in place of its own."""
    dynamics, rows = problem.dynamics, multipliers.constraints
    ndx, nu = dynamics.ndx, dynamics.nu
    by = dynamics.step_differentiator(by)

    def stage(x: Array, u: Array, knot: Knot, x_next: Array, lambda_: Array, force: Array) -> Array:
        here = problem.at(knot)

        def lagrangian(dz: Array) -> Array:
            moved = dynamics.integrate(x, dz[:ndx]), u + dz[ndx:]
            seen = here.seen(*moved)
            defect = dynamics.difference(here.dynamics.step(*moved), x_next)
            constrained = jnp.dot(force, here.constraint(*seen))
            return here.running(*seen) + jnp.dot(lambda_, defect) + constrained

        return by.hessian(lagrangian, ndx + nu)

    last = problem.end

    def end(dx: Array) -> Array:
        seen = last.seen(dynamics.integrate(knots.x[-1], dx))
        return last.terminal(*seen) + jnp.dot(rows.terminal, last.terminal_constraint(*seen))

    H = jax.vmap(stage)(*problem.stages(knots), knots.x, multipliers.dynamics, rows.stage)
    H_end = by.hessian(end, ndx) if ndx else jnp.zeros((0, 0))
    return QuadraticCost(
        cost.gx,
        cost.gu,
        jnp.concatenate([H[:, :ndx, :ndx], H_end[None]]),
        H[:, ndx:, :ndx],
        H[:, ndx:, ndx:],
    )
