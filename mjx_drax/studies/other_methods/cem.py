"""The cross-entropy method.

    m <- m + a (mean of the elite - m),    s <- s + a (standard deviation of the elite - s)

where the elite are the cheapest sequences of an iteration and a is the rate. The spread never falls
below `floor`.

Source: R. Rubinstein, "The Cross-Entropy Method for Combinatorial and Continuous Optimization",
Methodology and Computing in Applied Probability 1, 1999. Time-correlated samples as in C. Pinneri
et al., "Sample-efficient Cross-Entropy Method for Real-time Planning", CoRL 2020.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.studies.other_methods.shooting import Plan


@register_dataclass
@dataclass(frozen=True)
class CEM:
    """rate a, first spread s and its floor [half widths of the box], r, and size of the elite."""

    name: ClassVar[str] = "cem"
    rate: ArrayLike = 0.7
    spread: ArrayLike = 1.0
    floor: ArrayLike = 0.01
    correlation: ArrayLike = 0.0
    elite: int = field(default=26, metadata=Static)

    def update(self, plan: Plan, v: Array, cost: Array, t: Array) -> tuple[Array, Array]:
        """Mean and spread nearer to those of the elite."""
        _, chosen = jax.lax.top_k(-cost, min(self.elite, len(cost)))
        elite = v[chosen]
        mean = plan.mean + self.rate * (elite.mean(axis=0) - plan.mean)
        spread = plan.spread + self.rate * (elite.std(axis=0) - plan.spread)
        return mean, jnp.maximum(spread, self.floor)
