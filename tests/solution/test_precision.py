"""float64 by one argument, while JAX is set to float32."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import (
    Restarts,
    Solution,
    Trajectory,
    from_function,
    from_mjcf,
    from_program,
    minimize,
    save_csv,
    solve,
    solve_batch,
)
from mjx_drax.cli import main
from mjx_drax.solution.report import _apart
from mjx_drax.view.plotting import plot_solution

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("error"),  # JAX warns where float64 is cut to float32
]

DT = 0.2
GAIN = np.array([[0.7]])  # JAX sees it in float32 first
ONCE = Restarts(descent=20, attempts=1)
RAIL = """<mujoco><option timestep="0.05"><flag contact="disable"/></option><worldbody>
  <body><joint name="slide" type="slide"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor joint="slide" gear="4" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>"""


def reach(**changes):
    """A mass on a rail with a soft motor, that is to come to rest at 1."""

    def f(x, u):
        return x + DT * jnp.array([x[1], jnp.sin(GAIN @ u)[0]])

    given = {
        "x_init": [0.1, 0.0],
        "nu": 1,
        "dt": DT,
        "horizon": 10 * DT,
        "running_residual": lambda x, u: 0.1 * u,
        "terminal_residual": lambda x: 10.0 * (x - jnp.array([1.0, 0.0])),
        "u_bounds": (-2.0, 2.0),
    }
    return from_function(f, **given | changes)


@pytest.fixture(scope="module")
def problem():
    made = reach()
    made.dynamics.step(jnp.zeros(2), jnp.zeros(1))
    return made


@pytest.fixture(scope="module")
def solution(problem):
    return solve(problem, chains=4, solver=ONCE, precision=64)


@pytest.fixture(scope="module")
def rail():
    problem = from_mjcf(
        RAIL,
        horizon=0.5,
        running_residual=lambda data, u: 0.1 * u,
        terminal_residual=lambda data: 10.0 * jnp.append(data.qpos - 0.2, data.qvel),
    )
    return problem, solve(problem, chains=2, solver=ONCE, precision=64)


def test_what_is_printed_later_is_computed_in_float64(rail):
    _, found = rail
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # as where JAX makes float32 of float64
        assert "CERTIFIED" in str(found)


def assert_double(*trees):
    for leaf in jax.tree.leaves(trees):
        assert leaf.dtype == np.float64


def test_a_function_reaches_1e_8(solution):
    assert solution.tolerance == 1e-8
    assert solution.residual.max() < 1e-8
    assert solution.max_defect.max() < 1e-12
    assert solution.status == ["optimal"] * 4
    assert solution.certificate.success
    assert len(solution.optima) == 1
    assert solution.where(0) is None
    assert solution.problem.precision == 64
    assert_double(solution.trajectories, solution.gains, solution.cost, solution.plans)
    assert_double(solution.open_loop.cost, solution.feedback.cost)
    assert jnp.zeros(()).dtype == jnp.float32  # JAX is set as before


def test_reports_compare_motions_in_float64(solution):
    """JAX warns where it shortens a number to float32."""
    (found,) = solution.optima
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "by +0 at knot" in _apart(solution, found, found)


def test_it_is_saved_and_loaded_in_float64(problem, solution, tmp_path):
    solution.save(tmp_path)
    for loaded in (Solution.load(tmp_path), Solution.load(tmp_path, problem).certify()):
        assert loaded.problem.precision == 64
        assert loaded.optimal
        assert loaded.tolerance == 1e-8
        np.testing.assert_array_equal(loaded.plans, solution.plans)
        np.testing.assert_array_equal(loaded.replay_cost, solution.replay_cost)
        assert len(loaded.optima) == 1
    plot_solution(loaded, tmp_path / "plot.png")
    save_csv(loaded, tmp_path / "replay.csv")


def test_a_guess_and_another_attempt_stay_in_float64(problem):
    guess = Trajectory(np.zeros((10, 2)), np.zeros((10, 1)))
    eager = Restarts(descent=20, attempts=2, done_share=2.0)
    found = solve(problem, chains=2, solver=eager, guess=guess, record=10, precision=64)
    assert len(found.history["began"]) == 2
    assert found.residual.max() < 1e-8


def test_a_model_reaches_1e_8(rail, tmp_path):
    problem, solution = rail
    assert solution.tolerance == 1e-8
    assert solution.residual.max() < 1e-8
    assert solution.optimal
    assert "C engine" in solution.certificate.engine
    assert_double(solution.trajectories, solution.cost, solution.replayed)
    assert solution.feedback.max_deviation.max() < 1e-10
    solution.save(tmp_path)
    for loaded in (Solution.load(tmp_path), Solution.load(tmp_path, problem).certify()):
        assert loaded.optimal
        assert loaded.problem.precision == 64
        np.testing.assert_array_equal(loaded.replayed[0], solution.replayed[0])


def test_batches_reach_1e_8(problem):
    starts = np.array([[0.0, 0.0], [0.1, 0.0]])
    batch = solve_batch(
        lambda x: replace(problem, x_init=x), starts, chains=2, solver=ONCE, precision=64
    )
    assert batch.status == ["optimal"] * 2
    assert batch.chain_residual.max() < 1e-8
    assert batch.where(0) is None
    assert_double(batch.x, batch.u, batch.cost)


def test_programs_reach_1e_8():
    program = from_program(2, cost=lambda x: (x[0] - 1) ** 2 + 9 * (x[1] - x[0] ** 2) ** 2)
    found = minimize(program, chains=2, solver=ONCE, precision=64)
    assert found.residual.max() < 1e-8
    np.testing.assert_allclose(found.x, 1.0, atol=1e-6)


def test_the_command_makes_the_problem_in_float64(tmp_path, capsys):
    words = "solve pendulum --horizon 1 --chains 2 --iterations 4 --no-video --quiet"
    main([*words.split(), "--precision", "64", "--residual", "1e-7", "--out", str(tmp_path)])
    assert capsys.readouterr() == ("", "")
    loaded = Solution.load(tmp_path)
    assert loaded.problem.precision == 64
    assert loaded.tolerance == 1e-7
    assert_double(loaded.trajectories)
    assert jnp.zeros(()).dtype == jnp.float32


def integrator(x_init):
    return from_function(
        lambda x, u: x + 0.1 * u,
        x_init=[x_init],
        nu=1,
        dt=0.1,
        horizon=0.5,
        running_cost=lambda x, u: x @ x + u @ u,
    )


def test_32_bits_are_32_bits_whatever_jax_is_set_to():
    problem = integrator(1.0)
    with jax.enable_x64(True):
        found = solve(problem, chains=2, solver=ONCE, progress=False)
    assert found.optimal
    assert found.trajectories.u.dtype == np.float32


def test_a_file_in_float32_belongs_to_the_same_problem_in_float64(tmp_path):
    solve(integrator(0.1), chains=2, solver=ONCE, progress=False).save(tmp_path)
    with jax.enable_x64(True):
        assert Solution.load(tmp_path, integrator(0.1)).certified
