"""Which chains are done, how long to wait for the others, and what is tried next.

Decisions between the iterations, from costs alone. Costs are measured from the problem's floor, and
are infinite where a chain is not sound. A chain is done if its cost exceeds the best by at most a
share. An attempt, with noise or without, has at least a place for each chain. What its places find
goes to the chains that are not done. Two questions are answered by rates, in chains that become
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
        active: which places still move, (places,).
        cost, before: costs of places, now and when this was asked last, (places,).
        bar: up to which cost chains are done.
        wanted: how many places must find what makes a chain done: in the first attempt as `wanted`
            says, later as many as there are chains that are not done without it.
        needless: of them this many may fail to.
        iterations, since: of the attempt, and since this was asked last.
        wider: places of another attempt, for each of this one's.
    """

    active: np.ndarray
    cost: np.ndarray
    before: np.ndarray
    bar: float
    wanted: int
    needless: float
    iterations: int
    since: int
    wider: float

    @property
    def near(self) -> np.ndarray:
        """Places that have found what makes a chain done, (places,)."""
        return self.cost <= self.bar

    @property
    def hopeful(self) -> np.ndarray:
        """Places that have, or that are not sound yet and may, (places,)."""
        return self.near | np.isinf(self.cost)

    def missing(self, places: np.ndarray) -> float:
        """How many more places must find it if each of these does."""
        return float(self.wanted - self.needless - places.sum())

    @property
    def explores(self) -> bool:
        """Whether enough chains are done without it, and it only looks for better optima."""
        return self.wanted <= self.needless

    @property
    def waited_for(self) -> np.ndarray:
        """Active places that matter, (places,).

        Those that are far too expensive are not, if another attempt will start them again, or if
        enough others are done.
        """
        some = self.explores or self.missing(self.hopeful) > 0.0
        return self.active & self.hopeful if some else self.active

    @property
    def over(self) -> bool:
        """Whether to end the attempt, where a finish will polish the places that are left.

        First case: it only explores, and half a place or less is expected to bring what none of
        those that have settled did. Second case: enough chains are done, and there are more places
        than are wanted. (Else the finish is the same as waiting.) Third case: another attempt is
        needed, and would bring more than waiting. Both expect one place more than came (Laplace's
        rule of succession), so that a few do not decide by chance.
        """
        if self.explores:
            return bool(2 * self.waited_for.sum() <= (~self.active).sum() + 2)
        if self.missing(self.near & ~self.active) <= 0.0:
            return len(self.active) > self.wanted
        if self.missing(self.hopeful) <= 0.0:
            return False
        now, before = self.near.sum(), (self.before <= self.bar).sum()
        another = min(self.wider * now, self.missing(self.near)) / self.iterations
        return bool((max(now - before, 0) + 1) / self.since < another)


def wanted(chains: int, places: int) -> int:
    """How many places of the first attempt must find what makes a chain done.

    As many as there are chains, and half of all: where most end elsewhere, better ones may be left.
    """
    return max(chains, places // 2)


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


def noise_is_better(done: np.ndarray, work: np.ndarray) -> bool:
    """Whether attempts with noise bring at least as many chains for each iteration of a place.

    done and work, (2,), are those of an attempt without and of one with noise: places that found
    what makes a chain done, and places times iterations.
    """
    return bool(done[1] * work[0] >= done[0] * work[1])


def owners_of_places(done: np.ndarray, cost: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Which chain gets what each place has found, (..., places).

    The worst of the chains that are not done gets the best, and so on, in turns. If all are done,
    the first one gets everything.

    Args:
        done: which chains are, (..., chains).
        cost: of what they have, (..., chains).
        order: the places, those that found the best first, (..., places).
    """
    worst = np.argsort(-cost, axis=-1, kind="stable")
    done_last = np.argsort(np.take_along_axis(done, worst, -1), axis=-1, kind="stable")
    unfinished = np.take_along_axis(worst, done_last, -1)
    count = (~done).sum(axis=-1, keepdims=True)
    turn = np.arange(order.shape[-1]) % np.maximum(count, 1)
    takers = np.where(count > 0, np.take_along_axis(unfinished, turn, -1), 0)
    owners = np.empty_like(order)
    np.put_along_axis(owners, order, takers, -1)
    return owners


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
