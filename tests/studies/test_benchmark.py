"""Peers find known optima, everyone is judged alike, and rows say what they should."""

import json
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import DraxError, Geometric, Langevin, Restarts, from_function, tasks
from mjx_drax.cli import main
from mjx_drax.studies import benchmark, one_thread
from mjx_drax.studies import measurements as measure
from mjx_drax.studies.benchmark_plot import pooled
from mjx_drax.studies.other_methods import shooting
from mjx_drax.studies.other_methods.cem import CEM
from mjx_drax.studies.other_methods.ipopt import FUNCTIONS, Transcription
from mjx_drax.studies.other_methods.mbd import MBD
from mjx_drax.studies.other_methods.mppi import MPPI

DT, KNOTS = 0.1, 20
METHODS = [
    MPPI(0.01, spread=0.1, correlation=0.9),
    CEM(rate=0.9, correlation=0.9, elite=10),
    MBD(0.001, correlation=0.9),
]


def double_integrator(**options):
    """From 1 to rest at 0; the optimum keeps |u| below 2."""
    given = {
        "x_init": [1.0, 0.0],
        "nu": 1,
        "dt": DT,
        "horizon": DT * KNOTS,
        "running_residual": lambda x, u: 0.3 * u,
        "terminal_residual": lambda x: 5.0 * x,
        "u_bounds": (-2.0, 2.0),
        "goal": lambda x: np.linalg.norm(x) < 0.2,
    }
    return from_function(lambda x, u: x + DT * jnp.array([x[1], u[0]]), **given | options)


def least_cost():
    """The cost is a linear least-squares problem in u: x_K = c + M u."""
    A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([0.0, DT])
    powers = [np.linalg.matrix_power(A, KNOTS - 1 - k) @ B for k in range(KNOTS)]
    M, c = np.stack(powers, axis=1), np.linalg.matrix_power(A, KNOTS) @ [1.0, 0.0]
    J, r = np.vstack([0.3 * np.eye(KNOTS), 5.0 * M]), np.append(np.zeros(KNOTS), 5.0 * c)
    u, *_ = np.linalg.lstsq(J, -r, rcond=None)
    assert np.abs(u).max() < 2.0
    return 0.5 * np.sum((J @ u + r) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_shooting_nears_the_optimum(method):
    optimum = least_cost()
    row = measure.shoot(double_integrator(), method, 2, 128, 2 * 128 * KNOTS * 100, seed=0)
    assert row["iterations"] == 100
    assert row["evaluations"] == 2 * 128 * KNOTS * 100
    assert row["success_rate"] == 1.0
    assert 0.999 * optimum < row["best_cost"] < 1.1 * optimum
    assert 0 < row["time_to_certified_s"] <= row["solve_time_s"] + 1
    assert row["curve"][-1][1] == 1.0


def test_samples_are_correlated_in_time_and_have_unit_variance():
    L = np.asarray(shooting.smoother(0.8, 6))
    lag = np.abs(np.subtract.outer(range(6), range(6)))
    np.testing.assert_allclose(L @ L.T, 0.8**lag, atol=1e-6)
    np.testing.assert_allclose(shooting.smoother(0.0, 4), np.eye(4))


def test_diffusion_noise_is_that_of_the_product_of_alphas():
    """1 / abar - 1 for beta rising linearly over 100 steps, as the source has it."""
    abar = np.cumprod(1.0 - np.linspace(1e-4, 1e-2, 100))
    ours = [float(MBD().update(*_one_sample(), 1.0 - i / 100)[1][0, 0]) for i in (1, 50, 100)]
    np.testing.assert_allclose(ours, np.sqrt(1 / abar[[0, 49, 99]] - 1), rtol=0.25)
    np.testing.assert_allclose(ours[1:], np.sqrt(1 / abar[[49, 99]] - 1), rtol=0.02)


def _one_sample():
    plan = shooting.Plan(jnp.zeros((1, 1)), jnp.ones((1, 1)), jnp.zeros((1, 1)), jnp.array(0.0))
    return plan, jnp.zeros((1, 1, 1)), jnp.zeros(1)


def test_average_follows_the_cheap_and_survives_equal_costs():
    v = jnp.array([[[1.0]], [[-1.0]]])
    assert shooting.average(v, jnp.array([0.0, 1.0]), 0.01).item() == pytest.approx(1.0)
    assert shooting.average(v, jnp.array([3.0, 3.0]), 0.01).item() == pytest.approx(0.0)


def test_shooting_stays_inside_the_bounds_of_states():
    """The straight way to the goal passes x = -0.05; with a wall there it does not."""
    free = double_integrator(terminal_residual=lambda x: 5.0 * (x + jnp.array([0.4, 0.0])))
    walled = replace(free, bounds=replace(free.bounds, x_lower=jnp.array([-0.05, -9.0])))
    walled = replace(walled, bounds=replace(walled.bounds, x_upper=jnp.array([2.0, 9.0])))
    for problem, stays in ((free, False), (walled, True)):
        runs = shooting.optimize(METHODS[1], problem, 1, 128, 128 * KNOTS * 60, seed=0)
        x = shooting.rollout(problem, jnp.asarray(runs.u[-1, 0])).x
        assert bool(x[:, 0].min() > -0.06) is stays


def test_judge_wants_goal_and_bounds():
    problem = double_integrator()
    still = np.zeros((1, KNOTS, 1))
    assert measure.judge(problem, still).success.tolist() == [False]
    at_goal = measure.judge(problem, still, x_init=np.zeros((1, 2)))
    assert at_goal.success.tolist() == [True]
    assert at_goal.cost == pytest.approx(0.0)
    box = replace(problem.bounds, x_lower=jnp.array([0.5, -9.0]), x_upper=jnp.array([2.0, 9.0]))
    outside = measure.judge(replace(problem, bounds=box), still, x_init=np.zeros((1, 2)))
    assert outside.success.tolist() == [False]


def test_shooting_refuses_unbounded_controls():
    problem = from_function(
        lambda x, u: x + u,
        x_init=[0.0],
        nu=1,
        dt=1.0,
        horizon=2.0,
        terminal_residual=lambda x: x,
    )
    with pytest.raises(DraxError, match="u_bounds"):
        shooting.optimize(MPPI(), problem, 1, 4, 8, seed=0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_ipopt_has_the_same_functions(name):
    pytest.importorskip("casadi")
    problem = tasks.load(name).make()
    program = Transcription(problem)
    for seed in range(3):
        knots = problem.draw(jax.random.key(seed))
        cost, h = program.evaluate(knots)
        assert cost == pytest.approx(float(problem.cost(knots)), rel=1e-5)
        np.testing.assert_allclose(h, problem.defects(knots), atol=1e-5)


def test_ipopt_finds_the_pendulums_optimum():
    pytest.importorskip("casadi")
    row = measure.ipopt(tasks.load("pendulum").make(), 2, seed=0)
    assert row["success_rate"] == 1.0
    assert row["best_cost"] == pytest.approx(0.031774, rel=1e-4)
    assert row["time_to_certified_s"] < row["solve_time_s"]
    assert [point[1:] for point in row["curve"]] == [[0.5, 0.5], [1.0, 1.0]]


def test_peers_without_casadi_say_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "casadi", None)
    assert main(["benchmark", "--suite", "peers", "--out", str(tmp_path)]) == 2
    assert 'pip install "mjx-drax[peers]"' in capsys.readouterr().err
    assert not benchmark.has_casadi()


def test_suites_name_what_they_have():
    with pytest.raises(DraxError, match="peers"):
        benchmark.run(suite="everything")
    with pytest.raises(DraxError, match="deep_trap"):
        benchmark.run(["pendulum_swingup"], suite="gpu")
    with pytest.raises(DraxError, match="gpu has no pendulum_swingup"):
        benchmark.run(["pendulum_s"], suite="gpu")


def test_evaluations_count_linearizations_and_the_ladder():
    problem = double_integrator()
    solver = Langevin(iterations=7, tail=3)
    linear, ladder = 1 + 2 + 1, len(solver.preconditioner.ladder)
    assert measure.evaluations(solver, problem, 5, 10) == 5 * KNOTS * (10 * linear + 3 * ladder)
    tries = Restarts(solver, descent=2)  # 5 iterations, then 10 an attempt
    assert measure.evaluations(tries, problem, 1, 25) == KNOTS * (25 * linear + 9 * ladder)


@pytest.mark.slow
def test_first_certified_answer_comes_before_the_last_iteration():
    problem = double_integrator()
    solver = Langevin(iterations=5, tail=95, noise=Geometric(0.1, 0.01))
    row = measure.ours(problem, solver, 2, seed=0)
    times = [point[0] for point in row["curve"]]
    assert times == sorted(times)
    assert row["time_to_certified_s"] == times[0] < times[-1]
    hopeless = replace(problem, goal=lambda x: False)
    row = measure.ours(hopeless, solver, 2, seed=0)
    assert row["time_to_certified_s"] is None
    assert row["certified"] is False
    assert "cost_ratio" not in row


def test_an_answer_far_above_the_best_known_cost_is_not_near_it(monkeypatch):
    problem, row = double_integrator(), {}
    for best, share in ((least_cost(), 1.0), (0.1 * least_cost(), 0.0)):
        monkeypatch.setitem(measure.BEST_KNOWN, problem.name, best)
        row = measure.shoot(problem, METHODS[1], 1, 128, 128 * KNOTS * 50, seed=0)
        assert (row["success_rate"], row["near_rate"]) == (1.0, share)
    assert row["time_to_near_s"] is None
    assert row["time_to_certified_s"] > 0


def test_pooled_curves_are_weighted_and_end_where_they_end():
    times, share = pooled([[[1.0, 0.9, 0.5], [3.0, 1.0, 1.0]], [[2.0, 1.0, 1.0]]], [3, 1])
    assert times.tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(share, [0.375, 0.625, 1.0])


def test_random_states_are_the_same_however_many():
    few, more = (measure.random_starts(2, count, 0)[0] for count in (3, 1000))
    np.testing.assert_array_equal(few, more[:3])
    assert 3.9 < np.abs(more).max() < 4.0


@pytest.mark.slow
def test_command_writes_a_list_of_rows(tmp_path, capsys, monkeypatch):
    fewer = {"no restarts": Restarts(attempts=1)}
    monkeypatch.setattr(benchmark, "ablations", lambda problem, solver: fewer)
    command = "benchmark pendulum --suite gpu --seeds 0 --chains 4 --out"
    main([*command.split(), str(tmp_path)])
    rows = json.loads((tmp_path / "benchmark.json").read_text())
    assert isinstance(rows, list)
    assert [row["problem"] for row in rows] == [*["pendulum"] * 2, "pendulum, random x_init"]
    assert [row["solver"] for row in rows] == ["mjx_drax", "no restarts", "mjx_drax"]
    states = rows[2]
    assert 0 <= states["share_feasible_1e-5"] <= states["share_feasible_1e-3"] <= 1
    for row in rows:
        assert {"problem", "horizon", "seed", "success_rate", "best_cost", "device"} <= set(row)
        assert row["chains"] == 4
        assert row["jax"] == jax.__version__
    assert f"{rows[0]['success_rate']:.1%}" in capsys.readouterr().out
    assert (tmp_path / "benchmark.png").stat().st_size > 1000


@pytest.mark.slow
def test_suite_of_peers(monkeypatch):
    pytest.importorskip("casadi")
    monkeypatch.setattr(benchmark, "ablations", lambda problem, solver: {})
    monkeypatch.setattr(benchmark, "SHOOTING", {m.name: [m] for m in METHODS})
    rows = benchmark.run(["pendulum"], [0], 4, "peers")
    solvers = ["mjx_drax", "ipopt", "mppi", "cem", "mbd", "mjx_drax"]
    assert [row["solver"] for row in rows] == solvers
    by_name = dict(zip(solvers[:-1], rows, strict=False))
    for name in ("mppi", "cem", "mbd"):
        assert by_name[name]["evaluations"] == pytest.approx(rows[0]["evaluations"], rel=0.1)
    assert rows[-1]["sample_within_1_percent"] <= rows[-1]["sample_within_10_percent"] <= 1


def test_ablations_take_out_one_part():
    solver = Restarts()
    found = benchmark.ablations(tasks.load("pendulum").make(), solver)
    assert set(found) == {"no restarts", "no noise", "diagonal", "identity", "no tail"}
    assert found["no restarts"].attempts == 1
    assert float(found["no noise"].flow.noise(jnp.array(0.0))) == 0.0
    assert found["no tail"].flow.tail == 0
    assert found["no tail"].flow.iterations == solver.flow.iterations + solver.flow.tail
    assert type(found["diagonal"].flow.preconditioner).__name__ == "Diagonal"
    assert type(found["identity"].preconditioner).__name__ == "Identity"


@pytest.mark.slow
def test_one_thread_is_one_core():
    rows = one_thread.run(0, [1])
    assert all(row["cpus"] == 1 for row in rows)
    assert rows[-1]["solver"] == "mjx_drax, 1 thread"
    assert rows[-1]["time_to_certified_s"] > 0
    if benchmark.has_casadi():
        assert rows[-1]["peer_median_s"] == rows[0]["median_start_s"]
