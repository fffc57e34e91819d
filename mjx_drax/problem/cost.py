"""Costs and constraints of one knot, from the functions that a user gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from inspect import signature
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.kernels.linalg import transposed_product
from mjx_drax.problem.differentiators import Differentiator, positive_part
from mjx_drax.problem.rollout import untraced
from mjx_drax.problem.tracing import traced
from mjx_drax.problem.trajectory import Knot


def as_partial(function: Callable[..., Any]) -> Partial:
    """The function as a pytree: static code, traced arguments.

    A `jax.tree_util.Partial` given by the user keeps its bound arguments as traced leaves, which
    is how a cost or a model takes parameters that may change without recompiling. So does any other
    callable that is registered as a pytree, like the terms of `mjx_drax.Terms`.
    """
    if takes_knot(function):
        return Partial(_of_knot, _as_partial(function))
    return _as_partial(function)


def _as_partial(function: Callable[..., Any]) -> Partial:
    if isinstance(function, Partial):
        return function
    if not jax.tree_util.all_leaves([function]):
        cls: Any = type(function)
        return Partial(_call_of(cls), function)
    return Partial(function)


@lru_cache
def _call_of(cls: type) -> Callable[..., Any]:
    """What calls objects of one class: of two classes the structures may be equal, this is not."""

    def call(function: Callable[..., Any], *arguments: Any, **more: Any) -> Any:
        return function(*arguments, **more)

    return call


def takes_knot(function: Callable[..., Any]) -> bool:
    """Whether a function asks for its `Knot`: it has a parameter `knot`, not bound yet.

    A callable object may say so itself, by an attribute `takes_knot`.
    """
    own = getattr(function, "takes_knot", None)
    if own is not None:
        return bool(own)
    try:
        return "knot" in signature(function).parameters
    except (TypeError, ValueError):
        return False


def _of_knot(function: Callable[..., Any], *arguments: Any, knot: Knot) -> Any:
    """What `as_partial` makes of a function that takes its knot."""
    return function(*arguments, knot=knot)


def at_knot(function: Any, knot: Knot) -> Any:
    """The function at one knot; the same one if it does not ask for it."""
    if not depends_on_knot(function):
        return function
    return Partial(_of_knot, *function.args, knot=knot)


def depends_on_knot(function: Any) -> bool:
    """Whether `as_partial` has found that the function takes its knot."""
    return isinstance(function, Partial) and function.func is _of_knot


def in_float64(function: Any) -> Any:
    """The same function, none of whose constants JAX has seen in float32."""
    if function is None:
        return None

    def own(part: Any) -> Any:
        return in_float64(part) if isinstance(part, Partial) else part

    arguments = jax.tree.map(own, function.args, is_leaf=lambda part: isinstance(part, Partial))
    module = getattr(function.func, "__module__", None) or ""
    ours = module.startswith("mjx_drax.problem.")  # wrappers, without constants
    func = function.func if ours else untraced(function.func)
    return Partial(func, *arguments, **function.keywords)


@register_dataclass
@dataclass(frozen=True)
class Cost:
    """scalar(...) + 1/2 |residual(...)|^2, either part optional.

    A residual is the better way to give a cost: its Gauss-Newton Hessian J'J is positive
    semidefinite by construction and needs first derivatives only.
    """

    scalar: Partial | None
    residual: Partial | None

    def __call__(self, *arguments: Any) -> Array:
        """The cost, a scalar."""
        total = jnp.zeros(())
        if self.scalar is not None:
            total = total + self.scalar(*arguments)
        if self.residual is not None:
            total = total + 0.5 * jnp.sum(jnp.square(self.residual(*arguments)))
        return total

    def at(self, knot: Knot) -> Cost:
        """The same cost at one knot."""
        return Cost(at_knot(self.scalar, knot), at_knot(self.residual, knot))

    def in_float64(self) -> Cost:
        """The same cost for float64; see `Problem.in_float64`."""
        return Cost(in_float64(self.scalar), in_float64(self.residual))

    def expand(
        self, at: Callable[[Array], tuple[Any, ...]], size: int, by: Differentiator, key: Array
    ) -> tuple[Array, Array]:
        """Gradient (n,) and positive semidefinite Hessian (n, n) in local coordinates.

        `at(dz)` gives the cost's arguments a displacement dz (n,) away from the knot. The residual
        contributes J'r and J'J; the scalar its gradient, and its Hessian with negative eigenvalues
        set to zero.
        """
        gradient, hessian = jnp.zeros(size), jnp.zeros((size, size))
        if self.scalar is not None:
            scalar = self.scalar

            def value(dz: Array) -> Array:
                return jnp.asarray(scalar(*at(dz)), float)  # also a plain number

            slope, _ = by.jacobian(lambda dz: value(dz)[None], size, key)
            gradient = gradient + slope[0]
            hessian = hessian + positive_part(by.hessian(value, size))
        if self.residual is not None:
            residual = self.residual
            jacobian, r = by.jacobian(lambda dz: jnp.ravel(residual(*at(dz))), size, key)
            gradient = gradient + transposed_product(jacobian, r)
            hessian = hessian + transposed_product(jacobian, jacobian)
        return gradient, hessian


@register_dataclass
@dataclass(frozen=True)
class Constraint:
    """equality(...) = 0 and inequality(...) <= 0, either part optional; rows in that order.

    Attributes:
        equality, inequality: the functions.
        equalities, inequalities: their rows.
        unit: what plans measure each row in, (rows,); None: as the user has them.
        further: more inequalities, after the others; see `with_inequality`.
    """

    equality: Partial | None
    inequality: Partial | None
    equalities: int = field(metadata=Static)
    inequalities: int = field(metadata=Static)
    unit: Array | None = None
    further: Partial | None = None

    def __call__(self, *arguments: Any) -> Array:
        """All parts in one vector, (equalities + inequalities,)."""
        every = (self.equality, self.inequality, self.further)
        parts = [p for p in every if p is not None]
        return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(p(*arguments)) for p in parts)])

    def in_units(self, values: Array) -> Array:
        """Values (..., rows), divided by their units."""
        return values if self.unit is None else values / self.unit

    def at(self, knot: Knot) -> Constraint:
        """The same constraint at one knot."""
        parts = at_knot(self.equality, knot), at_knot(self.inequality, knot)
        return replace(self, equality=parts[0], inequality=parts[1])

    def in_float64(self) -> Constraint:
        """The same constraint for float64; see `Problem.in_float64`."""
        parts = in_float64(self.equality), in_float64(self.inequality)
        return replace(self, equality=parts[0], inequality=parts[1])

    @property
    def rows(self) -> int:
        """Of both parts."""
        return self.equalities + self.inequalities

    def with_inequality(self, further: Partial, rows: int) -> Constraint:
        """The same and further(...) <= 0, which has so many rows, after all others."""
        return replace(self, further=further, inequalities=self.inequalities + rows)

    def with_slack(self, values: Array, slack: Array) -> Array:
        """The equality constraints [equality; inequality + slack], for values (..., m)."""
        inequality = values[..., self.equalities :] + slack
        return jnp.concatenate([values[..., : self.equalities], inequality], axis=-1)

    def violation(self, values: Array) -> Array:
        """Largest |equality| or positive inequality, scalar; 0 without constraints."""
        equality = jnp.abs(values[..., : self.equalities]).max(initial=0.0)
        return jnp.maximum(equality, values[..., self.equalities :].max(initial=0.0))


def cost_of(cost: Callable[..., Any] | None, residual: Callable[..., Any] | None) -> Cost:
    """A Cost from the functions that a user gives; either or both may be None."""
    return Cost(
        None if cost is None else as_partial(cost),
        None if residual is None else as_partial(residual),
    )


def constraint_of(
    equality: Callable[..., Any] | None,
    inequality: Callable[..., Any] | None,
    arguments: tuple[Any, ...],
    knot: Knot,
    label: str = "",
) -> Constraint:
    """A Constraint from the functions that a user gives; their sizes are traced abstractly."""
    parts = [None if f is None else as_partial(f) for f in (equality, inequality)]
    sizes = []
    for name, part in zip(("equality", "inequality"), parts, strict=True):
        here = at_knot(part, knot)
        out = None if here is None else traced(f"{label}{name}", here, arguments)
        sizes.append(0 if out is None else int(np.prod(out.shape)))
    return Constraint(parts[0], parts[1], sizes[0], sizes[1])
