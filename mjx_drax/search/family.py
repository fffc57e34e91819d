"""Problems that differ in numbers only: what all have in common, and what each has of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, reason, shown
from mjx_drax.base.pytrees import with_host_fields
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.schedules import Scale
from mjx_drax.polish.interior_point import Polish
from mjx_drax.problem.problem import Problem, checked
from mjx_drax.problem.tracing import plain
from mjx_drax.problem.trajectory import Stagewise, Trajectory
from mjx_drax.search.iterate import Question, partition
from mjx_drax.search.units import with_units

LESS_FEEDBACK = (0.3, 0.1, 0.03)
"""Shares of the feedback gains that are tried where a replay with all of them leaves its plan."""

ALIKE = 1e-4
"""Plans that end within this share of the largest entries of motions end alike."""

SOME = 256
"""So many plans tell how large the entries of motions are."""

OFF_PLAN = 1e-2
"""A replay leaves its plan if it is off by more than this share of the plan's own way."""


class Tracked(NamedTuple):
    """Replays with feedback: states, controls and gains of plans (n, K, ...), and how far off.

    off (n,) is the largest deviation, over the largest distance of the plan from its start.
    """

    states: np.ndarray
    controls: np.ndarray
    gains: np.ndarray
    off: np.ndarray

    @property
    def left(self) -> np.ndarray:
        """Which plans were left, (n,)."""
        return self.off > OFF_PLAN


@dataclass(frozen=True)
class Family:
    """Problems that differ in some of their numbers.

    Attributes:
        problem: all of them; leaves that differ have a leading axis (N, ...).
        differs: which leaves, in the order of `jax.tree.leaves`.
        count: N.
        nth: makes one of them by itself, if they differ in more than numbers, as in their goals.
    """

    problem: Problem
    differs: tuple[bool, ...]
    count: int
    nth: Callable[[int], Problem] | None = None

    @cached_property
    def kinked(self) -> bool:
        """Whether f has kinks, asked once: a model of MuJoCo takes milliseconds to say."""
        return self.problem.dynamics.kinked

    @property
    def alone(self) -> bool:
        """Whether this is one problem by itself."""
        return not any(self.differs)

    @classmethod
    def of_one(cls, problem: Problem) -> Family:
        """One problem by itself."""
        return cls(problem, (False,) * len(jax.tree.leaves(problem)), 1)

    @classmethod
    def of(cls, make: Callable[[Any], Problem], values: Any) -> Family:
        """The problems make(value) for values stacked along the first axis of every leaf.

        Raises:
            DraxError: leaves of `values` without a common first axis, or a misfit in the first
                problem.
        """
        if not callable(make):
            raise DraxError(f"make is {shown(make)}: give a function of a value, to a Problem.")
        try:
            values = jax.tree.map(jnp.asarray, values)
        except (TypeError, ValueError) as error:
            raise DraxError(
                f"values are {shown(values)}: give arrays of numbers, one entry for each problem."
            ) from error
        counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(values)}
        if len(counts) != 1 or not min(counts) or min(counts)[0] < 1:
            raise DraxError(
                f"values have first axes {sorted(counts)}: stack one entry for each problem along "
                "the first axis of every array."
            )
        count = min(counts)[0]

        def nth(i: int) -> Problem:
            try:
                return make(jax.tree.map(lambda leaf: leaf[i], values))
            except DraxError:
                raise
            except Exception as error:
                raise DraxError(
                    f"make failed for value {i}: {reason(error)}. Make it a function of one value "
                    "that returns a Problem."
                ) from error

        first, last = checked(nth(0)), nth(count - 1)
        if isinstance(last, Problem) and first.horizon != last.horizon:
            raise DraxError(
                f"make gives problems of {first.horizon} and {last.horizon} knots: all of a batch "
                "have one horizon. Vary numbers only, or solve them one by one."
            )
        leaves, others = jax.tree.leaves(first), jax.tree.leaves(last)
        if len(leaves) != len(others):
            raise DraxError("make gives problems of different structure: vary numbers only.")
        differs = tuple(a is not b for a, b in zip(leaves, others, strict=True))
        if not any(differs):
            raise DraxError(
                "make gives the same problem for every value: let it change some number."
            )
        tree: list[Any] = []

        @jax.jit
        @jax.vmap
        def differing(value: Any) -> list[Array]:
            try:
                found, structure = jax.tree.flatten(make(value))
            except Exception as error:  # with plain numbers it has worked, above
                ours = isinstance(error, DraxError)
                words = "what it builds takes numbers, not traced values" if ours else plain(error)
                raise DraxError(
                    f"make failed when it was traced: {words}. Let it change numbers of a problem "
                    "built outside of it, by JAX: lambda x: problem.with_x_init(x), with_data or "
                    "dataclasses.replace."
                ) from error
            tree.append(structure)
            return [jnp.asarray(a) for a, d in zip(found, differs, strict=True) if d]

        stacked = iter(differing(values))
        merged = [next(stacked) if d else a for a, d in zip(leaves, differs, strict=True)]
        whole = with_host_fields(jax.tree.unflatten(tree[0], merged), first)
        if first.guess is not last.guess:
            raise DraxError(
                "make gives every problem another guess, and all start from one: leave guess out, "
                "or make it outside of make."
            )
        alike = first.goal is last.goal and first.data_at is last.data_at
        family = cls(whole, differs, count, None if alike else nth)
        if family.varies("dynamics") and first.dynamics.fingerprint():
            raise DraxError(
                f"make changes the dynamics of {first.name}, and the C engine would "
                "replay another: solve for each model by itself."
            )
        family._check()
        return family

    def _check(self) -> None:
        """Complain about numbers of single problems that no solve could use."""
        leaves = zip(jax.tree.leaves(self.problem), self.differs, strict=True)
        numbers = [np.asarray(leaf) for leaf, differs in leaves if differs]
        nan = np.any([np.isnan(n).reshape(self.count, -1).any(1) for n in numbers], axis=0)
        faults = np.asarray(self.mapped(_faults))
        for wrong, words in (
            (nan, "holds NaN: give numbers"),
            (faults[:, 0], "starts at infinity: give a finite x_init"),
            (faults[:, 1], "has bounds that cross: give lower <= upper"),
            (faults[:, 2], "starts outside the bounds of x: move its x_init, or widen the bounds"),
        ):
            if wrong.any():
                raise DraxError(
                    f"problem {int(np.argmax(wrong))} of {self.count} ({int(wrong.sum())} such) "
                    f"{words}."
                )

    def _changed(self, change: Callable[[Any], Any]) -> Problem:
        """The problem with another value for each leaf that differs."""
        leaves, tree = jax.tree.flatten(self.problem)
        new = [change(a) if d else a for a, d in zip(leaves, self.differs, strict=True)]
        return with_host_fields(jax.tree.unflatten(tree, new), self.problem)

    def varies(self, *names: str) -> bool:
        """Whether any number in those attributes of the problem differs."""
        tree = jax.tree.structure(self.problem)
        differs = jax.tree.unflatten(tree, self.differs)
        return any(any(jax.tree.leaves(getattr(differs, name))) for name in names)

    def at(self, i: int) -> Problem:
        """One of the problems."""
        if self.alone:
            return self.problem
        found = self._changed(lambda leaf: leaf[i])
        return with_host_fields(found, self.nth(i)) if self.nth else found

    def rows(self, indices: np.ndarray, chains: int) -> Problem:
        """Those problems, with a row for each of their chains in the leaves that differ."""
        if self.alone:
            return self.problem
        which = np.repeat(indices, chains)
        return self._changed(lambda leaf: leaf[which])

    def starts(self, indices: np.ndarray, knots: Trajectory) -> np.ndarray:
        """x_0 of knots (rows, K, ...), as many for each of those problems, (rows, nx)."""
        rows = self.rows(indices, len(knots.x) // len(indices))
        x = np.broadcast_to(np.asarray(rows.x_init), (len(knots.x), rows.dynamics.nx))
        E = rows.start_map
        if E is None or knots.start is None:
            return x
        with self.problem.arithmetic():
            integrate: Any = jax.vmap(self.at(0).dynamics.integrate)
            return np.asarray(integrate(x, knots.start @ E.T))

    def question(
        self,
        flow: Langevin,
        scale: Scale,
        indices: np.ndarray,
        chains: int,
        polish: Polish | None = None,
    ) -> tuple[Question, Question]:
        """What the chains of those problems share, and what each has of its own.

        Args:
            flow: the settings of all.
            scale: cost and noise of each problem, (len(indices),).
            indices: of the problems.
            chains: of each problem.
            polish: what follows the noise, if anything but the flow's tail.
        """
        if self.alone:
            return partition(Question(flow, self.problem, polish=polish), None)
        number = self.problem.x_init.dtype  # else float64 in numpy, for which JAX compiles again
        each = Scale(*(np.repeat(np.asarray(s, number), chains) for s in vars(scale).values()))
        whole = Question(replace(flow, scale=each), self.rows(indices, chains), polish=polish)
        flags = jax.tree.map(lambda leaf: False, flow)
        of_flow = jax.tree.leaves(replace(flags, scale=Scale(True, True)))
        of_polish = (False,) * len(jax.tree.leaves(polish))
        return partition(whole, (*of_flow, *self.differs, False, *of_polish))

    def mapped(self, function: Callable[[Problem], Any]) -> Any:
        """function(problem) for every problem, (N, ...)."""
        tree = jax.tree.structure(self.problem)
        axes = jax.tree.unflatten(tree, [0 if d else None for d in self.differs])
        return jax.vmap(function, in_axes=(axes,))(self.problem)

    def in_units(self, units: Stagewise | None) -> Family:
        """The same problems with all their constraints measured in these units."""
        if units is None and self.problem.constraint.unit is None:
            return self
        tree = jax.tree.structure(self.problem)
        flags = jax.tree.unflatten(tree, self.differs)
        shared: Any = jax.tree.map(lambda _: False, units)
        differs = tuple(jax.tree.leaves(with_units(flags, shared)))
        return replace(self, problem=with_units(self.problem, units), differs=differs)

    @property
    def parts(self) -> tuple[Problem, Problem]:
        """What each problem has of its own (N, ...), and what all share; None for the others."""
        leaves, tree = jax.tree.flatten(self.problem)
        own, shared = (
            [leaf if d is is_own else None for leaf, d in zip(leaves, self.differs, strict=True)]
            for is_own in (True, False)
        )
        return jax.tree.unflatten(tree, own), jax.tree.unflatten(tree, shared)

    def replay(
        self, of: np.ndarray, plan: np.ndarray, u: np.ndarray, gains: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`Problem.replay` of plans (n, K + 1, nx) of the problems `of` (n,)."""
        if self.alone:
            return self.problem.replay(plan, u, gains)
        if not self.varies("dynamics", "bounds"):
            with self.problem.arithmetic():
                knots = self.mapped(lambda problem: problem.knots.at(slice(-1)))
            return self.problem.replay(plan, u, gains, knots.at(of))
        states, controls = np.empty(plan.shape), np.empty(u.shape)
        for i in np.unique(of):
            rows = of == i
            states[rows], controls[rows] = self.at(int(i)).replay(plan[rows], u[rows], gains[rows])
        return states, controls

    def tracked(
        self, of: np.ndarray, plan: np.ndarray, u: np.ndarray, gains: np.ndarray
    ) -> Tracked:
        """Replays of the problems `of` with feedback; gains may be smaller than the given ones.

        A linear model of contacts holds for small changes only, and gains that trust it can make
        controls chatter between their bounds. So where f has kinks and a replay leaves its plan,
        smaller ones are tried, and the first replay that stays is taken, or else the nearest.
        """
        difference = self.at(0).dynamics.host_difference

        def largest(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            with np.errstate(invalid="ignore"):  # of states that are not finite
                return np.nan_to_num(np.abs(difference(x, y)).max(axis=(1, 2)), nan=np.inf)

        way = largest(plan, np.broadcast_to(plan[:, :1], plan.shape))

        def ran(rows: np.ndarray, given: np.ndarray) -> Tracked:
            states, controls = self.replay(of[rows], plan[rows], u[rows], given)
            with np.errstate(over="ignore"):  # where a plan stands still and its replay does not
                off = largest(states, plan[rows]) / np.maximum(way[rows], np.finfo(float).tiny)
            return Tracked(states, controls, given, off)

        found = ran(np.arange(len(u)), gains)
        left = np.flatnonzero(found.left)
        if not (self.kinked and gains.any() and len(left)):
            return found
        # The other shares side by side: a replay hardly takes longer with more rows
        count = len(LESS_FEEDBACK)
        tried = ran(np.tile(left, count), np.concatenate([s * gains[left] for s in LESS_FEEDBACK]))
        by_share = np.stack([found.off[left], *np.split(tried.off, count)])
        stays = by_share <= OFF_PLAN
        share = np.where(stays.any(axis=0), stays.argmax(axis=0), by_share.argmin(axis=0))
        source = np.arange(len(u))
        others = len(u) + (share - 1) * len(left) + np.arange(len(left))
        source[left] = np.where(share > 0, others, left)
        return Tracked(*(np.concatenate(both)[source] for both in zip(found, tried, strict=True)))

    def arrive(self, of: np.ndarray, plans: np.ndarray) -> np.ndarray:
        """`reached`, where plans with one goal that end alike are asked once.

        A goal takes microseconds in Python.
        """
        if not len(plans):
            return np.zeros(0, bool)
        ends = np.asarray(plans[:, -1], float)
        size = np.abs(plans[:SOME]).max(axis=(0, 1)) + np.finfo(float).tiny
        weights = np.random.default_rng(0).uniform(1.0, 2.0, len(size))
        keys = (np.round(ends / (ALIKE * size)) * weights).sum(axis=1)  # sorts sooner than rows
        if not self._one_goal:
            keys = keys + 1j * of
        _, first, which = np.unique(keys, return_index=True, return_inverse=True)
        found: np.ndarray = self.reached(of[first], plans[first])[which]
        return found

    @property
    def _one_goal(self) -> bool:
        """Whether all problems judge a motion alike."""
        return self.alone or not (self.nth or self.varies("dynamics", "t_init"))

    def reached(self, of: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Whether motions x_0..x_K, (n, K + 1, nx), of problems `of` (n,) end at their goal."""

        def asked(problem: Problem, motions: np.ndarray) -> np.ndarray:
            times, begin = problem.dynamics.times, float(problem.t_init)
            ends = [float(times(motion, begin)[-1]) for motion in motions]
            return problem.all_reached(motions[:, -1], ends)

        if self._one_goal:
            return asked(self.at(0), states)
        found = np.zeros(len(states), bool)
        for i in np.unique(of):
            found[of == i] = asked(self.at(int(i)), states[of == i])
        return found


def _faults(problem: Problem) -> Array:
    """Whether x_init is not finite, bounds cross, and x_init is outside of them, (3,)."""
    box, x = problem.bounds, problem.x_init

    def above(lower: Array, upper: Array) -> Array:
        return (lower - upper > 1e-6).any()

    crossed = above(box.x_lower, box.x_upper) | above(box.u_lower, box.u_upper)
    outside = above(box.x_lower, x) | above(x, box.x_upper)
    alike = box.x_lower.ndim == box.x_upper.ndim == 1  # bounds of single knots do not hold for x_0
    return jnp.stack([~jnp.isfinite(x).all(), crossed, outside & alike])
