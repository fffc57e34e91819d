"""How far a chain is from a local optimum: the scaled residual of the KKT system, free of units.

With the Lagrangian L = c + lambda'h - v_l'(z - z_L) - v_u'(z_U - z), a local optimum has

    stationarity        dL/dz = 0         each coordinate relative to the largest sum, over the
                                          motion, of the absolute values of the terms in it
    defects             h = 0             relative to how far each coordinate of the state moves
    constraints         r = 0             relative to what a row changes by as everything moves
    complementarity     v slack = 0       summed over all bounds, relative to the cost
    price               lambda'h = 0      relative to PRICED times the cost, of which this is what
                                          is amiss, to first order, for what is left of h

and the residual is the largest of the five. How far a coordinate moves is measured from x_init, and
from 0 for controls; it counts as at least a hundredth of the box that initial knots are drawn from,
or 0.01 where that has no width. The cost is measured by what its slope promises over the motion,
sum |dc/du| |u| and a share of sum |dc/dx| |x|. So neither units nor constants that are added to it
change the residual. Where the cost has neither slope nor curvature, as one that is constant,
lambda = 0 and v = 0 are right, whatever they are here: every motion that breaks nothing is an
optimum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.bounds import Sides
from mjx_drax.method.model import Derivatives, Model, slope_of
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

CURVED = 1e-2
"""Share of curvature times motion that a term counts as at least: at a perfect fit all vanish."""

FIT = 1e-5
"""The same where it is compared with terms of other coordinates: a heavy terminal weight has much
curvature, and must not hide the slopes of controls."""

STILL = 1e-3
"""Share of the largest term below which the scale of others does not fall."""

STATES = 0.05
"""Share of the states' slopes in the cost's size: where terminal weights are large, they promise
many times what the cost is."""

PRICED = 3.0
"""So many times as large as other parts the price may be: float32 can often not get nearer."""

REST = 1e-2
"""Share of the box of initial knots that a coordinate moves by at least."""


@register_dataclass
@dataclass(frozen=True)
class Scales:
    """Sizes of what a motion is made of.

    Attributes:
        x, u: how far each coordinate moves, (ndx,) and (nu,).
        terms: the largest sum of terms of dL/dz, times how far the coordinate moves: a cost.
        cost: sum |dc/du| |u| + STATES sum |dc/dx| |x| over the motion.
    """

    x: Array
    u: Array
    terms: Array
    cost: Array


@register_dataclass
@dataclass(frozen=True)
class Residual:
    """The five parts, scalars, and what the barrier is held against.

    Attributes:
        stationarity, defects, constraints, complementarity, price: relative.
        error: the largest slope and defect as costs, for the barrier's weight.
    """

    stationarity: Array
    defects: Array
    constraints: Array
    complementarity: Array
    price: Array
    error: Array

    @property
    def others(self) -> Array:
        """The largest of all but complementarity."""
        return jnp.maximum(self.stationarity, jnp.maximum(self.defects, self.constraints))

    @property
    def total(self) -> Array:
        """The largest of the five; infinite where one is not a number."""
        largest = jnp.maximum(jnp.maximum(self.others, self.complementarity), self.price)
        return jnp.where(jnp.isnan(largest), jnp.inf, largest)


def residual_of(problem: Problem, model: Model, v: Sides) -> tuple[Residual, Scales]:
    """The residual at a model's knots and multipliers, with multipliers v of the bounds."""
    derivatives, multipliers = model.derivatives, model.multipliers
    assert derivatives is not None  # for the type checker
    knots, tangent = model.trajectory, problem.dynamics.tangent
    below, above = (replace(side, x=tangent(side.x)) for side in v)
    slope = slope_of(derivatives, multipliers, knots, model.start)
    absolute = jax.tree.map(jnp.abs, replace(multipliers, bounds=None))
    dual = jax.tree.map(lambda g, a, b: g - a + b, slope, below, above)
    sizes = slope_of(jax.tree.map(jnp.abs, derivatives), absolute, knots, model.start, 1.0)
    sizes = jax.tree.map(lambda s, a, b: s + a + b, sizes, below, above)

    offset, (of_x, of_u) = jax.vmap(problem.dynamics.difference, (0, None)), problem.widths
    x, u = _moves(of_x, offset(knots.x, problem.x_init)), _moves(of_u, knots.u)
    tiny = jnp.finfo(u.dtype).tiny
    curved = [
        jnp.abs(jnp.einsum("kii->ki", H)) for H in (derivatives.cost.Hxx, derivatives.cost.Huu)
    ]
    parts = [
        (part.max(axis=0, initial=0.0), H.max(axis=0, initial=0.0) * moves, moves)
        for part, H, moves in zip((sizes.x, sizes.u), curved, (x, u), strict=True)
    ]
    peaks = [jnp.maximum(peak, CURVED * bend) for peak, bend, _ in parts]
    terms = tiny + jnp.max(
        jnp.stack([(jnp.maximum(p, FIT * b) * moves).max(initial=0.0) for p, b, moves in parts])
    )
    gradient = derivatives.cost
    flat = is_flat(derivatives)
    of_x, of_u = jnp.sum(jnp.abs(gradient.gx[1:]) * x), jnp.sum(jnp.abs(gradient.gu) * u)
    cost = STILL * terms + STATES * of_x + of_u
    scales = Scales(x, u, terms, cost)

    def relative(g: Array, peak: Array, extent: Array) -> Array:
        share = jnp.abs(g).max(axis=0, initial=0.0) / jnp.maximum(peak, STILL * terms / extent)
        return share.max(initial=0.0)

    stationarity = jnp.maximum(relative(dual.x, peaks[0], x), relative(dual.u, peaks[1], u))
    defects = (jnp.abs(model.h.dynamics) / x).max(initial=0.0)
    rows, rows_end = row_scales(derivatives, scales, knots)
    r = model.h.constraints
    of_stage, of_end = jnp.abs(r.stage) / (rows + tiny), jnp.abs(r.terminal) / (rows_end + tiny)
    gap = sum(jnp.sum(part) for part in jax.tree.leaves(products(problem, knots, v)))
    prices = [model.h.dynamics * multipliers.dynamics]
    prices += jax.tree.leaves(jax.tree.map(jnp.multiply, r, multipliers.constraints))
    forces = jnp.max(jnp.stack([jnp.abs(part).max(initial=0.0) for part in prices]))
    price = jnp.abs(sum(jnp.sum(part) for part in prices)) / (PRICED * cost)
    slopes = (jnp.abs(dual.x) * x).max(initial=0.0), (jnp.abs(dual.u) * u).max(initial=0.0)
    error = jnp.maximum(forces, jnp.maximum(*slopes))
    if model.start is not None:
        extent, peak = (moves_of_start(model.start, z) for z in (x, peaks[0]))
        stationarity = jnp.maximum(stationarity, relative(dual.start[None], peak, extent))
        error = jnp.maximum(error, (jnp.abs(dual.start) * extent).max())
    if knots.slack is not None:
        pairs = zip(jax.tree.leaves(dual.slack), jax.tree.leaves(knots.slack), strict=True)
        of_slack = jnp.max(jnp.stack([jnp.abs(g * s).max(initial=0.0) for g, s in pairs]))
        error = jnp.maximum(error, of_slack)
        stationarity = jnp.maximum(stationarity, of_slack / (terms + of_slack))
    return Residual(
        jnp.where(flat, 0.0, stationarity),
        defects,
        jnp.maximum(of_stage.max(initial=0.0), of_end.max(initial=0.0)),
        jnp.where(flat, 0.0, gap / cost),
        jnp.where(flat, 0.0, price),
        error,
    ), scales


def is_flat(derivatives: Derivatives) -> Array:
    """Whether the cost has no slope and no curvature anywhere along the motion."""
    parts = [(part != 0.0).any() for part in jax.tree.leaves(derivatives.cost)]
    return ~jnp.stack(parts).any()


def moves_of_start(E: Array, x: Array) -> Array:
    """How far the free coordinates of x_0 move, (n0,), given how far those of states do (ndx,)."""
    return jnp.max(jnp.asarray(E).T * x, axis=1)


def row_scales(derivatives: Derivatives, scales: Scales, knots: Trajectory) -> tuple[Array, Array]:
    """What rows of constraints change by as everything moves, and slacks: (m,) and (m_end,)."""
    both = jnp.concatenate([scales.x, scales.u])
    stage = (jnp.abs(derivatives.stage) @ both).max(axis=0, initial=0.0)
    end = jnp.abs(derivatives.terminal) @ scales.x
    if knots.slack is None:
        return stage, end
    of_stage, of_end = knots.slack.stage.max(axis=0, initial=0.0), knots.slack.terminal
    equalities = len(stage) - len(of_stage), len(end) - len(of_end)
    return (
        stage.at[equalities[0] :].max(of_stage),
        end.at[equalities[1] :].max(of_end),
    )


def products(problem: Problem, knots: Trajectory, v: Sides) -> Sides:
    """v slack of every bound, lower and upper; 0 where there is none."""
    slacks = slacks_of(problem, knots)
    return (
        jax.tree.map(lambda v, s: jnp.where(jnp.isinf(s), 0.0, v * s), v[0], slacks[0]),
        jax.tree.map(lambda v, s: jnp.where(jnp.isinf(s), 0.0, v * s), v[1], slacks[1]),
    )


def slacks_of(problem: Problem, knots: Trajectory) -> Sides:
    """Distances from the lower and the upper ends; infinite where there is none."""
    lower, upper = problem.plan_bounds.with_room().sides(knots)
    return jax.tree.map(jnp.subtract, knots, lower), jax.tree.map(jnp.subtract, upper, knots)


def _moves(width: Array, offsets: Array) -> Array:
    """How far each coordinate moves, given the width of the box of initial knots.

    Where it has none, as rotations, it is 1: a ball joint may not turn about one of its axes.
    """
    floor = REST * jnp.where(width > 0.0, width, 1.0)
    return jnp.maximum(jnp.abs(offsets).max(axis=0, initial=0.0), floor)
