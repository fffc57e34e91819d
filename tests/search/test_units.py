"""The units that a solve measures constraints in, and what a user sees of them: nothing."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax import MPC, Solution, from_function, solve, solve_batch
from mjx_drax.problem.trajectory import Stagewise
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.units import units_of, with_units

DT, K = 0.1, 20
SCALES = [1e-6, 1e6]
MOSTLY_LARGE = [pytest.param(1e-6, marks=pytest.mark.slow), 1e6]


def push(x, u):
    return x + DT * jnp.stack([x[2], x[3], u[0], u[1]])


def outside(scale, x, u):  # a disc
    return scale * (0.08 - 0.5 * jnp.sum((x[:2] - jnp.array([0.5, 0.05])) ** 2))[None]


def there(scale, target, x):
    return scale * (x - target)


def problem_in(scale, far=1.0):
    """Round a disc to a point, with all constraints multiplied by a scale."""
    scale, target = jnp.asarray(scale, float), jnp.array([far, 0.2, 0.0, 0.0])
    return from_function(
        push,
        x_init=np.zeros(4),
        nu=2,
        dt=DT,
        horizon=K * DT,
        running_residual=lambda x, u: 0.3 * u,
        inequality=Partial(outside, scale),
        terminal_equality=Partial(there, scale, target),
        u_bounds=(-5.0, 5.0),
        x_scatter=(-2.0, 2.0),
    )


@cache
def answer(scale):
    others = Stagewise(jnp.full(1, 1e9), jnp.full(4, 1e9))  # of another solve
    return solve(with_units(problem_in(scale), others), chains=4, progress=False)


def test_usual_constraints_keep_their_units():
    problem = problem_in(1.0)
    knots = initial_knots(problem, 4, None, jax.random.key(0))
    assert units_of(problem, knots) is None
    assert answer(1.0).problem.constraint.unit is None


@pytest.mark.parametrize("scale", SCALES)
def test_units_follow_the_scale_in_powers_of_two(scale):
    problem = problem_in(scale)
    units = units_of(problem, initial_knots(problem, 4, None, jax.random.key(0)))
    for unit in (units.stage, units.terminal):
        assert (np.log2(unit) % 1 == 0).all()
        assert (np.abs(np.log10(unit) - np.log10(scale)) < 2).all()


def test_a_constraint_of_one_knot_counts_and_one_that_is_constant_does_not():
    def inequality(x, u, knot):
        here = jnp.where(knot.index == 7, 1e5 * x[0], -1.0)
        return jnp.stack([here, jnp.asarray(-1e9), jnp.where(x[0] > 0, jnp.nan, 1e5 * x[1])])

    problem = from_function(
        push,
        x_init=np.zeros(4),
        nu=2,
        dt=DT,
        horizon=K * DT,
        running_cost=lambda x, u: u @ u,
        inequality=inequality,
        x_scatter=(-2.0, 2.0),
    )
    one, constant, partly_nan = units_of(
        problem, initial_knots(problem, 8, None, jax.random.key(0))
    ).stage
    assert one > 1e3
    assert constant == 1.0
    assert partly_nan > 1e3


@pytest.mark.parametrize("scale", MOSTLY_LARGE)
def test_the_same_motion_comes_out_and_multipliers_are_the_users(scale):
    mine, found = answer(1.0), answer(scale)
    assert found.certified
    assert found.status == ["optimal"] * 4
    best = mine.cost.min()
    assert found.cost.min() == pytest.approx(best, rel=1e-3)
    of_end = found.multipliers.constraints.terminal[found.best_chain]
    expected = mine.multipliers.constraints.terminal[mine.best_chain]
    np.testing.assert_allclose(scale * of_end, expected, rtol=2e-2, atol=2e-2)
    slack = found.trajectories.slack.stage[found.best_chain, :, 0]
    states = found.plans[found.best_chain, :-1]
    g = jax.vmap(lambda x: outside(scale, x, None))(jnp.asarray(states))[:, 0]
    np.testing.assert_allclose(slack, -g, atol=1e-3 * scale)


@pytest.mark.parametrize("scale", MOSTLY_LARGE)
def test_a_warm_start_goes_on_where_the_answer_was(scale):
    again = solve(problem_in(scale), chains=4, guess=answer(scale), progress=False)
    assert again.optimal
    assert again.iterations <= 20


def test_what_an_infeasible_plan_breaks_is_told_in_the_users_units():
    scale = 1e6
    found = solve(problem_in(scale, far=1e3), chains=4, max_iterations=10, progress=False)
    assert not found.feasible.any()
    broken = found.where(0)
    unit = np.asarray(found.problem.terminal_constraint.unit)[broken.entry]
    assert broken.kind == "terminal_equality"
    assert unit > 1e4
    assert broken.allowed == pytest.approx(FEASIBLE * unit)
    off = np.abs(found.plans[0, -1] - [1e3, 0.2, 0.0, 0.0])
    assert broken.size == pytest.approx(scale * off[broken.entry], rel=1e-3)


def test_units_are_saved(tmp_path):
    found = answer(1e6)
    found.save(tmp_path)
    for loaded in (Solution.load(tmp_path), Solution.load(tmp_path, problem_in(1e6))):
        for name in ("constraint", "terminal_constraint"):
            unit = getattr(found.problem, name).unit
            np.testing.assert_array_equal(getattr(loaded.problem, name).unit, unit)
    assert Solution.load(tmp_path, problem_in(1e6)).certified


def test_a_batch_has_one_unit_for_all():
    given = problem_in(1e6)
    starts = np.array([[-0.1, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [-0.1, 0.1, 0.0, 0.0]])
    found = solve_batch(lambda x: replace(given, x_init=x), starts, chains=2, progress=False)
    assert found.certified.all()
    assert found.family.problem.constraint.unit.shape == (1,)


@pytest.mark.slow
def test_plans_in_the_loop_have_units_too():
    policy = MPC(problem_in(1e6), chains=2, explorers=0)
    assert policy.reset(np.zeros(4)).max_defect < FEASIBLE
