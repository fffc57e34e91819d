"""Problems of the suite are what the books say, guesses fit, and IPOPT finds known optima."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from mjx_drax import DraxError, Trajectory, from_function, tasks
from mjx_drax.cli import main
from mjx_drax.studies.convergence import open_problems, suite
from mjx_drax.studies.convergence.optimal_control import integral, runge_kutta, straight
from mjx_drax.studies.convergence.programs import PROGRAMS
from mjx_drax.studies.convergence.suite import CASES
from mjx_drax.studies.other_methods import ipopt_jax

OPEN = open_problems.CASES


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", PROGRAMS)
def test_published_solutions_of_programs_are_optimal(name):
    """They are feasible, cost what the book says, and forces of constraints balance the slope."""
    program = PROGRAMS[name]
    x = np.array(program.solution)

    def all_functions(x):
        rows = [program.cost(*x)]
        rows += [*program.equality(*x)] if program.equality else []
        rows += [*program.inequality(*x)] if program.inequality else []
        return (jnp.stack(rows),) * 2

    J, values = jax.jit(jax.jacfwd(all_functions, has_aux=True))(x)
    (cost, *values), (slope, *slopes) = np.asarray(values), np.asarray(J)
    assert cost == pytest.approx(program.optimum, rel=1e-5, abs=1e-8)
    equalities = len(program.equality(*x)) if program.equality else 0
    assert np.abs(values[:equalities]).max(initial=0) < 1e-4
    assert np.max(values[equalities:], initial=0) < 1e-4
    rows, pushes = [np.zeros((0, x.size))], []
    for i, (value, row) in enumerate(zip(values, slopes, strict=True)):
        if i < equalities or value > -1e-4:
            rows.append(row[None])
            pushes.append(i >= equalities)
    for side, at in ((-1.0, program.lower), (1.0, program.upper)):
        off = side * (x - at)
        assert off.max() < 1e-6
        rows.append(side * np.eye(x.size)[off > -1e-6])
        pushes += [True] * len(rows[-1])
    left = slope
    if pushes:
        J = np.concatenate(rows)
        least = np.where(pushes, -1e-12, -np.inf)
        left = J.T @ lsq_linear(J.T, -slope, (least, np.inf)).x + slope
    assert np.abs(left).max() < 1e-4 * max(1.0, np.abs(slope).max())


def test_there_are_as_many_problems_as_promised():
    assert len(CASES) - len(OPEN) >= 10
    assert len([case for case in OPEN.values() if case.optimum is not None]) >= 8
    assert len(PROGRAMS) >= 20
    assert len(set(suite.names())) == len(suite.names())


@pytest.mark.slow
@pytest.mark.parametrize("name", [*CASES, "quadrotor", "bug_trap", "hs071"])
def test_guesses_fit_their_problems(name):
    problem, knots = suite.posed(name)
    K, nx, nu = problem.horizon, problem.dynamics.nx, problem.dynamics.nu
    assert problem.name == name
    assert knots.x.shape == (K, nx)
    assert knots.u.shape == (K, nu)
    assert float(problem.bounds.violation(knots)) <= 1e-6
    end = CASES[name].end if name in CASES else None
    if end is not None:
        np.testing.assert_allclose(knots.x[-1, : len(end)], end, rtol=1e-6, atol=1e-6)
    values = jax.eval_shape(problem.values, knots)
    assert values.costs.shape == (K + 1,)


@pytest.mark.slow
@pytest.mark.parametrize("name", OPEN)
def test_open_problems_leave_something_open_or_follow_data(name):
    problem, knots = suite.posed(name)
    assert problem.free or problem.data is not None
    assert (knots.start is None) == (not problem.free)


def test_guesses_of_durations_parameters_and_starts_are_in_the_middle():
    """The step of 40 knots in 0.5 to 5 s, three rates in 0 to 20, and x_0 in -5 to 5."""
    knots = {
        name: suite.posed(name)[1]
        for name in ("double_integrator_time", "gas_oil", "forced_oscillator")
    }
    np.testing.assert_allclose(knots["double_integrator_time"].x[:, 2], 2.75 / 40, rtol=1e-6)
    np.testing.assert_allclose(knots["gas_oil"].x[:, 2:], 10.0)
    np.testing.assert_allclose(knots["forced_oscillator"].x, 0.0)
    for each in knots.values():
        np.testing.assert_allclose(each.start, 0.0)


def test_measurements_are_at_their_times():
    """Two steps from each of 20 to the next; nothing is measured in between."""
    times, measured = open_problems.table(open_problems.GAS_OIL, 2, 2)
    np.testing.assert_allclose(times[:4], [0.0125, 0.025, 0.0375, 0.05])
    np.testing.assert_allclose(times[-2:], [0.9, 0.95])
    np.testing.assert_allclose(measured[[1, 39]], [[0.8105, 0.2], [0.069, 0.01]])
    assert np.isnan(measured[::2]).all()
    assert np.isfinite(measured[1::2]).all()
    data = suite.posed("gas_oil")[0].data
    np.testing.assert_allclose(np.cumsum(data["step"])[:-1], times, rtol=1e-5)
    np.testing.assert_allclose(data["x"][1:][1::2], measured[1::2], rtol=1e-6)


def test_the_cycloid_ends_at_10_and_5():
    a = 3.508368768524476
    assert 5 * (a - np.sin(a)) / (1 - np.cos(a)) == pytest.approx(10)
    assert open_problems.cycloid() == pytest.approx(1.8012955)


@pytest.mark.slow
def test_straight_lines_lead_to_the_end_with_unit_quaternions():
    problem = tasks.load("quadrotor").make()
    x = np.asarray(straight(problem, suite.TASKS["quadrotor"]).x)
    np.testing.assert_allclose(np.linalg.norm(x[:, 3:7], axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(np.diff(x[:, 0]), x[1, 0] - x[0, 0], rtol=1e-3)
    np.testing.assert_allclose(x[-1, :3], [2.5, 0.0, 1.0], atol=1e-6)


@pytest.mark.usefixtures("float64")
def test_runge_kutta_has_order_four_for_states_and_integrals():
    """x' = x u with x_0 = 1 and u = 1: x = e^t, whose integral is e^t - 1."""
    errors = []
    for steps in (4, 8):
        dt, x, total = 1 / steps, jnp.ones(1), 0.0
        rate, u = (lambda x, u: x * u), jnp.ones(1)
        for _ in range(steps):
            total += integral(rate, lambda x, u: x[0], dt)(x, u)
            x = runge_kutta(rate, dt)(x, u)
        errors.append([float(x[0]) - np.e, float(total) - np.e + 1])
    np.testing.assert_allclose(np.divide(*errors), 16, rtol=0.2)


def short(**changes):
    """Two knots with constraints of every kind, and a cost that is no sum of squares."""
    given = {
        "x_init": [0.3, -0.2],
        "nu": 1,
        "dt": 1.0,
        "horizon": 3.0,
        "running_cost": lambda x, u: jnp.cos(x[0] * u[0]) + x[1] ** 3,
        "terminal_residual": lambda x: jnp.sin(x) * x[::-1],
        "equality": lambda x, u: jnp.array([x[0] * u[0] ** 2]),
        "inequality": lambda x, u: jnp.array([x[0] * x[1], jnp.exp(u[0]) - 2]),
        "terminal_inequality": lambda x: x[:1] * x[1] ** 2,
    }
    return from_function(
        lambda x, u: jnp.array([x[0] * x[1] + u[0], jnp.sin(x[0]) + u[0] ** 2]), **given | changes
    )


def opened():
    """The same, with a free duration, a free entry of x_0 and a parameter in all functions."""

    def f(x, u, knot):
        own = knot.parameters["p"] * x[0] * x[1] + u[0] + knot.x_init[1]
        return x + knot.dt**2 * jnp.stack([own, jnp.sin(x[0] * knot.time)])

    return from_function(
        f,
        x_init=[0.3, -0.2],
        x_init_bounds=([0.3, -1.0], [0.3, 1.0]),
        parameters={"p": (1.0, 3.0)},
        nu=1,
        horizon=(1.0, 5.0),
        knots=3,
        running_cost=lambda x, u, knot: knot.dt * jnp.cos(x[1] * u[0] * knot.parameters["p"]),
        terminal_cost=lambda x, knot: x[0] ** 3 * knot.x_init[1] ** 2,
        equality=lambda x, u, knot: x[:1] * u[:1] ** 2 * knot.time,
        inequality=lambda x, u, knot: x * knot.x_init[1],
        terminal_inequality=lambda x, knot: x[1:] * (x - knot.x_init)[1:],
    )


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("make", [short, pytest.param(opened, marks=pytest.mark.slow)])
def test_ipopt_gets_the_derivatives_of_the_whole_program(make):
    """Blocks put in their places against the derivatives of the whole in one piece."""
    program = ipopt_jax.Program(make())
    rng = np.random.default_rng(0)
    z, forces = rng.normal(size=program.size), rng.normal(size=program.rows)

    def values(z):
        return ipopt_jax.cost_and_constraints(program.problem, program.knots(z))

    def dense(pattern, entries, rows):
        out = np.zeros((rows, program.size))
        out[pattern.rows, pattern.columns] = entries
        return out

    cost, h = program.values(z)
    problem, knots = program.problem, program.knots(jnp.asarray(z))
    assert float(cost) == pytest.approx(float(problem.cost(knots)))
    n = 3 * problem.dynamics.nx
    np.testing.assert_allclose(h[:n], problem.defects(knots).ravel(), atol=1e-12)
    np.testing.assert_allclose(h[n : n + 9], problem.constraints(knots).stage.ravel())
    kinds = [True] * n + [True, False, False] * 3 + [False]
    assert program.is_equality.tolist() == kinds
    slope = jax.grad(lambda z: values(z)[0])(z)
    np.testing.assert_allclose(program.gradient(z), slope, atol=1e-12)
    jacobian = dense(program.jacobian_pattern, program.jacobian(z), program.rows)
    np.testing.assert_allclose(jacobian, jax.jacfwd(lambda z: values(z)[1])(z), atol=1e-12)
    lagrangian = jax.hessian(lambda z: 0.7 * values(z)[0] + forces @ values(z)[1])(z)
    upper = dense(
        program.hessian_pattern, program.hessian(z, np.array([0.7]), forces), program.size
    )
    np.testing.assert_allclose(upper, np.triu(lagrangian), atol=1e-12)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize(
    "name", ["bryson_denham", "brachistochrone", "zermelo", "gas_oil", "hs071", "hs039"]
)
def test_ipopt_finds_known_optima(name):
    pytest.importorskip("casadi")
    known = PROGRAMS[name].optimum if name in PROGRAMS else CASES[name].optimum
    answer = ipopt_jax.solve(*suite.posed(name))
    assert answer.solved
    assert answer.max_defect < 1e-7
    assert answer.cost == pytest.approx(known, rel=2e-3)
    assert 3 < answer.iterations < 50


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", [*CASES, *PROGRAMS])
def test_ipopt_finds_all_known_optima(name):
    pytest.importorskip("casadi")
    known = PROGRAMS[name].optimum if name in PROGRAMS else CASES[name].optimum
    answer = ipopt_jax.solve(*suite.posed(name))
    assert answer.solved
    if known is not None:
        error = CASES[name].error if name in CASES else 3e-3
        assert answer.cost == pytest.approx(known, rel=error, abs=1e-7)


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", OPEN)
def test_open_problems_end_at_their_published_optima(name):
    _, residual, cost, status = suite.ours(*suite.posed(name))
    assert (status, residual <= suite.TOLERANCE) == ("optimal", True)
    assert cost == pytest.approx(OPEN[name].optimum, rel=OPEN[name].error)


def test_rows_become_lines_with_or_without_ipopt():
    row = {"problem": "hs006", "numbers": 2}
    assert suite.line(row) == "| hs006 | 2 | - | - | - | - | - | - | - | - | - |"
    row |= {"ipopt_iterations": 4, "ipopt_cost": 1.0, "ipopt_status": "Solve_Succeeded"}
    row |= {
        "optimum": 1.0,
        "iterations": 6,
        "cost": 1.0,
        "residual": 2e-9,
        "status": "optimal",
        "ratio": 1.5,
    }
    assert suite.line(row).count("|") == suite.HEADER.splitlines()[0].count("|")
    assert suite.line(row).endswith("| 6 | 1 | 2e-09 | optimal | 1.50 |")


NAMES = ["pendulum, 50 of the flow", "pendulum, 100 of the flow"]


def test_ratio_is_of_iterations(monkeypatch):
    problem, knots = suite.posed("hs006")
    monkeypatch.setattr(suite, "posed", lambda name: (problem, knots))
    monkeypatch.setattr(suite, "has_casadi", lambda: True)
    answer = ipopt_jax.Answer(Trajectory(knots.x, knots.u), 8, 1.0, 0.0, "Solve_Succeeded")
    monkeypatch.setattr(ipopt_jax, "solve", lambda *_: answer)
    monkeypatch.setattr(suite, "ours", lambda _, __, flow: (12 + flow, 1e-9, 1.0, "optimal"))
    (row,) = suite.measure("hs006")
    assert (row["ipopt_iterations"], row["iterations"], row["ratio"]) == (8, 12, 1.5)
    assert (row["numbers"], row["optimum"]) == (2, 0.0)
    rows = suite.measure("pendulum")
    assert [row["problem"] for row in rows] == ["pendulum", *NAMES]
    assert [row["iterations"] for row in rows] == [12, 62, 112]
    assert [row["ratio"] for row in rows] == [1.5, 7.75, 14.0]


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
def test_the_flow_and_the_polish_reach_the_tolerance_together():
    found = [suite.ours(*suite.posed("pendulum"), flow) for flow in suite.DESCENTS]
    assert [status for *_, status in found] == ["optimal"] * 3
    assert all(residual < suite.TOLERANCE for _, residual, *_ in found)
    assert [cost for *_, cost, _ in found] == pytest.approx([0.0317737] * 3, rel=1e-4)
    assert all(n > flow for (n, *_), flow in zip(found, suite.DESCENTS, strict=True))


@pytest.mark.slow
def test_the_suite_runs_in_float64_and_writes_its_rows(tmp_path, capsys):
    assert main(["benchmark", "hs028", "--suite", "convergence", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "| hs028 | 3 | 0 |" in said
    (row,) = json.loads((tmp_path / "convergence.json").read_text())
    assert row["problem"] == "hs028"


def test_unknown_problems_are_named():
    with pytest.raises(DraxError, match="hs071"):
        suite.posed("hs072")
