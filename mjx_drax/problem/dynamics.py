"""Discrete-time dynamics x_{k+1} = f(x_k, u_k), and the arithmetic of its states.

A state x holds nx numbers. Differences between states live in the tangent space and hold ndx
numbers; for the vector spaces of this module the two are the same. Everything that is solved for
(defects, linearizations, multipliers, noise) lives in tangent space, so a state with quaternions
only has to bring its own `difference` and `integrate`.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import CellType, CodeType, FunctionType, MethodType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax.base.pytrees import Static, register_dataclass


class Dynamics:
    """What the solver asks of a system: sizes, f, state arithmetic and what costs see.

    A system is a frozen dataclass under `pytrees.register_dataclass`.

    Attributes:
        nx: numbers in a state.
        ndx: numbers in a difference of states.
        nu: numbers in a control.
        dt: time between knots [s].
        derivatives: how f is differentiated, if not as the solver would; see `derivatives`.
    """

    nx: int
    ndx: int
    nu: int
    dt: float
    derivatives: Any = None

    def step(self, x: Array, u: Array) -> Array:
        """f(x, u): the state (nx,) one knot after x (nx,) under the control u (nu,)."""
        raise NotImplementedError

    def difference(self, x: Array, y: Array) -> Array:
        """x - y in the tangent space at y, (ndx,), so that integrate(y, x - y) = x."""
        return x - y

    def integrate(self, x: Array, dx: Array) -> Array:
        """x + dx: the state (nx,) reached from x (nx,) along the tangent vector dx (ndx,)."""
        return x + dx

    def valid(self, x: Array) -> Array:
        """The state next to numbers (..., nx) that need not be one, as random numbers are not."""
        return x

    def tangent(self, numbers: Array) -> Array:
        """Of numbers for the entries of a state (..., nx), those for its tangent (..., ndx).

        Bounds are on entries of states; their forces act in tangent space.
        """
        return numbers

    def observe(self, x: Array, u: Array) -> Any:
        """What cost functions receive for the knot (x, u): here the state itself."""
        return x

    @property
    def kinked(self) -> bool:
        """Whether f has kinks, as contacts make them: an answer may need `restarts`' mending."""
        return False

    def differentiator(self, by: Any) -> Any:
        """How functions of one knot of this system are best differentiated, if asked to by `by`."""
        return by

    @property
    def engine(self) -> str:
        """What replays a result, in words."""
        raise NotImplementedError

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run u_k + K_k (x_k - plan_k), clipped to the control limits, in float64.

        Args:
            plan: planned states x_0..x_K, (chains, K + 1, nx); each replay starts at its x_0.
            u: planned controls, (chains, K, nu).
            gains: feedback K_k, (chains, K, nu, ndx); zeros replay open loop.
            limits: (lower, upper), each broadcastable to (K, nu).

        Returns:
            states (chains, K + 1, nx) and the controls that were applied (chains, K, nu).
        """
        raise NotImplementedError

    def deviation(self, states: np.ndarray, plan: np.ndarray) -> np.ndarray:
        """max|x - plan| in tangent space, (...,) for states and plan of shape (..., nx)."""
        return np.abs(states - plan).max(axis=-1)

    def observe_replayed(self, x: np.ndarray) -> Any:
        """What goal functions receive for a replayed state (nx,): here the state itself."""
        return x


def as_partial(function: Callable[..., Any]) -> Partial:
    """The function as a pytree: static code, traced arguments.

    A `jax.tree_util.Partial` given by the user keeps its bound arguments as traced leaves, which
    is how a cost or a model takes parameters that may change without recompiling. So does any other
    callable that is registered as a pytree, like the terms of `mjx_drax.Terms`.
    """
    if isinstance(function, Partial):
        return function
    if not jax.tree_util.all_leaves([function]):
        cls: Any = type(function)
        return Partial(_call_of(cls), function)
    return Partial(function)


@lru_cache
def _call_of(cls: type) -> Callable[..., Any]:
    """What calls objects of one class: of two classes the structures may be equal, this is not."""

    def call(function: Callable[..., Any], *arguments: Any) -> Any:
        return function(*arguments)

    return call


@register_dataclass
@dataclass(frozen=True)
class FunctionDynamics(Dynamics):
    """Dynamics given as a JAX function f(x (nx,), u (nu,)) -> x_next (nx,) on a vector space."""

    function: Partial
    dt: float
    nx: int = field(metadata=Static)
    nu: int = field(metadata=Static)

    @property
    def ndx(self) -> int:  # type: ignore[override]
        """Differences of vectors are vectors."""
        return self.nx

    def step(self, x: Array, u: Array) -> Array:
        """f(x, u), (nx,)."""
        return self.function(x, u)

    @property
    def engine(self) -> str:
        """Functions are rolled out in double precision."""
        return "rollout of f, float64"

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """States and controls under u_k + K_k (x_k - plan_k) with f in float64; see `Dynamics`."""
        f = self.function
        own = replace(self, function=Partial(_with_own_arrays(f.func), *f.args, **f.keywords))
        with jax.enable_x64(True):
            states, applied = _replay(*jax.tree.map(_double, (own, plan, u, gains, limits)))
            return np.asarray(states), np.asarray(applied)


def _double(leaf: Any) -> Any:
    """The same number or array in float64, if it is one of floats."""
    array = np.asarray(leaf)
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else leaf


@lru_cache
def _with_own_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, with copies of the numpy arrays that it and its helpers refer to.

    JAX knows an array by its identity, in the precision in which it first saw it, and a function
    that was traced in float32 then fails in float64.
    """
    return _copied(function, {})


def _copied(value: Any, seen: dict[int, Any]) -> Any:
    """A copy of arrays, and of containers, methods and functions that hold them; else the same."""
    if id(value) in seen:
        return seen[id(value)]
    if isinstance(value, np.ndarray):
        return value.copy()
    if type(value) in (list, tuple):
        return type(value)(_copied(entry, seen) for entry in value)
    if type(value) is dict:
        return {key: _copied(entry, seen) for key, entry in value.items()}
    if isinstance(value, MethodType):
        owner = copy(value.__self__)
        for name, entry in vars(value.__self__).items():
            object.__setattr__(owner, name, _copied(entry, seen))
        return MethodType(_copied(value.__func__, seen), owner)
    if not isinstance(value, FunctionType):
        return value
    if (value.__module__ or "").split(".")[0] in ("jax", "numpy"):
        return value
    names = dict(value.__globals__)
    cells = tuple(CellType() for _ in value.__closure__ or ())
    new = FunctionType(value.__code__, names, value.__name__, value.__defaults__, cells)
    new.__kwdefaults__ = value.__kwdefaults__
    seen[id(value)] = new
    for cell, old in zip(cells, value.__closure__ or (), strict=True):
        cell.cell_contents = _copied(old.cell_contents, seen)
    for name in _names(value.__code__):
        if name in names:
            names[name] = _copied(names[name], seen)
    return new


def _names(code: CodeType) -> set[str]:
    """Names of globals that a function may use, those of functions inside it included."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


@jax.jit
def _replay(
    dynamics: Dynamics, plan: Array, u: Array, gains: Array, limits: tuple[Array, Array]
) -> tuple[Array, Array]:
    lower, upper = (jnp.broadcast_to(side, u.shape[1:]) for side in limits)

    def advance(x: Array, stage: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        planned, control, gain, low, high = stage
        control = jnp.clip(control + gain @ dynamics.difference(x, planned), low, high)
        x = dynamics.step(x, control)
        return x, (x, control)

    def chain(plan: Array, u: Array, gains: Array) -> tuple[Array, Array]:
        states, applied = jax.lax.scan(advance, plan[0], (plan[:-1], u, gains, lower, upper))[1]
        return jnp.concatenate([plan[:1], states]), applied

    return jax.vmap(chain)(plan, u, gains)
