"""Random shooting: changes of controls are drawn and rolled out, and the best is kept.

No derivative tells that a push would help while nothing touches; trying a push does. Each row is an
evolution strategy with one parent (Rechenberg 1973): in every generation random changes of its
controls are rolled out, and the best takes its place if it is better. A change is a polyline in
time through random points. Its size, its number of points, its window of time and the controls that
it moves are drawn anew each time, over all scales, so nothing has to be tuned to a problem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjx_drax.search.chains import first_of
from mjx_drax.search.iterate import ranking

SMALLEST = 0.02
"""Size of the smallest changes, in halves of the range of controls."""

GAIN, PATIENCE = 0.01, 10
"""A row that has not become cheaper by this share for so many generations is left alone."""


@dataclass(frozen=True)
class Shots:
    """Rollouts, and how good they are, (n, ...).

    Attributes:
        states: x_0..x_K, (n, K + 1, nx).
        controls: that were applied, (n, K, nu).
        cost: of each.
        broken: by how much constraints and bounds are, in units of what a feasible plan may.
        missed: which do not come to the goal.
    """

    states: np.ndarray
    controls: np.ndarray
    cost: np.ndarray
    broken: np.ndarray
    missed: np.ndarray

    def better(self, tried: Shots, of: np.ndarray) -> Shots:
        """For every row the best of what it has and of what was tried for it, `of` (n,)."""
        pairs = zip(vars(self).values(), vars(tried).values(), strict=True)
        both = Shots(*(np.concatenate(pair) for pair in pairs))
        owners = np.concatenate([np.arange(len(self.cost)), of])
        best = first_of(owners, *ranking(both.cost, both.broken), both.missed)
        return Shots(*(part[best] for part in vars(both).values()))

    def gained(self, before: Shots, floor: np.ndarray) -> np.ndarray:
        """Which rows became sound, or cheaper by `GAIN` of the cost from its floor, (n,)."""
        (worse, was), (bad, now) = (ranking(s.cost, s.broken) for s in (before, self))
        with np.errstate(invalid="ignore"):  # where both are infinite
            cheaper = was - now > GAIN * np.abs(was - np.where(worse, 0.0, floor))
        return (worse & ~bad) | (before.missed & ~self.missed) | cheaper


def shoot(
    fire: Callable[[np.ndarray, np.ndarray], Shots],
    controls: np.ndarray,
    box: Sequence[np.ndarray],
    floor: np.ndarray,
    keys: Sequence[tuple[int, ...]],
    most: tuple[int, int],
    told: Callable[[Shots], None],
) -> tuple[Shots, bool]:
    """Improve the controls of rows; what they came to, and whether it was not interrupted.

    Args:
        fire: rolls out controls (n, tries, K, nu) of rows (n,): n * tries shots, row by row.
        controls: to start from, (rows, K, nu), or from the middle of the box where that is better.
        box: lower and upper ends of controls, each (rows, K, nu).
        floor: what costs are measured from, (rows,).
        keys: of each row, numbers from 0 that its random changes depend on.
        most: changes of a row in a generation, and generations.
        told: called after every generation; may raise KeyboardInterrupt, which ends it.
    """
    (lower, upper), (samples, generations) = box, most
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    everyone, waited = np.arange(len(controls)), np.zeros(len(controls), int)
    shots = fire(everyone, controls[:, None])
    try:
        shots = shots.better(fire(everyone, middle[:, None]), everyone)
        for generation in range(generations):
            rows = np.flatnonzero(waited < PATIENCE)
            if not len(rows):
                break
            own = ((*keys[row], generation) for row in rows.tolist())
            drawn = np.stack([changes(key, samples, *controls.shape[1:]) for key in own])
            tries = shots.controls[rows, None] + half[rows, None] * drawn
            before, shots = shots, shots.better(fire(rows, tries), np.repeat(rows, samples))
            waited = np.where(shots.gained(before, floor), 0, waited + 1)
            told(shots)
    except KeyboardInterrupt:
        return shots, False
    return shots, True


def changes(key: tuple[int, ...], count: int, horizon: int, nu: int) -> np.ndarray:
    """Random changes of one row's controls, (count, horizon, nu), for a range of ± 1."""
    rng = np.random.default_rng(key)
    most = max(horizon / 2, 2.0)
    points = np.exp(rng.uniform(np.log(2.0), np.log(most), count)).round().astype(int)
    heights = rng.standard_normal((count, points.max(), nu))
    along = np.linspace(0.0, points - 1, horizon, axis=1)
    left = np.minimum(along.astype(int), points[:, None] - 2)
    share = (along - left)[..., None]
    a, b = (np.take_along_axis(heights, at[..., None], axis=1) for at in (left, left + 1))
    size = np.exp(rng.uniform(np.log(SMALLEST), 0.0, (count, 1, 1)))
    begin, end = np.sort(rng.integers(0, horizon, (2, count, 1)), axis=0)
    knots = np.arange(horizon)
    inside = (begin <= knots) & (knots <= end) | (rng.random((count, 1)) < 0.5)
    chosen = rng.random((count, nu)) < rng.uniform(0.0, 1.0, (count, 1))
    chosen |= rng.random((count, 1)) < 0.5
    return size * ((1.0 - share) * a + share * b) * inside[..., None] * chosen[:, None]
