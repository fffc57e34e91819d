"""Derivatives of functions of one knot, exact or from samples.

A *differentiator* turns a function of a displacement dz of one knot into its Jacobian. Dynamics,
residuals, costs and constraints all go through it, so with `Smoothed` the whole solver runs on
function values alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.kernels.linalg import symmetric
from mjx_drax.kernels.pruning import pruned
from mjx_drax.kernels.scalars.scalarize import scalarized

Function = Callable[[Array], Array]


class Differentiator(Protocol):
    """Derivatives at dz = 0 of functions of a displacement dz (n,)."""

    def jacobian(self, function: Function, size: int, key: Array) -> tuple[Array, Array]:
        """Jacobian (m, n) of a function dz (n,) -> (m,), and the function's value (m,)."""
        ...

    def hessian(self, function: Function, size: int) -> Array:
        """A model (n, n) of the Hessian of a function dz (n,) -> scalar."""
        ...


@register_dataclass
@dataclass(frozen=True)
class Autodiff:
    """Exact derivatives by forward-mode differentiation.

    Forward mode passes through the solver loops of MJX, which reverse mode does not.
    """

    def jacobian(self, function: Function, size: int, key: Array) -> tuple[Array, Array]:
        """Jacobian (m, n) and value (m,), one tangent for each of the n directions."""
        lean = pruned(function)

        def with_value(dz: Array) -> tuple[Array, Array]:
            value = lean(dz)
            return value, value

        return jax.jacfwd(with_value, has_aux=True)(jnp.zeros(size))

    def hessian(self, function: Function, size: int) -> Array:
        """Hessian (n, n)."""
        return jax.jacfwd(jax.jacfwd(pruned(function)))(jnp.zeros(size))


@register_dataclass
@dataclass(frozen=True)
class InScalars:
    """The derivatives of another differentiator, in scalar arithmetic where that is possible.

    Of the tangents of a mechanism most entries are zero, and cost nothing then
    (`kernels.scalars`).
    """

    by: Differentiator

    def jacobian(self, function: Function, size: int, key: Array) -> tuple[Array, Array]:
        """Jacobian (m, n) and value (m,)."""
        return scalarized(lambda: self.by.jacobian(function, size, key), outermost=True)()

    def hessian(self, function: Function, size: int) -> Array:
        """Hessian (n, n)."""
        return scalarized(lambda: self.by.hessian(function, size), outermost=True)()


def without_gaps(jacobians: Array) -> Array:
    """Jacobians of knots (K, m, n); where one is not finite, that of the knot before.

    At the beginning that of the first knot that has one. MJX divides 0 by 0 in places of no width,
    as where a tendon begins to touch what it wraps, and in float32 knots do get there.
    """
    fine = jnp.isfinite(jacobians).all(axis=(1, 2))
    last = jax.lax.cummax(jnp.where(fine, jnp.arange(len(fine)), -1))
    return jacobians[jnp.where(last < 0, jnp.argmax(fine), last)]


@register_dataclass
@dataclass(frozen=True)
class Smoothed:
    """Derivatives of the function smoothed by Gaussian noise, from function values only.

    With perturbations delta_i ~ N(0, radius^2 I) of one knot, in antithetic pairs, the Jacobian is
    the least-squares fit of  f(delta_i) - f(-delta_i) = 2 J delta_i  (a ridge of 1e-6 keeps it
    unique with fewer pairs than unknowns). Perturbing one knot at a time needs far fewer samples
    than perturbing the whole trajectory. Works for functions with jumps and kinks; a scalar cost
    contributes its gradient and no curvature, so prefer residuals.

    Attributes:
        pairs: antithetic pairs a knot; at least ndx + nu for a full-rank fit.
        radius: standard deviation of the perturbations, in the units of the state and control.
    """

    pairs: int = field(default=16, metadata=Static)
    radius: ArrayLike = 1e-2

    def jacobian(self, function: Function, size: int, key: Array) -> tuple[Array, Array]:
        """Jacobian (m, n) of the smoothed function, and the value (m,) of the function itself."""
        radius = jnp.asarray(self.radius)
        delta = jax.random.normal(key, (self.pairs, size))
        ahead, behind = (jax.vmap(function)(sign * radius * delta) for sign in (1.0, -1.0))
        slopes = (ahead - behind) / (2.0 * radius)
        normal = delta.T @ delta + 1e-6 * jnp.eye(size)
        return jnp.linalg.solve(normal, delta.T @ slopes).T, function(jnp.zeros(size))

    def hessian(self, function: Function, size: int) -> Array:
        """Zero: curvature from so few samples would be noise."""
        return jnp.zeros((size, size))


def second_differences(function: Function, steps: Array) -> Array:
    """The Hessian (n, n) at dz = 0 of a function dz (n,) -> scalar, from n^2 + n + 2 values.

        H_ii = [ s(h_i e_i) - s(0) ] / h_i^2,        s(z) = f(z) + f(-z)
        H_ij = [ s(h_i e_i + h_j e_j) - s(h_i e_i) - s(h_j e_j) + s(0) ] / (2 h_i h_j)

    Exact up to third derivatives. The function is compiled once, as it is, where exact second
    derivatives may take minutes.

    Args:
        function: of a displacement.
        steps: h, (n,), in the units of the displacement.
    """
    h, size = steps, len(steps)
    i, j = np.tril_indices(size, -1)
    alone = jnp.diag(h)
    points = jnp.concatenate([jnp.zeros((1, size)), alone, alone[i] + alone[j]])
    lean = pruned(function)

    def of_both_signs(rows: Array) -> Array:
        return jax.vmap(lambda dz: lean(dz) + lean(-dz))(rows)

    # n points at a time need as much memory as a Jacobian's tangents
    filled = jnp.pad(points, ((0, -len(points) % size), (0, 0)))
    s = jax.lax.map(of_both_signs, filled.reshape(-1, size, size)).ravel()
    single, pairs = s[1 : size + 1], s[size + 1 : len(points)]
    H = jnp.diag((single - s[0]) / jnp.square(h))
    mixed = (pairs - single[i] - single[j] + s[0]) / (2.0 * h[i] * h[j])
    return H.at[i, j].set(mixed).at[j, i].set(mixed)


def positive_part(matrix: Array) -> Array:
    """The nearest positive semidefinite matrix (n, n) in the Frobenius norm to a symmetric one."""
    values, vectors = jnp.linalg.eigh(symmetric(matrix))
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T
