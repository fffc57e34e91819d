"""How large the costs of a problem are, measured on initial knots, free of units and constants.

Costs are measured from their floor: the least that running and terminal cost were seen to be, at
initial knots z and after a step d of each knot by itself, whatever the dynamics say:

    d = -H^{-1} g, each entry at most `REACH` widths of the box that initial knots are drawn from

with the cost's gradient g and Gauss-Newton Hessian H. A constant that is added to a cost is added
to its floor too. The scale of costs is that of answers, not of knots:

    scale = SHARE R + min(SHARE T, max(EFFORT E, SHARE R))

R and T are medians of the running and of the terminal cost above their floors, and E is the median
of what the running cost loses by a step d of controls alone, from controls as far from the middle
of their box as its root mean square. (Initial controls will not do: about half of the chains have
them close to the middle, so that their median is a toss-up.) With a heavy terminal weight answers
cost what the way to the goal does, so beyond some weight T no longer counts. Where nothing is
polished it counts in full: there the penalty alone holds the dynamics against the terminal cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels import linalg
from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.pruning import pruned
from mjx_drax.method.langevin import Langevin
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Knot, Trajectory
from mjx_drax.search.iterate import Question, by_row, identity_of_rows, partition

SHARE = 1 / 300
"""The scale of costs, as a share of the median cost of the initial knots."""

EFFORT = 2.0
"""Times what random controls cost: the scale of answers where terminal weights are heavy."""

REACH = 3.0
"""Longest step of a knot, in widths of the box of initial knots."""


@register_dataclass
@dataclass(frozen=True)
class Sizes:
    """Costs of one chain's initial knots, scalars.

    Attributes:
        running, terminal: sum_k l(x_k, u_k) and phi(x_K).
        least_running: K times the least l that was seen.
        least_terminal: the least phi that was seen, at any knot.
        effort: what sum_k l(x_k, u_k) loses as controls alone take a step.
    """

    running: Array
    terminal: Array
    least_running: Array
    least_terminal: Array
    effort: Array


@partial(compiled, key=identity_of_rows)
@linalg.full_precision
def sizes_of(own: Question, shared: Question, knots: Trajectory) -> Sizes:
    """The sizes of every chain, (rows,), at knots (rows, K, ...)."""

    def measured(q: Question, knots: Trajectory) -> Sizes:
        return _sizes(q.problem, knots, q.flow.preconditioner.derivatives or Autodiff())

    sizes: Sizes = by_row(shared, own, measured, knots)
    return sizes


def _sizes(problem: Problem, knots: Trajectory, by: Any) -> Sizes:
    """The sizes of one chain."""
    dynamics = problem.dynamics
    ndx, by, last = dynamics.ndx, dynamics.differentiator(by), problem.end
    reach_x, reach_u = (REACH * of for of in problem.widths)
    reach = jnp.concatenate([reach_x, reach_u])

    def stage(x: Array, u: Array, knot: Knot, key: Array) -> tuple[Array, Array, Array]:
        here = problem.at(knot)

        def at(dz: Array) -> tuple[Any, ...]:
            return here.seen(dynamics.integrate(x, dz[:ndx]), u + dz[ndx:])

        g, H = here.running.expand(at, len(reach), by, key)
        of_controls = jnp.zeros_like(g).at[ndx:].set(_step(g[ndx:], H[ndx:, ndx:], reach_u))
        steps = jnp.stack([jnp.zeros_like(g), _step(g, H, reach), of_controls])
        now, moved, steered = jax.vmap(pruned(lambda dz: here.running(*at(dz))))(steps)
        return now, jnp.fmin(now, moved), now - steered

    def end(x: Array, key: Array) -> tuple[Array, Array]:
        def at(dx: Array) -> tuple[Any, ...]:
            return last.seen(dynamics.integrate(x, dx))

        step = _step(*last.terminal.expand(at, ndx, by, key), reach_x)
        steps = jnp.stack([jnp.zeros_like(step), step])
        now, moved = jax.vmap(pruned(lambda dx: last.terminal(*at(dx))))(steps)
        return now, jnp.fmin(now, moved)

    keys = jax.random.split(jax.random.key(0), problem.horizon)
    x, u, at_knot = problem.stages(knots)
    of_both = jax.vmap(lambda u: jax.vmap(stage)(x, u, at_knot, keys))
    running, least, effort = of_both(jnp.stack([u, _wide(problem)]))
    terminal, least_end = jax.vmap(end)(knots.x, keys)
    return Sizes(
        jnp.sum(running[0]),
        terminal[-1],
        problem.horizon * jnp.nanmin(least),
        jnp.nanmin(least_end),
        jnp.sum(jnp.maximum(effort[1], 0.0)),
    )


def _wide(problem: Problem) -> Array:
    """Controls (K, nu) as far from the middle of their box as its root mean square."""
    box, shape = problem.scatter, (problem.horizon, problem.dynamics.nu)
    side = jax.random.rademacher(jax.random.key(0), shape, problem.x_init.dtype)
    u = 0.5 * (box.u_lower + box.u_upper) + side * (box.u_upper - box.u_lower) / np.sqrt(12.0)
    return jnp.where(jnp.isfinite(u), u, 0.0)


def _step(g: Array, H: Array, reach: Array) -> Array:
    """-H^{-1} g (n,), each entry within its reach (n,); for g (n,) and semidefinite H (n, n)."""
    g, H = reach * g, reach[:, None] * H * reach
    largest = jnp.max(jnp.diag(H), initial=0.0)
    ridge = jnp.where(largest > 0.0, 1e-6 * largest, jnp.max(jnp.abs(g), initial=0.0))
    ridge = jnp.where(ridge > 0.0, ridge, 1.0)
    d = -linalg.solve(linalg.cholesky(H + ridge * jnp.eye(len(g))), g)
    return reach * jnp.clip(jnp.where(jnp.isfinite(d), d, 0.0), -1.0, 1.0)


def scale_at(problem: Problem, flow: Langevin, knots: Trajectory) -> float:
    """The scale of costs at knots (chains, K, ...) of one problem, for a flow with its tail."""
    shared, own = partition(Question(flow, problem), None)
    return float(scale_and_floor(sizes_of(own, shared, knots), polished=False)[0])


def scale_and_floor(sizes: Sizes, polished: bool) -> tuple[np.ndarray, np.ndarray]:
    """The scales of costs of problems, (...,), and the floors of their costs, from (..., chains).

    Without a polish it is the penalty that holds the dynamics against the terminal cost: there T
    counts in full.
    """
    of_running, of_end = _least(sizes.least_running), _least(sizes.least_terminal)
    R = SHARE * median(np.asarray(sizes.running, float) - of_running[..., None])
    T = SHARE * median(np.asarray(sizes.terminal, float) - of_end[..., None])
    E = EFFORT * median(sizes.effort)
    limit = np.maximum(E, R)
    scale = R + (np.where(limit > 0.0, np.minimum(T, limit), T) if polished else T)
    return np.where(scale == 0.0, 1.0, scale), of_running + of_end


def _least(values: Any) -> np.ndarray:
    """The least of finite values (..., n), (...,); 0 if there is none."""
    values = np.asarray(values, float)
    least = np.where(np.isfinite(values), values, np.inf).min(axis=-1)
    return np.where(np.isfinite(least), least, 0.0)


def median(values: Any) -> np.ndarray:
    """Median of the absolute values of finite numbers (..., n), (...,); 0 if there is none."""
    finite = np.ma.masked_invalid(np.abs(np.asarray(values, float)))
    return np.ma.filled(np.ma.median(finite, axis=-1), 0.0)
