"""How the noise, penalty, damping and barrier weights change over a solve.

A schedule is a function of progress t: 0 to 1 while noise is on, 1 to 2 in the noise-free tail.
Its numbers are traced, so they may change without recompiling.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass


class Schedule(Protocol):
    """A callable pytree; its numbers are traced."""

    def __call__(self, t: Array) -> Array:
        """The value at progress t: 0 to 1 while noise is on, 1 to 2 in the noise-free tail."""
        ...


@register_dataclass
@dataclass(frozen=True)
class Constant:
    """The same value all along."""

    value: ArrayLike

    def __call__(self, t: Array) -> Array:
        """The value at progress t."""
        return jnp.asarray(self.value)


@register_dataclass
@dataclass(frozen=True)
class Geometric:
    """start (end / start)^t while noise is on; then on to `final` over the tail's first half.

    Without `final` the tail holds `end`. From a start of 0 the value stays 0.
    """

    start: ArrayLike
    end: ArrayLike
    final: ArrayLike | None = None

    def __post_init__(self) -> None:
        if self.final is None:  # always a number, so that giving one later does not recompile
            object.__setattr__(self, "final", self.end)

    def __call__(self, t: Array) -> Array:
        """The value at progress t in [0, 2]."""
        start, end, final = map(jnp.asarray, (self.start, self.end, self.final))
        noisy = _between(start, end, jnp.minimum(t, 1.0))
        return jnp.where(t <= 1.0, noisy, _between(end, final, jnp.clip(2.0 * (t - 1.0), 0.0, 1.0)))


def _between(start: Array, end: Array, t: Array) -> Array:
    """start^(1-t) end^t, where 0 stays 0."""
    return start * (end / jnp.where(start == 0.0, 1.0, start)) ** t


@register_dataclass
@dataclass(frozen=True)
class Weights:
    """The schedules' values at one iteration: sigma, mu, delta and rho, scalars."""

    noise: Array
    penalty: Array
    damping: Array
    barrier: Array


@register_dataclass
@dataclass(frozen=True)
class Scale:
    """Units that the schedules are multiples of.

    Attributes:
        cost: of mu, delta and rho, which all are costs.
        noise: of sigma, the square root of a cost: sigma^2 is a temperature.
    """

    cost: ArrayLike = 1.0
    noise: ArrayLike = 1.0
