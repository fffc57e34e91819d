"""Solving, and what is claimed about the result: certificate, status, feedback, interruptions."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import Bouncing, bouncing, made_up, point, replays
from jax.tree_util import Partial

from mjx_drax import (
    DraxError,
    Identity,
    Langevin,
    Trajectory,
    from_dynamics,
    from_function,
    from_mjcf,
)
from mjx_drax.search import engine
from mjx_drax.search.engine import REPORT_EVERY
from mjx_drax.search.family import Family
from mjx_drax.search.iterate import evaluate, iterate
from mjx_drax.solution import solution as solutions
from mjx_drax.solution.solve import solve
from mjx_drax.tasks import load

OPTIMUM = 0.031774  # of the pendulum: 600 of 600 IPOPT multistarts agree
DT, K = 0.2, 10
CHAINS = 24


@pytest.fixture(scope="module")
def pendulum():
    task = load("pendulum")
    return solve(task.make(), chains=CHAINS)


def reach(**rest):
    """A double integrator that is to come to rest at 1."""
    arguments = {
        "x_init": [0.0, 0.0],
        "nu": 1,
        "dt": DT,
        "horizon": K * DT,
        "running_residual": effort,
        "terminal_residual": miss,
        "u_bounds": (-2.0, 2.0),
        "name": "reach",
        **rest,
    }
    return from_function(arguments.pop("f", double_integrator), **arguments)


def double_integrator(x, u):
    return x + DT * jnp.array([x[1], u[0]])


def effort(x, u):
    return 0.1 * u


def miss(x):
    return 10.0 * (x - jnp.array([1.0, 0.0]))


def near(x):
    return abs(x[0] - 1) < 0.1


QUICK = Langevin(iterations=40, tail=40)

POINT = """<mujoco><worldbody>
  <body><joint name="slide" type="slide"/><geom size="0.1"/></body></worldbody>
<actuator><motor joint="slide" ctrlrange="-1 1"/></actuator></mujoco>"""


def rollout(problem, u):
    """States (chains, K + 1, nx) of f under controls (chains, K, nu), in numpy's float64."""
    x = np.broadcast_to(problem.x_init, (len(u), problem.dynamics.nx)).astype(float)
    states = [x]
    for k in range(u.shape[1]):
        x = x + DT * np.stack([x[:, 1], u[:, k, 0]], axis=1)
        states.append(x)
    return np.stack(states, axis=1)


# The pendulum of the paper.


def test_pendulum_chains_reach_the_known_optimum(pendulum):
    assert pendulum.success_rate > 0.9
    assert pendulum.certified
    assert pendulum.cost[pendulum.best_chain] == pytest.approx(OPTIMUM, rel=0.01)
    feasible_costs = pendulum.cost[pendulum.feasible]
    assert feasible_costs.min() > 0.99 * OPTIMUM  # nothing feasible undercuts it
    assert pendulum.max_defect[pendulum.best_chain] < 1e-4
    assert (pendulum.max_violation == 0).all()


def test_certificate_tells_what_the_best_chain_did(pendulum):
    certificate, c = pendulum.certificate, pendulum.best_chain
    assert certificate.success
    assert "float64" in certificate.engine
    for label in ("open_loop", "feedback"):
        told, found = getattr(certificate, label), getattr(pendulum, label)
        assert set(told) == {
            "success",
            "cost",
            "max_deviation",
            "final_deviation",
            "max_violation",
            "violations",
        }
        assert set(told["violations"]) == {"goal", "control_bounds"}
        assert told["success"] is True
        assert told["cost"] == pytest.approx(OPTIMUM, rel=0.01)
        assert 0 <= told["final_deviation"] <= told["max_deviation"] == found.max_deviation[c]
        assert found.states.dtype == np.float64
    states, controls = pendulum.replayed
    better = pendulum.replays_in(pendulum.replay_mode)
    cheaper = min(pendulum.open_loop.cost[c], pendulum.feedback.cost[c])
    assert better.cost[c] == pytest.approx(cheaper, rel=1e-5)  # of two that are alike, either
    assert better.cost[c] == pendulum.replay_cost[pendulum.certified_chains].min()
    np.testing.assert_array_equal(states, better.states[c])
    np.testing.assert_array_equal(controls, better.controls[c])
    assert np.abs(controls).max() <= 1


def test_solution_keeps_status_and_history(pendulum):
    total, solver = pendulum.iterations, pendulum.solver
    np.testing.assert_array_equal(pendulum.history["began"], [0])  # one attempt was enough
    assert solver.descent < total < solver.descent + solver.polish.iterations  # it ended by itself
    assert pendulum.feasible.all()
    optimal = pendulum.residual < solver.polish.tolerance
    assert optimal.mean() > 0.9
    assert pendulum.status == ["optimal" if o else "feasible" for o in optimal]
    assert (pendulum.died_at == -1).all()
    assert ((pendulum.feasible_since > 0) == pendulum.feasible).all()
    history = pendulum.history
    np.testing.assert_array_equal(history["iteration"], np.arange(0, total + 1, REPORT_EVERY))
    np.testing.assert_array_equal(history["cost"][-1], pendulum.cost)
    np.testing.assert_array_equal(history["max_defect"][-1], pendulum.max_defect)
    np.testing.assert_array_equal(history["residual"][-1], pendulum.residual)
    assert not np.isfinite(history["residual"][: solver.descent // REPORT_EVERY]).any()
    log = pendulum.log().splitlines()
    assert len(log) == 2 + len(history["iteration"])
    assert log[-1].split()[-2:] == [str(CHAINS), str(optimal.sum())]
    for c in np.flatnonzero(pendulum.feasible):
        since = history["iteration"] >= pendulum.feasible_since[c]
        assert (history["max_defect"][since, c] < 1e-3).all()
        assert history["max_defect"][~since, c][-1] >= 1e-3


def test_a_replay_that_leaves_the_bounds_of_the_states_is_no_success(pendulum):
    problem, extent = pendulum.problem, np.abs(pendulum.trajectories.x).max(axis=(0, 1))
    gains = np.zeros_like(pendulum.gains)
    for share, succeeds in ((1.1, pendulum.open_loop.success), (0.9, False)):
        ends = share * extent
        narrow = replace(problem, bounds=replace(problem.bounds, x_lower=-ends, x_upper=ends))
        found = replays(narrow, pendulum.trajectories, gains)
        np.testing.assert_array_equal(
            found.success & pendulum.feasible, succeeds & pendulum.feasible
        )
        assert (found.max_violation[pendulum.feasible] > 0.05).all() != np.any(succeeds)


def test_feedback_tracks_where_open_loop_drifts(pendulum):
    problem, good = pendulum.problem, pendulum.feasible
    plan = pendulum.open_loop.states[good]
    push = 0.05 * np.random.default_rng(0).normal(size=(good.sum(), problem.horizon, 1))
    u, free = pendulum.trajectories.u[good] + push, (-np.inf, np.inf)
    gains, knots = pendulum.gains[good].astype(float), problem.knots.at(slice(-1))
    drift, tracked = (
        np.abs(problem.dynamics.replay(plan, u, K, free, knots)[0] - plan).max(axis=(1, 2))
        for K in (0 * gains, gains)
    )
    assert np.median(tracked) < 0.4 * np.median(drift)  # at saturated controls it can do little


# Replays.


def test_a_plan_that_was_rolled_out_deviates_by_nothing():
    problem = reach()
    u = np.random.default_rng(0).uniform(-1, 1, (3, K, 1)).astype(np.float32)
    plan = rollout(problem, u.astype(float))
    found = replays(problem, Trajectory(plan[:, 1:], u), np.ones((3, K, 1, 2)))
    np.testing.assert_allclose(found.states, plan, atol=1e-6)
    np.testing.assert_allclose(found.controls, u, atol=1e-6)
    assert found.max_deviation.max() < 1e-6
    assert found.success.all()  # without a goal: it ends where it was planned to
    trajectory = Trajectory(plan[:, 1:].astype(np.float32), u)
    np.testing.assert_allclose(found.cost, evaluate(problem, trajectory).cost, rtol=1e-5)


def test_wrong_controls_are_no_success():
    problem = reach()
    u = np.full((2, K, 1), 0.5, np.float32)
    plan = rollout(problem, u.astype(float))
    off = 0.02
    u[1, 0] += off / (DT * K * DT)
    found = replays(problem, Trajectory(plan[:, 1:], u), np.zeros((2, K, 1, 2)))
    np.testing.assert_array_equal(found.success, [True, False])
    expected = off / (K * DT) * np.array([(K - 1) * DT, 1.0]).max()
    assert found.final_deviation[1] == pytest.approx(expected, rel=1e-3)


def test_with_a_goal_success_is_where_the_replay_ends_not_where_the_plan_does():
    problem = reach(goal=near)
    still, arrived = np.zeros((1, K, 1), np.float32), np.tile([1.0, 0.0], (1, K, 1))
    assert not replays(problem, Trajectory(arrived, still), np.zeros((1, K, 1, 2))).success[0]


def test_replays_respect_the_control_bounds():
    problem = reach(u_bounds=([-1.0], [0.5]))
    u, plan = np.array([[[9.0], [-9.0]] * (K // 2)]), np.zeros((1, K, 2))
    found = replays(problem, Trajectory(plan, u), np.full((1, K, 1, 2), 3.0))
    assert found.controls.min() >= -1
    assert found.controls.max() <= 0.5


def test_gains_that_chatter_are_lowered_where_f_has_kinks_until_the_plan_is_tracked():
    along = {"x_init": [0.0], "horizon": 2.0, "terminal_residual": lambda x: x}
    dynamics = Bouncing(Partial(lambda x, u: x + u), 0.1, 1, 1)
    problem = from_dynamics(dynamics, **along)
    plan, u = np.zeros((3, 21, 1)), np.full((3, 20, 1), [[[0.01]], [[0.0]], [[0.01]]])
    plan[:, 1:] = [[[0.0]], [[0.0]], [[1.0]]]
    gains = np.full((3, 20, 1, 1), -2.5)  # an error becomes -1.5 times itself; 0.25 with 0.3
    gains[2] = -1.0
    gentle, smooth = (
        Family.of_one(p).tracked(np.zeros(len(u), int), plan, u, gains)
        for p in (problem, from_function(lambda x, u: x + u, nu=1, dt=0.1, **along))
    )
    np.testing.assert_array_equal(gentle.gains[:, 0, 0, 0], [-0.75, -2.5, -1.0])
    assert gentle.states[0].max() == pytest.approx(0.01 / 0.75)
    assert smooth.states[0].max() > 1.0
    np.testing.assert_array_equal(smooth.gains, gains)


def test_a_replay_that_turns_nan_is_no_success():
    problem = reach(goal=lambda x: True)
    u = np.full((1, K, 1), np.nan)
    found = replays(problem, Trajectory(np.zeros((1, K, 2)), u), np.zeros((1, K, 1, 2)))
    assert not found.success[0]
    assert found.max_deviation[0] == np.inf


@pytest.mark.parametrize("control", [np.nan, 1e30])
def test_what_blows_up_in_the_c_engine_is_no_success(control, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    problem = from_mjcf(
        """<mujoco><worldbody><body><joint name="j"/><geom size="0.1" pos="0 0 -1"/></body>
        </worldbody><actuator><motor joint="j"/></actuator></mujoco>""",
        horizon=0.1,
        running_residual=lambda data, u: u,
        goal=lambda data: abs(data.qpos[0]) < 0.1,  # as MuJoCo's automatic reset leaves it
    )
    K = problem.horizon
    u, plan = np.full((1, K, 1), control), np.zeros((1, K, 2))
    states, _ = problem.dynamics.replay(
        np.zeros((1, K + 1, 2)), u, np.zeros((1, K, 1, 2)), (np.array(-np.inf), np.array(np.inf))
    )
    assert not np.isfinite(states[0, -1]).all()
    assert not replays(problem, Trajectory(plan, u), np.zeros((1, K, 1, 2))).success[0]


# Solves.


@pytest.mark.slow
def test_gains_come_even_where_the_preconditioner_factorizes_nothing():
    solver = replace(QUICK, preconditioner=Identity(), step_size=1e-3)
    solution = solve(reach(), chains=3, solver=solver)
    assert solution.gains.shape == (3, K, 1, 2)
    assert (solution.gains[:, :-1] < 0).all()  # pushes back, at every knot that still matters


@pytest.mark.slow
def test_same_seed_same_solution():
    first, again, other = (solve(reach(), chains=3, seed=s, solver=QUICK) for s in (0, 0, 1))
    np.testing.assert_array_equal(first.trajectories.x, again.trajectories.x)
    np.testing.assert_array_equal(first.cost, again.cost)
    assert not np.array_equal(first.trajectories.x, other.trajectories.x)
    assert first.certified


def test_an_infeasible_answer_is_not_certified_however_cheap():
    once = replace(QUICK, iterations=1, tail=0)
    weak = reach(u_bounds=(-1e-3, 1e-3))  # too weak to get there
    solution = solve(weak, chains=3, solver=once)
    assert not solution.certified
    assert solution.success_rate == 0
    assert set(solution.status) == {"infeasible"}


def test_ctrl_c_between_reports_keeps_what_there_is():
    seen = []

    def progress(done, total, info):
        seen.append((done, total))
        if done == 2 * REPORT_EVERY:
            raise KeyboardInterrupt

    solution = solve(reach(), chains=3, solver=QUICK, progress=progress)
    assert solution.interrupted
    assert str(solution).startswith("interrupted ")
    assert set(solution.status) <= {"interrupted", "feasible"}
    assert not solve(reach(), chains=3, solver=QUICK).interrupted
    assert seen == [(REPORT_EVERY, 80), (2 * REPORT_EVERY, 80)]
    assert solution.iterations == 2 * REPORT_EVERY
    np.testing.assert_array_equal(
        solution.history["iteration"], [0, REPORT_EVERY, 2 * REPORT_EVERY]
    )
    short = solve(reach(), chains=3, solver=QUICK, progress=progress)
    np.testing.assert_array_equal(short.trajectories.x, solution.trajectories.x)


@pytest.mark.parametrize("call", [2, 3])
def test_ctrl_c_during_an_iteration_reports_the_numbers_of_the_chains_it_returns(call, monkeypatch):
    calls = []

    def interrupted(*arguments, **options):
        calls.append(None)  # the first only compiles
        if len(calls) == call:
            raise KeyboardInterrupt
        return iterate(*arguments, **options)

    monkeypatch.setattr(engine, "iterate", interrupted)
    solution = solve(reach(), chains=3, solver=QUICK)
    info = evaluate(solution.problem, solution.trajectories)
    assert solution.iterations == (call - 2) * REPORT_EVERY
    np.testing.assert_allclose(solution.max_defect, info.max_defect, rtol=1e-6)
    np.testing.assert_allclose(solution.cost, info.cost, rtol=1e-6)


def knots(*lead):
    return Trajectory(np.full((*lead, K, 2), 0.3), np.full((*lead, K, 1), 0.2))


def test_guesses_are_one_for_all_or_one_for_each():
    still = Langevin(iterations=1, tail=0, step_size=0.0)
    each = jax.tree.map(lambda a: a * np.arange(1, 4)[:, None, None], knots(3))
    for guess, expected in ((knots(), knots(3)), (each, each)):
        solution = solve(reach(), chains=3, solver=still, guess=guess)
        for seen, wanted in zip(
            *map(jax.tree.leaves, (solution.trajectories, expected)), strict=True
        ):
            np.testing.assert_allclose(seen, wanted, rtol=1e-6)


@pytest.fixture
def no_compilation(monkeypatch):
    """What is refused must be refused before the long compilation."""

    def fail(*arguments):
        pytest.fail("the solver was compiled")

    monkeypatch.setattr(engine, "iterate", fail)


@pytest.mark.parametrize(
    ("guess", "words"),
    [
        (knots(2), r"guess.x has shape \(2, 10, 2\): give \(10, 2\), or \(3, 10, 2\)"),
        (replace(knots(), u=np.zeros((K, 2))), r"guess.u has shape \(10, 2\): give \(10, 1\)"),
        (replace(knots(), x=np.zeros((K + 1, 2))), r"guess.x has shape \(11, 2\)"),
        (replace(knots(), u=np.full((K, 1), np.nan)), "guess.u holds NaN"),
    ],
)
def test_guesses_that_are_refused(guess, words, no_compilation):
    with pytest.raises(DraxError, match=words):
        solve(reach(), chains=3, solver=QUICK, guess=guess)


def test_a_cost_or_dynamics_that_are_nan_everywhere_are_refused(no_compilation):
    for label, part in (
        ("terminal_cost", {"terminal_cost": lambda x: jnp.log(-1.0 - x[0] ** 2)}),
        ("the dynamics f.x, u.", {"f": lambda x, u: x / 0.0 - x / 0.0}),
    ):
        with pytest.raises(DraxError, match=f"the value of {label} is not finite at"):
            solve(reach(**part), chains=3, solver=QUICK)


def test_numbers_that_float32_cannot_hold_are_told_from_faults(no_compilation):
    wide = reach(terminal_cost=lambda x: ((x[0] - 9.0) * 1e25) ** 2)
    with pytest.raises(DraxError, match=r"value of terminal_cost .* float32, .* precision=64"):
        solve(wide, chains=3, solver=QUICK)
    with pytest.raises(DraxError, match=r"terminal_cost is not finite at .* \(no 0/0"):
        solve(reach(terminal_cost=lambda x: x[0] / 0.0), chains=3, solver=QUICK)


def test_a_cost_without_a_least_value_is_told_from_faults():
    endless = point(running_cost=lambda x, u: -jnp.sum(u**2), terminal_residual=None)
    with pytest.raises(DraxError, match=r"have grown to .*: the cost may have no least value"):
        solve(endless, chains=3, solver=Langevin(iterations=300, tail=1))


@pytest.mark.slow
def test_a_models_cost_that_is_nan_everywhere_is_refused(no_compilation):
    for cost, words in (
        (
            lambda data, u: jnp.log(data.qvel[0]),
            "the value of running_cost is not finite at x_init",
        ),
        (lambda data, u: jnp.sqrt(data.qvel[0]), "the derivative of running_cost"),
        (lambda data, u: jnp.abs(data.qvel[0]) ** 1.5, "the second derivative of running_cost"),
    ):
        problem = from_mjcf(POINT, horizon=0.1, running_cost=cost)
        with pytest.raises(DraxError, match=words):
            solve(problem, chains=3, solver=QUICK)


@pytest.mark.parametrize(
    "solver", [pytest.param(None, marks=pytest.mark.slow), Langevin(iterations=1000)]
)
def test_nan_away_from_x_init_ends_the_solve_and_names_the_knot(solver):
    edge = reach(
        running_cost=lambda x, u: 10.0 * (x[0] - 3.0) ** 2 - 0.1 * jnp.sqrt(0.5 - x[0]),
        x_scatter=([-0.1, -0.1], [0.1, 0.1]),
    )
    words = r"the value of running_cost is not finite at knot \d+, of all 3 chains after at most"
    with pytest.raises(DraxError, match=words):
        solve(edge, chains=3, solver=solver)


def test_a_chain_whose_cost_is_nan_is_diverged_and_never_best():
    guess = jax.tree.map(lambda a: a * np.array([-1, 1, 2])[:, None, None], knots(3))
    partly = reach(terminal_cost=lambda x: 1e-3 * jnp.sqrt(x[0]))
    solution = solve(partly, chains=3, solver=QUICK, guess=guess)
    assert solution.status == ["diverged", "feasible", "feasible"]
    np.testing.assert_array_equal(solution.died_at, [0, -1, -1])
    np.testing.assert_array_equal(solution.success, [False, True, True])
    assert solution.best_chain != 0


def test_a_problem_may_draw_its_own_knots():
    drawn = reach(guess=lambda key: jax.tree.map(jnp.asarray, knots())).draw(jax.random.key(0))
    np.testing.assert_array_equal(drawn.x, np.float32(knots().x))


def test_counts_that_are_refused(no_compilation):
    with pytest.raises(DraxError, match="chains is 0"):
        solve(reach(), chains=0)
    with pytest.raises(DraxError, match="iterations"):
        solve(reach(), chains=1, solver=Langevin(iterations=0, tail=0))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"u_bounds": ([-1.0, -1.0], [1.0, 1.0])}, r"lower end of u.*\(1,\)"),
        ({"x_bounds": ([-1.0], [1.0])}, r"lower end of x.*\(2,\)"),
        ({"x_bounds": ([-1.0] * 3, 1.0)}, r"lower end of x.*\(2,\)"),
        ({"x_bounds": (-np.ones((K + 3, 2)), 9.0)}, "lower end of x|bounds of x"),
        ({"f": lambda x, u: x[:1]}, r"dynamics f\(x, u\) returned shape \(1,\)"),
        ({"f": lambda x, u: x @ u}, "dynamics .* failed"),
        ({"nu": 0}, "nu is 0: give a whole number of at least 1"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"x_init": [[0.0, 0.0]]}, "x_init"),
        ({"x_bounds": (0.5, 1.0)}, "x_init .*outside the bounds of x by 0.5"),
        ({"terminal_cost": lambda x: x}, "terminal_cost returned shape"),
        ({"goal": lambda x: x > 0}, r"goal returned shape \(2,\)"),
        ({"goal": lambda x: x.qpos}, "goal failed"),
        ({"running_residual": None, "terminal_residual": None}, "reach has no cost"),
    ],
)
def test_problems_that_are_refused(arguments, words):
    with pytest.raises(DraxError, match=words):
        reach(**arguments)


@pytest.mark.slow
def test_cartpole_swings_up_from_mjcf():
    task, before = load("cartpole_swingup"), iterate._cache_size()
    solution = solve(task.make(), chains=4)
    assert iterate._cache_size() - before == 1
    assert solution.success_rate > 0.5
    assert solution.certified
    assert f"MuJoCo {mujoco.__version__} C engine" in solution.certificate.engine
    assert solution.certificate.feedback["max_deviation"] < 0.01
    assert solution.cost[solution.best_chain] < 0.3


DRIFT = np.array([[1.0, 0.1], [0.0, 1.0]])
PUSH = {"gain": np.array([0.0, 0.1])}


class Plant:
    """A double integrator whose numbers are numpy arrays wherever a user may have them."""

    def __init__(self):
        self.offset = np.array([1 / 3, 0.0])

    def step(self, x, u):
        return pushed(x, u) + 0.1 * self.offset


def pushed(x, u):
    return DRIFT @ x + PUSH["gain"] * u[0]


def in_closure():
    offset = np.array([1 / 3, 0.0])
    return lambda x, u: pushed(x, u) + 0.1 * offset


def of_no_module():
    f = in_closure()
    f.__module__ = None  # as of code that is run by exec
    return f


@pytest.mark.slow
@pytest.mark.parametrize(
    "f", [in_closure(), Plant().step, of_no_module()], ids=["closure", "method", "no module"]
)
def test_functions_may_hold_numpy_arrays(f):
    """Which JAX would remember in the precision of the solve, and then not replay in float64."""
    target = np.array([0.5, 0.1])
    problem = from_function(
        f,
        x_init=[0.0, 0.0],
        nu=1,
        dt=0.1,
        horizon=0.5,
        terminal_residual=lambda x: 10.0 * (x - target),
        running_residual=lambda x, u: 0.1 * u,
    )
    solver = Langevin(iterations=2, tail=8)
    solution = solve(problem, chains=2, solver=solver)
    assert solution.open_loop.max_deviation.max() < 1e-5
    states, controls = solution.open_loop.states[0], solution.open_loop.controls[0]
    for x, u, reached in zip(states[:-1], controls, states[1:], strict=True):
        np.testing.assert_allclose(reached, f(x, u), rtol=1e-14)


def test_what_jax_raises_is_one_sentence(monkeypatch):
    def fails(self):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory\nmore\nlines")

    monkeypatch.setattr("mjx_drax.search.engine.Search.run", fails)
    with pytest.raises(DraxError, match=r"solve of .*out of memory\): try with fewer chains\.$"):
        solve(reach(), 2, progress=False)


def test_of_chains_that_cost_the_same_the_best_is_an_optimal_one():
    made = made_up(point(goal=lambda x: True), 3)
    replays = replace(made.open_loop, cost=np.array([1.0, 1.00001, 1.1]))
    made = replace(made, open_loop=replays, feedback=replays)
    assert made.best_chain == 0
    assert replace(made, residual=np.array([1.0, 1e-5, 1e-5])).best_chain == 1
    assert replace(made, residual=np.array([1.0, 1.0, 1e-5])).best_chain == 0


def test_without_a_certificate_the_best_is_the_feasible_chain_with_the_cheapest_replay():
    made = made_up(point(goal=lambda x: False), 4)
    costs = np.array([np.nan, 1100.0, 4.5, 0.1])
    replays = replace(made.open_loop, cost=costs, success=np.zeros(4, bool))
    plans = {"cost": np.array([1.0, 1.9, 2.5, 0.1]), "max_defect": np.array([0.0, 0.0, 0.0, 1.0])}
    assert replace(made, open_loop=replays, feedback=replays, **plans).best_chain == 2
    replays = replace(replays, cost=np.array([0.1, np.inf, np.nan, np.inf]))
    plans["max_defect"] = np.array([1.0, 0.0, 0.0, 0.0])
    assert replace(made, open_loop=replays, feedback=replays, **plans).best_chain == 1


@pytest.mark.slow
def test_bounds_that_leave_no_choice_are_kept_like_constraints():
    """No control in the first three knots, and one place to be at knot 6."""
    lower, upper = np.full((K, 1), -4.0), np.full((K, 1), 4.0)
    lower[:3] = upper[:3] = 0.0
    low, high = np.full((K, 2), -5.0), np.full((K, 2), 5.0)
    low[5, 0] = high[5, 0] = 0.4
    found = solve(reach(u_bounds=(lower, upper), x_bounds=(low, high)), chains=4)
    alike = reach(
        u_bounds=(-4.0, 4.0),
        equality=lambda x, u, knot: jnp.stack(
            [jnp.where(knot.index < 3, u[0], 0.0), jnp.where(knot.index == 6, x[0] - 0.4, 0.0)]
        ),
    )
    wanted = solve(alike, chains=4)
    assert found.certified
    assert found.optimal
    # Plans have a little room where bounds leave none
    np.testing.assert_allclose(found.cost.min(), wanted.cost.min(), rtol=1e-3)
    states, controls = found.replayed
    np.testing.assert_array_equal(controls[:3], 0.0)
    assert abs(states[6, 0] - 0.4) < 1e-4


@pytest.mark.slow
def test_a_motion_may_start_and_end_on_its_bounds():
    """They forbid nothing that the best motion without them would do."""
    kept = solve(reach(x_bounds=([0.0, 0.0], [1.0, 5.0])), chains=4)
    free = solve(reach(), chains=4)
    assert kept.optimal_chains.all()
    np.testing.assert_allclose(kept.cost, free.cost.min(), rtol=1e-3)


def test_where_f_has_kinks_plans_that_counted_are_judged_by_the_engine(monkeypatch):
    """f may differ from it by more than a plan may: in contacts of MJX, in float32."""
    found = solve(bouncing(), chains=2)
    assert found.feasible.all()

    def far_off(problem, knots):
        return replace(evaluate(problem, knots), max_defect=jnp.ones(2))

    monkeypatch.setattr(solutions, "evaluate", far_off)
    again = found.certify()
    assert again.feasible.all()
    assert (again.max_defect < 1e-3).all()
    infeasible = replace(found, max_defect=np.ones(2, np.float32)).certify()
    assert not infeasible.feasible.any()
    away = np.linspace(0.0, 1.0, found.problem.horizon)[:, None]
    moved = replace(found.trajectories, x=found.trajectories.x + away)
    assert not replace(found, trajectories=moved).certify().feasible.any()


def test_numbers_that_functions_read_may_change_before_it_is_judged_again():
    price = np.ones(2, np.float32)
    problem = point(running_cost=lambda x, u: jnp.sum(price * u**2), terminal_residual=None)
    found = solve(problem, chains=2, solver=Langevin(iterations=1, tail=1))
    price *= 3.0
    again = found.certify()
    np.testing.assert_allclose(again.open_loop.cost, 3.0 * found.open_loop.cost, rtol=1e-5)
    np.testing.assert_allclose(again.cost, 3.0 * found.cost, rtol=1e-5)
