"""Boxes of initial knots that fit the motions that are found: narrower ones, or wider ones.

By default initial knots are drawn between the bounds, and a coordinate that hardly moves counts as
a hundredth of that box: in the residual, and in what constraints are allowed. Bounds of 1e6, which
are to say that there are none, would so make anything feasible and optimal. No bound is too wide by
itself, as units are the user's; a motion that is found tells. Where there are no bounds, it also
tells that the default box is too small: defects are measured by that, and what is a thousand times
as far away would need more digits than numbers have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, TypeVar

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

PAID, NOTHING = 10.0, 1e-4
"""A motion that breaks PAID times as much as another one, and more than PAID times the share
NOTHING of what is allowed, has paid with that for a lower cost; of up to a half."""

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
        if not is_better(answer, other, tolerance):
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
    hardly be needed. Where no bound is, sides are narrower if no state, or no control, uses that. A
    side that was given between bounds, and is not theirs, stays; so do bounds of single knots.

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
    chosen = []
    for part in _parts(problem, x, u):
        first = np.stack([np.asarray(getattr(given.scatter, end)) for end in part.ends])
        width, extent = part.box[1] - part.box[0], part.extent
        bounded = np.isfinite(part.bounds).all(axis=0) & (part.bounds == first).all(axis=0)
        free, little = part.free, extent < REST * width
        wide = bounded & little
        wide &= (wide == bounded).all()
        if (little | ~(bounded | free)).all() and extent.any():
            wide |= free
        chosen.append((part, wide, np.maximum(AROUND * extent, LEAST * width)))
    return _with_reaches(problem, chosen)


def widened(problem: Problem, x: np.ndarray, u: ArrayLike) -> tuple[Problem, np.ndarray] | None:
    """The problem with a box of initial knots that holds a motion which broke what must hold.

    None if that motion goes nowhere beyond AROUND times the box where no bound is. Knots of 1e6
    that must not be off by a thousandth of a box of +-1 would need more digits than float32 has.

    Args and what is returned are those of `narrowed`.
    """
    if problem.dynamics.kinked:
        return None
    chosen = []
    for part in _parts(problem, x, u):
        width, extent = part.box[1] - part.box[0], part.extent
        far = part.free & (extent > AROUND * width) & np.isfinite(extent)
        chosen.append((part, far, 2.0 * extent))
    return _with_reaches(problem, chosen)


class Part(NamedTuple):
    """States or controls of a motion, n entries, and the sides of their boxes.

    Attributes:
        ends: attributes of boxes, the lower and the upper one.
        about: what they move about, (n,).
        extent: how far, (n,).
        bounds, box: (2, n).
        free: which have no bounds, (n,); further states, chosen for a whole motion, count as bound.
    """

    ends: tuple[str, str]
    about: np.ndarray
    extent: np.ndarray
    bounds: np.ndarray
    box: np.ndarray
    free: np.ndarray


def _parts(problem: Problem, x: np.ndarray, u: ArrayLike) -> Iterator[Part]:
    """States, which move about x_0, and controls, about 0; without those bounded knot by knot."""
    controls = np.asarray(u)
    for name, moves, about in (("x", x, x[0]), ("u", controls, np.zeros(controls.shape[1]))):
        ends = f"{name}_lower", f"{name}_upper"
        bounds, box = (
            [np.asarray(getattr(of, end)) for end in ends]
            for of in (problem.bounds, problem.scatter)
        )
        if all(side.ndim == 1 for side in (*bounds, *box)):
            extent = np.abs(moves - about).max(axis=0, initial=0.0)
            given = problem.dynamics.given_nx if name == "x" else len(extent)
            free = np.isinf(np.stack(bounds)).all(axis=0) & (np.arange(len(extent)) < given)
            yield Part(ends, about, extent, np.stack(bounds), np.stack(box), free)


def _with_reaches(
    problem: Problem, chosen: Sequence[tuple[Part, np.ndarray, np.ndarray]]
) -> tuple[Problem, np.ndarray] | None:
    """The problem with sides of some entries, (n,), that reach so far, and which; None if none."""
    nx = problem.dynamics.nx
    which = np.zeros(nx + problem.dynamics.nu, bool)
    sides: dict[str, Any] = {}
    for part, entries, reach in chosen:
        new = np.stack([part.about - reach, part.about + reach])
        new = np.clip(new, *part.bounds)
        for end, side, other in zip(part.ends, part.box, new, strict=True):
            sides[end] = jnp.asarray(np.where(entries, other, side), side.dtype)
        which[slice(nx) if part.ends[0].startswith("x") else slice(nx, None)] = entries
    if not which.any():
        return None
    return replace(problem, scatter=replace(problem.scatter, **sides)), which


def is_better(known: Answer[Any], other: Answer[Any], tolerance: float) -> bool:
    """Whether what was found in another box takes the place of what was known.

    Args:
        known: in the wider box, by which it may break more than the other box allows.
        other: in the box that fits better.
        tolerance: share of the cost by which it must be cheaper, unless the known one has PAID.
    """
    knots = [jax.tree.map(jnp.asarray, replace(of.knots, slack=None)) for of in (known, other)]
    both = jax.tree.map(lambda *rows: jnp.stack(rows), *knots)
    broken, less = np.asarray(evaluate(other.problem, both).max_defect, float)
    if not np.isfinite(known.cost):
        return bool(np.isfinite(other.cost))
    if not broken < FEASIBLE:
        return True  # it was feasible in the units of the wide box alone
    paid = broken > PAID * max(less, NOTHING * FEASIBLE)
    return other.cost < known.cost + (1.0 if paid else -tolerance) * abs(known.cost)
