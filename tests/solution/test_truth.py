"""What a solution says of its chains is true of the knots that it holds.

The problems have several local optima, in which different chains end: knots, gains, costs and
verdicts of two chains that were swapped would not fit.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import Langevin, Restarts, Trajectory, from_function, solve, solve_batch

VALLEYS = from_function(
    lambda x, u: x + 0.1 * u,
    x_init=[0.1, -0.1],
    nu=2,
    dt=0.1,
    horizon=1.0,
    running_residual=lambda x, u: 0.1 * u,
    # Valleys at x_1, x_2 = -1 or 1: (-1, -1) is the deepest, (1, 1) the highest.
    terminal_residual=lambda x: jnp.concatenate([5.0 * (x**2 - 1.0), x - jnp.array([-1.2, -1.4])]),
)
STARTS = np.array([[0.1, -0.1], [-0.2, 0.2], [0.0, 0.3]], np.float32)
CHAINS = 8
ONCE = Langevin(iterations=1, tail=40)
"""Hardly any noise: a chain stays in the valley where it began."""
TWICE = Restarts(ONCE, descent=40, attempts=2, done_share=1.0)
"""The second attempt works for the chains that did not end in the deepest valley."""


def from_start(x):
    return replace(VALLEYS, x_init=x)


@pytest.fixture(scope="module")
def solution():
    return solve(VALLEYS, CHAINS, solver=TWICE)


@pytest.fixture(
    scope="module",
    params=[pytest.param(ONCE, marks=pytest.mark.slow), TWICE],
    ids=["once", "twice"],
)
def batch(request):
    return solve_batch(from_start, STARTS, chains=CHAINS, solver=request.param)


def test_every_chain_has_its_own_knots(solution):
    assert np.ptp(solution.cost) > 0.1  # some are in other valleys than others
    costs = jax.vmap(VALLEYS.cost)(solution.trajectories)
    np.testing.assert_allclose(costs, solution.cost, rtol=1e-3, atol=1e-4)
    defects = jax.vmap(VALLEYS.max_defect)(solution.trajectories)
    np.testing.assert_allclose(defects, solution.max_defect, atol=1e-5)


def test_the_best_chain_of_every_problem_has_its_own_knots(batch):
    beside = (batch.best[:, None] + [-1, 1]) % CHAINS
    apart = np.take_along_axis(batch.chain_cost, beside, 1) - batch.plan_cost[:, None]
    assert apart.max() > 0.1  # some neighbour is in another valley
    for i, start in enumerate(STARTS):
        problem = from_start(jnp.asarray(start))
        knots = Trajectory(jnp.asarray(batch.x[i, 1:]), jnp.asarray(batch.u[i]))
        np.testing.assert_allclose(problem.cost(knots), batch.plan_cost[i], rtol=1e-3, atol=1e-4)
        replayed = (batch.open_loop, batch.feedback)[batch.replay_modes[i] == "with feedback"]
        again = Trajectory(
            *(jnp.asarray(a[i]) for a in (replayed.states[:, 1:], replayed.controls))
        )
        np.testing.assert_allclose(problem.cost(again), batch.cost[i], rtol=1e-4)
        np.testing.assert_allclose(problem.max_defect(knots), batch.max_defect[i], atol=1e-5)
        np.testing.assert_allclose(batch.open_loop.states[i], batch.x[i], atol=1e-2)
    np.testing.assert_array_equal(batch.plan_cost, batch.chain_cost.min(axis=1))


def test_the_best_chain_of_every_problem_has_its_own_gains():
    """Controls count by their squares, so each is of either sign, and tells that of its gain."""
    either_way = from_function(
        lambda x, u: x + 0.1 * u**2,
        x_init=[0.0],
        nu=1,
        dt=0.1,
        horizon=1.0,
        running_residual=lambda x, u: 0.3 * u**2,
        terminal_residual=lambda x: 5.0 * (x - 1.0),
    )
    starts = np.array([[0.0], [0.1], [-0.2]], np.float32)
    found = solve_batch(lambda x: replace(either_way, x_init=x), starts, CHAINS, solver=TWICE)
    signs = np.sign(found.u[..., 0])
    assert len(np.unique(signs, axis=0)) == len(starts)
    # Where the state is ahead of the plan, the control's size has to shrink
    np.testing.assert_array_equal(np.sign(found.gains[..., 0, 0]), -signs)


def test_an_infeasible_chain_does_not_succeed(solution):
    assert solution.success.all()
    infeasible = np.arange(CHAINS) % 3 == 0
    worse = replace(solution, max_defect=np.where(infeasible, 1.0, solution.max_defect))
    np.testing.assert_array_equal(worse.feasible, ~infeasible)
    np.testing.assert_array_equal(worse.success, ~infeasible)
    np.testing.assert_array_equal(worse.certified_chains, ~infeasible)
    assert worse.success_rate == 1 - infeasible.mean()
    assert not infeasible[worse.best_chain]
    lost = replace(solution, max_defect=np.ones(CHAINS))
    assert not lost.success.any()
    assert not lost.certified


def test_a_chain_that_diverged_does_not_succeed_unless_it_was_feasible_by_then(solution):
    """It was stopped at its last finite knots, which are as good as any others."""
    died = np.where(np.arange(CHAINS) == 1, 3, -1)
    defect = np.where(died >= 0, 1.0, solution.max_defect)
    diverged = replace(solution, died_at=died, max_defect=defect)
    np.testing.assert_array_equal(diverged.success, np.arange(CHAINS) != 1)
    assert diverged.status[1] == "diverged"
    cost = np.where(died >= 0, np.nan, solution.cost)
    assert replace(solution, died_at=died, cost=cost).status[1] == "diverged"
    stopped = replace(solution, died_at=died)
    np.testing.assert_array_equal(stopped.success, solution.success)
    assert stopped.status == solution.status


def test_an_infeasible_problem_is_not_certified(batch):
    assert batch.certified.all()
    defects = batch.chain_defect.copy()
    defects[1, batch.best[1]] = 1.0
    np.testing.assert_array_equal(replace(batch, chain_defect=defects).certified, [1, 0, 1])


def test_a_problem_whose_chains_all_diverge_says_so(batch):
    died = np.array([-1, 5, 7])
    cost, defect = batch.chain_cost.copy(), batch.chain_defect.copy()
    cost[1, batch.best[1]], defect[2, batch.best[2]] = np.nan, 1.0
    found = replace(batch, died_at=died, chain_cost=cost, chain_defect=defect)
    assert found.status == [batch.status[0], "diverged", "diverged"]
    np.testing.assert_array_equal(found.certified, [1, 0, 0])
    np.testing.assert_array_equal(batch.died_at, -1)


def test_of_many_problems_one_may_diverge():
    edge = from_function(
        lambda x, u: jnp.where(jnp.abs(x[0]) < 3.0, x + 0.1 * u, jnp.nan),
        x_init=[0.0, 0.0],
        nu=2,
        dt=0.1,
        horizon=1.0,
        running_residual=lambda x, u: 0.1 * u,
    )
    starts = np.array([[0.0, 0.0], [3.5, 0.0]], np.float32)
    found = solve_batch(lambda x: replace(edge, x_init=x), starts, chains=2, solver=ONCE)
    assert found.status == ["feasible", "diverged"]
    np.testing.assert_array_equal(found.died_at, [-1, 0])
