"""Descending first, heating what failed: nothing found is lost, and no setting depends on units."""

from dataclasses import dataclass, fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import bouncing, point
from jax.tree_util import Partial

from mjx_drax import (
    Constant,
    DraxError,
    GaussNewton,
    Geometric,
    Identity,
    Langevin,
    Polish,
    Restarts,
    Smoothed,
    Trajectory,
    from_dynamics,
    from_function,
    from_program,
    minimize,
    solve,
    solve_batch,
    tasks,
)
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import State
from mjx_drax.method.schedules import Scale
from mjx_drax.polish.interior_point import Progress
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.search import restarts
from mjx_drax.search.chains import Chains, best_of
from mjx_drax.search.engine import Search
from mjx_drax.search.family import Family
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.iterate import Question, begin, evaluate, iterate, partition, restart_at
from mjx_drax.search.replayer import Replayer
from mjx_drax.search.restarts import Rollouts, settled

DT, K = 0.1, 20


def wells(x):
    """A good minimum near -1, and one near 1 that costs more than twice as much."""
    return 10 * (x[0] ** 2 - 1) ** 2 + 4 * x[0] + 6 + x[1] ** 2


PROGRAM = from_program(2, cost=wells, bounds=(-2.0, 2.0))
RARE = from_program(2, cost=wells, bounds=([-1.2, -2.0], [2.0, 2.0]))  # a third start near it
SHORT = replace(Restarts().flow, iterations=40, tail=20)


def search(solver, chains=8, problem=PROGRAM, progress=None):
    """What a search comes to: where the chains are, its records, when attempts began."""
    settings = settled(problem, chains, 0, solver)
    return Search(Family.of_one(problem), chains, 0, settings, progress=progress).run()


def swing(weight=1.0):
    """A damped pendulum with little torque, whose cost is in units of 1 / weight."""
    root = np.sqrt(weight)
    return from_function(
        lambda x, u: x + DT * jnp.array([x[1], 2.0 * u[0] - 2.0 * jnp.sin(x[0]) - 0.1 * x[1]]),
        x_init=[0.0, 0.0],
        nu=1,
        dt=DT,
        horizon=K * DT,
        running_residual=lambda x, u: root * 0.1 * u,
        terminal_residual=lambda x: root * jnp.array([5.0, 2.0]) * (x - jnp.array([1.5, 0.0])),
        u_bounds=(-1.0, 1.0),
        x_scatter=(-3.0, 3.0),
    )


def two_links(obstacle):
    """A planar arm, at rest before and after, whose hand keeps 0.4 m away from a point."""

    def rate(x, u):
        v, c, s = x[2:], jnp.cos(x[1]), jnp.sin(x[1])
        M = jnp.array([[1.667 + c, 0.333 + 0.5 * c], [0.333 + 0.5 * c, 0.333]])
        bias = 0.5 * s * jnp.array([-(2 * v[0] + v[1]) * v[1], v[0] ** 2])
        return jnp.concatenate([x[2:], jnp.linalg.solve(M, u - bias)])

    def step(x, u):
        half = x + 0.025 * rate(x, u)
        return x + 0.05 * rate(half, u)

    def too_near(x, u):
        first, both = x[0], x[0] + x[1]
        hand = jnp.array([jnp.cos(first) + jnp.cos(both), jnp.sin(first) + jnp.sin(both)])
        return 0.16 - jnp.sum((hand - jnp.array(obstacle)) ** 2)

    return from_function(
        step,
        x_init=[0.0, 0.3, 0.0, 0.0],
        nu=2,
        dt=0.05,
        horizon=2.0,
        running_residual=lambda x, u: 0.3 * u,
        terminal_equality=lambda x: x - jnp.array([1.3, 0.3, 0.0, 0.0]),
        inequality=too_near,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("start", "coolings"), [(6.0, 0), (1e3, 2), (1e4, 3)])
def test_an_attempt_that_noise_throws_away_starts_again_with_less(start, coolings):
    solver = Restarts(attempts=2, done_share=1.1)  # always with noise
    solver = replace(solver, flow=replace(solver.flow, noise=Geometric(start, 1.5e-3)))
    found = solve(point(running_residual=lambda x, u: 0.1 * u), chains=4, solver=solver)
    began = found.history["began"]
    np.testing.assert_array_equal(np.diff(began)[1:], np.full(coolings, 20))
    assert len(began) == 2 + coolings
    assert found.optimal


@pytest.mark.slow
def test_chains_in_the_worse_minimum_are_heated_until_they_leave_it():
    once = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=1))
    assert 0 < np.mean(once.cost > 2 * once.cost.min()) < 1  # some are trapped
    many = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=8, done_share=1.0))
    assert (many.cost < 2 * many.cost.min()).all()
    assert many.cost.min() == pytest.approx(once.cost.min(), rel=1e-3)


@pytest.mark.slow
def test_beyond_enough_every_chain_is_tried_again():
    first = search(Restarts(SHORT, attempts=1), chains=6)
    further = search(Restarts(SHORT, attempts=3, done_share=2.0), chains=6)
    assert (further.chains.cost <= first.chains.cost).all()
    moved = further.chains.cost < 0.99 * first.chains.cost
    assert moved.any()
    assert len(further.began) == 3


@pytest.mark.slow
def test_chains_take_the_best_that_several_places_found():
    one, four = (
        minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=1, tries=tries))
        for tries in (1, 4)
    )
    assert 0 < np.mean(one.cost > 2 * one.cost.min()) < 0.7  # over a fourth of the tries are good
    assert (four.cost < 2 * one.cost.min()).all()
    assert four.cost.shape == four.history["cost"][0].shape == (16,)


@pytest.mark.slow
def test_where_most_places_disagree_one_more_attempt_looks_for_better_optima():
    once, twice = (
        search(Restarts(SHORT, tries=tries, attempts=attempts), 16, RARE)
        for tries, attempts in ((4, 1), (4, 5))
    )
    assert (once.chains.cost < 2 * once.chains.cost.min()).all()  # all chains are done
    assert [end > began for began, end in twice.began][:2] == [False, True]
    good = from_program(2, cost=wells, bounds=([-2.0, -2.0], [-0.5, 2.0]))
    agreed = search(Restarts(SHORT, tries=4), 16, good)
    assert not any(end > began for began, end in agreed.began)


@pytest.mark.slow
def test_chains_at_the_goal_are_kept_though_others_are_cheaper():
    """A mass between two wells: the goal is in the dearer one, which half of the chains come to."""

    def well(x):
        return 0.5 * (x[0] + 1.0) ** 2 * (x[0] - 2.0) ** 2 + 0.15 * (2.0 - x[0])

    asked = []

    def goal(x):
        asked.append(x)
        return abs(x[0] - 2.0) < 0.2

    problem = from_function(
        lambda x, u: x + DT * jnp.array([x[1], u[0]]),
        x_init=[-1.0, 0.0],
        nu=1,
        dt=DT,
        horizon=4.0,
        running_cost=lambda x, u: 0.02 * well(x) + 0.05 * u[0] ** 2,
        terminal_cost=lambda x: well(x) + x[1] ** 2,
        u_bounds=(-2.0, 2.0),
        x_bounds=([-3.0, -3.0], [4.0, 3.0]),
        goal=goal,
    )
    found = solve(problem, chains=8)
    assert found.success_rate == 1.0
    assert len(asked) < 60  # plans that end alike are asked once
    away = solve(replace(problem, goal=lambda x: abs(x[0] + 1.0) < 0.2), chains=8)
    assert away.cost.max() < 0.6 * found.cost.min()
    never = solve(replace(problem, goal=lambda x: False), chains=8, solver=Restarts(attempts=2))
    assert len(never.history["began"]) == 2
    assert never.success_rate == 0.0


@pytest.mark.slow
def test_later_attempts_have_more_places_than_the_first(monkeypatch):
    monkeypatch.setattr(restarts, "ROOM", 4)
    solver = Restarts(replace(SHORT, iterations=20), attempts=2, done_share=2.0, tries=4)
    found = solve(swing(), chains=2, solver=solver, record=5)
    first, later = found.recording.attempts
    for attempt, places in ((first, 4), (later, 8)):
        assert {len(shot.cost) for shot in attempt.snapshots} == {places}
    for chain, cost in enumerate(found.cost):  # each has what it says that it got
        assert found.recording.history_of(chain).cost[-1] == cost
        np.testing.assert_array_equal(
            found.recording.history_of(chain).x[-1], found.trajectories.x[chain]
        )


@pytest.mark.slow
def test_what_an_attempt_leaves_early_is_polished_in_the_end():
    endless = Polish(tolerance=1e-12, iterations=60, patience=1)
    solver = Restarts(SHORT, descent=10, attempts=2, heated=False, done_share=1.0, polish=endless)
    found = search(solver, chains=64)
    _, (second, _), (finish, no_noise) = found.began
    assert second < solver.descent + endless.iterations  # the first attempt was left early
    assert no_noise == finish
    polished = np.asarray(found.chains.state.polish.iterations)
    assert (polished >= endless.iterations - 2).all()  # the first and the last take no step
    assert found.records[-1][0] - finish < endless.iterations


@pytest.mark.slow
def test_the_best_chain_goes_on_until_it_settles_where_the_polish_was_short():
    pendulum = tasks.load("pendulum").make()

    def ended(patience):
        solver = Restarts(descent=20, attempts=1, polish=Polish(iterations=8, patience=patience))
        return solve(pendulum, chains=3, solver=solver)

    short, long = ended(1), ended(5)
    assert short.polished == ["unfinished"] * 3
    assert "converged" in long.polished
    assert long.optimal
    assert long.iterations <= 28 + 5 * 8


def test_a_solve_ends_after_the_seconds_that_it_is_given():
    found = solve(point(), chains=2, max_seconds=1e-9)
    assert found.interrupted
    assert found.iterations <= 20


@pytest.mark.parametrize(("wind", "heated"), [(0.0, []), (0.01, [True])])
def test_optima_of_different_costs_make_one_more_attempt_with_noise(wind, heated):
    either = from_function(
        lambda x, u: x + DT * u,
        x_init=[0.0],
        nu=1,
        dt=DT,
        horizon=1.0,
        running_residual=lambda x, u: 0.3 * (u + wind),
        terminal_residual=lambda x: 10.0 * (x**2 - 1.0),
    )
    found = search(Restarts(SHORT), 16, either)
    assert len(np.unique(np.sign(found.chains.state.trajectory.x[:, -1, 0]))) == 2  # both are found
    assert [end > began for began, end in found.began if end > began] == heated


@pytest.mark.slow
def test_an_optimum_that_noise_has_found_once_makes_another_attempt():
    arm = two_links(obstacle=[1.2, 0.9])
    once = solve(arm, chains=16, solver=Restarts(attempts=1))
    assert 13.0 < once.cost.min() < once.cost.max() < 14.0  # so all chains are done
    found = solve(arm, chains=16)
    assert found.cost.min() == pytest.approx(7.565, rel=1e-2)


@pytest.mark.slow
def test_attempts_go_on_without_noise_where_it_brought_less_unless_all_are_asked_for():
    flow = replace(SHORT, iterations=200, noise=Constant(1e-6))  # it only takes longer
    for enough, noisy in ((1.0, 0), (2.0, 200)):
        found = search(Restarts(flow, descent=5, attempts=4, done_share=enough), 64, RARE)
        first, second, third, *_ = [ends - began for began, ends in found.began]
        assert (first, second, third) == (0, 200, noisy)


@pytest.mark.slow
def test_chains_that_are_done_are_left_alone():
    first = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=1))
    second = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=2))
    done = first.cost <= 2 * first.cost.min()
    np.testing.assert_array_equal(second.x[done], first.x[done])  # done chains are left alone
    assert (second.cost <= first.cost).all()
    assert (second.cost < first.cost).any()


@pytest.mark.slow
@pytest.mark.parametrize("weight", [1e-3, 1e4])
def test_no_setting_depends_on_the_units_of_the_cost(weight):
    solver = Restarts(SHORT, attempts=1)
    usual, other = (solve(swing(w), chains=4, solver=solver) for w in (1.0, weight))
    assert usual.feasible.all()
    np.testing.assert_allclose(other.trajectories.x, usual.trajectories.x, atol=2e-3)
    np.testing.assert_allclose(other.cost / weight, usual.cost, rtol=2e-2)


@pytest.mark.slow
def test_attempts_share_one_compilation():
    before = iterate._cache_size()
    found = search(Restarts(SHORT, attempts=3, done_share=2.0))
    assert [ends - began for began, ends in found.began] == [0, 40, 40]  # the first has no noise
    assert iterate._cache_size() - before == 1


@pytest.mark.slow
def test_ctrl_c_in_a_later_attempt_keeps_the_answers_of_the_first():
    def interrupt(done, total, info):
        if done > 120:
            raise KeyboardInterrupt

    solver = Restarts(SHORT, attempts=5)
    first = search(replace(solver, attempts=1)).chains
    kept = search(solver, progress=interrupt)
    assert kept.records[-1][0] == 140
    cheaper = kept.chains.cost <= first.cost
    assert (cheaper & kept.chains.feasible >= first.feasible).all()


@pytest.mark.slow
def test_ctrl_c_between_two_attempts_keeps_the_answers_of_the_first():
    reports, drawn = [], []

    def guess(key):
        drawn.append(key)
        if reports and reports[-1] == 120:  # the first attempt's last; the second draws its knots
            raise KeyboardInterrupt
        return Trajectory(jnp.zeros((1, 0)), jax.random.uniform(key, (1, 2), minval=-2.0))

    problem = replace(PROGRAM, guess=guess)
    first = search(Restarts(SHORT, attempts=1), problem=problem)
    before = len(drawn)
    kept = search(Restarts(SHORT), problem=problem, progress=lambda done, *_: reports.append(done))
    assert len(drawn) == before + 2  # once for each attempt
    assert kept.records[-1][0] == 120
    np.testing.assert_array_equal(kept.chains.state.trajectory.u, first.chains.state.trajectory.u)


def attempt(costs, defects, label, missed=False):
    """An attempt whose knots say which one it was, and which row."""
    n = len(costs)
    marks = label + jnp.arange(n)[:, None]
    state = State(marks, marks, marks, marks, (), marks, jnp.ones(n, bool), jnp.full(n, -1))
    none = jnp.zeros(n)
    info = Info(jnp.asarray(costs, float), jnp.asarray(defects, float), none, none, none)
    return Chains(state, info, label + np.arange(n), np.broadcast_to(missed, n))


@pytest.mark.parametrize("kind", [jnp.asarray, np.asarray])  # on the device and on the host
def test_every_chain_keeps_the_best_that_was_found_for_it(kind):
    kept = attempt([5.0, 1.0, 3.0, 9.0], [0.0, 1.0, 0.0, 0.5], 100)
    found = attempt([4.0, 7.0, np.nan, 8.0], [0.0, 0.0, np.nan, 0.2], 200)
    kept, found = (jax.tree.map(kind, chains) for chains in (kept, found))
    # rows 0 and 2 worked for chain 0, row 1 for chain 1, row 3 for chain 3
    best = best_of(kept, found, np.array([0, 1, 0, 3]))
    expected = [200, 201, 102, 203]  # cheaper; feasible; untouched; less infeasible
    np.testing.assert_array_equal(best.state.trajectory[:, 0], expected)
    np.testing.assert_array_equal(best.feasible_since, expected)
    np.testing.assert_array_equal(best.info.cost, [4.0, 7.0, 3.0, 8.0])


def test_a_motion_whose_cost_is_not_a_number_is_not_feasible():
    chains = attempt([1.0, np.nan, 2.0, 9.0], [0.0, 0.0, 0.0, 1.0], 100)
    np.testing.assert_array_equal(chains.feasible, [True, False, True, False])
    assert chains.sound_cost.min() == 1.0
    np.testing.assert_array_equal(chains.order()[0], [0, 2, 3, 1])
    best = best_of(chains, attempt([9.0] * 4, [0.0] * 4, 200), np.arange(4))
    np.testing.assert_array_equal(best.feasible_since, [100, 201, 102, 203])


def test_a_rollout_replaces_what_is_optimal_only_if_it_costs_clearly_less():
    def polished(chains, optimal):
        names = [f.name for f in fields(Progress)]
        polish = Progress(**(dict.fromkeys(names, jnp.zeros(3)) | {"optimal": jnp.array(optimal)}))
        return replace(chains, state=replace(chains.state, polish=polish))

    kept = attempt([1001.0, 1001.0, 5.0], [0.0, 0.0, 1.0], 100)
    found = attempt([1000.9995, 1000.99, 5.0], [0.0, 0.0, 0.5], 200)
    assert not kept.optimal.any()
    kept, found = polished(kept, [True] * 3), polished(found, [False] * 3)
    best = best_of(kept, found, np.arange(3), np.full(3, 1e3))
    np.testing.assert_array_equal(best.feasible_since, [100, 201, 202])
    best = best_of(kept, found, np.arange(3))
    np.testing.assert_array_equal(best.feasible_since, [200, 201, 202])


def test_what_a_replay_missed_is_better_than_infeasible_only():
    kept = attempt([1.0, 2.0, 1.0, 3.0], [0.0, 0.0, 1.0, 0.0], 100, [True, False, False, True])
    found = attempt([5.0, 1.0, 9.0, 2.0], [0.0, 0.0, 0.0, 0.0], 200, [False, True, True, True])
    best = best_of(kept, found, np.arange(4))
    np.testing.assert_array_equal(best.feasible_since, [200, 101, 202, 203])
    np.testing.assert_array_equal(best.missed, [False, False, True, True])
    np.testing.assert_array_equal(best.sound, ~best.missed)


@pytest.mark.slow
def test_a_langevin_is_one_attempt_as_it_stands():
    found = search(SHORT, chains=4)
    assert found.records[-1][0] == 60
    same = Restarts(SHORT, descent=None, attempts=1, polish=Polish(iterations=0))
    again = search(same, chains=4)
    np.testing.assert_array_equal(found.chains.state.trajectory.u, again.chains.state.trajectory.u)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"attempts": 0}, "attempts is 0: give a whole number of at least 1"),
        ({"descent": -1}, "descent is -1"),
        ({"within": "half"}, "within is 'half'"),
        ({"done_share": -0.5}, "done_share is -0.5"),
        ({"flow": "fast"}, "flow is 'fast': give a Langevin"),
        ({"flow": Langevin(tail=-1)}, "tail is -1"),
        ({"heated": "yes"}, "heated is 'yes': give True, False or None"),
        ({"rollouts": 3}, r"rollouts is 3: give Rollouts\(\) or None"),
        ({"rollouts": Rollouts(rounds=-1)}, "rollouts.rounds is -1"),
        ({"rollouts": Rollouts(iterations=0)}, "rollouts.iterations is 0"),
        (
            {"rollouts": Rollouts(iterations=30), "polish": Polish(iterations=20)},
            "than the 20 that",
        ),
        ({"tries": 0}, "tries is 0: give a whole number of at least 1"),
        ({"polish": 1e-6}, r"polish is 1e-06: give Polish\(\) or None"),
        ({"polish": Polish(0.0)}, "polish.tolerance is 0.0"),
        ({"polish": Polish(iterations=-1)}, "polish.iterations is -1"),
        ({"polish": Polish(patience=0)}, "polish.patience is 0"),
    ],
)
def test_settings_that_are_refused(settings, words):
    with pytest.raises(DraxError, match=words):
        minimize(PROGRAM, chains=2, solver=Restarts(**settings))


def test_a_solver_of_another_kind_is_refused():
    with pytest.raises(DraxError, match="solver is 'ipopt': give a Langevin or a Restarts"):
        minimize(PROGRAM, chains=2, solver="ipopt")


def test_a_tolerance_and_iterations_of_the_polish_are_arguments(balls):
    problem, kinked = swing(), balls[1]
    for solver, tolerance, iterations, found in (
        (None, 1e-3, None, (1e-3, 200)),
        (None, None, 7, (1e-4, 7)),
        (Restarts(polish=Polish(1e-2, 50)), None, 9, (1e-2, 9)),
        (Restarts(polish=Polish(1e-2, 50)), 1e-3, None, (1e-3, 50)),
    ):
        settings = settled(problem, 4, 0, solver, tolerance, iterations)
        assert (settings.polish.tolerance, settings.polish.iterations) == found
    assert settled(kinked, 4, 0, None).polish == Polish(1e-4)
    assert settled(kinked, 4, 0, None, 1e-3).polish == Polish(1e-3)


@pytest.mark.slow
def test_a_looser_tolerance_ends_sooner_and_judges_what_is_optimal():
    once = partial(minimize, PROGRAM, chains=8, solver=Restarts(SHORT, attempts=1))
    loose, tight = (once(tolerance=t) for t in (1e-1, 1e-4))
    assert loose.tolerance == 1e-1
    assert loose.optimal_chains.mean() > 0.5
    assert tight.optimal_chains.mean() > 0.5
    assert np.median(tight.residual) < 1e-4 < np.median(loose.residual)
    few = once(max_iterations=2)
    assert not few.optimal_chains.any()


@pytest.fixture(scope="module")
def balls():
    """The same bouncing ball without and with being told of the kink."""
    return bouncing(kinked=None), bouncing()


NO_ROLLOUTS = Rollouts(first=0, rounds=0)


@pytest.mark.slow
def test_rollouts_follow_where_f_has_kinks(balls):
    """The same dynamics with and without being told of the kink."""
    solver = Restarts(attempts=1, polish=Polish(iterations=0))
    plain, kinked = (solve(p, chains=16, solver=solver, record=10) for p in balls)
    assert not plain.feasible.any()
    assert kinked.feasible.mean() > 0.9
    assert kinked.certified
    assert kinked.iterations > plain.iterations
    for chain in range(16):  # recorded all the way
        path = kinked.recording.history_of(chain)
        np.testing.assert_array_equal(path.x[-1], kinked.trajectories.x[chain])
        assert path.iteration[-1] == kinked.iterations


@pytest.mark.slow
def test_where_all_that_a_round_changes_is_worse_a_share_of_it_helps(balls, monkeypatch):
    no_shots = Rollouts(samples=0)
    solver = Restarts(attempts=1, rollouts=no_shots, polish=Polish(iterations=0))
    in_part = solve(balls[1], chains=8, solver=solver)
    monkeypatch.setattr("mjx_drax.search.replayer.SHARES", (1.0,))  # all of it once more
    whole = solve(balls[1], chains=8, solver=solver)
    assert in_part.feasible.all()
    assert (in_part.cost < whole.cost).all()
    assert np.median(in_part.cost) < 0.6 * np.median(whole.cost)


@pytest.mark.slow
def test_chains_that_rounds_leave_as_they_are_are_not_replayed_again(balls, monkeypatch):
    def answer(all_rows):
        seen, in_part = [], Replayer.rolled_out_in_part

        def watched(self, now, whole, rows, done):
            seen.append(len(rows))
            return in_part(self, now, whole, np.arange(8) if all_rows else rows, done)

        with monkeypatch.context() as patched:
            patched.setattr(Replayer, "rolled_out_in_part", watched)
            return solve(balls[1], chains=8, solver=Restarts(attempts=1)), seen

    (found, seen), (same, _) = answer(all_rows=False), answer(all_rows=True)
    assert 0 < min(seen) < max(seen) == 8
    np.testing.assert_array_equal(found.trajectories.u, same.trajectories.u)
    np.testing.assert_array_equal(found.cost, same.cost)


@register_dataclass
@dataclass(frozen=True)
class Heavier(FunctionDynamics):
    """A mass on a wavy track, and 2 % more of it for what replays it."""

    kinked = True

    def replay(self, plan, u, gains, limits, knots):
        states, forces = super().replay(plan, u / 1.02, gains / 1.02, limits, knots)
        return states, 1.02 * forces


@pytest.mark.parametrize(
    ("fastest", "goal", "keeps"),
    [
        (5.0, lambda x: abs(x[0] - 1.0) < 0.3, True),
        pytest.param(  # it breaks a constraint
            0.5, lambda x: abs(x[0] - 1.0) < 0.3, False, marks=pytest.mark.slow
        ),
        pytest.param(5.0, lambda x: abs(x[0] - 3.0) < 0.3, False, marks=pytest.mark.slow),
        pytest.param(5.0, None, True, marks=pytest.mark.slow),
        pytest.param(0.5, None, False, marks=pytest.mark.slow),
    ],
)
def test_a_rollout_that_does_what_is_asked_is_feasible_by_what_replays_it(fastest, goal, keeps):
    problem = from_dynamics(
        Heavier(Partial(lambda x, u: x + DT * jnp.array([x[1], u[0] - jnp.sin(x[0])])), DT, 2, 1),
        x_init=[0.0, 0.0],
        horizon=K * DT,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=lambda x: 10.0 * (x - jnp.array([1.0, 0.0])),
        inequality=lambda x, u: x[1:] - fastest,
        x_scatter=(-1.0, 1.0),
        goal=goal,
    )
    rollouts = Rollouts(rounds=0, iterations=1, samples=0)
    flow, no_polish = replace(SHORT, tail=1), Polish(iterations=0)
    once = Restarts(flow, descent=1, attempts=1, rollouts=rollouts, polish=no_polish)
    found = solve(problem, 4, solver=once)
    assert (evaluate(problem, found.trajectories).max_defect > 1e-3).all()
    assert found.certified_chains.all() == keeps
    assert (found.max_defect < 1e-5).all() == keeps
    if keeps:
        assert np.isnan(found.residual).all()  # which would be another motion's
        ran = found.open_loop.states[:, 1:]
        np.testing.assert_allclose(found.trajectories.x, ran, atol=1e-5)


def test_a_rollout_on_its_bounds_stays_there():
    """Its max|h| belongs to these knots, not to those that a barrier would move inside."""
    problem, key = swing(), jax.random.key(0)
    shared, own = partition(Question(Restarts().flow, problem, polish=Polish(1e-4)), None)
    knots = initial_knots(problem, 2, None, key)
    state, upper = begin(own, shared, knots, key), problem.bounds.u_upper
    on_bounds = replace(knots, u=jnp.broadcast_to(upper, knots.u.shape))
    moved = restart_at(own, shared, state, on_bounds).trajectory
    np.testing.assert_array_equal(moved.u, on_bounds.u)
    beyond = restart_at(own, shared, state, replace(on_bounds, u=1.1 * on_bounds.u)).trajectory
    np.testing.assert_array_equal(beyond.u, on_bounds.u)


def two_balls(ball, rollouts=None, **changes):
    """A batch of the ball from two starts."""
    solver = Restarts(attempts=1, rollouts=rollouts, polish=changes.pop("polish", None))
    starts = np.array([[1.0, 0.0], [0.8, 0.5]], np.float32)
    make = partial(with_start, ball)
    return starts, solve_batch(make, starts, chains=8, solver=solver, **changes)


def with_start(ball, x):
    return replace(ball, x_init=x)


def test_a_stalled_chain_that_is_moved_is_polished_again():
    problem, key = swing(), jax.random.key(0)
    shared, own = partition(Question(Restarts().flow, problem, polish=Polish(1e-4)), None)
    knots = initial_knots(problem, 2, None, key)
    state = begin(own, shared, knots, key)
    stalled = replace(state, polish=replace(state.polish, stalled=jnp.ones(2, bool)))
    assert not stalled.polish.active.any()
    assert restart_at(own, shared, stalled, knots).polish.active.all()


@pytest.mark.slow
def test_rollouts_follow_in_a_batch_too(balls):
    tail = Polish(iterations=0)
    _, without = two_balls(balls[1], NO_ROLLOUTS, polish=tail)
    _, with_tail = two_balls(balls[1], polish=tail)
    starts, found = two_balls(balls[1])
    assert not (without.chain_defect < 1e-3).any()
    for batch in (with_tail, found):
        assert (batch.chain_defect < 1e-3).mean() > 0.9
    assert found.feasible.all()
    np.testing.assert_array_equal(found.x[:, 0], starts)
    assert without.open_loop.max_deviation.min() > 1.0
    assert found.open_loop.max_deviation.max() < 0.02


@pytest.mark.slow
def test_each_problem_of_a_batch_has_its_own_rollouts(balls):
    """Bit for bit as users compile, which the slow tests do."""
    (_, found), (_, split) = two_balls(balls[1]), two_balls(balls[1], chunk=1)
    np.testing.assert_array_equal(split.u, found.u)
    np.testing.assert_array_equal(split.chain_cost, found.chain_cost)


@pytest.mark.slow
def test_interrupted_between_rollouts_keeps_what_there_is(balls):
    def stop(done, total, info):
        if done > 170:  # the attempt took 160
            raise KeyboardInterrupt

    solution = solve(balls[1], chains=16, progress=stop)
    assert 170 < solution.iterations < 220
    assert solution.feasible.any()


TINY = replace(Restarts().flow, iterations=4, tail=4)


def test_a_gpu_has_room_for_several_places_a_chain(monkeypatch):
    assert settled(swing(), 64, 0, None).tries == 1  # on a CPU
    monkeypatch.setattr(restarts, "on_gpu", lambda: True)
    places = {}
    for chains in (8, 64, 512, 1024, 2048, 16384):
        settings = settled(swing(), chains, 0, None)
        places[chains] = [settings.places(chains, attempt) for attempt in (0, 1, 4)]
    assert places == {
        8: [32, 32, 32],
        64: [256, 256, 256],
        512: [1024, 2048, 2048],
        1024: [1024, 4096, 4096],
        2048: [2048, 4096, 4096],
        16384: [16384, 16384, 16384],
    }
    assert settled(bouncing(), 64, 0, None).tries == 1
    assert settled(swing(), 64, 0, Restarts(tries=2)).places(64, 0) == 128
    assert settled(swing(), 64, 0, Langevin()).tries == 1


@pytest.mark.slow
def test_settings_that_depend_on_the_problem(balls):
    smooth, kinked = (Restarts().for_problem(ball, 4) for ball in balls)
    assert (smooth.within, smooth.done_share, smooth.heated) == (0.1, 0.95, True)
    assert (kinked.within, kinked.done_share, kinked.heated) == (1.0, 0.9, None)
    assert (smooth.rollouts, kinked.rollouts) == (NO_ROLLOUTS, Rollouts())
    assert (smooth.polish, kinked.polish) == (Polish(1e-4), Polish(1e-4))
    sampled = replace(TINY, preconditioner=GaussNewton(derivatives=Smoothed()))
    for flow in (sampled, replace(TINY, preconditioner=Identity())):
        assert Restarts(flow).for_problem(balls[0], 4).polish == Polish(iterations=0)
    with jax.enable_x64(True):
        assert Restarts().for_problem(bouncing(kinked=None), 4).polish == Polish(1e-8)
    solver = Restarts(TINY, descent=4, attempts=2)
    found = solve(balls[1], chains=2, solver=solver).solver
    rest = {"rollouts": Rollouts(), "polish": Polish(1e-4), "tries": 1}
    assert found == replace(solver, within=1.0, done_share=0.9, **rest)


@pytest.mark.slow
def test_where_f_has_kinks_noise_is_tried_in_turns_while_no_chain_is_done(balls):
    lost = replace(balls[1], goal=lambda x: False)
    solver = Restarts(TINY, descent=5, attempts=4, rollouts=Rollouts(first=1, rounds=0))
    easy = replace(lost, goal=lambda x: True)
    for problem, noisy in ((lost, [0, 4, 0, 4]), (easy, [0, 0])):
        history = solve(problem, chains=2, solver=replace(solver, within=0.0)).history
        lengths = (history["noise_ends"] - history["began"])[: len(noisy)]
        np.testing.assert_array_equal(lengths, noisy)


@pytest.mark.slow
def test_no_setting_of_the_users_is_replaced(balls):
    given = {
        "within": 0.5,
        "done_share": 2.0,
        "heated": True,
        "rollouts": Rollouts(first=1, rounds=3, iterations=1),
        "polish": Polish(iterations=0),
        "tries": 2,
    }
    for ball in balls:
        solver = Restarts(TINY, descent=5, attempts=2, **given)
        found = solve(ball, chains=2, solver=solver)
        assert found.solver == solver
        # And they are what was done: two attempts, the second with noise, rounds of one iteration
        np.testing.assert_array_equal(found.history["began"], [0, 12])
        np.testing.assert_array_equal(found.history["noise_ends"], [0, 16])
        np.testing.assert_array_equal(
            found.history["iteration"], [0, 9, 10, 11, 12, 20, 21, 22, 23]
        )
    none = replace(solver, done_share=0.0, heated=False, rollouts=NO_ROLLOUTS)
    found = solve(balls[1], chains=2, solver=none)
    assert found.solver == none
    np.testing.assert_array_equal(found.history["iteration"], [0, 9])


def test_chains_start_near_and_far_where_f_has_kinks(balls):
    keys = jax.random.split(jax.random.key(0), 200)
    near, far = (jax.vmap(p.draw)(keys).x - p.x_init for p in reversed(balls))
    width = np.abs(near[..., 1]).max(axis=1)
    assert np.abs(far[..., 1]).max(axis=1).min() > 6.0
    assert 0.03 * 7.0 < width.min() < 0.05 * 8.0
    assert 6.0 < width.max() <= 8.0


@pytest.mark.slow
def test_a_feasible_guess_that_an_attempt_loses_is_improved():
    problem, rng = bouncing(), np.random.default_rng(0)
    good = solve(problem, chains=8).replayed[1]
    u = np.clip(good + 0.4 * rng.normal(size=good.shape), -3, 3).astype(np.float32)
    x = [np.asarray(problem.x_init)]
    for control in u:
        x.append(np.asarray(problem.dynamics.step(x[-1], control)))
    guess = Trajectory(np.stack(x[1:]), u)
    noise = replace(Restarts().flow, iterations=20, noise=Geometric(30.0, 30.0))
    solver = Restarts(noise, descent=None, attempts=1, polish=Polish(iterations=6))
    found = solve(problem, chains=4, solver=solver, guess=guess)
    assert (found.cost < 0.5 * float(problem.cost(guess))).all()


def test_scales_of_problems_have_their_precision():
    """Else numpy's float64, for which JAX would compile the same program once more."""
    family = Family.of(point().with_x_init, np.zeros((2, 2)))
    ones = Scale(np.ones(2), np.ones(2))
    _, own = family.question(Langevin(), ones, np.arange(2), 3)
    assert own.flow.scale.cost.dtype == own.flow.scale.noise.dtype == np.float32
