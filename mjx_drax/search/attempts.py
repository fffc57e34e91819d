"""Which chains are done, how long to wait for the others, and what is tried next.

Decisions between the iterations, from costs alone. Costs are measured from the problem's floor, and
are infinite where a chain is not sound. A chain is done if its cost exceeds the best by at most a
share. An attempt, with noise or without, has a place for each chain, and works for those that are
not done: several places for one, maybe. Two questions are answered by rates, in chains that become
done for each iteration:

    wait longer?    while another attempt like this one would not bring the missing chains faster
    noise next?     if attempts with noise bring as many as those without, by the present best

The first is the marginal value theorem (Charnov 1976): stay where you find until you find more
elsewhere. The second prefers what has worked on this problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jax.typing import ArrayLike

from mjx_drax.search.sizes import median

STRICTER, FEW = 10.0, 0.5
"""Factor on the scale of costs after an attempt that leaves a smaller share of chains feasible."""

NEGLIGIBLE = 1e-3
"""Differences of cost below so many scales of costs do not count."""


@dataclass(frozen=True)
class AttemptSoFar:
    """How an attempt at one problem stands.

    Attributes:
        owners: for which chain each place works, (places,).
        active: which places still move, (places,).
        cost, before: costs of places, now and when this was asked last, (places,).
        bar: up to which cost chains are done.
        kept: which chains were done before the attempt, (chains,).
        needless: how many chains need not be done.
        iterations, since: of the attempt, and since this was asked last.
    """

    owners: np.ndarray
    active: np.ndarray
    cost: np.ndarray
    before: np.ndarray
    bar: float
    kept: np.ndarray
    needless: float
    iterations: int
    since: int

    @property
    def near(self) -> np.ndarray:
        """Places that make their chains done, (places,)."""
        return self.cost <= self.bar

    @property
    def hopeful(self) -> np.ndarray:
        """Places that do, or that are not sound yet and may, (places,)."""
        return self.near | np.isinf(self.cost)

    def gained(self, places: np.ndarray) -> int:
        """How many chains these places make done that were not."""
        done = np.zeros(len(self.kept), bool)
        done[self.owners[places]] = True
        return int((done & ~self.kept).sum())

    def missing(self, places: np.ndarray) -> float:
        """How many more chains must become done if these places make theirs done."""
        return float((~self.kept).sum() - self.gained(places) - self.needless)

    @property
    def waited_for(self) -> np.ndarray:
        """Active places that matter, (places,).

        If another attempt will be made, those that are not far too expensive, as these start again.
        """
        return self.active & self.hopeful if self.missing(self.hopeful) > 0.0 else self.active

    @property
    def over(self) -> bool:
        """Whether to end the attempt, where a finish will polish the places that are left.

        First case: enough chains are done, and some have several places. (Where each place works
        for a chain of its own, the finish is the same as waiting.) Second case: another attempt is
        needed, and would bring more chains than waiting. Of waiting one chain more is expected than
        came since this was asked last (Laplace's rule of succession), so that a few chains do not
        decide by chance.
        """
        if self.missing(self.near & ~self.active) <= 0.0:
            return int(np.bincount(self.owners).max()) > 1
        if self.missing(self.hopeful) <= 0.0:
            return False
        now, before = self.gained(self.near), self.gained(self.before <= self.bar)
        another = min(now, self.missing(self.near)) / self.iterations
        return (max(now - before, 0) + 1) / self.since < another


def done_up_to(
    costs: np.ndarray, sizes: np.ndarray, within: float, cost_scale: ArrayLike
) -> np.ndarray:
    """Up to which cost chains are done, (..., 1), given the costs (..., n) of all that there are.

    That is the best cost and a share of it, or of its size (..., n), where that is smaller; minus
    infinity where none is sound.

    Args:
        costs: of problems (...), each with n chains.
        sizes: of these costs, whatever constants were added; NaN where unknown.
        within: the share.
        cost_scale: of each problem, (...).
    """
    best = costs.min(axis=-1, keepdims=True)
    known = np.isfinite(best)
    best = np.where(known, best, 0.0)
    size = np.take_along_axis(sizes, costs.argmin(axis=-1)[..., None], axis=-1)
    size = np.fmin(np.abs(best), size)
    margin = np.maximum(within * size, NEGLIGIBLE * np.expand_dims(cost_scale, -1))
    return np.where(known, best + margin, -np.inf)


def noise_is_better(done: np.ndarray, iterations: np.ndarray) -> bool:
    """Whether attempts with noise bring at least as many chains for each iteration.

    done and iterations, (2,), are those of an attempt without and of one with noise.
    """
    return bool(done[1] * iterations[0] >= done[0] * iterations[1])


def owners_of_places(done: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """For which chain each place works: those that are not done, the worst first, (..., chains).

    If all are done, for the first one.
    """
    order = np.argsort(-cost, axis=-1, kind="stable")
    done_last = np.argsort(np.take_along_axis(done, order, -1), axis=-1, kind="stable")
    unfinished = np.take_along_axis(order, done_last, -1)
    count = (~done).sum(axis=-1, keepdims=True)
    turn = np.arange(done.shape[-1]) % np.maximum(count, 1)
    return np.where(count > 0, np.take_along_axis(unfinished, turn, -1), 0)


def stricter(cost_scale: np.ndarray, feasible: np.ndarray) -> np.ndarray:
    """Scales of costs for a further attempt, (n,), from those so far and which chains are feasible.

    Where few are, the cost of the initial knots says too little: defects are penalized more.
    """
    return np.where(feasible.mean(axis=1) < FEW, STRICTER * cost_scale, cost_scale)


def temperature(costs: np.ndarray, feasible: np.ndarray, cost_scale: ArrayLike) -> np.ndarray:
    """The scale of the costs of answers (..., chains), (...,), not negligible beside `cost_scale`.

    That is the best cost so far, or what all have if none is feasible.
    """
    best = np.abs(np.where(feasible, costs, np.inf).min(axis=-1))
    scale = np.where(feasible.any(axis=-1), best, median(costs))
    return np.maximum(scale, NEGLIGIBLE * np.asarray(cost_scale))
