"""Numbers that users give for each knot: references, weights that switch, obstacles that move.

They are arrays with one row for each of the knots 0..K, in any pytree, or a function of time [s]
that returns such a pytree for one knot. All are traced: other numbers do not recompile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.problem.tracing import plain


def rows(data: Any, times: np.ndarray) -> Any:
    """The user's data as arrays with a row for each of the times (K + 1,).

    Raises:
        DraxError: a function that fails or cannot be traced, arrays of another length, or what is
            no number.
    """
    if data is None:
        return None
    if callable(data):
        return _of_function(data, times)
    count = len(times)

    def row(path: Any, leaf: Any) -> Any:
        name = "data" + jax.tree_util.keystr(path)
        if isinstance(leaf, jax.core.Tracer):  # by what makes many problems
            require_length(name, leaf, count)
            return leaf
        try:
            array = np.asarray(leaf)
            if array.dtype.kind not in "biuf":
                raise ValueError(f"numbers of type {array.dtype}")
        except Exception as error:
            raise DraxError(
                f"{name} is {shown(leaf)}: give arrays of numbers, a row for each of {count} knots."
            ) from error
        require_length(name, array, count)
        with np.errstate(over="ignore"):
            rounded = jnp.asarray(array)
        wrong = ~np.isfinite(rounded) if array.dtype.kind == "f" else np.zeros(1)
        if wrong.any():
            at = tuple(np.argwhere(wrong)[0])
            raise DraxError(
                f"{name} is not finite in row {int(at[0])}, {array[at]} as {rounded.dtype}: give "
                "numbers."
            )
        return rounded

    return jax.tree_util.tree_map_with_path(row, data)


def require_length(name: str, array: Any, count: int) -> None:
    """Complain about an array that has no row for each of `count` knots."""
    if np.ndim(array) == 0 or len(array) != count:
        raise DraxError(
            f"{name} has shape {np.shape(array)}: give {count} rows, one for each of the knots "
            f"0..{count - 1}, or a function of time."
        )


def _of_function(data: Callable[[Any], Any], times: np.ndarray) -> Any:
    try:
        found = jax.vmap(data)(jnp.asarray(times, float))
    except Exception as error:
        raise DraxError(
            f"data failed when it was traced: {plain(error)}. Make it a JAX function of the time, "
            "one number, or give arrays with a row for each knot."
        ) from error
    return rows(found, times)


def require_rows(data: Any) -> None:
    """Where the horizon is free, data are no function of time: knots have no times yet.

    Raises:
        DraxError: they are.
    """
    if callable(data):
        raise DraxError(
            "data is a function of time, and the horizon is free: read knot.time in the functions "
            "of the problem, or give arrays with a row for each knot."
        )


def later(data: Any, by: int) -> Any:
    """Arrays `by` rows later; the last row stays."""

    def shift(array: Any) -> Any:
        return array[np.clip(np.arange(len(array)) + by, 0, len(array) - 1)]

    return jax.tree.map(shift, data)
