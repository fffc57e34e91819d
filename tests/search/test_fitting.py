"""Boxes of initial knots that do not fit a motion, and what others save."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from builders import point, robot
from jax.tree_util import Partial

from mjx_drax import (
    Langevin,
    at_time,
    from_function,
    from_program,
    minimize,
    solve,
    solve_batch,
    tasks,
)
from mjx_drax.base.errors import DraxWarning
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.fitting import Answer, is_better, narrowed, widened

INF = np.inf


def motion(x, u):
    """States x_0..x_10 that move from 0 to x, and controls that are u half of the time."""
    return np.linspace(0.0, x, 11), np.outer(np.arange(10) % 2, u)


def boxes(problem):
    """Lower and upper sides of states and of controls."""
    box = problem.scatter
    return [np.asarray(side).tolist() for side in (box.x_lower, box.x_upper)], [
        np.asarray(side).tolist() for side in (box.u_lower, box.u_upper)
    ]


def test_a_box_that_no_control_uses_becomes_ten_times_as_wide_as_the_motion():
    given = point(u_bounds=([-1e3, 0.0], [1e3, 1e4]))
    problem, which = narrowed(given, given, *motion([1.0, 1.0], [2.0, 0.0]))
    assert which.tolist() == [False, False, True, True]
    of_x, of_u = boxes(problem)
    assert of_x == boxes(given)[0]
    assert of_u == [[-20.0, 0.0], [20.0, 10.0]]  # what stands still gets a thousandth
    assert jnp.array_equal(problem.bounds.u_upper, given.bounds.u_upper)
    again, which = narrowed(given, problem, *motion([1.0, 1.0], [0.1, 0.0]))
    np.testing.assert_allclose(boxes(again)[1], [[-1.0, 0.0], [1.0, 0.01]], rtol=1e-6)


def test_a_box_of_which_something_is_used_stays():
    x, u = motion([1.0, 1.0], [2.0, 30.0])
    used = point(u_bounds=([-1e3, -1e3], [1e3, 1e3]))
    assert narrowed(used, used, x, u) is None
    given = point(u_bounds=(-1e6, 1e6), u_scatter=(-1e3, 1e3))
    assert narrowed(given, given, x, u) is None
    one_sided = point(u_bounds=(0.0, INF))
    assert narrowed(one_sided, one_sided, x, u) is None
    by_knot = point(u_bounds=(-1e6 * np.ones((10, 2)), 1e6))
    assert narrowed(by_knot, by_knot, x, u) is None


@pytest.mark.slow
@pytest.mark.parametrize(("wide", "there"), [(1e4, -0.5), (1e5, 8.0), (1e6, 8.0)])
def test_bounds_that_mean_none_do_not_make_anything_feasible(wide, there):
    problem = from_function(
        lambda x, u: x + 0.05 * jnp.stack([x[1], u[0]]), x_init=[0.0, 0.0], nu=1, dt=0.05,
        horizon=2.0, running_residual=lambda x, u: 0.05 * u,
        terminal_residual=lambda x: x[1:] - 5.0, u_bounds=(-20.0, 20.0),
        x_bounds=([-wide, -5.0], [wide, 5.0]), equality=at_time(lambda x, u: x[:1] - there, 1.0),
    )  # fmt: skip
    found = solve(problem, chains=4)
    assert found.certified == (there < 5.0)  # no motion gets further in a second
    if found.certified:
        assert found.replayed[0][20, 0] == pytest.approx(there, abs=0.05)


def test_where_no_bound_is_a_box_is_narrower_if_nothing_uses_it():
    given = point(x_bounds=([-INF, -1e3], [INF, 1e3]))
    x, u = motion([1e-3, 1e-2], [2e-3, 0.0])
    problem, which = narrowed(given, given, x, u)
    assert which.tolist() == [True, True, True, True]
    np.testing.assert_allclose(boxes(problem)[0][1], [1e-2, 2.0], rtol=1e-6)
    np.testing.assert_allclose(boxes(problem)[1][1], [2e-2, 2e-3], rtol=1e-6)
    _, which = narrowed(given, given, x, 100.0 * u)  # what is free and used stays
    assert which.tolist() == [True, True, False, False]
    _, which = narrowed(given, given, 1e3 * x, u)
    assert which.tolist() == [False, True, True, True]
    assert narrowed(given, given, 1e5 * x, 100.0 * u) is None


def test_a_cost_that_was_paid_for_with_violations_gives_way():
    problem = point(running_residual=lambda x, u: u, terminal_equality=lambda x: x - 1.0)

    def answer(miss, cost):
        x = jnp.linspace(0.1, 1.0, 10)[:, None] * jnp.ones(2) * (1.0 - miss)
        knots = Trajectory(x, jnp.ones((10, 2)) * (1.0 - miss))
        return Answer(None, problem, np.zeros((11, 2)), knots, cost, False)

    exact = answer(0.0, 1.0)
    assert is_better(answer(1e-4, 0.9), exact, 1e-4)
    assert not is_better(answer(1e-4, 0.4), exact, 1e-4)  # it is another motion
    assert not is_better(answer(0.0, 0.9), exact, 1e-4)
    assert is_better(answer(0.0, 1.01), exact, 1e-4)
    assert not is_better(answer(0.0, 1.00001), exact, 1e-4)
    assert is_better(answer(0.1, 0.1), exact, 1e-4)  # it is not feasible


def test_states_count_from_where_they_start():
    given = point(x_init=[100.0, -3.0], x_bounds=(-1e4, 1e4))
    x, u = motion([1.0, 1.0], [0.5, 0.5])
    problem, which = narrowed(given, given, x + np.array([100.0, -3.0]), u)
    assert which.tolist() == [True, True, False, False]
    assert boxes(problem)[0] == [[80.0, -23.0], [120.0, 17.0]]


def test_what_is_chosen_for_a_whole_motion_is_not_taken_for_standing_still():
    given = point(horizon=(0.5, 50.0), knots=10, dt=None, f=lambda x, u, knot: x + knot.dt * u)
    x, u = motion([1.0, 1.0], [0.5, 0.5])
    whole = np.tile(np.asarray(given.x_init), (11, 1))
    whole[:, :2] += x
    assert narrowed(given, given, whole, u) is None
    _, which = narrowed(given, given, np.tile(whole[:1], (11, 1)) + 1e-4 * whole, u)
    assert which.tolist() == [True, True, False, False, False]


def test_where_f_has_kinks_nothing_is_narrower():
    given = tasks.load("hopper_jump").make()
    nx, nu = given.dynamics.nx, given.dynamics.nu
    assert narrowed(given, given, np.zeros((11, nx)), np.zeros((10, nu))) is None
    assert robot().dynamics.kinked is False


def test_a_box_that_is_left_far_behind_becomes_twice_as_wide_as_the_motion():
    given = point(x_init=[5.0, 0.0], x_bounds=([-INF, -50.0], [INF, 50.0]), u_bounds=(0.0, INF))
    x, u = motion([100.0, 40.0], [1e3, 1e3])
    problem, which = widened(given, x + np.array([5.0, 0.0]), u)
    assert which.tolist() == [True, False, False, False]  # the others have a bound
    assert boxes(problem)[0] == [[-195.0, -50.0], [205.0, 50.0]]
    assert boxes(problem)[1] == boxes(given)[1]
    assert widened(problem, x, u) is None
    by_knot = point(x_bounds=(-INF * np.ones((10, 2)), INF))
    assert widened(by_knot, 1e3 * x, 0.0 * u) is None
    near = motion([19.0, 1.0], [1.0, 1.0])[0]
    assert widened(given, near + np.array([5.0, 0.0]), u) is None
    assert widened(tasks.load("hopper_jump").make(), np.full((11, 11), 1e6), u) is None


SLOW = pytest.mark.slow


def effort(weight, x, u):
    return weight * u


def miss(end, x):
    return x - end


@pytest.mark.parametrize(
    "far", [1e5, pytest.param(1e-2, marks=SLOW), pytest.param(1e-4, marks=SLOW), 1e-6]
)
def test_motions_that_do_not_fit_the_default_box_are_found(far):
    problem = runs(
        np.inf,
        u_bounds=None,
        running_cost=None,
        running_residual=Partial(effort, 0.1 / far),  # all distances have one program
        terminal_equality=Partial(miss, jnp.array([far, 0.0])),
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = solve(problem, chains=4)
    for words, expected in (("beyond the default ones", far > 1.0), ("by default", far < 1e-3)):
        assert any(words in str(each.message) for each in told) == expected
    assert found.optimal
    assert found.replay_cost[found.best_chain] == pytest.approx(0.07519, rel=1e-3)


def runs(bound, **changes):
    """A double integrator whose cost is least without force, and whose force may be large."""
    return from_function(
        lambda x, u: x + 0.1 * jnp.stack([x[1], u[0]]),
        **{
            "x_init": np.zeros(2),
            "nu": 1,
            "dt": 0.1,
            "horizon": 2.0,
            "running_cost": lambda x, u: (u[0] + 1.0) ** 2,
            "u_bounds": (0.0, bound),
            **changes,
        },
    )


@pytest.mark.parametrize("bound", [pytest.param(1e3, marks=SLOW), 1e7])
def test_wide_bounds_do_not_hide_that_a_motion_is_no_optimum(bound):
    with pytest.warns(DraxWarning, match="solved again.*u0 have, between bounds"):
        found = solve(runs(bound), chains=4)
    assert found.optimal
    assert found.replay_cost[found.best_chain] == pytest.approx(20.0, rel=1e-3)
    assert float(found.problem.bounds.u_upper[0]) == bound


@pytest.mark.slow
def test_wide_bounds_do_not_hide_that_a_constraint_is_broken():
    opposed = runs(
        1.0,
        x_bounds=(-1e4, 1e4),
        u_bounds=(-1e3, 1e3),
        terminal_equality=lambda x: jnp.stack([x[0] - 0.5, x[0] - 0.52]),
    )
    with pytest.warns(DraxWarning, match="solved again"):
        found = solve(opposed, chains=4)
    assert not found.certified


def test_programs_with_wide_bounds_end_at_their_optimum():
    program = from_program(
        1, cost=lambda x: x[0] ** 2, inequality=lambda x: 1.5 - x, bounds=(-1e6, 1e6)
    )
    with pytest.warns(DraxWarning, match=r"room that x\[0\] have.*narrower bounds, or a scatter"):
        found = minimize(program, chains=4)
    assert found.optimal
    assert found.best[0] == pytest.approx(1.5, rel=1e-3)


def test_a_batch_says_that_its_bounds_are_too_wide():
    starts = np.array([[0.0, 0.0], [0.5, 0.0]], np.float32)
    with pytest.warns(DraxWarning, match="say little. Give narrower bounds, or x_scatter"):
        solve_batch(runs(1e7).with_x_init, starts, chains=2, solver=Langevin(tail=20))
