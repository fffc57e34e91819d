"""Rollouts of chains by the engine that replays them, as knots to go on from; see `Rollouts`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import State
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.chains import CHEAPER, Chains, best_of, improved
from mjx_drax.search.family import Family, Tracked
from mjx_drax.search.iterate import (
    FEASIBLE,
    Question,
    between,
    judged,
    restart_at,
    worst_and_unit,
)
from mjx_drax.search.shooting import Shots

SHARES = (0.5, 0.2, 0.05)
"""Of what a round has changed, these are rolled out where all of it brings no improvement."""


@dataclass(frozen=True)
class Replayer:
    """Replays the chains of a chunk of problems.

    Attributes:
        family: the problems.
        indices: those of the chunk, (n,).
        question: what the chunk's rows share, and what each has of its own.
        floor: what the costs of each row are measured from, (rows,).
        diagnosed: states of all rows, on one device, and where they are.
    """

    family: Family
    indices: np.ndarray
    question: tuple[Question, Question]
    floor: np.ndarray
    diagnosed: Callable[[State], tuple[State, Info]]

    @property
    def places(self) -> int:
        """Rows of each problem."""
        return len(self.floor) // len(self.indices)

    @property
    def of(self) -> np.ndarray:
        """The problem of each row, (rows,)."""
        return np.repeat(self.indices, self.places)

    def missed(self, chains: Chains) -> np.ndarray:
        """Which chains miss when they are replayed with feedback, (rows,); see `_tracked`."""
        return self._rolled_out(chains, 1.0)[1]

    def short(self, chains: Chains) -> np.ndarray:
        """Which feasible chains have plans that end short of the goal, (rows,).

        Where all chains of one of many problems cost the same, nothing is to be chosen, and they
        are not asked.
        """
        missed, feasible = np.zeros(len(chains.missed), bool), chains.feasible
        asked = feasible
        if not self.family.alone:
            costs = (chains.cost - self.floor).reshape(-1, self.places)
            least = costs.min(axis=1, keepdims=True)
            alike = feasible.reshape(costs.shape) & (costs <= least + CHEAPER * np.abs(least))
            asked = feasible & ~np.repeat(alike.all(axis=1), self.places)
        rows = np.flatnonzero(asked)
        plans = self._plans(chains.state.trajectory)[rows]
        missed[rows] = ~self.family.arrive(self.of[rows], plans)
        return missed

    def rolled_out(
        self, chains: Chains, rows: np.ndarray, with_feedback: float, done: int
    ) -> Chains:
        """The chains, and of `rows` the best of them and of their rollouts."""
        everyone = np.arange(len(self.floor))
        found = self._better(chains, rows, with_feedback, done)
        if len(rows) == len(everyone):
            return found
        return best_of(_only(chains, np.setdiff1d(everyone, rows)), found, everyone)

    def rolled_out_in_part(
        self, now: Chains, whole: Chains, rows: np.ndarray, done: int
    ) -> tuple[Chains, np.ndarray]:
        """What a round has made of chains `now`, rolled out; or a share of it, where all is worse.

        That of `rows`; of the others nothing. Also the largest share that has brought an
        improvement, 0 for none, (all rows,).
        """
        found = self._better(whole, rows, 1.0, done, now)
        better = np.where(improved(now, found, self.floor), 1.0, 0.0)
        rest = rows[better[rows] == 0.0]
        if not len(rest):
            return found, better
        # Shares are replayed side by side: a replay hardly takes longer with more rows
        ends, count = (now.state.trajectory, whole.state.trajectory), len(SHARES)
        parts = [between(self.question[1], self.question[0], *ends, share) for share in SHARES]
        plan = np.concatenate([self._plans(part)[rest] for part in parts])
        u = np.concatenate([np.asarray(part.u)[rest] for part in parts])
        gains = np.tile(np.asarray(whole.state.gains)[rest], (count, 1, 1, 1))
        ran, missed = self._tracked(np.tile(rest, count), plan, u, gains)
        of_shares = (np.split(a, count) for a in (ran.states, ran.controls, missed))
        for share, states, controls, late in zip(SHARES, *of_shares, strict=True):
            part = self._as_knots(whole, rest, states, controls, late, done, now)
            better = np.where(improved(now, part, self.floor), np.maximum(better, share), better)
            found = best_of(found, part, np.arange(len(better)))
        return found, better

    def fired(self, knots: Trajectory, rows: np.ndarray, controls: np.ndarray) -> Shots:
        """Rollouts of controls (n, samples, K, nu) of `rows` (n,), without feedback, row by row.

        They start where the knots (all rows, K, ...) do.
        """
        family, samples = self.family, controls.shape[1]
        dynamics, K = family.problem.dynamics, family.problem.horizon
        x_0 = np.repeat(family.starts(self.indices, knots)[rows], samples, axis=0)
        plan = np.broadcast_to(x_0[:, None], (len(x_0), K + 1, dynamics.nx))
        u = controls.reshape(-1, K, dynamics.nu)
        gains = np.broadcast_to(0.0, (*u.shape, dynamics.ndx))
        of = np.repeat(self.of[rows], samples)
        states, applied = family.replay(of, plan, u, gains)
        missed = np.zeros(len(u), bool)
        if family.problem.goal is not None:
            missed = ~family.reached(of, states)
        # All rows, as numbers of problems belong to rows; those not asked for stand still
        all_x, all_u = (np.repeat(np.asarray(a)[None], samples, axis=0) for a in (knots.x, knots.u))
        all_x[:, rows] = states[:, 1:].reshape(len(rows), samples, K, -1).swapaxes(0, 1)
        all_u[:, rows] = applied.reshape(len(rows), samples, K, -1).swapaxes(0, 1)
        start = None
        if knots.start is not None:
            start = jnp.broadcast_to(knots.start, (samples, *knots.start.shape))
        tried = Trajectory(jnp.asarray(all_x), jnp.asarray(all_u), start=start)
        both = judged(self.question[1], self.question[0], tried)
        cost, broken = (np.asarray(a, float)[:, rows].T.ravel() for a in both)
        return Shots(states, applied, cost, broken, missed)

    def taken(self, chains: Chains, rows: np.ndarray, shots: Shots, done: int) -> Chains:
        """Shots of `rows`, one of each, as chains to go on from; others are infinitely bad."""
        ran = shots.states, shots.controls, shots.missed
        return self._as_knots(chains, rows, *ran, done, None)

    def _better(
        self,
        chains: Chains,
        rows: np.ndarray,
        with_feedback: float,
        done: int,
        kept: Chains | None = None,
    ) -> Chains:
        """The best of chains and of their rollouts, of `rows`; the others are infinitely bad."""
        ran, missed = self._rolled_out(chains, with_feedback, rows)
        found = self._as_knots(chains, rows, ran.states, ran.controls, missed, done, kept)
        late = np.ones(len(self.floor), bool)
        # One replay that arrives, with feedback or without, is enough
        late[rows] = missed & chains.missed[rows] if with_feedback else missed
        kept = _only(replace(chains, missed=late), rows)
        return best_of(kept, found, np.arange(len(late)), self.floor)

    def _rolled_out(
        self, chains: Chains, with_feedback: float, rows: np.ndarray | slice = slice(None)
    ) -> tuple[Tracked, np.ndarray]:
        """Replays of rows of chains, and which of them miss; see `_tracked`."""
        knots, gains = chains.state.trajectory, with_feedback * np.asarray(chains.state.gains)
        return self._tracked(rows, self._plans(knots)[rows], np.asarray(knots.u)[rows], gains[rows])

    def _tracked(
        self, rows: np.ndarray | slice, plan: np.ndarray, u: np.ndarray, gains: np.ndarray
    ) -> tuple[Tracked, np.ndarray]:
        """Replays of plans of rows, and which miss the goal; without one, which leave the plan."""
        family, of = self.family, self.of[rows]
        ran = family.tracked(of, plan, u, gains)
        return ran, ran.left if family.problem.goal is None else ~family.reached(of, ran.states)

    def _as_knots(
        self,
        chains: Chains,
        rows: np.ndarray,
        states: np.ndarray,
        controls: np.ndarray,
        missed: np.ndarray,
        done: int,
        kept: Chains | None,
    ) -> Chains:
        """Chains whose knots are rollouts (n, K + 1, nx) of `rows`, some of which have missed.

        All other rows get infinitely bad diagnostics, so that answers do not depend on neighbours
        in a batch. The engine does not judge a rollout that costs no less than the sound chain
        `kept`: that one would not be replaced.
        """
        knots = chains.state.trajectory
        x, u, late = np.array(knots.x), np.array(knots.u), np.ones(len(self.floor), bool)
        x[rows], u[rows], late[rows] = states[:, 1:], controls, missed
        rolled = Trajectory(jnp.asarray(x), jnp.asarray(u), start=knots.start)
        state = restart_at(self.question[1], self.question[0], chains.state, rolled)
        state, info = self.diagnosed(state)
        if self.family.problem.goal is None:  # a motion of the engine is all that is asked for
            late = np.zeros(len(x), bool)
        may_win = ~late if kept is None else ~late & ~(kept.sound_cost <= np.asarray(info.cost))
        info = self._by_the_engine(info, replace(state.trajectory, slack=None), may_win)
        return _only(Chains(state, info, np.full(len(x), done), late), rows)

    def _plans(self, knots: Trajectory) -> np.ndarray:
        """x_0..x_K of knots (rows, K, ...), (rows, K + 1, nx)."""
        return np.concatenate([self.family.starts(self.indices, knots)[:, None], knots.x], axis=1)

    def _by_the_engine(self, info: Info, knots: Trajectory, chosen: np.ndarray) -> Info:
        """`by_the_engine` of these chains."""
        return by_the_engine(
            self.family, self.question, self.of, info, knots, self._plans(knots), chosen
        )


def by_the_engine(
    family: Family,
    question: tuple[Question, Question],
    of: np.ndarray,
    info: Info,
    knots: Trajectory,
    plans: np.ndarray,
    chosen: np.ndarray,
) -> Info:
    """Diagnostics of rollouts; max|h| of `chosen` ones (rows,) as the replaying engine has it.

    Where f has kinks it may differ from the engine by more than a feasible plan may. A rollout
    is a motion of the engine: where it reaches the goal it counts, if it keeps the constraints.

    Args:
        family, question: the problems, and what rows share and have of their own.
        of: the problem of each row, (rows,).
        info, knots, plans: of the rows; plans are x_0..x_K, (rows, K + 1, nx).
        chosen: the rows.
    """
    defect = np.array(info.max_defect)
    which = np.flatnonzero(chosen & ~(defect < FEASIBLE))
    if not (family.kinked and len(which)):
        return info
    broken, unit = map(np.asarray, worst_and_unit(question[1], question[0], knots))
    u = np.asarray(knots.u)
    for index in np.unique(of[which]):
        problem, rows = family.at(int(index)), which[of[which] == index]
        off = problem.engine_defects(plans[rows], u[rows]) / unit[rows, None]
        defect[rows] = np.maximum(off.max(axis=(1, 2)), broken[rows])
    return replace(info, max_defect=jnp.asarray(defect))


def _only(chains: Chains, rows: np.ndarray) -> Chains:
    """The chains; those of other rows with infinitely bad diagnostics."""
    others = np.ones(len(chains.missed), bool)
    others[rows] = False
    worst: Info = jax.tree.map(lambda a: np.where(others, np.inf, a), chains.info)
    return replace(chains, info=worst)
