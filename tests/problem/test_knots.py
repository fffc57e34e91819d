"""Functions of a knot's time and data: references, wind, waypoints, against closed forms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import DT, NAN, K, double_integrator, matrices, point, robot

from mjx_drax import (
    MPC,
    DraxError,
    Identity,
    Langevin,
    Problem,
    Restarts,
    Solution,
    Terms,
    at_time,
    between,
    solve,
    solve_batch,
)
from mjx_drax.base.errors import DraxWarning
from mjx_drax.modelling.terms import Reference
from mjx_drax.problem.trajectory import Knot
from mjx_drax.search.family import Family

TIMES = DT * np.arange(K + 1)


def tracking_optimum(reference):
    """Controls that minimize 1/2 sum_k 100 (p_k - reference_k)^2 + 0.01 u_k^2, (K,)."""
    G, c = matrices()
    rows = np.concatenate([10 * G[:-1, 0], 0.1 * np.eye(K)])
    right = np.concatenate([10 * (reference[1:-1] - c[:-1, 0]), np.zeros(K)])
    return np.linalg.lstsq(rows, right, rcond=None)[0]


def off_track(x, u, knot):
    return jnp.stack([10 * (x[0] - knot.data["p"]), 0.1 * u[0]])


@pytest.mark.slow
def test_a_reference_is_tracked_and_another_one_does_not_compile():
    calls = []

    def residual(x, u, knot):
        calls.append(1)
        return off_track(x, u, knot)

    problem = double_integrator(running_residual=residual, data={"p": np.sin(TIMES)})
    found = solve(problem, chains=2)
    u = found.best.u[:, 0]
    np.testing.assert_allclose(u, tracking_optimum(np.sin(TIMES)), atol=2e-3)
    other = problem.with_data(lambda t: {"p": 1 - jnp.cos(t)})
    calls.clear()
    found = solve(other, chains=2)
    np.testing.assert_allclose(found.best.u[:, 0], tracking_optimum(1 - np.cos(TIMES)), atol=2e-3)
    assert len(calls) < 30  # the checks at the door trace; compiling would, many times
    assert found.certified
    assert found.optimal


@pytest.mark.slow
def test_many_references_in_one_call():
    problem = double_integrator(running_residual=off_track, data={"p": np.sin(TIMES)})
    rates = jnp.array([0.5, 1.0, 2.0])

    def make(rate):
        return replace(problem, data={"p": jnp.sin(rate * TIMES)})

    found = solve_batch(make, rates, chains=1)
    for u, rate in zip(found.u[:, :, 0], rates, strict=True):
        np.testing.assert_allclose(u, tracking_optimum(np.sin(rate * TIMES)), atol=5e-3)


@pytest.mark.slow
def test_dynamics_that_depend_on_time_replay_in_float64():
    push = np.sin(3 * TIMES[:-1])

    def f(x, u, knot):
        return x + DT * jnp.stack([x[1], u[0] + jnp.sin(3 * knot.time)])

    goal = np.array([1.0, 0.0])
    problem = double_integrator(
        f, running_residual=lambda x, u: u, terminal_equality=lambda x: x - goal
    )
    found = solve(problem, chains=2)
    G, c = matrices(push)
    expected = np.linalg.pinv(G[-1]) @ (goal - c[-1])
    np.testing.assert_allclose(found.best.u[:, 0], expected, atol=2e-3)
    assert found.optimal
    assert found.certified
    assert found.open_loop.max_deviation.max() < 1e-5  # the replay has the same wind
    states = np.stack([problem.replay(*args)[0] for args in [_as_replayed(problem, expected)]])
    np.testing.assert_allclose(states[0, 0, -1], goal, atol=1e-6)


def _as_replayed(problem, u):
    plan = np.zeros((1, K + 1, 2))
    return plan, u[None, :, None], np.zeros((1, K, 1, 2))


def test_a_batch_makes_problems_of_their_data():
    problem = double_integrator(running_residual=off_track, data={"p": np.sin(TIMES)})
    references = np.stack([np.sin(TIMES), np.zeros(K + 1), TIMES])
    family = Family.of(lambda p: problem.with_data({"p": p}), references)
    for i, p in enumerate(references):
        np.testing.assert_allclose(family.at(i).data["p"], p, rtol=1e-6)
    amplitudes = np.array([1.0, 2.0])
    family = Family.of(lambda a: problem.with_data(lambda t: {"p": a * t}), amplitudes)
    np.testing.assert_allclose(family.at(1).data["p"], 2.0 * TIMES, rtol=1e-6)
    with pytest.raises(DraxError, match=f"give {K + 1} rows"):
        Family.of(lambda p: problem.with_data({"p": p}), references[:, 1:])


@pytest.mark.slow
def test_the_papers_own_flow_follows_a_reference():
    flow = Langevin(
        iterations=10, tail=300, step_size=1e-3, preconditioner=Identity()
    )  # gradients go through the same functions
    problem = double_integrator(running_residual=off_track, data={"p": np.sin(TIMES)})
    found = solve(problem, chains=1, solver=Restarts(flow, attempts=1, descent=0, polish=None))
    shifted = problem.with_data({"p": np.sin(TIMES) + 1})
    other = solve(shifted, chains=1, solver=Restarts(flow, attempts=1, descent=0, polish=None))
    assert np.mean(other.best.x[:, 0] - found.best.x[:, 0]) > 0.1


@pytest.mark.slow
def test_a_waypoint_at_a_time_and_a_wall_for_a_while():
    way = at_time(lambda x, u: x[:1] - 1.0, 1.0)
    problem = double_integrator(
        running_residual=lambda x, u: u, equality=way, terminal_equality=lambda x: x
    )
    found = solve(problem, chains=2)
    G, _ = matrices()
    rows = np.concatenate([G[9, :1], G[-1]])  # x_10, at 1 s, and x_20
    expected = np.linalg.pinv(rows) @ np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.best.u[:, 0], expected, atol=5e-3)
    assert found.optimal
    assert found.certified

    low = between(lambda x, u: 0.5 + x[:1], 0.5, 1.0, idle=-1.0)  # p <= -0.5 then
    problem = double_integrator(running_residual=lambda x, u: u, inequality=low)
    found = solve(problem, chains=2)
    p = found.best.x[:, 0]
    assert p[4:10].max() < -0.5 + 1e-3  # x_5..x_10
    assert p[3] > -0.45
    assert found.certified


def test_functions_of_a_model_know_the_time():
    seen = robot(
        running_cost=lambda data, u: data.time + 0.0 * data.qpos[0],
        terminal_cost=lambda data, knot: 10 * data.time + knot.index + 0.0 * data.qpos[0],
        terminal_residual=None,
        goal=lambda data: abs(data.time - 0.1) < 1e-6,
    )
    knots = seen.draw(jax.random.key(0))
    expected = np.append(seen.times[:-1], 10 * 0.1 + seen.horizon)
    np.testing.assert_allclose(seen.costs(knots), expected, rtol=1e-6)
    assert seen.reached(np.asarray(seen.x_init))


def test_terms_follow_references():
    terms = Terms(robot().dynamics.mj_model)
    path = np.linspace(0.1, 0.3, robot().horizon + 1)
    for reference in (path[:, None], lambda t: jnp.stack([0.1 + 0.2 * t / 0.1])):
        residual = terms.posture(reference) + terms.velocity(weight=1e-4)
        problem = robot(running_residual=residual, terminal_residual=terms.posture(reference))
        still = problem.draw(jax.random.key(0))
        still = replace(still, x=jnp.zeros_like(still.x))
        costs = np.asarray(problem.costs(still))[1:]
        np.testing.assert_allclose(costs, 0.5 * np.square(path[1:]), rtol=1e-5)


@pytest.mark.slow
def test_data_move_with_the_horizon_of_a_policy():
    problem = double_integrator(running_residual=off_track, data={"p": TIMES})
    later = problem.at_time(0.5)
    np.testing.assert_allclose(later.data["p"], np.minimum(TIMES + 0.5, TIMES[-1]), rtol=1e-6)
    np.testing.assert_allclose(later.times, TIMES + 0.5, rtol=1e-6)
    assert int(later.knots.index[0]) == 5
    own = problem.with_data(lambda t: {"p": t}).at_time(0.5)
    np.testing.assert_allclose(own.data["p"], TIMES + 0.5, rtol=1e-6)

    policy = MPC(problem.with_data(lambda t: {"p": jnp.sin(t)}), chains=2, explorers=0)
    x, t, off = np.zeros(2), 0.0, []
    for _ in range(40):
        u = policy(x, t)
        x, t = x + DT * np.array([x[1], u[0]]), t + DT
        off.append(abs(x[0] - np.sin(t)))
    assert max(off[10:]) < 0.1


@pytest.mark.slow
def test_a_saved_solution_loads_with_its_problem(tmp_path):
    problem = double_integrator(running_residual=off_track, data={"p": np.sin(TIMES)})
    found = solve(problem, chains=1)
    found.save(tmp_path)
    for loaded in (Solution.load(tmp_path), Solution.load(tmp_path, problem)):
        np.testing.assert_array_equal(loaded.best.u, found.best.u)
        np.testing.assert_allclose(loaded.problem.times, problem.times)


@pytest.mark.slow
def test_float64_and_data():
    problem = double_integrator(running_residual=off_track, data=lambda t: {"p": jnp.sin(t)})
    double = problem.in_float64()
    assert isinstance(double, Problem)
    with double.arithmetic():
        assert double.knots.time.dtype == np.float64
    found = solve(problem, chains=1, precision=64)
    assert found.residual[0] < 1e-8
    np.testing.assert_allclose(found.best.u[:, 0], tracking_optimum(np.sin(TIMES)), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": np.zeros(7)}, r"data has shape \(7,\): give 11 rows"),
        ({"data": {"a": np.zeros((11, 2)), "b": 3.0}}, r"data\['b'\] has shape \(\)"),
        ({"data": np.full(11, NAN)}, "data is not finite in row 0"),
        ({"data": np.full(11, 1e39)}, r"data is not finite in row 0, 1e\+39 as float32"),
        ({"data": ["a"] * 11}, r"data\[0\] is 'a'"),
        ({"data": lambda t: float(t)}, "data failed when it was traced"),
        ({"equality": at_time(lambda x, u: x, 3.0)}, "equality holds at 3 s, where it has no knot"),
        ({"equality": at_time(lambda x, u: x, 1.0)}, "terminal functions"),
        ({"inequality": between(lambda x, u: x, 2.0, 3.0)}, "inequality holds from 2 to 3 s"),
        ({"running_cost": lambda x, u, knot: knot.data["p"]}, "running_cost failed"),
    ],
)
def test_bad_data_are_named(changes, message):
    with pytest.raises(DraxError, match=message):
        point(**changes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: at_time(3, 1.0), "3 is no function"),
        (lambda: at_time(abs, "soon"), "begin is 'soon'"),
        (lambda: between(abs, 2.0, 1.0), "begins at 2.0 s and ends at 1.0 s"),
    ],
)
def test_bad_windows_are_named(make, message):
    with pytest.raises(DraxError, match=message):
        make()


def test_references_of_the_wrong_length_are_named():
    terms = Terms(robot().dynamics.mj_model)
    with pytest.raises(DraxError, match="terminal_residual follows a reference of 4 rows: give 11"):
        robot(terminal_residual=terms.posture(np.zeros((4, 1))), dt=0.01)
    short, zero = terms.posture(np.zeros((4, 1))), terms.velocity(weight=1e-4)
    for residual in (zero + short, zero + (zero + short), at_time(short, 0.05)):
        with pytest.raises(DraxError, match="reference of 4 rows"):
            robot(running_residual=residual)
    with pytest.raises(DraxError, match=r"posture returned shape \(2,\)"):
        terms.posture(lambda t: jnp.zeros(2))


@pytest.mark.parametrize("dt", [0.1, 0.02, 0.01, 0.003])
def test_a_time_between_two_knots_is_that_of_one(dt):
    """In float32 no time is exactly halfway between two others."""
    knots = 200
    times = jnp.asarray(dt, jnp.float32) * jnp.arange(knots, dtype=jnp.float32)
    for k in range(knots - 1):
        way = at_time(lambda x, u: x, (k + 0.5) * dt)
        active = np.asarray(way.active(Knot(index=0, stage=0, time=times, dt=jnp.float32(dt))))
        assert np.flatnonzero(active).tolist() == [k]
        way.check_knots("equality", np.arange(knots) * dt)


def test_another_start_or_time_stays_in_float64():
    problem = double_integrator(running_residual=off_track, data=lambda t: {"p": jnp.sin(t)})
    double = problem.in_float64()
    for moved in (double.with_x_init([0.1, 0.2]), double.at_time(1.0)):
        assert moved.precision == 64
        assert np.asarray(moved.bounds.u_lower).dtype == np.float64
    assert double.at_time(1.0).data["p"].dtype == np.float64


def test_a_reference_before_its_first_row_is_that_row():
    reference = Reference(jnp.arange(5.0)[:, None])
    rows = [float(reference.at(Knot(index=i, stage=i, time=0.0, dt=0.1))[0]) for i in (-2, 1, 9)]
    assert rows == [0.0, 1.0, 4.0]


FIRST, SECOND = (at_time(lambda x, u, p=p: x[:1] - p, t) for p, t in ((0.5, 0.5), (-0.5, 1.0)))


def test_waypoints_are_added():
    for equality in (FIRST + SECOND, sum([FIRST, SECOND]), FIRST + (lambda x, u: x[:1])):
        assert double_integrator(running_residual=SECOND, equality=equality).constraint.rows == 2
    late = at_time(lambda x, u: x[:1], 9.0)
    with pytest.raises(DraxError, match="equality holds at 9 s, where it has no knot"):
        double_integrator(equality=FIRST + late, running_residual=FIRST)


def test_a_waypoint_between_two_knots_is_told():
    with pytest.warns(DraxWarning, match="is asked for at 0.93 s, .* at the nearest, at 0.9 s"):
        double_integrator(equality=at_time(lambda x, u: x[:1], 0.93), running_residual=FIRST)


@pytest.mark.slow
def test_added_waypoints_are_passed():
    problem = double_integrator(
        running_residual=lambda x, u: 0.1 * u,
        equality=FIRST + SECOND,
        terminal_equality=lambda x: x,
    )
    found = solve(problem, chains=2)
    np.testing.assert_allclose(found.best.x[[4, 9], 0], [0.5, -0.5], atol=1e-3)
    assert found.certified
