"""Problems from functions: what is refused, and where initial knots are scattered."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import point
from jax.tree_util import Partial

from mjx_drax import (
    LBFGS,
    Constant,
    DraxError,
    Langevin,
    Trajectory,
    between,
    from_function,
    from_program,
    minimize,
    solve,
    tasks,
)
from mjx_drax.base.errors import DraxWarning
from mjx_drax.problem.trajectory import APART, Box


def make(**changes):
    given = {"x_init": [0.0], "nu": 1, "dt": 0.1, "horizon": 1.0, "terminal_cost": lambda x: x @ x}
    return from_function(lambda x, u: x + u, **{**given, **changes})


def test_a_problem_shows_itself_in_a_line():
    assert repr(make(name="drift")) == "<Problem drift: FunctionDynamics, nx=1, nu=1, horizon=10>"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_bounds": 3.0}, "bounds of x are 3.0"),
        ({"u_bounds": (1, 2, 3)}, r"pair \(lower, upper\)"),
        ({"u_bounds": ({}, 1)}, "lower end of u"),
        ({"u_bounds": (1.0, -1.0)}, "cross"),
        ({"horizon": "2"}, "horizon is '2'"),
        ({"horizon": -1.0}, "horizon is -1.0"),
        ({"goal": lambda x: "no"}, "one truth value"),
        ({"x_init": [np.nan]}, "finite"),
    ],
)
def test_misfits_are_named(changes, message):
    with pytest.raises(DraxError, match=message):
        make(**changes)


def test_a_horizon_that_is_no_multiple_of_the_step_is_told_how_long_the_plan_is():
    with pytest.warns(DraxWarning, match=r"no multiple of dt = 0\.1 s.* 10 knots and lasts 1 s"):
        assert make(horizon=1.04).horizon == 10
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert make(horizon=0.7).horizon == 7  # 0.7 / 0.1 is not 7 to the last digit


@pytest.mark.parametrize(
    ("x", "inequality", "told"),
    [
        ([0.5], lambda x, u: jnp.array([x[0] - 1.0, x[0] - 0.2]), r"inequality \[1\] by 0\.3"),
        pytest.param([0.5], lambda x, u: x[0] - 1.0, None, marks=pytest.mark.slow),
        ([0.5], lambda x, u: x + u - 0.2, None),  # a control can keep it
        ([2.0], between(lambda x, u: x - 1.0, 0.5, 1.0), None),
    ],
)
def test_a_start_that_breaks_a_constraint_is_told_before_the_solve(x, inequality, told):
    problem, few = make(x_init=x, inequality=inequality), Langevin(iterations=1, tail=0)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        solve(problem, chains=2, solver=few, progress=False)
    seen = [str(w.message) for w in seen if issubclass(w.category, DraxWarning)]
    assert len(seen) == (told is not None)
    assert told is None or re.search(f"x_init breaks {told}, whatever the controls", seen[0])


@pytest.mark.parametrize("arguments", [{"chains": 0}, {"chains": 2.5}, {"seed": -1}, {"seed": 1.5}])
def test_solve_wants_whole_numbers(arguments):
    with pytest.raises(DraxError, match=next(iter(arguments))):
        solve(make(), **arguments)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": 0.1}, r"Constant\(0.1\)"),
        ({"preconditioner": LBFGS}, r"LBFGS\(\)"),
        ({"tail": -1}, "tail is -1"),
        ({"iterations": 0, "tail": 0}, "at least 1"),
    ],
)
def test_settings_that_cannot_work_are_named(settings, message):
    with pytest.raises(DraxError, match=message):
        solve(make(), solver=Langevin(**settings))


@pytest.mark.parametrize(
    ("bounds", "scatter"),
    [
        ((5.0, np.inf), (5.0, 7.0)),
        ((-np.inf, -3.0), (-5.0, -3.0)),
        ((-np.inf, np.inf), (-1.0, 1.0)),
        ((-0.5, 4.0), (-0.5, 4.0)),
    ],
)
def test_knots_are_scattered_inside_one_sided_bounds(bounds, scatter):
    box = make(u_bounds=bounds).scatter
    assert (float(box.u_lower[0]), float(box.u_upper[0])) == scatter


@pytest.mark.slow
def test_lbfgs_is_a_method_of_multipliers():
    # min (a - 1)^2 + 10 (b - a^2)^2  s.t.  a + b = 1: eliminate b and set the derivative to zero.
    slope = np.polyder(np.polyadd([1, -2, 1], 10 * np.polymul([-1, -1, 1], [-1, -1, 1])))
    stationary = [float(a.real) for a in np.roots(slope) if abs(a.imag) < 1e-9]
    program = from_program(
        2,
        cost=lambda x: (x[0] - 1) ** 2 + 10 * (x[1] - x[0] ** 2) ** 2,
        equality=lambda x: jnp.array([x.sum() - 1.0]),
    )
    solver = Langevin(
        iterations=0, tail=400, penalty=Constant(10.0), preconditioner=LBFGS(inner=20)
    )
    found = minimize(program, chains=16, solver=solver)
    assert np.median(found.max_defect) < 1e-4
    assert min(abs(found.best[0] - a) for a in stationary) < 1e-2


def test_float64_keeps_no_rounding_of_functions_that_ran_in_float32():
    """JAX keeps constant arrays in the precision in which it first saw them."""
    third = np.array([1 / 3])
    problem = from_function(
        lambda x, u: x * third,
        x_init=[1.0],
        nu=1,
        dt=0.1,
        horizon=0.2,
        running_residual=lambda x, u: jnp.sqrt(2 * third) * x,
        terminal_cost=Partial(lambda a, x: a * jnp.sum(x * third), 0.5),
        equality=lambda x, u: x - third,
        terminal_inequality=lambda x: x - third,
        goal=lambda x: True,
        guess=lambda key: Trajectory(np.zeros((2, 1), np.float32), np.zeros((2, 1), np.float32)),
    )
    ones = Trajectory(jnp.ones((2, 1)), jnp.ones((2, 1)))
    assert {leaf.dtype for leaf in jax.tree.leaves(problem.values(ones))} == {np.dtype("f4")}
    exact = problem.in_float64()
    with jax.enable_x64(True):
        values = exact.values(jax.tree.map(lambda a: np.ones(a.shape), ones))
        assert exact.draw(jax.random.key(0)).u.dtype == np.float64
    assert {leaf.dtype for leaf in jax.tree.leaves(values)} == {np.dtype("f8")}
    np.testing.assert_allclose(values.costs, [1 / 3, 1 / 3, 1 / 6], rtol=1e-15)
    np.testing.assert_allclose(values.defects, -2 / 3, rtol=1e-15)
    np.testing.assert_allclose(values.constraints.stage, 2 / 3, rtol=1e-15)
    np.testing.assert_allclose(values.constraints.terminal, 2 / 3, rtol=1e-15)
    assert (exact.name, exact.goal, exact.guess) == (problem.name, problem.goal, problem.guess)


@pytest.mark.parametrize("name", ["pendulum", "pendulum_swingup"])  # a function, and MJCF
def test_few_programs_replay_all_numbers_of_rows(name, caplog):
    problem = tasks.load(name).make()
    K, d = problem.horizon, problem.dynamics

    def run(rows):
        plan, u = np.zeros((rows, K + 1, d.nx)), np.zeros((rows, K, d.nu))
        states, _ = problem.replay(plan, u, np.zeros((rows, K, d.nu, d.ndx)))
        assert states.shape == plan.shape
        np.testing.assert_allclose(problem.engine_defects(states, u), 0.0, atol=1e-12)

    run(4)
    with jax.log_compiles():
        run(3)
    assert not [record for record in caplog.records if "XLA compilation" in record.getMessage()]


def test_equal_bounds_leave_a_little_room_in_plans():
    """Of their own size, else of the coordinate's, else of 1; other bounds are as they were."""
    lower = jnp.array([[-2.0, 0.0, 0.0, -jnp.inf], [0.5, 0.0, 0.0, 1.0]])
    upper = jnp.array([[2.0, 0.0, 8.0, jnp.inf], [0.5, 0.0, 0.0, 1.0]])
    box = Box(jnp.zeros(1), jnp.ones(1), lower, upper)
    below, above = box.with_room().sides(Trajectory(jnp.zeros((2, 1)), jnp.zeros((2, 4))))
    room = np.array([[0.0, 1.0, 0.0, 0.0], [0.5, 1.0, 8.0, 1.0]]) * APART / 2
    np.testing.assert_allclose(below.u, lower - room, atol=1e-9)
    np.testing.assert_allclose(above.u, upper + room, atol=1e-9)
    np.testing.assert_array_equal((below.x, above.x), [[[0.0]] * 2, [[1.0]] * 2])


def test_bounds_at_which_a_plan_starts_are_opened():
    lower, upper = jnp.array([0.0, -1.0, -jnp.inf, 0.0]), jnp.array([2.0, 3.0, jnp.inf, 1.0])
    box = Box(lower, upper, jnp.zeros(1), jnp.ones(1)).opened_at(jnp.array([0.0, 3.0, 7.0, 0.5]))
    room = np.array([2.0, 3.0]) * APART / 2  # of the coordinate's size, of the end's own
    np.testing.assert_allclose(box.x_lower - lower, [-room[0], 0.0, np.nan, 0.0], atol=1e-9)
    np.testing.assert_allclose(box.x_upper - upper, [0.0, room[1], np.nan, 0.0], atol=2e-7)
    np.testing.assert_array_equal((box.u_lower, box.u_upper), [[0.0], [1.0]])


def test_a_defect_below_the_rounding_of_a_state_is_none():
    # 7e6 m away knots of float32 are half a metre apart; the box of 2 m around x_init is a guess
    p, far = point(x_init=[7e6, 0.0]), 7e6 + 0.5
    knots = Trajectory(jnp.array([[far, 0.0]] * p.horizon), jnp.zeros((p.horizon, 2)))
    assert p.max_defect(knots) < 1e-3
    off = Trajectory(knots.x.at[3, 1].set(1e-3), knots.u)  # no rounding of what is near 0
    assert p.max_defect(off) == pytest.approx(1e-3 / (2.0 / 12.0), rel=1e-3)
    with jax.enable_x64(True):
        assert p.in_float64().max_defect(knots) > 1e-3
