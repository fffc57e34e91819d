"""|h|^2 of the paper's flow on the pendulum, with and without its multipliers, over the penalty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.metrics import Direction, Identity, Metric
from mjx_drax.method.model import Model
from mjx_drax.problem.problem import Problem
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.convergence import followed
from mjx_drax.studies.reproduce.output import Numbers, tell
from mjx_drax.view.plotting import BLUE, VERMILLION, label_axes, new_figure


@register_dataclass
@dataclass(frozen=True)
class PenaltyOnly(Identity):
    """M = I, and multipliers that stay where they are: the flow minimizes c + mu/2 |h|^2."""

    def direction(
        self, problem: Problem, model: Model, key: Array | None, memory: object
    ) -> Direction:
        """That of `Identity`, the multipliers' rate 0."""
        to = super().direction(problem, model, key, memory)
        return replace(to, multipliers=jax.tree.map(jnp.zeros_like, to.multipliers))


def make(
    chains: int = 32,
    iterations: int | None = None,
    penalties: Sequence[float] = (1.0, 10.0, 100.0),
) -> tuple[Numbers, Figure]:
    """The median of the chains at the end, for every penalty mu, with multipliers and without.

    There are `chains` of each, and 20,000 iterations by default.
    """
    problem = tasks.load("pendulum").make()
    flow = settings.pendulum_flows(iterations)["paper's flow"]
    stops = np.unique(np.linspace(0, int(flow.iterations), 21).round().astype(int))
    kinds: dict[str, Metric] = {"with multipliers": Identity(), "without": PenaltyOnly()}
    rows = []
    for mu in penalties:
        for name, metric in kinds.items():
            tell(f"multipliers: μ = {mu:g}, {name}")
            own = replace(flow, preconditioner=metric)
            *_, row = followed(own, problem, mu, chains, stops)
            rows.append({"mu": mu, "multipliers": name, **row})
    figure = new_figure(5.4, 3.6)
    axes = figure.subplots()
    for name, color, marker in zip(kinds, (BLUE, VERMILLION), "o^", strict=True):
        medians = [row["median |h|²"] for row in rows if row["multipliers"] == name]
        axes.loglog(penalties, medians, f"{marker}-", color=color, label=name)
    label_axes(axes, "penalty μ", "median |h|² at the end")
    title = f"Paper's flow, pendulum, {int(flow.iterations):,} iterations"
    axes.set_title(title, loc="left", fontsize=9)
    axes.legend(fontsize=8)
    return {"rows": rows, "settings": {"paper's flow": flow}}, figure
