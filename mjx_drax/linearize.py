"""First-order models of the dynamics around knots that need not be feasible.

h_k(dz) ~ h_k + A_k dx_k + B_k du_k - dx_{k+1},     A = df/dx (ndx, ndx),  B = df/du (ndx, nu)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import register_dataclass

from mjx_drax.problem import Problem, Trajectory


@register_dataclass
@dataclass(frozen=True)
class Linearization:
    """A (K, ndx, ndx), B (K, ndx, nu) and the defects h (K, ndx), all in tangent space."""

    A: Array
    B: Array
    h: Array


Linearize = Callable[[Problem, Trajectory], Linearization]


def autodiff(problem: Problem, trajectory: Trajectory) -> Linearization:
    """Exact A and B by forward-mode differentiation, ndx + nu tangents a knot.

    Forward mode passes through the solver loops of MJX, which reverse mode does not.
    """
    dynamics = problem.dynamics

    def linearize(x: Array, u: Array, x_next: Array) -> Linearization:
        def defect(dz: Array) -> tuple[Array, Array]:
            moved = dynamics.integrate(x, dz[: dynamics.ndx])
            h = dynamics.difference(dynamics.step(moved, u + dz[dynamics.ndx :]), x_next)
            return h, h

        zero = jnp.zeros(dynamics.ndx + dynamics.nu, x.dtype)
        jacobian, h = jax.jacfwd(defect, has_aux=True)(zero)
        return Linearization(jacobian[:, : dynamics.ndx], jacobian[:, dynamics.ndx :], h)

    return jax.vmap(linearize)(problem.stages(trajectory), trajectory.u, trajectory.x)
