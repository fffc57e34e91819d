"""Boxes of initial knots that fit the motions that are found: narrower ones, or wider ones.

By default initial knots are drawn between the bounds, and a coordinate that hardly moves counts as
a hundredth of that box: in the residual, and in what constraints are allowed. Bounds of 1e6, which
are to say that there are none, would so make anything feasible and optimal. No bound is too wide by
itself, as units are the user's; a motion that is found tells. Where there are no bounds, it also
tells that the default box is too small: defects are measured by that, and what is a thousand times
as far away would need more digits than numbers have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mjx_drax.polish.residual import REST
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import FEASIBLE, evaluate

AROUND, LEAST = 10.0, 1e-3
"""The new box reaches so many times as far as the motion, and at least this share of the old one:
what stands still says nothing of how far it could have moved."""

BOXES = 3
"""So many times at most."""

NARROWER, WIDER = "narrower", "wider"

Found = TypeVar("Found")


@dataclass(frozen=True)
class Answer(Generic[Found]):
    """What a solve came to.

    Attributes:
        found: all of it.
        problem: with units of constraints that go with its box of initial knots.
        x: planned states x_0..x_K of the best chain, (K + 1, nx).
        knots: of that.
        cost: of that; infinite if it is not feasible, or not certified.
        last: whether no other solve may follow.
    """

    found: Found
    problem: Problem
    x: np.ndarray
    knots: Trajectory
    cost: float
    last: bool


def in_a_fitting_box(
    problem: Problem,
    solved: Callable[[Problem], Answer[Found]],
    told: Callable[[Problem, np.ndarray, str], None],
    tolerance: float,
) -> Found:
    """What `solved` finds, again and again in a box that fits better as long as that helps.

    Args:
        problem: as given.
        solved: solves it, with this or another box.
        told: called with the problem, the entries (nx + nu,) that got other sides, if any, and
            NARROWER or WIDER.
        tolerance: on the residual; what is cheaper by this share shows that what it replaces is
            no optimum.
    """
    given, answer = problem, solved(problem)
    nothing = np.zeros(problem.dynamics.nx + problem.dynamics.nu, bool)
    others = {NARROWER: nothing, WIDER: nothing}
    for _ in range(BOXES):
        if answer.last:
            break
        how, fitting = NARROWER, narrowed(given, problem, answer.x, answer.knots.u)
        if fitting is None and not np.isfinite(answer.cost):
            how, fitting = WIDER, widened(problem, answer.x, answer.knots.u)
        if fitting is None:
            break
        problem, which = fitting
        other = solved(problem)
        if not is_better(other.problem, answer.knots, answer.cost, other.cost, tolerance):
            break
        answer, others[how] = other, others[how] | which
    for how, which in others.items():
        if which.any():
            told(given, which, how)
    return answer.found


def narrowed(
    given: Problem, problem: Problem, x: np.ndarray, u: ArrayLike
) -> tuple[Problem, np.ndarray] | None:
    """The problem with a box of initial knots that fits a motion; None if its own does.

    It does if any bounded state, and any bounded control, uses a hundredth of the room: others may
    hardly be needed. A side that was given, and is not that of the bounds, stays; so do bounds of
    single knots.

    Args:
        given: by the user.
        problem: the same, whose box may be narrower by now. Where f has kinks it stays: nothing is
            optimal there, and much of a robot stands still.
        x, u: states x_0..x_K (K + 1, nx) and controls (K, nu).

    Returns:
        It, and which entries of [x, u] have other sides, (nx + nu,).
    """
    if problem.dynamics.kinked:
        return None
    controls = np.asarray(u)
    sides: dict[str, Any] = {}
    which = []
    for name, moves, about in (("x", x, x[0]), ("u", controls, np.zeros(controls.shape[1]))):
        ends = f"{name}_lower", f"{name}_upper"
        bounds, first, box = (
            [np.asarray(getattr(of, end)) for end in ends]
            for of in (given.bounds, given.scatter, problem.scatter)
        )
        if any(side.ndim != 1 for side in (*bounds, *box)):
            which.append(np.zeros(len(about), bool))
            continue
        extent, width = np.abs(moves - about).max(axis=0, initial=0.0), box[1] - box[0]
        bounded = np.isfinite(bounds).all(axis=0) & np.equal(bounds, first).all(axis=0)
        wide = bounded & (extent < REST * width)
        wide &= (wide == bounded).all()
        reach = np.where(wide, np.maximum(AROUND * extent, LEAST * width), 0.0)
        for end, side, new in zip(ends, box, (about - reach, about + reach), strict=True):
            sides[end] = jnp.asarray(np.where(wide, np.clip(new, *box), side), side.dtype)
        which.append(wide)
    changed = np.concatenate(which)
    if not changed.any():
        return None
    return replace(problem, scatter=replace(problem.scatter, **sides)), changed


def widened(problem: Problem, x: np.ndarray, u: ArrayLike) -> tuple[Problem, np.ndarray] | None:
    """The problem with a box of initial knots that holds a motion which broke what must hold.

    None if that motion goes nowhere beyond AROUND times the box where no bound is. Knots of 1e6
    that must not be off by a thousandth of a box of +-1 would need more digits than float32 has.

    Args and what is returned are those of `narrowed`.
    """
    if problem.dynamics.kinked:
        return None
    controls = np.asarray(u)
    sides: dict[str, Any] = {}
    which = []
    for name, moves, about in (("x", x, x[0]), ("u", controls, np.zeros(controls.shape[1]))):
        ends, both = (f"{name}_lower", f"{name}_upper"), (problem.bounds, problem.scatter)
        bounds, box = ([np.asarray(getattr(of, end)) for end in ends] for of in both)
        extent = np.abs(moves - about).max(axis=0, initial=0.0)
        far = np.isinf(bounds).all(axis=0) & np.isfinite(extent)
        far &= extent > AROUND * (box[1] - box[0])
        for end, side, new in zip(ends, box, (about - 2 * extent, about + 2 * extent), strict=True):
            sides[end] = jnp.asarray(np.where(far, new, side), side.dtype)
        which.append(far)
    changed = np.concatenate(which)
    if not changed.any():
        return None
    return replace(problem, scatter=replace(problem.scatter, **sides)), changed


def is_better(
    problem: Problem, knots: Trajectory, cost: float, found: float, tolerance: float
) -> bool:
    """Whether what was found in the narrower box takes the place of what was known.

    Args:
        problem: with the narrower box, and units of constraints that go with it.
        knots: of the best chain that was known, (K, ...).
        cost: of that; infinite if it is not feasible.
        found: the same of the best chain in the narrower box.
        tolerance: share of the cost by which it must be cheaper.
    """
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], replace(knots, slack=None))
    feasible = float(evaluate(problem, one).max_defect[0]) < FEASIBLE
    if not feasible and np.isfinite(cost):
        return True  # it was feasible in the units of the wide box alone
    return found < cost - tolerance * abs(cost) if np.isfinite(cost) else bool(np.isfinite(found))
