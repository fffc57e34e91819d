"""Goals that cheap plans miss: chains that reach them are what a search keeps, and what is told."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import Restarts, from_function, solve, solve_batch
from mjx_drax.search.recording import Recorder

STARTS = np.array([[0.0], [0.05], [-0.05]])


def wells(x_init=(0.0,), goal=lambda x: x[0] > 0.5):
    """A cheap valley at -1, and a dearer one at +1, where the goal is."""
    return from_function(
        lambda x, u: x + 0.1 * u,
        x_init=x_init,
        nu=1,
        dt=0.1,
        horizon=1.0,
        running_cost=lambda x, u: 0.01 * u[0] ** 2,
        terminal_cost=lambda x: 20.0 * (x[0] ** 2 - 1.0) ** 2 + x[0] + 1.0,
        u_bounds=(-5.0, 5.0),
        goal=goal,
    )


PROBLEM = wells()


@cache
def solved(attempts=5):
    return solve(PROBLEM, chains=8, solver=Restarts(attempts=attempts), progress=False)


def test_a_warm_start_that_misses_the_goal_replaces_nothing():
    left = solve(wells(goal=None), chains=8, progress=False)
    assert left.trajectories.x[left.best_chain, -1, 0] < 0
    assert solve(PROBLEM, chains=8, guess=left, progress=False).certified_chains.all()


def test_a_solve_that_is_ended_in_a_later_attempt_keeps_what_reached_the_goal():
    first = int(solved(1).certified_chains.sum())
    assert 0 < first < 8
    for stop in range(int(solved().history["began"][1]) + 20, solved().iterations, 40):

        def end(done, total, info, stop=stop):
            if done >= stop:
                raise KeyboardInterrupt

        ended = solve(PROBLEM, chains=8, progress=end)
        assert ended.interrupted, stop
        assert ended.certified_chains.sum() >= first


def test_a_warm_start_of_fewer_chains_takes_those_that_reach_the_goal():
    found = solved(1)
    assert not found.certified_chains[np.argsort(found.cost)[:2]].any()
    again = solve(PROBLEM, chains=2, guess=found, solver=Restarts(attempts=1), progress=False)
    assert again.certified_chains.all()


def test_a_batch_takes_the_chains_that_reach_the_goal():
    found = solve_batch(PROBLEM.with_x_init, STARTS, chains=8, progress=False)
    assert found.certified.all()
    assert (found.x[:, -1, 0] > 0.5).all()


def test_a_batch_without_any_says_so_once():
    never = wells(goal=lambda x: False)
    one = Restarts(attempts=1)
    found = solve_batch(never.with_x_init, STARTS, chains=8, solver=one, progress=False)
    assert [found.where(i).kind for i in range(3)] == ["goal"] * 3
    assert "there are none" in str(found)
    assert "nan" not in str(found)


def test_a_recording_follows_the_attempt_that_gave_the_answer():
    recorder = Recorder(40)
    found = solve(PROBLEM, chains=8, record=recorder, progress=False)
    for chain in range(8):
        end = found.recording.history_of(chain).x[-1, -1, 0]
        assert end == pytest.approx(found.trajectories.x[chain, -1, 0], abs=1e-3)


def test_problems_of_a_batch_may_have_further_states(tmp_path):
    def step(x, u, knot):
        return x + 0.1 * jnp.stack([x[1], u[0] * knot.parameters["gain"]])

    problem = from_function(
        step,
        x_init=np.zeros(2),
        nu=1,
        dt=0.1,
        horizon=1.0,
        parameters={"gain": (0.5, 2.0)},
        running_cost=lambda x, u: u @ u,
        terminal_equality=lambda x: x - jnp.array([0.3, 0.0]),
    )
    starts = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]])
    given = {"chains": 2, "chunk": 2, "progress": False}
    found, again = (
        solve_batch(problem.with_x_init, starts, checkpoint=tmp_path / "file", **given)
        for _ in range(2)
    )
    assert found.certified.all()
    np.testing.assert_array_equal(again.u, found.u)
    np.testing.assert_allclose(found.x[:, 0, :2], starts)
