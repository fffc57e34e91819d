"""The Hessian of the Lagrangian, stage by stage: exact, or measured by differences.

    H_k = d2/dz2 [ l + lambda'h_k + nu'g ]    at z = (dx_k, du_k)
    H_K = d2/dx2 [ phi + nu'g ]               at the end

in tangent space, at fixed multipliers. It may be indefinite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.method.model import Multipliers, QuadraticCost
from mjx_drax.problem.differentiators import Differentiator, Function, second_differences
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
    ndx = dynamics.ndx
    by = dynamics.step_differentiator(by)
    H = _of_stages(problem, knots, multipliers, by.hessian)
    last = problem.end
    force = last.terminal_constraint.in_units(rows.terminal)

    def end(dx: Array) -> Array:
        seen = last.seen(dynamics.integrate(knots.x[-1], dx))
        return last.terminal(*seen) + jnp.dot(force, last.terminal_constraint(*seen))

    H_end = by.hessian(end, ndx) if ndx else jnp.zeros((0, 0))
    return QuadraticCost(
        cost.gx,
        cost.gu,
        jnp.concatenate([H[:, :ndx, :ndx], H_end[None]]),
        H[:, ndx:, :ndx],
        H[:, ndx:, ndx:],
    )


def measured_hessian(
    problem: Problem, knots: Trajectory, multipliers: Multipliers, x: Array, u: Array
) -> Array:
    """H_k of the stages (K, n, n), n = ndx + nu, by differences.

    Controls are kept away from their bounds for it, where f may be cut off.

    Args:
        problem, knots, multipliers: where.
        x, u: how far coordinates move, (ndx,) and (nu,); differences are a share of it.
    """
    share = jnp.finfo(u.dtype).eps ** 0.25  # where rounding and truncation are about alike
    box, margin = problem.bounds, 2.0 * share * u  # two directions of one control at once, at most
    margin = jnp.minimum(margin, 0.5 * (box.u_upper - box.u_lower))
    inside = replace(knots, u=jnp.clip(knots.u, box.u_lower + margin, box.u_upper - margin))
    steps = share * jnp.concatenate([x, u])
    return _of_stages(problem, inside, multipliers, lambda f, _: second_differences(f, steps))


def _of_stages(
    problem: Problem,
    knots: Trajectory,
    multipliers: Multipliers,
    hessian: Callable[[Function, int], Array],
) -> Array:
    """H_k of the stages, (K, n, n), each the `hessian` of a function dz (n,) -> scalar."""
    dynamics, rows = problem.dynamics, multipliers.constraints
    ndx, nu = dynamics.ndx, dynamics.nu

    def stage(x: Array, u: Array, knot: Knot, x_next: Array, lambda_: Array, force: Array) -> Array:
        here = problem.at(knot)
        force = here.constraint.in_units(force)

        def lagrangian(dz: Array) -> Array:
            moved = dynamics.integrate(x, dz[:ndx]), u + dz[ndx:]
            seen = here.seen(*moved)
            defect = dynamics.difference(here.dynamics.step(*moved), x_next)
            constrained = jnp.dot(force, here.constraint(*seen))
            return here.running(*seen) + jnp.dot(lambda_, defect) + constrained

        return hessian(lagrangian, ndx + nu)

    of_stages: Array = jax.vmap(stage)(
        *problem.stages(knots), knots.x, multipliers.dynamics, rows.stage
    )
    return of_stages
