"""Warm starts: few iterations where little has changed, and never worse than the guess."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import DT, K, double_integrator, fastest

from mjx_drax import DraxError, Polish, Restarts, Trajectory, from_function, solve
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.warm import require_alike
from mjx_drax.solution.solve import warm_of


def limited(target=1.0, **changes):
    """To a target at rest, along a rail with an end, by a force that has limits."""
    given = {
        "running_residual": lambda x, u: u,
        "terminal_equality": lambda x, knot: x - jnp.stack([knot.data[0], 0.0]),
        "inequality": lambda x, u: x[1:] - 0.7,
        "u_bounds": (-1.5, 1.5),
        "data": np.full((K + 1, 1), target),
    }
    return double_integrator(**given | changes)


@pytest.fixture(scope="module")
def cold():
    return solve(limited(), chains=4)


def iterations(found):
    return found.iterations - found.history["noise_ends"][0]


@pytest.mark.slow
def test_the_answer_itself_stays(cold):
    again = solve(limited(), chains=4, guess=cold)
    assert again.optimal_chains.all()
    assert iterations(again) <= 20
    np.testing.assert_allclose(again.cost, cold.cost, rtol=1e-4)


@pytest.mark.slow
def test_another_target_takes_few_iterations(cold):
    other = solve(limited(1.05), chains=4)
    warm = solve(limited(1.05), chains=4, guess=cold)
    assert warm.optimal_chains.all()
    assert iterations(warm) < other.iterations
    np.testing.assert_allclose(warm.cost, other.cost, rtol=1e-3)


@pytest.mark.slow
def test_a_longer_horizon_begins_with_the_old_motion(cold):
    longer = limited(horizon=(K + 4) * DT, data=np.full((K + 5, 1), 1.0))
    warm = solve(longer, chains=2, guess=cold)
    assert warm.optimal_chains.all()
    np.testing.assert_allclose(warm.cost, solve(longer, chains=2).cost, rtol=1e-3)


@pytest.mark.slow
def test_no_chain_ends_worse_than_its_guess(cold):
    hasty = replace(Restarts(), attempts=1, descent=3, polish=Polish(iterations=2))
    worst = solve(limited(), chains=4, solver=hasty)
    assert worst.cost.min() > 1.001 * cold.cost.min() or not worst.feasible.any()
    knots = Trajectory(cold.trajectories.x, cold.trajectories.u)
    found = solve(limited(), chains=4, solver=hasty, guess=knots)
    np.testing.assert_allclose(found.cost, cold.cost, rtol=1e-5)
    assert found.certified


@pytest.mark.slow
def test_solutions_of_other_sizes_are_refused(cold):
    with pytest.raises(DraxError, match="guess is the solution of a problem with 1 constraints"):
        solve(limited(inequality=None), chains=2, guess=cold)


def test_guesses_with_another_x_0_or_other_inequalities_are_refused(cold):
    known = warm_of(cold, limited(), 2)
    require_alike(limited(), known)
    start = jnp.zeros((2, 1))
    for knots, words in (
        (replace(known.knots, start=start), "1 free coordinates of x_0"),
        (replace(known.knots, slack=None), "0 inequalities"),
    ):
        with pytest.raises(DraxError, match=words):
            require_alike(limited(), replace(known, knots=knots))


def test_the_step_of_a_guess_is_the_step_of_its_first_knot():
    """So the best knots of a free duration are a guess; and `start` has to fit."""
    problem = fastest(knots=5)
    x = np.tile([[0.2, 0.1, 0.35]], (5, 1))
    knots = initial_knots(problem, 2, Trajectory(x, np.ones((5, 1))), None)
    np.testing.assert_allclose(problem.x_init[2] + knots.start, 0.35, rtol=1e-6)
    for start, words in (([1.0, 2.0], "give 1 finite numbers"), ([np.nan], "give 1 finite")):
        with pytest.raises(DraxError, match=words):
            initial_knots(problem, 2, Trajectory(x, np.ones((5, 1)), start=start), None)


@pytest.mark.slow
def test_a_guess_that_is_better_than_what_is_found_is_polished():
    def problem(**scatter):  # a point that must pass a moving disc, ahead of it or behind
        def step(x, u, knot):
            return x + knot.dt * u[1] * jnp.stack([jnp.cos(u[0]), jnp.sin(u[0])])

        def inside(x, u, knot):
            disc = jnp.stack([0.8, 0.5 * knot.time - 0.6])
            return 0.09 - jnp.sum((x - disc) ** 2, keepdims=True)

        return from_function(
            step,
            x_init=np.zeros(2),
            nu=2,
            horizon=(0.5, 6.0),
            knots=40,
            running_cost=lambda x, u, knot: knot.dt,
            terminal_equality=lambda x: x - jnp.array([2.0, 0.0]),
            inequality=inside,
            u_bounds=([-3.2, 0.0], [3.2, 1.0]),
            **scatter,
        )

    ahead = solve(problem(u_scatter=([-1.0, 0.5], [1.0, 1.0])), chains=12, progress=False)
    behind = solve(problem(), chains=1, progress=False)
    assert behind.replay_cost.min() > 1.05 * ahead.replay_cost.min()
    found = solve(problem(), chains=1, guess=ahead.best, progress=False)
    assert found.optimal
    assert found.replay_cost.max() == pytest.approx(ahead.replay_cost.min(), rel=1e-3)
