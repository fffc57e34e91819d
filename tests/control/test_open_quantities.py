"""Problems with open quantities in the loop: rates, parameters and free durations."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import DT, K, double_integrator, robot

from mjx_drax import MPC, DraxError, Restarts, from_function
from mjx_drax.control.open_quantities import Applied, at_present, driven, rate_ends
from mjx_drax.control.shift import shifted
from mjx_drax.search.iterate import start

FAST = Restarts(replace(Restarts().flow, iterations=30, tail=30), descent=40, attempts=1)
GOAL = np.array([1.0, 0.0])


def moved(x, u, h):
    return jnp.stack([x[0] + h * x[1] + 0.5 * h * h * u[0], x[1] + h * u[0]])


def fastest(**changes):
    """Rest to rest over 1 m with |u| <= 1: 2 s."""
    given = {
        "x_init": np.zeros(2),
        "nu": 1,
        "horizon": (0.4, 5.0),
        "knots": K,
        "running_cost": lambda x, u, knot: knot.dt,
        "terminal_equality": lambda x: x - GOAL,
        "u_bounds": (-1.0, 1.0),
    }
    return from_function(lambda x, u, knot: moved(x, u, knot.dt), **given | changes)


def limited():
    return double_integrator(
        running_residual=lambda x, u, knot: 0.3 * knot.rate,
        terminal_residual=lambda x: 10 * (x - GOAL),
        rates=1,
        u_init=[0.0],
        rate_bounds=(-4.0, 4.0),
    )


def test_the_last_controls_are_those_before_a_time():
    jerky = double_integrator(
        running_residual=lambda x, u, knot: knot.jerk, terminal_residual=lambda x: x, rates=2
    )
    given = Applied(jerky.dynamics)
    assert not given.any
    for k in range(20):
        given.add(np.array([float(k)]), k * DT / 2, since=(k - 6) * DT / 2)
    np.testing.assert_array_equal(given.before(9.5 * DT, DT), [18.0, 16.0])
    assert len(given._given) < 10
    step = float(np.float32(DT))  # of a plan: its times are not quite the same as those here
    for k in (7, 8, 9):
        np.testing.assert_array_equal(given.before(k * step, step)[:1], [2.0 * k - 1])
    given.add(np.array([-1.0]), 5 * DT, since=0.0)  # time has gone back
    np.testing.assert_array_equal(given.before(6 * DT, DT)[:1], [-1.0])
    known = Applied(limited().dynamics)
    np.testing.assert_array_equal(known.before(0.0, DT), [0.0])


def test_what_was_driven_has_the_last_controls_and_steps():
    problem = fastest(rates=2)
    x, u = np.ones((4, problem.dynamics.nx)), np.array([[1.0], [2.0], [3.0]])
    own = problem.dynamics.extras(driven(problem.dynamics, x, u))
    np.testing.assert_array_equal(own.v, [[0, 0], [1, 0], [2, 1], [3, 2]])
    np.testing.assert_allclose(own.h, problem.dynamics.dt)


def test_less_is_left_of_a_free_duration_but_never_less_than_the_least():
    problem, flow = fastest(), FAST.flow
    knots = problem.draw(jax.random.key(0))
    knots = replace(knots, start=jnp.array([2.0 / K]) - problem.dynamics.nominal)
    knots = problem.dynamics.consistent(knots)
    chain = start(flow, problem, jax.tree.map(lambda a: a[None], knots), jax.random.key(0))
    chain = jax.tree.map(lambda a: a[0], chain)

    @jax.jit
    def rest(passed):
        now = at_present(problem, passed, None)
        later = shifted(flow, now, passed / problem.dynamics.dt, chain)
        return K * now.dynamics.extras(later.trajectory.x).h[:, 0], later.trajectory.u

    left, u = rest(0.5)
    np.testing.assert_allclose(left, 1.5, rtol=1e-4)
    places = (0.5 + np.arange(K) * 1.5 / K) / (2.0 / K)  # by time along the plan
    wanted = np.interp(places, np.arange(K), np.asarray(chain.trajectory.u)[:, 0])
    np.testing.assert_allclose(u[:, 0], wanted, atol=1e-5)
    for passed in (1.9, 30.0):
        assert 0.4 < float(rest(passed)[0][0]) < 0.45


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (lambda: fastest(x_init_bounds=(-1.0, 1.0)), "x_0 free, and MPC starts where the robot is"),
        (
            lambda: double_integrator(
                x_init_bounds=(-1.0, 1.0), terminal_residual=lambda x: x, running_cost=None
            ),
            "x_0 free",
        ),
        (
            lambda: fastest(horizon=[(0.1, 1.0), (0.1, 1.0)], knots=[10, 10]),
            "2 phases, and the first ends",
        ),
        (lambda: fastest(data=np.zeros(K + 1)), "data for each knot and a free duration"),
        (
            lambda: robot(
                parameters={"m": (1.0, 2.0)},
                model_numbers=lambda model, p: {"body_mass": model.body_mass.at[1].set(p["m"])},
            ),
            "has model_numbers, and MPC cannot change the robot",
        ),
    ],
)
def test_what_cannot_stay_open_is_refused(problem, words):
    with pytest.raises(DraxError, match=words):
        MPC(problem())


def drive(policy, steps, dt, push=None):
    policy.reset(np.zeros(2))
    x, controls = np.zeros(2), []
    for k in range(steps):
        controls.append(policy(x, k * dt))
        x = np.asarray(moved(x, controls[-1], dt)) + (push if k == steps // 3 and push else 0.0)
    return x, np.array(controls)


def test_bounds_of_rates_are_those_of_the_problem():
    np.testing.assert_array_equal(rate_ends(limited()), [[-4.0], [4.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # as of numbers that float32 cannot hold
        upper = double_integrator(
            terminal_residual=lambda x: x,
            inequality=lambda x, u: x - 3.0,
            rate_bounds=(-np.inf, 5.0),
        )
    np.testing.assert_array_equal(rate_ends(upper), [[-np.inf], [5.0]])
    np.testing.assert_array_equal(rate_ends(fastest()), [[-np.inf], [np.inf]])


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 3])
def test_rates_stay_within_their_bounds_from_control_to_control(every):
    problem = limited()
    policy = MPC(problem, chains=4, explorers=1, hold=1.0, every=every, solver=FAST)
    policy.reset(np.zeros(2))
    compiled, x, u = policy.planner._cache_size(), np.zeros(2), [0.0]
    for k in range(60):
        u.append(policy(x, k * DT).item())
        x = x + DT * np.array([x[1], u[-1]]) + (np.array([0.1, -0.3]) if k == 20 else 0.0)
    assert np.abs(np.diff(u) / DT).max() < 4.0 + 1e-4
    np.testing.assert_allclose(x, GOAL, atol=0.02)
    assert max(policy.statistics.max_defects) < 1e-4
    assert policy.planner._cache_size() == compiled


@pytest.mark.slow
def test_the_fastest_motion_arrives_in_time_and_stays():
    policy = MPC(fastest(), chains=4, explorers=0, iterations=4, solver=FAST)
    x, _ = drive(policy, 105, 0.02)  # 2 s are the optimum
    np.testing.assert_allclose(x, GOAL, atol=0.04)
    assert np.mean(np.array(policy.statistics.max_defects) < 1e-3) > 0.9
    assert np.abs(drive(policy, 200, 0.02)[0] - GOAL).max() < 0.04


@pytest.mark.slow
def test_a_motion_of_least_effort_arrives_when_its_time_is_over():
    slow = fastest(
        horizon=(0.4, 3.0), running_cost=lambda x, u, knot: knot.dt * u[0] ** 2, u_bounds=(-5, 5)
    )
    policy = MPC(slow, chains=4, explorers=1, solver=FAST)
    x, u = drive(policy, 155, 0.02)
    np.testing.assert_allclose(x, GOAL, atol=0.03)
    assert 0.02 * np.sum(u**2) == pytest.approx(12 / 3**3, rel=0.05)  # 12 d^2 / T^3
    assert np.mean(np.array(policy.statistics.max_defects) < 1e-3) > 0.95


@pytest.mark.slow
def test_every_plan_chooses_its_parameters():
    problem = double_integrator(
        running_residual=lambda x, u: 0.3 * u,
        terminal_residual=lambda x, knot: jnp.append(
            10 * (x - knot.parameters["where"] * jnp.array([1.0, 0.0])),
            knot.parameters["where"] - 2.0,
        ),
        parameters={"where": (0.0, 1.0)},
    )
    policy = MPC(problem, chains=2, explorers=0, hold=1.0, solver=FAST)
    u = policy(np.zeros(2), 0.0)
    assert u.shape == (1,)
    assert 0.0 < policy.parameters["where"] < 1.0
    before = policy.parameters["where"]
    policy.plan(np.array([3.0, 0.0]), DT)
    assert policy.parameters["where"] > before
