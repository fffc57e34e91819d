"""Which chains are done, how long an attempt waits, and what follows it."""

from dataclasses import replace

import numpy as np

from mjx_drax.search.attempts import (
    AttemptSoFar,
    done_up_to,
    noise_is_better,
    owners_of_places,
    stricter,
    temperature,
    wanted,
)

INF = np.inf


def so_far(cost, active, before=None, **rest):
    cost = np.asarray(cost, float)
    usual = {"bar": 1.0, "wanted": len(cost), "needless": 0.0, "iterations": 100}
    usual |= {"since": 20, "wider": 1.0}
    return AttemptSoFar(
        active=np.asarray(active, bool),
        cost=cost,
        before=cost if before is None else np.asarray(before, float),
        **(usual | rest),
    )


def test_the_worst_chains_get_the_best_that_was_found():
    done, cost = np.array([False, True, False, False]), np.array([2.0, 1.0, INF, 5.0])
    best_first = np.array([3, 0, 4, 2, 1])
    np.testing.assert_array_equal(owners_of_places(done, cost, best_first), [3, 3, 2, 2, 0])
    both = np.stack([done, ~done]), np.stack([cost, cost]), np.stack([best_first] * 2)
    np.testing.assert_array_equal(owners_of_places(*both), [[3, 3, 2, 2, 0], [1] * 5])
    everyone = np.ones(4, bool)
    np.testing.assert_array_equal(owners_of_places(everyone, cost, best_first), [0] * 5)


def test_defects_are_penalized_more_where_few_chains_are_feasible():
    feasible = np.array([[True, False, False, False], [True, True, False, False]])
    np.testing.assert_array_equal(stricter(np.array([2.0, 3.0]), feasible), [20.0, 3.0])


def test_chains_are_done_up_to_a_share_above_the_best_or_of_its_size():
    costs = np.array([[10.0, 11.5, INF], [INF, INF, INF], [100.0, 101.0, 111.0]])
    sizes = np.array([[np.nan] * 3, [np.nan] * 3, [5.0, 5.0, 5.0]])
    bars = done_up_to(costs, sizes, 0.1, np.ones(3))
    np.testing.assert_allclose(bars, [[11.0], [-INF], [100.5]])
    bars = done_up_to(np.zeros((1, 2)), np.ones((1, 2)), 0.1, np.array([50.0]))
    np.testing.assert_allclose(bars, [[0.05]])  # costs of no importance


def test_all_active_places_are_waited_for_unless_another_attempt_will_be_made():
    # the third is far too expensive, the fourth is not sound yet
    cost, active = [0.9, 0.95, 7.0, INF], [False, True, True, True]
    must = so_far(cost, active)
    np.testing.assert_array_equal(must.waited_for, [False, True, False, True])
    may = so_far(cost, active, needless=1.0)
    np.testing.assert_array_equal(may.waited_for, active)


def test_an_attempt_that_only_looks_for_better_optima_ends_when_few_may_be_one():
    cost, active = [0.9, 0.95, 7.0, INF], [False, True, True, True]
    at = so_far(cost, active, wanted=1, needless=1.0)
    assert not at.over
    np.testing.assert_array_equal(at.waited_for, [False, True, False, True])
    # after two that have settled, half a one of the two that move is expected to be better
    assert so_far([*cost, 0.9], [*active, False], wanted=1, needless=1.0).over


def test_half_of_the_places_must_agree_in_the_first_attempt():
    assert [wanted(64, places) for places in (64, 128, 192, 256)] == [64, 64, 96, 128]


def test_an_attempt_is_over_once_enough_chains_have_settled():
    assert not so_far([0.9, 0.9], [False, True]).over  # no other attempt would follow
    assert not so_far([0.9, 0.9], [False, True], needless=1.0).over  # nor a finish do more
    assert so_far([0.9, 0.9], [False, True], wanted=1).over
    assert not so_far([0.9, INF], [True, True], wanted=1).over


def test_an_attempt_is_over_when_another_brings_chains_faster():
    cost = np.array([0.9] * 40 + [7.0] * 60)
    at = so_far(cost, [True] * 100)
    assert at.over  # none in 20 iterations, 40 in 100
    before = np.where(np.arange(100) < 30, cost, INF)
    assert not replace(at, before=before).over  # ten in 20
    assert not replace(at, needless=58.0).over  # two are missing, which another cannot exceed
    fewer = so_far([0.9] * 2 + [7.0] * 98, [True] * 100, before=[0.9] * 5 + [7.0] * 95)
    assert not fewer.over  # three are not feasible for the moment
    late = replace(at, iterations=1000)
    assert not late.over  # one more in 20 is not slower than 40 in 1,000
    assert replace(late, wider=4.0, wanted=400).over  # but slower than 160 in 1,000
    assert not replace(late, wider=4.0, wanted=85).over  # of which 45 are missing


def test_each_place_that_finds_what_is_wanted_makes_a_chain_done():
    at = so_far([0.9, 0.9, 0.9, 7.0], [False] * 4, wanted=5, needless=0.5)
    assert at.missing(at.near) == 1.5


def test_noise_goes_on_where_it_brought_as_many_chains_for_each_iteration():
    assert noise_is_better(np.array([10, 20]), np.array([100, 200]))
    assert not noise_is_better(np.array([10, 19]), np.array([100, 200]))
    assert noise_is_better(np.array([0, 0]), np.array([100, 400]))


def test_the_temperature_is_the_best_cost_and_never_negligible():
    costs, feasible = np.array([4.0, -2.0, 1.0]), np.array([True, False, True])
    assert temperature(costs, feasible, 1.0) == 1.0
    assert temperature(costs, ~feasible, 1.0) == 2.0
    assert temperature(0.0 * costs, feasible, 1.0) == 1e-3
