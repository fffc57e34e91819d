"""Model predictive path integral control, iterated on the whole horizon.

    m <- sum_n w_n v_n,    w_n ~ exp(-c(v_n) / (temperature std(c))),    s constant

Source: G. Williams, A. Aldrich, E. Theodorou, "Model Predictive Path Integral Control: From Theory
to Parallel Computation", Journal of Guidance, Control, and Dynamics 40(2), 2017; here offline, with
the temperature in standard deviations of the sampled costs and time-correlated noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.studies.other_methods.shooting import Plan, average


@register_dataclass
@dataclass(frozen=True)
class MPPI:
    """temperature [standard deviations of the cost], spread s [half widths of the box], and r."""

    name: ClassVar[str] = "mppi"
    temperature: ArrayLike = 0.1
    spread: ArrayLike = 0.5
    correlation: ArrayLike = 0.0

    def update(self, plan: Plan, v: Array, cost: Array, t: Array) -> tuple[Array, Array]:
        """The weighted mean; the spread stays."""
        return average(v, cost, self.temperature), plan.spread
