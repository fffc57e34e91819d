"""First without the ends of actuators' forces, then with them.

Beyond those ends f has no slope, and no noise brings the controls of all knots back. So a problem
whose controls can be there is solved in steps, by one program that gets other numbers:

    at first    actuators give any force, and constraints keep forces within their ranges where
                knots begin: f is smooth, and the true system can mostly do what is found
    from there  with the true ranges, a polish and rollouts; constraints keep controls from where
                they are of no use, by a generous estimate
    anew        the same from random knots or the guess, with all attempts, if no chain of the first
                step is sound, or if the second gained much: forces at their ends then matter
    as given    from there without these constraints, by a program of its own, only if one bears a
                force in a chain that seems to be optimal, as where the cost rewards such controls

Answers are those of the problem as given, without these constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.method.langevin import State
from mjx_drax.method.model import Multipliers
from mjx_drax.polish.interior_point import Polish
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory
from mjx_drax.search.chains import Chains, best_of
from mjx_drax.search.engine import Found, Search
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.restarts import Restarts, Rollouts
from mjx_drax.search.units import CONSTRAINTS, to_units
from mjx_drax.search.warm import Warm

MUCH = 0.1
"""Share of the cost that shows that forces at their ends matter."""

Searched = Callable[[Problem, Restarts, Warm | None], tuple[Search, Found]]
"""Runs a search for a problem, with settings, from the guess given to `solve` or from these chains.
"""


class Both(NamedTuple):
    """The problems of the steps, and how many constraints of a stage each has besides.

    `held` is that of `Unlimited`.
    """

    first: Problem
    then: Problem
    rows: int
    held: Callable[[np.ndarray, np.ndarray], np.ndarray]


def both_of(problem: Problem) -> Both | None:
    """What is solved in place of the problem; None if no force is in its way."""
    unlimited = problem.dynamics.unlimited()
    if unlimited is None or not problem.holds_beyond(unlimited.useful):
        return None
    first, then = (
        replace(problem, constraint=problem.constraint.with_inequality(ends, unlimited.rows))
        for ends in (unlimited.at_once, unlimited.all_along)
    )
    first = replace(first, dynamics=unlimited.dynamics)
    return Both(first, then, unlimited.rows, unlimited.held)


def is_motion(problem: Problem, guess: Trajectory | Warm | None, chains: int) -> bool:
    """Whether a guess is a solution, or obeys the dynamics for any chain: none may end worse."""
    if guess is None or isinstance(guess, Warm):
        return guess is not None
    knots = initial_knots(problem, chains, guess, jax.random.key(0))
    plans = np.asarray(problem.with_start(knots))
    off = problem.engine_defects(plans, np.asarray(knots.u))
    allowed = [FEASIBLE * np.asarray(problem.defect_unit(plan)) for plan in plans]
    return bool((off <= np.array(allowed)[:, None]).all(axis=(1, 2)).any())


def found_in_steps(
    problem: Problem, both: Both, settings: Restarts, searched: Searched
) -> tuple[Problem, Found]:
    """What the steps come to: the problem, in units of its constraints, and what was found."""
    assert settings.polish is not None  # for the type checker
    short = replace(settings, attempts=1, polish=replace(settings.polish, patience=1))
    search, found = searched(both.first, without_rollouts(settings), None)
    every, least, chains = [found], _least(found), None
    gains_much = True
    if np.isfinite(least):
        warm = _wider(both, _in_users_units(search.family.problem, found.chains))
        search, found = searched(both.then, short, warm)
        chains = _after(every, found)
        floor = float(search.stage.floor[0])
        gains_much = _least(found) - floor < (1.0 - MUCH) * (least - floor)
    if chains is None or (gains_much and not found.interrupted):
        before = search.family.problem
        search, found = searched(both.then, settings, None)
        anew = _after(every, found)
        if chains is None:
            chains = anew
        else:
            chains = _in_units_of(search.family.problem, before, chains)
            floors = np.full(len(anew.missed), search.stage.floor[0])
            chains = best_of(chains, anew, np.arange(len(floors)), floors)
    solved = search.family.problem
    given, state = _as_given(problem, solved, chains.state)
    if not found.interrupted and _bear(both, solved, chains, settings.polish).any():
        warm = _in_users_units(given, replace(chains, state=state))
        search, found = searched(problem, short, warm)
        return search.family.problem, _joined(every, _after(every, found))
    return given, _joined(every, replace(chains, state=state))


def without_rollouts(settings: Restarts) -> Restarts:
    """The same settings, for systems that nobody has: their replays would tell nothing."""
    return replace(settings, rollouts=Rollouts(first=0, rounds=0))


def _bear(both: Both, solved: Problem, chains: Chains, polish: Polish) -> np.ndarray:
    """Which chains that seem optimal lean on a constraint of a step, (chains,).

    Its multiplier times the room between both ends is then more than the tolerance of the cost.
    """
    users, n = _in_users_units(solved, chains), both.rows // 2
    assert users.knots.slack is not None  # for the type checker
    force, slack = (
        np.asarray(numbers.stage)[..., -both.rows :]
        for numbers in (users.multipliers.constraints, users.knots.slack)
    )
    room = np.tile(slack[..., :n] + slack[..., n:], 2)
    worth = (force * room).max(axis=(1, 2)) / np.asarray(chains.state.polish.cost)
    return chains.optimal & (worth > np.asarray(polish.tolerance))


def _least(found: Found) -> float:
    """The lowest cost of a chain that is feasible, and does not miss the goal."""
    return float(found.chains.sound_cost.min())


def _after(every: list[Found], found: Found) -> Chains:
    """The chains of a search, feasible since so many iterations of all; it is put to the others."""
    before, since = sum(each.records[-1][0] for each in every), found.chains.feasible_since
    every.append(found)
    return replace(found.chains, feasible_since=np.where(since < 0, since, before + since))


def _joined(every: list[Found], chains: Chains) -> Found:
    """All searches, one after the other, with these chains."""
    records, began, before = [], [], 0
    for found in every:
        records += [(before + n, info) for n, info in found.records]
        began += [(before + a, before + b) for a, b in found.began]
        before = records[-1][0]
    last = every[-1]
    return replace(last, chains=chains, records=records, began=began, flow=every[0].flow)


def _in_users_units(problem: Problem, chains: Chains) -> Warm:
    """Chains of a problem that measures constraints in units, in those of a user."""
    state = chains.state
    knots, multipliers = to_units(problem, state.trajectory, state.multipliers, back=True)
    return Warm(knots, multipliers, state.gains)


def _in_units_of(problem: Problem, before: Problem, chains: Chains) -> Chains:
    """Chains in the units of this problem, not in those of the one before."""
    users = _in_users_units(before, chains)
    knots, multipliers = to_units(problem, users.knots, users.multipliers)
    state = replace(chains.state, trajectory=knots, multipliers=multipliers)
    return replace(chains, state=state)


def _wider(both: Both, warm: Warm) -> Warm:
    """Chains of the first step for the next one, whose constraints leave more room.

    Slacks grow by that, and forces on them are what balances the barrier there.
    """
    knots, multipliers = warm.knots, warm.multipliers
    own, rows = knots.slack, slice(-both.rows, None)
    assert own is not None  # for the type checker, as below
    assert multipliers.bounds is not None
    lower, upper = multipliers.bounds
    wide = jax.vmap(both.then.inequalities)(knots)
    assert lower.slack is not None
    assert wide is not None
    slack = jnp.maximum(-wide.stage, own.stage)[..., rows]
    force = (lower.slack.stage * own.stage)[..., rows] / slack

    def with_rows(numbers: Stagewise, new: Array) -> Stagewise:
        return replace(numbers, stage=numbers.stage.at[..., rows].set(new))

    of_bounds = replace(lower, slack=with_rows(lower.slack, force)), upper
    of_rows = with_rows(multipliers.constraints, force)
    return Warm(
        replace(knots, slack=with_rows(own, slack)),
        replace(multipliers, constraints=of_rows, bounds=of_bounds),
        warm.gains,
    )


def _as_given(problem: Problem, solved: Problem, state: State) -> tuple[Problem, State]:
    """The problem in units of its own constraints, and the states (rows, ...) of its chains."""
    given = {}
    for name in CONSTRAINTS:
        own, unit = getattr(problem, name), getattr(solved, name).unit
        given[name] = replace(own, unit=None if unit is None else unit[: own.rows])
    stage, end = problem.constraint, problem.terminal_constraint

    def own_slack(slack: Any) -> Stagewise | None:
        if stage.inequalities + end.inequalities == 0:
            return None
        return replace(slack, stage=slack.stage[..., : stage.inequalities])

    def without(z: Trajectory) -> Trajectory:
        return replace(z, slack=own_slack(z.slack))

    forces, bounds = state.multipliers.constraints, state.multipliers.bounds
    multipliers = Multipliers(
        state.multipliers.dynamics,
        replace(forces, stage=forces.stage[..., : stage.rows]),
        None if bounds is None else (without(bounds[0]), without(bounds[1])),
    )
    states = replace(state, trajectory=without(state.trajectory), multipliers=multipliers)
    return replace(problem, **given), states
