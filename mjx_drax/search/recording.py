"""The knots of all chains over the iterations of a solve, kept on request.

`solve(problem, record=1)` fills a `Recorder`. What it kept is `solution.recording`: which try led
to a chain's answer, and where that try's knots were at every iteration. `render_diffusion` shows
it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, require_whole
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.method.descent import Info
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import ranking

LIMIT = 500_000_000
"""Bytes that recordings may take. Beyond, every second snapshot is dropped."""


@jax.jit
@full_precision
def knot_defects(problem: Problem, trajectory: Trajectory) -> Array:
    """max|h_k| of each knot of a batch of chains, in `problem.defect_unit`, (chains, K)."""

    def of_chain(z: Trajectory) -> Array:
        return jnp.abs(problem.defects(z) / problem.defect_unit(z.x)).max(axis=1)

    return jax.vmap(of_chain)(trajectory)


@dataclass(frozen=True)
class Snapshot:
    """Every place in the batch at one moment.

    Attributes:
        iteration: so many were done.
        sigma: the noise at that moment.
        x: states x_1..x_K, (chains, K, nx).
        defects: max|h_k| of each knot, (chains, K).
        cost, max_defect: (chains,); max_defect counts constraints too.
    """

    iteration: int
    sigma: float
    x: np.ndarray
    defects: np.ndarray
    cost: np.ndarray
    max_defect: np.ndarray

    @property
    def size(self) -> int:
        """Bytes."""
        return self.x.nbytes + self.defects.nbytes + self.cost.nbytes + self.max_defect.nbytes


_OF_ALL, _OF_PLACES = ("iteration", "sigma"), ("x", "defects", "cost", "max_defect")
"""Names of a snapshot's numbers, and of its arrays of all places."""


@dataclass
class Tries:
    """One attempt: its snapshots, and which chain got what each place has found, (places,).

    If it `continues`, chains went on from where their best attempts had left them. `owners` is
    empty until the attempt ends, and -1 where no chain took what was found; so is `missed`, which
    says what misses the goal.
    """

    snapshots: list[Snapshot] = field(default_factory=list)
    continues: bool = False
    owners: np.ndarray = field(default_factory=lambda: np.array([], int))
    missed: np.ndarray = field(default_factory=lambda: np.array([], bool))

    def best(self, chain: int) -> tuple[int, tuple[bool, bool, float]] | None:
        """The place whose end is best among those that the chain got, and its rank.

        As `Chains.order` ranks. None if it got none.
        """
        places = np.flatnonzero(self.owners == chain)
        if not len(places):
            return None
        last = self.snapshots[-1]
        infeasible, value = ranking(last.cost, last.max_defect)
        missed = self.missed if len(self.missed) else np.zeros(len(value), bool)
        ranks = [(bool(infeasible[i]), bool(missed[i]), float(value[i])) for i in places]
        rank = min(ranks)
        return int(places[ranks.index(rank)]), rank


@dataclass(frozen=True)
class ChainHistory:
    """What one chain went through, over the attempts that led to its answer.

    Attributes:
        iteration, sigma, cost, max_defect: (snapshots,); iteration counts the solve's.
        attempt: which one, from 0, (snapshots,).
        x: states x_1..x_K, (snapshots, K, nx).
        defects: max|h_k| of each knot, (snapshots, K).
    """

    iteration: np.ndarray
    sigma: np.ndarray
    cost: np.ndarray
    max_defect: np.ndarray
    attempt: np.ndarray
    x: np.ndarray
    defects: np.ndarray


@dataclass(frozen=True)
class Recording:
    """The attempts of a solve, the first of all chains, later ones of those that had failed."""

    attempts: list[Tries]

    def history_of(self, chain: int) -> ChainHistory:
        """The chain's tries, the best of each attempt, up to the one that gave its answer."""
        found = [(i, *best) for i, a in enumerate(self.attempts) if (best := a.best(chain))]
        tries = [one for one in found if not self.attempts[one[0]].continues]
        if not tries:
            raise DraxError(f"the recording holds nothing of chain {chain}: choose another.")
        answer = min(tries, key=lambda one: one[2])[0]  # the earliest of equals
        shots = [
            (attempt, place, shot)
            for attempt, place, _ in found
            if attempt <= answer or self.attempts[attempt].continues
            for shot in self.attempts[attempt].snapshots
        ]

        def each(name: str) -> np.ndarray:
            return np.stack([getattr(shot, name)[place] for _, place, shot in shots])

        return ChainHistory(
            iteration=np.array([shot.iteration for *_, shot in shots]),
            sigma=np.array([shot.sigma for *_, shot in shots]),
            cost=each("cost"),
            max_defect=each("max_defect"),
            attempt=np.array([attempt for attempt, *_ in shots]),
            x=each("x"),
            defects=each("defects"),
        )


def _joined(arrays: list[np.ndarray]) -> np.ndarray:
    """One after the other; nothing of nothing."""
    return np.concatenate(arrays) if arrays else np.array([], int)


class Recorder:
    """Takes snapshots during a solve, every few iterations and whenever an attempt ends.

    When they fill `LIMIT` bytes, every second one is dropped and further ones are taken half as
    often; the first and the last of an attempt always stay.
    """

    def __init__(self, every: int) -> None:
        require_whole("record", every)
        self.every = int(every)
        self.attempts: list[Tries] = []

    def begin(self, continues: bool = False) -> None:
        """An attempt begins."""
        self.attempts.append(Tries(continues=continues))

    def belong(self, owners: np.ndarray, missed: np.ndarray) -> None:
        """The latest attempt's places belong to those chains, and some miss the goal, (places,)."""
        if self.attempts:
            self.attempts[-1].owners, self.attempts[-1].missed = owners, missed

    def take(self, problem: Problem, sigma: float, done: int, z: Trajectory, info: Info) -> None:
        """A snapshot after `done` iterations of the solve, at the noise sigma."""
        snapshot = Snapshot(
            done,
            sigma,
            np.asarray(z.x),
            np.asarray(knot_defects(problem, z)),
            np.asarray(info.cost),
            np.asarray(info.max_defect),
        )
        self.attempts[-1].snapshots.append(snapshot)
        taken = [shot for tries in self.attempts for shot in tries.snapshots]
        if len(taken) > 4 and sum(shot.size for shot in taken) > LIMIT:
            self.every *= 2
            for tries in self.attempts:
                shots = tries.snapshots
                tries.snapshots = [*shots[:-1:2], shots[-1]]

    def saved(self) -> dict[str, np.ndarray]:
        """All of it, as arrays; those of places one after the other, as attempts differ in them."""
        shots = [shot for tries in self.attempts for shot in tries.snapshots]
        owners = [tries.owners for tries in self.attempts]
        return {
            "every": np.array(self.every),
            "owners": _joined(owners),
            "missed": _joined([tries.missed for tries in self.attempts]),
            "owned": np.array([len(a) for a in owners]),
            "continues": np.array([tries.continues for tries in self.attempts]),
            "counts": np.array([len(tries.snapshots) for tries in self.attempts]),
            "places": np.array([len(shot.cost) for shot in shots]),
            **{n: np.array([getattr(shot, n) for shot in shots]) for n in _OF_ALL},
            **{n: _joined([getattr(shot, n) for shot in shots]) for n in _OF_PLACES},
        }

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Become the recorder of which these are the arrays."""

        def parted(name: str, sizes: str) -> list[np.ndarray]:
            return np.split(saved[name], np.cumsum(saved[sizes])[:-1])

        rows = zip(*(parted(name, "places") for name in _OF_PLACES), strict=True)
        both = zip(saved["iteration"].tolist(), saved["sigma"].tolist(), rows, strict=True)
        shots = iter([Snapshot(done, sigma, *arrays) for done, sigma, arrays in both])
        self.every = int(saved["every"])
        ends = (parted(name, "owned") for name in ("owners", "missed"))
        parts = saved["counts"].tolist(), saved["continues"].tolist(), *ends
        self.attempts = [
            Tries(list(islice(shots, count)), continues, owners, missed.astype(bool))
            for count, continues, owners, missed in zip(*parts, strict=True)
        ]

    def recording(self) -> Recording:
        """What was kept; an attempt that was interrupted before its first snapshot is left out."""
        return Recording([tries for tries in self.attempts if tries.snapshots])
