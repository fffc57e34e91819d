"""First-order models of the dynamics around knots that need not be feasible.

h_k(dz) ~ h_k + A_k dx_k + B_k du_k - dx_{k+1},     A = df/dx (ndx, ndx),  B = df/du (ndx, nu)
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.problem.differentiators import Differentiator
from mjx_drax.problem.problem import Problem, Trajectory


@register_dataclass
@dataclass(frozen=True)
class Linearization:
    """A (K, ndx, ndx), B (K, ndx, nu) and the defects h (K, ndx), all in tangent space."""

    A: Array
    B: Array
    h: Array


def linearize(
    problem: Problem, trajectory: Trajectory, by: Differentiator, keys: Array
) -> Linearization:
    """The dynamics at every knot, with one random key for each, (K,)."""
    dynamics = problem.dynamics
    if not dynamics.kinked:  # else f holds a loop that ends when it is done: no scalars, in vain
        by = dynamics.differentiator(by)
    ndx, by = dynamics.ndx, dynamics.derivatives or by

    def stage(x: Array, u: Array, x_next: Array, key: Array) -> Linearization:
        def defect(dz: Array) -> Array:
            moved = dynamics.integrate(x, dz[:ndx])
            return dynamics.difference(dynamics.step(moved, u + dz[ndx:]), x_next)

        jacobian, h = by.jacobian(defect, ndx + dynamics.nu, key)
        return Linearization(jacobian[:, :ndx], jacobian[:, ndx:], h)

    stages = problem.stages(trajectory)
    return jax.vmap(stage)(stages, trajectory.u, trajectory.x, keys)
