"""Where the chains of a search are, how far it is, and which answer of a chain is better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import State
from mjx_drax.polish.interior_point import Progress
from mjx_drax.search.iterate import FEASIBLE, ranking

CHEAPER = 1e-3
"""A rollout is an improvement if it is cheaper by more than this share. Optima whose costs differ
by no more count as equal."""


@register_dataclass
@dataclass(frozen=True)
class Chains:
    """Where chains are, one row each.

    Attributes:
        state, info: of every row.
        feasible_since: since which iteration each was feasible, or -1, (rows,).
        missed: whether its replay, or its plan, did not come to where it should, (rows,).
    """

    state: State
    info: Info
    feasible_since: np.ndarray
    missed: np.ndarray

    @classmethod
    def of(cls, state: State, info: Info, feasible_since: np.ndarray) -> Chains:
        """Chains that were not replayed."""
        return cls(state, info, feasible_since, np.zeros(len(feasible_since), bool))

    @property
    def cost(self) -> np.ndarray:
        """Of the knots, (rows,)."""
        return np.asarray(self.info.cost)

    @property
    def feasible(self) -> np.ndarray:
        """Whether max|h| < `FEASIBLE`, and the cost is finite, (rows,)."""
        return (np.asarray(self.info.max_defect) < FEASIBLE) & np.isfinite(self.cost)

    @property
    def optimal(self) -> np.ndarray:
        """Whether a polish has brought it to its tolerance, (rows,)."""
        polish = self.state.polish
        if not isinstance(polish, Progress):
            return np.zeros(len(self.missed), bool)
        return np.asarray(polish.optimal)

    @property
    def sound(self) -> np.ndarray:
        """Feasible, and not known to miss, (rows,)."""
        return self.feasible & ~self.missed

    @property
    def sound_cost(self) -> np.ndarray:
        """The cost of what is sound, and infinity of the rest, (rows,)."""
        return np.where(self.sound, self.cost, np.inf)

    def order(self, problems: int = 1) -> np.ndarray:
        """The rows of each of so many problems, numbered from 0, best first, (problems, rows each).

        Feasible beats infeasible, then sound beats what its replay missed, then the cheaper or the
        less infeasible wins; the earlier one of equals.
        """
        infeasible, value = ranking(self.cost, self.info.max_defect)
        keys = (a.reshape(problems, -1) for a in (value, self.missed, infeasible))
        return np.lexsort(tuple(keys), axis=-1)

    def at(self, rows: np.ndarray) -> Chains:
        """Those rows."""
        info = jax.tree.map(lambda a: np.asarray(a)[rows], self.info)
        state = taken(self.state, rows)
        return Chains(state, info, self.feasible_since[rows], self.missed[rows])


@register_dataclass
@dataclass(frozen=True)
class Stage:
    """How far a search is: all that the rest of it depends on.

    Attributes:
        attempt: the one that is under way, from 0.
        heated: whether it has noise.
        finishing: how often it went on with what is kept instead; see `_begin_to_finish`.
        cost_scale: of each problem, (N,).
        floor: what costs of each problem are measured from, (N,); see `sizes`.
        todo: problems of this attempt.
        place: how many of them are done; the chunk is what follows.
        begun: whether `now` belongs to this chunk; else it has not begun.
        kept: the best so far of all chains of all problems, (N * chains,); None before any.
        least: the least cost, from its floor, of any feasible plan, even one that misses the goal,
            (N,); infinite where the goal is not asked. It sets the noise of heated attempts.
        now: where the chunk's chains are, (rows,).
        before: `now.sound_cost` when it was asked last whether to wait, (rows,).
        damping: of each row between rollouts, (rows,); inf for rows that they cannot improve.
        step: how many of the attempt's iterations are done.
        ends: of a single problem, `sound_cost` of the places at the ends of all attempts without
            noise, and of all with it; and places times iterations of these, `work` (2,).
        rollouts: how many rollouts, and rounds of them, are done.
        records: iterations done and diagnostics of the best places, as many as there are chains,
            for every report of a single problem.
        began: for every attempt, and every start of it, after how many iterations it began and its
            noise ended.
        coolings: how often an attempt has started again with less noise.
    """

    attempt: int
    heated: bool
    finishing: int
    cost_scale: np.ndarray
    floor: np.ndarray
    todo: np.ndarray
    place: int
    begun: bool
    kept: Chains | None
    least: np.ndarray
    now: Chains
    before: np.ndarray
    damping: np.ndarray
    step: int
    ends: tuple[np.ndarray, np.ndarray]
    work: np.ndarray
    rollouts: int
    records: tuple[tuple[int, Info], ...]
    began: tuple[tuple[int, int], ...] = ()
    coolings: int = 0

    @property
    def done(self) -> int:
        """Iterations of a single problem's search, at the last report."""
        return self.records[-1][0]


def slim(chains: Chains) -> Chains:
    """The chains with knots, gains and where they died alone, to save memory."""
    state = chains.state
    knots = replace(state.trajectory, slack=None)
    nothing: Any = ()
    few = State(knots, nothing, nothing, state.gains, nothing, nothing, nothing, state.died_at)
    return replace(chains, state=few)


def unset(like: Chains, rows: int) -> Chains:
    """Places on the host for the best of so many chains, infinitely bad so far."""
    empty: Chains = jax.tree.map(lambda a: np.zeros((rows, *a.shape[1:]), a.dtype), slim(like))
    worst: Info = jax.tree.map(lambda a: np.full(rows, np.inf), like.info)  # an array each
    return replace(empty, info=worst, feasible_since=np.full(rows, -1))


def improved(kept: Chains, found: Chains, floor: np.ndarray | float) -> np.ndarray:
    """Which chains became sound, or cheaper by more than `CHEAPER`, (chains,)."""
    before, after = (np.asarray(a.info.cost, float) - floor for a in (kept, found))
    cheaper = after < before - CHEAPER * np.abs(before)
    return found.sound & (cheaper | ~kept.sound)


def finished(kept: Chains, now: Chains, floor: float) -> Chains:
    """The chains after more polish; as they were kept where that has made them worse.

    The first rows of `now` are the chains; the others are the same again. Costs are measured from
    a floor.
    """
    rows = slice(len(kept.missed))
    polished = Chains(
        now.state,
        jax.tree.map(lambda a: np.asarray(a)[rows], now.info),
        now.feasible_since[rows],
        now.missed[rows],
    )
    worse = improved(polished, kept, floor)
    source = np.arange(len(worse)) + len(worse) * ~worse
    state, info = gather((kept.state, kept.info), (now.state, now.info), source)
    since = np.where(worse, kept.feasible_since, polished.feasible_since)
    return Chains(state, info, since, np.where(worse, kept.missed, polished.missed))


def best_of(
    kept: Chains, found: Chains, owners: np.ndarray, floor: np.ndarray | None = None
) -> Chains:
    """For every chain the best of what it has and what was found for it, as `Chains.order` ranks.

    owners (rows of found,) says for which chain each row of `found` is. With a floor of the costs
    (chains,), what is optimal stays unless something is cheaper by more than `CHEAPER`.
    """
    chains = len(kept.missed)

    def both(values: Callable[[Chains], ArrayLike]) -> np.ndarray:
        return np.concatenate([np.asarray(values(kept)), np.asarray(values(found))])

    infeasible, value = ranking(both(lambda a: a.cost), both(lambda a: a.info.max_defect))
    of, missed = np.concatenate([np.arange(chains), owners]), both(lambda a: a.missed)
    if floor is not None:
        proven = both(lambda a: a.optimal) & ~infeasible.astype(bool)
        value = value - np.where(proven, CHEAPER * np.abs(value - floor[of]), 0.0)
    source = first_of(of, infeasible, value, missed)
    pairs = (kept.state, kept.info), (found.state, found.info)
    if all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(pairs)):
        state, info = jax.tree.map(lambda a, b: np.concatenate([a, b])[source], *pairs)
    else:
        state, info = gather(*pairs, source)
    return Chains(state, info, both(lambda a: a.feasible_since)[source], missed[source])


def first_of(
    of: np.ndarray, infeasible: np.ndarray, value: np.ndarray, missed: np.ndarray
) -> np.ndarray:
    """Which row is the best `of` each chain, as `Chains.order` ranks."""
    order = np.lexsort((value, missed, infeasible, of))
    return order[np.unique(of[order], return_index=True)[1]]


@jax.jit
def gather(kept: Any, found: Any, source: Array) -> Any:
    """Rows `source` (chains,) of two batches, one after the other."""
    chains = len(source)

    def rows(a: Array, b: Array) -> Array:
        mine = (source < chains).reshape(-1, *[1] * (a.ndim - 1))
        return jnp.where(mine, a[source % chains], b[jnp.maximum(source - chains, 0)])

    return jax.tree.map(rows, kept, found)


@jax.jit
def taken(tree: Any, rows: Array) -> Any:
    """Those rows of every array; the last one for rows beyond the end."""
    return jax.tree.map(lambda a: a.at[rows].get(mode="clip"), tree)


@jax.jit
def put_back(tree: Any, some: Any, rows: Array) -> Any:
    """The arrays with others in those rows; rows beyond the end are left out."""
    return jax.tree.map(lambda a, b: a.at[rows].set(b, mode="drop"), tree, some)
