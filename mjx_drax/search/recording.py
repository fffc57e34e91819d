"""The knots of all chains over the iterations of a solve, kept on request.

`solve(problem, record=1)` fills a `Recorder`. What it kept is `solution.recording`: which try led
to a chain's answer, and where that try's knots were at every iteration. `render_diffusion` shows
it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import require_whole
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
    """max|h_k| of each knot of a batch of chains, in `problem.defect_scale`, (chains, K)."""
    scale = problem.defect_scale
    return jax.vmap(lambda z: jnp.abs(problem.defects(z) / scale).max(axis=1))(trajectory)


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


@dataclass
class Tries:
    """One attempt: for which chain each place in the batch worked (chains,), and its snapshots.

    If it `continues`, chains went on from where their best attempts had left them.
    """

    owners: np.ndarray
    snapshots: list[Snapshot] = field(default_factory=list)
    continues: bool = False

    def best(self, chain: int) -> tuple[int, tuple[bool, float]] | None:
        """The place whose end is best among those that worked for the chain, and its rank.

        As solves choose: feasible before infeasible, then the cheaper or the less infeasible.
        None if no place worked for it.
        """
        places = np.flatnonzero(self.owners == chain)
        if not len(places):
            return None
        last = self.snapshots[-1]
        infeasible, value = ranking(last.cost, last.max_defect)
        place = int(places[np.lexsort((value[places], infeasible[places]))[0]])
        return place, (bool(infeasible[place]), float(value[place]))


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


class Recorder:
    """Takes snapshots during a solve, every few iterations and whenever an attempt ends.

    When they fill `LIMIT` bytes, every second one is dropped and further ones are taken half as
    often; the first and the last of an attempt always stay.
    """

    def __init__(self, every: int) -> None:
        require_whole("record", every)
        self.every = int(every)
        self.attempts: list[Tries] = []

    def begin(self, owners: np.ndarray, continues: bool = False) -> None:
        """An attempt begins, in which each place in the batch works for the chain in owners."""
        self.attempts.append(Tries(owners, continues=continues))

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
        """All of it, as arrays."""
        shots = [shot for tries in self.attempts for shot in tries.snapshots]
        return {
            "every": np.array(self.every),
            "owners": np.array([tries.owners for tries in self.attempts]),
            "continues": np.array([tries.continues for tries in self.attempts]),
            "counts": np.array([len(tries.snapshots) for tries in self.attempts]),
            **{
                f.name: np.array([getattr(shot, f.name) for shot in shots])
                for f in fields(Snapshot)
            },
        }

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Become the recorder of which these are the arrays."""
        rows = zip(*(saved[f.name] for f in fields(Snapshot)), strict=True)
        shots = iter([Snapshot(int(i), float(sigma), *rest) for i, sigma, *rest in rows])
        self.every = int(saved["every"])
        self.attempts = [
            Tries(owners, list(islice(shots, int(count))), bool(continues))
            for owners, continues, count in zip(
                *(saved[name] for name in ("owners", "continues", "counts")), strict=True
            )
        ]

    def recording(self) -> Recording:
        """What was kept; an attempt that was interrupted before its first snapshot is left out."""
        return Recording([tries for tries in self.attempts if tries.snapshots])
