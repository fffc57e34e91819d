"""Scaling of constraints: what a solve measures each row in, so that its unit matters little.

The noise's penalty mu |h|^2 adds constraints to defects that are measured in parts of a box, and a
plan is feasible if both are below one number. So a row that changes by c where a knot moves by such
a part, in every coordinate of states and controls at once, is measured in c over what is usual:

    unit = c / clip(c, *USUAL)

in powers of two, which round nothing. c is the root mean square over random signs of the moves and
over initial knots, and the largest of all knots: a constraint may hold at one of them only. Rows
within what is usual keep their units. Multipliers of a row in units are `unit` times the user's,
and its slack is 1 / unit of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.method.model import Multipliers
from mjx_drax.problem.problem import PARTS, Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory
from mjx_drax.search.identity import identity

USUAL = (0.03, 1.0)
"""Changes of rows that are left as they are: those of this project's tasks are 0.05 to 1."""

CONSTRAINTS = ("constraint", "terminal_constraint")
"""The attributes of a problem that have units."""

CHAINS, MOVES = 16, 4
"""How many chains' initial knots are moved, and how often each."""


def units_of(problem: Problem, knots: Trajectory) -> Stagewise | None:
    """Units of the constraints at a stage (m,) and at the end (m_end,); None if all are 1.

    Args:
        problem: whose constraints.
        knots: initial ones, (chains, K, ...).
    """
    if not problem.constraint.rows + problem.terminal_constraint.rows:
        return None
    few = jax.tree.map(lambda a: a[:CHAINS], replace(knots, slack=None))
    changes = _changes(with_units(problem, None), few)
    units = jax.tree.map(lambda c: _unit(np.asarray(c)), changes)
    if all((unit == 1.0).all() for unit in jax.tree.leaves(units)):
        return None
    found: Stagewise = jax.tree.map(partial(jnp.asarray, dtype=problem.x_init.dtype), units)
    return found


def _unit(change: np.ndarray) -> np.ndarray:
    """The units of rows that change by so much, (m,); 1 for those that do not."""
    change = np.where(np.isfinite(change) & (change > 0.0), change.astype(float), 1.0)
    return 2.0 ** np.round(np.log2(change / np.clip(change, *USUAL)))


@partial(compiled, key=lambda problem, knots: identity((problem, knots), problem))
@full_precision
def _changes(problem: Problem, knots: Trajectory) -> Stagewise:
    """The change c of every row of the constraints, (m,) and (m_end,)."""
    parts = [jnp.where(width > 0.0, width / PARTS, 1.0) for width in problem.widths]

    def of_move(knots: Trajectory, key: Array) -> Stagewise:
        still, keys = problem.no_change(knots), jax.random.split(key)
        x, u = (
            jax.random.rademacher(key, z.shape, z.dtype) * part
            for key, z, part in zip(keys, (still.x, still.u), parts, strict=True)
        )

        def moved(share: Array) -> Stagewise:
            change = replace(still, x=share * x, u=share * u)
            return problem.constraints(problem.displaced(knots, change))

        changes: Stagewise = jax.jvp(moved, (jnp.zeros(()),), (jnp.ones(()),))[1]
        return changes

    keys = jax.random.split(jax.random.key(0), (len(knots.u), MOVES))
    found = jax.vmap(jax.vmap(of_move, (None, 0)))(knots, keys)

    def root_mean_square(changes: Array) -> Array:
        finite = jnp.where(jnp.isfinite(changes), jnp.square(changes), jnp.nan)
        return jnp.sqrt(jnp.nanmean(finite, axis=(0, 1)))

    of_knots = root_mean_square(found.stage)
    return Stagewise(jnp.nanmax(of_knots, axis=0), root_mean_square(found.terminal))


def with_units(problem: Problem, units: Stagewise | None) -> Problem:
    """The problem with its constraints measured in these units."""
    both = (None, None) if units is None else (units.stage, units.terminal)
    return replace(
        problem,
        **{
            name: replace(getattr(problem, name), unit=unit)
            for name, unit in zip(CONSTRAINTS, both, strict=True)
        },
    )


def to_units(
    problem: Problem, knots: Trajectory, multipliers: Multipliers, back: bool = False
) -> tuple[Trajectory, Multipliers]:
    """Knots and multipliers (rows, ...) of a problem's user in the units of its constraints.

    Args:
        problem: with the units.
        knots: with slacks, if there are any.
        multipliers: of constraints, and of bounds if they are known.
        back: the other way round.
    """
    parts = problem.constraint, problem.terminal_constraint
    stage, end = (part.unit for part in parts)
    if stage is None or end is None:
        return knots, multipliers
    power = -1 if back else 1
    of_rows = Stagewise(stage**power, end**power)
    of_slacks = Stagewise(
        of_rows.stage[parts[0].equalities :], of_rows.terminal[parts[1].equalities :]
    )

    def with_slack(z: Trajectory, by: Callable[[Array, Array], Array]) -> Trajectory:
        return z if z.slack is None else replace(z, slack=jax.tree.map(by, z.slack, of_slacks))

    of_constraints = jax.tree.map(jnp.multiply, multipliers.constraints, of_rows)
    bounds = multipliers.bounds
    if bounds is not None:
        bounds = with_slack(bounds[0], jnp.multiply), with_slack(bounds[1], jnp.multiply)
    forces = Multipliers(multipliers.dynamics, of_constraints, bounds)
    return with_slack(knots, jnp.divide), forces
