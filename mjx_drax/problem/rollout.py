"""Replays in float64: states that follow from controls and feedback, and arithmetic of states.

They work for any dynamics that JAX can trace, and know nothing of how a plan was found.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import lru_cache, partial
from types import CellType, CodeType, FunctionType, MethodType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


def replay(
    dynamics: Any,
    plan: np.ndarray,
    u: np.ndarray,
    gains: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    knots: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """`Dynamics.replay`, by f.

    Rows are repeated up to a power of two, so that few programs serve all numbers of them.
    """
    count = len(plan)
    rows = np.arange(1 << (count - 1).bit_length()) % count
    plan, u, gains = plan[rows], u[rows], gains[rows]
    if knots.time.ndim == 2:
        knots = jax.tree.map(lambda a: np.asarray(a)[rows], knots)
    with jax.enable_x64(True):
        step, difference, own = _in_float64(dynamics, "step", "difference")
        given = jax.tree.map(in_double, (plan, u, gains, limits, knots))
        ran = _replay(step, difference, own, *given)
        return np.asarray(ran[0])[:count], np.asarray(ran[1])[:count]


def replay_by(
    advance: Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    difference: Callable[[np.ndarray, np.ndarray], np.ndarray],
    plan: np.ndarray,
    u: np.ndarray,
    gains: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """`Dynamics.replay` by an engine on the host.

    Args:
        advance: k, states (chains, nx) and controls (chains, nu) to the next states and to the
            controls that were applied, NaN where a chain has diverged.
        difference: `Dynamics.host_difference`.
        plan, u, gains, limits: as of `Dynamics.replay`.
    """
    lower, upper = (np.broadcast_to(side, u.shape[1:]) for side in limits)
    states, applied = np.full(plan.shape, np.nan), np.full(u.shape, np.nan)
    states[:, 0] = plan[:, 0]
    for k in range(u.shape[1]):
        off = difference(states[:, k], plan[:, k])
        wanted = np.clip(u[:, k] + np.einsum("cij,cj->ci", gains[:, k], off), lower[k], upper[k])
        states[:, k + 1], applied[:, k] = advance(k, states[:, k], wanted)
    return states, applied


def apply(dynamics: Any, name: str, *arrays: np.ndarray) -> np.ndarray:
    """A method of the dynamics that works on single states, for arrays (..., n) of them."""
    leading = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
    rows = [np.broadcast_to(a, (*leading, a.shape[-1])).reshape(-1, a.shape[-1]) for a in arrays]
    with jax.enable_x64(True), jax.default_device(jax.local_devices(backend="cpu")[0]):
        method, own = _in_float64(dynamics, name)
        out = np.asarray(_apply(method, own, *map(in_double, rows)))
    return out.reshape(*leading, -1)


def _in_float64(dynamics: Any, *names: str) -> tuple[Any, ...]:
    """Methods of the dynamics as functions of it, and the dynamics, with numbers in float64."""
    own = dynamics.in_float64()
    methods = [untraced(getattr(type(own), name)) for name in names]
    return *methods, jax.tree.map(in_double, own)


@partial(jax.jit, static_argnums=0)
def _apply(method: Callable[..., Array], dynamics: Any, *rows: Array) -> Array:
    return jax.vmap(partial(method, dynamics))(*rows)


@partial(jax.jit, static_argnums=(0, 1))
def _replay(
    step: Callable[..., Array],
    difference: Callable[..., Array],
    dynamics: Any,
    plan: Array,
    u: Array,
    gains: Array,
    limits: tuple[Array, Array],
    knots: Any,
) -> tuple[Array, Array]:
    lower, upper = (jnp.broadcast_to(side, u.shape[1:]) for side in limits)

    def one(plan: Array, u: Array, gains: Array, knots: Any) -> tuple[Array, Array]:
        def advance(x: Array, u: Array, knot: Any) -> Array:
            return step(dynamics.at(knot), x, u)

        limits = lower, upper
        return follow(advance, partial(difference, dynamics), plan, u, gains, limits, knots)

    each = 0 if knots.time.ndim == 2 else None
    return jax.vmap(one, in_axes=(0, 0, 0, each))(plan, u, gains, knots)


def follow(
    step: Callable[..., Array],
    difference: Callable[..., Array],
    plan: Array,
    u: Array,
    gains: Array,
    limits: tuple[Array, Array],
    knots: Any,
) -> tuple[Array, Array]:
    """The states x_0..x_K (K + 1, nx) and controls (K, nu) of one chain's plan under feedback.

    Args:
        step, difference: f(x, u) at a knot, and x - y in the tangent space at y.
        plan: planned states (K + 1, nx), of which the first is where it starts.
        u: planned controls (K, nu).
        gains: K_k in u_k + K_k (x_k - planned x_k), (K, nu, ndx).
        limits: of controls, below and above, each (K, nu).
        knots: of the K stages.
    """

    def advance(x: Array, stage: tuple[Any, ...]) -> tuple[Array, tuple[Array, Array]]:
        planned, control, gain, low, high, knot = stage
        control = jnp.clip(control + gain @ difference(x, planned), low, high)
        x = step(x, control, knot)
        return x, (x, control)

    states, applied = jax.lax.scan(advance, plan[0], (plan[:-1], u, gains, *limits, knots))[1]
    return jnp.concatenate([plan[:1], states]), applied


def in_double(leaf: Any) -> Any:
    """The same number or array in float64, if it is one of floats."""
    array = np.asarray(leaf)
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else leaf


@lru_cache
def untraced(function: Callable[..., Any]) -> Callable[..., Any]:
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
