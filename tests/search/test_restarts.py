"""Descending first, heating what failed: nothing found is lost, and no setting depends on units."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import DraxError, Langevin, Restarts, from_function, from_program, minimize
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.langevin import Info, State
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.search import restarts
from mjx_drax.search.restarts import Attempt, run
from mjx_drax.solution.solution import solve

DT, K = 0.1, 20


def wells(x):
    """A good minimum near -1, and one near 1 that costs more than twice as much."""
    return 10 * (x[0] ** 2 - 1) ** 2 + 4 * x[0] + 6 + x[1] ** 2


PROGRAM = from_program(2, cost=wells, bounds=(-2.0, 2.0))
SHORT = replace(Restarts().flow, iterations=40, tail=20)


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


def test_chains_in_the_worse_minimum_are_heated_until_they_leave_it():
    once = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=1))
    assert 0 < np.mean(once.cost > 2 * once.cost.min()) < 1  # some are trapped
    many = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=8, enough=1.0))
    assert (many.cost < 2 * many.cost.min()).all()
    assert many.cost.min() == pytest.approx(once.cost.min(), rel=1e-3)


def test_chains_that_are_done_are_left_alone():
    first = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=1))
    second = minimize(PROGRAM, chains=16, solver=Restarts(SHORT, attempts=2))
    done = first.cost <= 2 * first.cost.min()
    np.testing.assert_array_equal(second.x[done], first.x[done])  # done chains are left alone
    assert (second.cost <= first.cost).all()
    assert (second.cost < first.cost).any()


@pytest.mark.parametrize("weight", [1e-3, pytest.param(1e4, marks=pytest.mark.slow)])
def test_no_setting_depends_on_the_units_of_the_cost(weight):
    solver = Restarts(SHORT, attempts=1)
    usual, other = (solve(swing(w), chains=4, solver=solver) for w in (1.0, weight))
    assert usual.feasible.all()
    np.testing.assert_allclose(other.trajectories.x, usual.trajectories.x, atol=2e-3)
    np.testing.assert_allclose(other.cost / weight, usual.cost, rtol=2e-2)


def test_attempts_share_one_compilation():
    before = restarts._advance._cache_size()
    found = run(PROGRAM, 8, 0, Restarts(SHORT, attempts=3, enough=2.0))
    assert found.records[-1][0] == 120 + 2 * 60
    assert found.began == [(0, 0), (120, 160), (180, 220)]  # the first has no noise
    assert restarts._advance._cache_size() - before == 1


def test_ctrl_c_in_a_later_attempt_keeps_the_answers_of_the_first():
    def interrupt(done, total, info):
        if done > 120:
            raise KeyboardInterrupt

    solver = Restarts(SHORT, attempts=5)
    first = run(PROGRAM, 8, 0, replace(solver, attempts=1))
    kept = run(PROGRAM, 8, 0, solver, progress=interrupt)
    assert kept.records[-1][0] == 140
    cheaper = np.asarray(kept.info.cost) <= np.asarray(first.info.cost)
    assert (cheaper & kept.feasible >= first.feasible).all()


def test_ctrl_c_between_two_attempts_keeps_the_answers_of_the_first(monkeypatch):
    start = restarts._Search._start

    def interrupted(self, flow, attempt):
        if attempt:
            raise KeyboardInterrupt
        return start(self, flow, attempt)

    monkeypatch.setattr(restarts._Search, "_start", interrupted)
    kept = run(PROGRAM, 8, 0, Restarts(SHORT))
    monkeypatch.undo()
    first = run(PROGRAM, 8, 0, Restarts(SHORT, attempts=1))
    np.testing.assert_array_equal(kept.state.trajectory.u, first.state.trajectory.u)


def attempt(costs, defects, label):
    """An attempt whose knots say which one it was, and which place."""
    n = len(costs)
    marks = label + jnp.arange(n)[:, None]
    state = State(marks, marks, marks, marks, (), marks, jnp.ones(n, bool), jnp.full(n, -1))
    info = Info(jnp.asarray(costs, float), jnp.asarray(defects, float), jnp.zeros(n))
    return Attempt(state, info, label + np.arange(n))


def test_every_chain_keeps_the_best_that_was_found_for_it():
    kept = attempt([5.0, 1.0, 3.0, 9.0], [0.0, 1.0, 0.0, 0.5], 100)
    found = attempt([4.0, 7.0, np.nan, 8.0], [0.0, 0.0, np.nan, 0.2], 200)
    # places 0 and 2 worked for chain 0, place 1 for chain 1, place 3 for chain 3
    best = restarts._best(kept, found, np.array([0, 1, 0, 3]))
    expected = [200, 201, 102, 203]  # cheaper; feasible; untouched; less infeasible
    np.testing.assert_array_equal(best.state.trajectory[:, 0], expected)
    np.testing.assert_array_equal(best.converged_at, expected)
    np.testing.assert_array_equal(best.info.cost, [4.0, 7.0, 3.0, 8.0])


def test_a_langevin_is_one_attempt_as_it_stands():
    found = run(PROGRAM, 4, 0, SHORT)
    assert found.records[-1][0] == 60
    again = run(PROGRAM, 4, 0, Restarts(SHORT, descent=None, attempts=1))
    np.testing.assert_array_equal(found.state.trajectory.u, again.state.trajectory.u)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"attempts": 0}, "attempts is 0: give a whole number of at least 1"),
        ({"descent": -1}, "descent is -1"),
        ({"within": "half"}, "within is 'half'"),
        ({"enough": -0.5}, "enough is -0.5"),
        ({"flow": "fast"}, "flow is 'fast': give a Langevin"),
        ({"flow": Langevin(tail=-1)}, "tail is -1"),
    ],
)
def test_settings_that_are_refused(settings, words):
    with pytest.raises(DraxError, match=words):
        minimize(PROGRAM, chains=2, solver=Restarts(**settings))


def test_a_solver_of_another_kind_is_refused():
    with pytest.raises(DraxError, match="solver is 'ipopt': give a Langevin or a Restarts"):
        minimize(PROGRAM, chains=2, solver="ipopt")


@register_dataclass
@dataclass(frozen=True)
class Bouncing(FunctionDynamics):
    """A ball on a stiff floor: f has a kink where they touch."""

    kinked = True


@pytest.fixture(scope="module")
def bouncing():
    """A ball of 1 kg that bounces on a floor of 300 N/m, with a thrust of 3 N to help it up."""

    def ball(x, u):
        v = x[1] + 0.05 * (u[0] - 9.81 + 300.0 * jnp.maximum(0.0, -x[0]))
        return jnp.array([x[0] + 0.05 * v, v])

    problem = from_function(
        ball,
        x_init=[1.0, 0.0],
        nu=1,
        dt=0.05,
        horizon=2.0,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=lambda x: 10.0 * (x - jnp.array([0.9, 0.0])),
        u_bounds=(-3.0, 3.0),
        x_scatter=([-0.5, -8.0], [1.5, 8.0]),
        goal=lambda x: abs(x[0] - 0.9) < 0.1 and abs(x[1]) < 0.5,
    )
    dynamics = problem.dynamics
    kinked = Bouncing(dynamics.function, dynamics.dt, dynamics.nx, dynamics.nu)
    return problem, replace(problem, dynamics=kinked)


def test_replays_lead_on_where_f_has_kinks(bouncing):
    """The same dynamics with and without being told of the kink."""
    solver = Restarts(attempts=1)
    plain, kinked = (solve(p, chains=16, solver=solver, record=10) for p in bouncing)
    assert not plain.feasible.any()
    assert kinked.feasible.mean() > 0.9
    assert kinked.certified
    assert kinked.iterations > plain.iterations
    for chain in range(16):  # recorded all the way
        path = kinked.recording.path(chain)
        np.testing.assert_array_equal(path.x[-1], kinked.trajectories.x[chain])
        assert path.iteration[-1] == kinked.iterations


def test_interrupted_while_replays_lead_on_keeps_what_there_is(bouncing):
    def stop(done, total, info):
        if done > 170:  # the attempt took 160
            raise KeyboardInterrupt

    solution = solve(bouncing[1], chains=16, progress=stop)
    assert 170 < solution.iterations < 220
    assert solution.feasible.any()


def test_chains_start_near_and_far_where_f_has_kinks(bouncing):
    keys = jax.random.split(jax.random.key(0), 200)
    near, far = (jax.vmap(p.draw)(keys).x - p.x_init for p in reversed(bouncing))
    width = np.abs(near[..., 1]).max(axis=1)
    assert np.abs(far[..., 1]).max(axis=1).min() > 6.0
    assert 0.03 * 7.0 < width.min() < 0.05 * 8.0
    assert 6.0 < width.max() <= 8.0
