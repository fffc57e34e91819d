"""A metric's step in coordinates without units, as the default flow takes it.

The penalty mu |h|^2 and the damping delta |dz|^2 add up numbers of different units. So the flow
measures each state in parts of the box that initial knots are drawn from, sixths with noise and
twelfths without, and each control in halves: x = S x', u = U u'. In these coordinates

    A' = S^-1 A S    B' = S^-1 B U    h' = S^-1 h    lambda' = S lambda    g' = S g    H' = S H S

and then the step is turned back. The box says in which units the states are; millimetres and
metres give the same step. Smaller parts make the dynamics stiffer and steps shorter: a descent
then does not tunnel through obstacles, from where no noise would bring it back. Under noise larger
parts lead to better optima.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.metrics import Direction, Metric
from mjx_drax.method.model import Derivatives, Linearization, Model, Multipliers, QuadraticCost
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

HEATED, CONTROLS = 6.0, 2.0
"""In how many parts the box is measured: states under noise, controls."""


@register_dataclass
@dataclass(frozen=True)
class Scaled(Metric):
    """The metric in units S = x (ndx,) of states and U = u (nu,) of controls.

    The changes of a free x_0 keep the user's units.
    """

    metric: Metric
    x: Array
    u: Array

    def direction(
        self, problem: Problem, model: Model, key: Array | None, memory: Any
    ) -> Direction:
        """Drift, noise, multiplier rate and gains, in the user's units."""
        to = self.metric.direction(problem, self._without_units(model), key, memory)
        rate = replace(to.multipliers, dynamics=to.multipliers.dynamics / self.x)
        gains = self.u[:, None] * to.gains / self.x
        noise = None if to.noise is None else self._times(to.noise)
        return Direction(self._times(to.drift), noise, rate, gains, to.memory)

    def _times(self, z: Trajectory, power: int = 1) -> Trajectory:
        """z S^power; slacks keep their units."""
        return replace(z, x=z.x * self.x**power, u=z.u * self.u**power)

    def _without_units(self, model: Model) -> Model:
        """The model in coordinates without units."""
        assert model.derivatives is not None  # for the type checker
        dynamics, cost, stage, terminal = model.derivatives
        x, u, (slope, curvature) = self.x, self.u, model.barrier
        derivatives = Derivatives(
            Linearization(dynamics.A * x / x[:, None], dynamics.B * u / x[:, None], dynamics.h / x),
            QuadraticCost(
                cost.gx * x,
                cost.gu * u,
                cost.Hxx * x * x[:, None],
                cost.Hux * x * u[:, None],
                cost.Huu * u * u[:, None],
            ),
            stage * jnp.concatenate([x, u]),
            terminal * x,
        )
        return replace(
            model,
            gradient=self._times(model.gradient),
            h=Multipliers(model.h.dynamics / x, model.h.constraints),
            multipliers=replace(model.multipliers, dynamics=model.multipliers.dynamics * x),
            barrier=(self._times(slope), self._times(curvature, 2)),
            derivatives=derivatives,
            start=None if model.start is None else model.start / x[:, None],
        )


def without_units(flow: Langevin, problem: Problem) -> Langevin:
    """The flow in coordinates without units, if its metric is `scaled_by_box`."""
    metric = flow.preconditioner
    if not metric.scaled_by_box:
        return flow
    of_x, of_u = problem.widths
    heated = (jnp.asarray(flow.scale.noise) > 0.0) & (of_x > 0.0)
    x = jnp.where(heated, of_x / HEATED, problem.defect_scale)
    u = jnp.where(of_u > 0.0, of_u / CONTROLS, 1.0)
    return replace(flow, preconditioner=Scaled(metric, x, u))
