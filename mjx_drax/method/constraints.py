"""Constraints of one stage in the quadratic model, with their slack variables eliminated.

At one knot let r = [equality; inequality + s] with Jacobian J = [E; G] in the knot's displacement
dz, multipliers nu, and a barrier on s with slope b and curvature c (damping included). The model

    nu'(r + J dz + [0; ds]) + mu/2 |r + J dz + [0; ds]|^2 + b'ds + 1/2 ds'diag(c) ds

is minimized over ds by ds = -(b + nu_g + mu r_g + mu G dz) / D with D = mu + c, elementwise. What
is left for dz has gradient J'(nu + mu r) - G'(mu / D) t, where t = b + nu_g + mu r_g, and Hessian
J'W J, W = mu for equalities and mu c / D for inequalities: an inequality weighs in as its slack
nears zero. Given dz, ds has variance 1/D under N(0, M^{-1}).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels.linalg import transposed_product


@register_dataclass
@dataclass(frozen=True)
class Eliminated:
    """What `recover` needs of one knot: J (m, n), r (m,), t (mg,) and D (mg,)."""

    J: Array
    r: Array
    t: Array
    D: Array


def eliminate(
    J: Array, r: Array, multipliers: Array, slope: Array, curvature: Array, penalty: Array
) -> tuple[Array, Array, Eliminated]:
    """Gradient (n,) and Hessian (n, n) of one knot's constraints, slacks (mg,) eliminated."""
    equalities = r.shape[0] - slope.shape[0]
    force = multipliers + penalty * r
    D = penalty + curvature
    t = slope + force[equalities:]
    G = J[equalities:]
    weights = jnp.concatenate([jnp.full(equalities, 1.0) * penalty, penalty * curvature / D])
    gradient = transposed_product(J, force) - transposed_product(G, penalty * t / D)
    return gradient, transposed_product(J, weights[:, None] * J), Eliminated(J, r, t, D)


def recover(
    block: Eliminated, dz: Array, nz: Array, white: Array, penalty: Array
) -> tuple[Array, Array, Array]:
    """Slack step ds (mg,), slack noise (mg,) and mu (r + J d) (m,), given dz and nz (n,)."""
    equalities = block.r.shape[0] - block.t.shape[0]
    G = block.J[equalities:]
    ds = -(block.t + penalty * (G @ dz)) / block.D
    ns = -penalty * (G @ nz) / block.D + white / jnp.sqrt(block.D)
    return ds, ns, penalty * (block.r + block.J @ dz).at[equalities:].add(ds)
