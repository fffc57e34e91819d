"""Whether another attempt is made, and who may take what an attempt has found."""

from dataclasses import dataclass, replace
from types import SimpleNamespace as Some

import numpy as np
import pytest

from mjx_drax.polish.interior_point import Polish
from mjx_drax.search.decisions import Decisions
from mjx_drax.search.restarts import Restarts, Rollouts

CHAINS, PLACES, USUAL, BEST = 64, 256, 1.5, 1.0
SETTINGS = Restarts(
    within=0.1, done_share=0.95, heated=True, polish=Polish(), rollouts=Rollouts(first=0, rounds=0)
)
DECISIONS = Decisions(SETTINGS, CHAINS, True, None)


@dataclass(frozen=True)
class Polished:
    optimal: np.ndarray
    stalled: np.ndarray

    @property
    def active(self):
        return ~(self.optimal | self.stalled)


@dataclass(frozen=True)
class Kept:
    sound_cost: np.ndarray
    info: Some
    state: Some
    missed: np.ndarray


def chains(cost, moving=False, missed=False):
    """Chains of these costs, all feasible."""
    cost = np.array(cost, float)
    missed, settled = np.full(len(cost), missed), np.full(len(cost), not moving)
    polish = Polished(settled, np.zeros(len(cost), bool))
    state = Some(polish=polish, alive=np.ones(len(cost), bool))
    sound_cost = np.where(missed, np.inf, cost)
    return Kept(sound_cost, Some(size=np.full(len(cost), np.nan)), state, missed)


def stage(kept, *noisy):
    """After an attempt without noise, whose places cost USUAL, and these with noise."""
    return Some(
        kept=chains(kept),
        now=chains(noisy[-1]),
        cost_scale=np.ones(1),
        floor=np.zeros(1),
        least=np.full(1, np.inf),
        ends=(np.full(PLACES, USUAL), np.concatenate(noisy)),
        work=np.array([100 * PLACES, 200 * PLACES * len(noisy)]),
        attempt=len(noisy),
        heated=True,
    )


def places(best):
    return [BEST] * best + [USUAL] * (PLACES - best)


ONE_BEST = [BEST] + [USUAL] * (CHAINS - 1)


@pytest.mark.parametrize(
    ("kept", "noisy", "another"),
    [
        (ONE_BEST, [places(1)], True),  # as the first to come there, and only once
        (ONE_BEST, [places(1), places(1)], False),  # and again
        (ONE_BEST, [places(1), places(0)], False),
        (ONE_BEST, [places(20)], True),  # the three that are left may finish half of the chains
        ([BEST] + [USUAL] * 40 + [2.5] * 23, [places(1), places(1)], True),  # some are far off
        ([BEST] * CHAINS, [places(CHAINS)], False),
    ],
)
def test_attempts_go_on_where_they_may_finish_chains_or_something_better_may_be_left(
    kept, noisy, another
):
    todo, heated = DECISIONS.next_attempt(stage(kept, *noisy), PLACES)
    assert (len(todo) == 1) == another
    assert heated or not another


def test_chains_that_are_done_take_nothing_that_still_moves():
    owners = np.repeat(np.arange(CHAINS), PLACES // CHAINS)
    at, found = stage([BEST] * CHAINS, places(0)), chains(places(3), moving=True)
    assert DECISIONS.not_for_done_chains(at, found, owners).missed.all()
    settled = chains(places(3))
    assert not DECISIONS.not_for_done_chains(at, settled, owners).missed.any()
    at = stage([BEST] + [USUAL] * (CHAINS - 1), places(0))  # all but one are not done
    missed = DECISIONS.not_for_done_chains(at, found, owners).missed
    np.testing.assert_array_equal(missed, owners == 0)
    with_rollouts = replace(DECISIONS, settings=replace(SETTINGS, rollouts=Rollouts()))
    assert not with_rollouts.not_for_done_chains(at, found, owners).missed.any()
