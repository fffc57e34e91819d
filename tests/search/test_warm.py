"""Warm starts: few iterations where little has changed, and never worse than the guess."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import DT, K, double_integrator

from mjx_drax import DraxError, Polish, Restarts, Trajectory, solve


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
