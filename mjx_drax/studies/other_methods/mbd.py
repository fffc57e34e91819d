"""Model-based diffusion: Monte Carlo ascent of the score of an annealed density over controls.

The target p_0(Y) ~ exp(-c(Y) / temperature) is blurred in T steps, alpha_i = 1 - beta_i, with
abar_i = alpha_1 ... alpha_i. Backwards, i = T..1, the score at Y_i is estimated from rollouts and
climbed:

    Y_0^n ~ N(Y_i / sqrt(abar_i), (1 / abar_i - 1) I),     Ybar = sum_n w_n Y_0^n,
    w_n ~ exp(-c(Y_0^n) / (temperature std(c))),
    grad log p_i = (sqrt(abar_i) Ybar - Y_i) / (1 - abar_i),
    Y_{i-1} = (Y_i + (1 - abar_i) grad log p_i) / sqrt(alpha_i) = sqrt(abar_{i-1}) Ybar.

So m = Y_i / sqrt(abar_i) becomes Ybar, and s = sqrt(1 / abar_i - 1) shrinks. beta rises linearly
from 1e-4 to 1e-2 over 100 steps; with T steps, at the same noise, 1 / abar(t) = exp(0.01 t +
0.495 t^2) with t = i / T.

Source: C. Pan, Z. Yi, G. Shi, G. Qu, "Model-Based Diffusion for Trajectory Optimization", NeurIPS
2024, with the temperature in standard deviations of the costs as there; time-correlated samples
(r > 0) are an addition that the other methods here have as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.studies.other_methods.shooting import Plan, average


@register_dataclass
@dataclass(frozen=True)
class MBD:
    """temperature [standard deviations of the cost], and r."""

    name: ClassVar[str] = "mbd"
    temperature: ArrayLike = 0.1
    correlation: ArrayLike = 0.0

    @property
    def spread(self) -> ArrayLike:
        """s at i = T."""
        return _spread(1.0)

    def update(self, plan: Plan, v: Array, cost: Array, t: Array) -> tuple[Array, Array]:
        """Ybar, and the spread of the next lower noise level."""
        spread = jnp.full_like(plan.spread, 1.0) * _spread(1.0 - t)
        return average(v, cost, self.temperature), spread


def _spread(t: ArrayLike) -> Array:
    """sqrt(1 / abar - 1) at noise level t = i / T."""
    t = jnp.asarray(t)
    return jnp.sqrt(jnp.expm1(0.01 * t + 0.495 * jnp.square(t)))
