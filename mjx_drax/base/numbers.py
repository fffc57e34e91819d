"""Numbers as users give them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, shown


def numbers(value: ArrayLike) -> np.ndarray:
    """Real numbers as float64.

    Raises:
        TypeError, ValueError: they are none, or lists of different lengths.
    """
    array = np.asarray(value)
    if array.dtype.kind in "USc":  # strings would be parsed, imaginary parts dropped
        raise TypeError(f"{array.dtype} holds no real numbers")
    try:
        return np.asarray(array, float)
    except OverflowError as error:  # of Python's own whole numbers
        raise ValueError(str(error)) from error


def vector(label: str, value: ArrayLike) -> Array:
    """A finite float vector (n,), or a DraxError that says what was given."""
    if isinstance(value, jax.core.Tracer):
        raise DraxError(
            f"{label} is traced, so its numbers cannot be checked: use "
            f"dataclasses.replace(problem, {label}=...) inside of JAX functions."
        )
    try:
        array = numbers(value)
    except (TypeError, ValueError) as error:
        raise DraxError(f"{label} is {shown(value)}: give a vector of numbers.") from error
    with np.errstate(over="ignore"):  # a number that float32 cannot hold becomes infinite
        out = jnp.asarray(array)
    if array.ndim != 1 or not np.isfinite(out).all():
        raise DraxError(f"{label} is {shown(value)}: give a vector of finite numbers.")
    return out
