"""The paper's figures and table at the smallest sizes that still say something."""

import json
from importlib import import_module
from inspect import signature

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import Constant, tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.cli import main
from mjx_drax.studies import reproduce
from mjx_drax.studies.many_starts import solve_each
from mjx_drax.studies.measurements import judge
from mjx_drax.studies.reproduce import (
    bug_trap,
    convergence,
    direct_against_shooting,
    multipliers,
    open_questions,
    parallel_table,
    settings,
    theorem_2,
)
from mjx_drax.studies.reproduce.output import table
from mjx_drax.studies.reproduce.settings import PENDULUM_FLOW, TRAP_FLOW


def figure_is_drawn(figure):
    figure.canvas.draw()
    return all(axes.has_data() or not axes.axison for axes in figure.axes)


@pytest.mark.parametrize("name", reproduce.NAMES)
def test_every_name_is_a_file_that_makes_it(name):
    module = import_module(f"mjx_drax.studies.reproduce.{name.replace('-', '_')}")
    assert {"chains", "iterations"} <= set(signature(module.make).parameters)


def test_flows_are_the_printed_one():
    for flow in (PENDULUM_FLOW, TRAP_FLOW):
        assert flow.iterations == 20_000
        assert flow.tail == 0
    assert PENDULUM_FLOW.penalty == Constant(10.0)


@pytest.mark.slow
def test_phase_portrait_is_written_and_its_numbers_are_measured(tmp_path, capsys):
    arguments = f"reproduce phase-portrait --chains 4 --iterations 60 --out {tmp_path}".split()
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "| preconditioned | 200 | 4 | 100.0% | 100.0% |" in out
    assert "| paper's flow | 60 | 4 | 0.0% | 0.0% |" in out
    assert (tmp_path / "phase-portrait.png").stat().st_size > 10_000
    numbers = json.loads((tmp_path / "phase-portrait.json").read_text())
    flow, preconditioned = numbers["rows"]
    assert flow["best cost"] is None
    np.testing.assert_allclose(preconditioned["best cost"], 0.031774, rtol=2e-3)
    assert numbers["settings"]["paper's flow"]["penalty"] == {"part": "Constant", "value": 10.0}
    assert numbers["settings"]["paper's flow"]["iterations"] == 60
    assert numbers["device"]
    assert numbers["jax"] == jax.__version__


@pytest.mark.slow
def test_convergence_has_a_curve_for_every_penalty():
    numbers, figure = convergence.make(chains=4, iterations=400, penalties=(0.01, 10.0))
    weak, strong = numbers["rows"]
    assert strong["median |h|²"] < 1e-2 * weak["median |h|²"]
    assert weak["step size"] == strong["step size"] == 0.025
    series = numbers["series"]
    assert len(series["iteration"]) == len(series["mu=10"]["median"]) == 201
    assert series["mu=10"]["median"][0] == series["mu=0.01"]["median"][0]  # the same knots
    assert figure_is_drawn(figure)


@pytest.mark.slow
def test_bug_trap_gives_every_method_the_same_budget():
    numbers, figure = bug_trap.make(chains=4, iterations=30, longer=2, matrix=True)
    budgets = {row["method"]: row["iterations"] for row in numbers["rows"]}
    long = {name for name in budgets if name.endswith("2×")}
    assert len(long) == 4
    assert {budgets[name] for name in long} == {60}
    assert {budgets[name] for name in set(budgets) - long} == {30}
    assert numbers["settings"]["gradient descent"].noise.start == 0.0
    assert figure_is_drawn(figure)
    titles = [axes.get_title(loc="left").split("\n")[0] for axes in figure.axes]
    assert titles == ["(a) gradient descent", "(b) BFGS, full matrix", "(c) paper's flow"]


@pytest.mark.slow
def test_parallel_table_solves_a_problem_for_each_initial_state():
    numbers, figure = parallel_table.make(4, 50, sizes=(4, 8), grid=(601, 201))
    assert [(row["N"], row["x_init"]) for row in numbers["rows"]] == [
        (4, "random"),
        (4, "hanging"),
    ]
    hanging = numbers["rows"][-1]
    assert hanging["preconditioned: rollout upright"] == 1.0
    assert hanging["paper's flow: rollout upright"] == 0.0  # not after 50 iterations
    assert hanging["can be upright"] == 1.0
    assert hanging["preconditioned: projected: upright"] == 1.0
    assert hanging["preconditioned: of those that can"] == 1.0
    assert hanging["preconditioned: time [s]"] > 0
    assert "| 4 | hanging |" in table(numbers)
    assert figure_is_drawn(figure)


@pytest.mark.slow
def test_batched_problems_start_where_they_should():
    problem = tasks.load("pendulum").make()
    starts = jnp.array([[3.1, 0.0], [3.0, 0.2], [-3.1, 0.0], [3.2, -0.1]])
    keys = jax.random.split(jax.random.key(0), 4)
    knots, info, *_ = solve_each(settings.PENDULUM, problem, starts, keys)
    for i in range(4):
        own = problem.with_x_init(starts[i])
        one = jax.tree.map(lambda a, i=i: a[i], knots)
        assert own.max_defect(one) < 1e-3
        np.testing.assert_allclose(own.max_defect(one), info.max_defect[i], atol=1e-6)
    u = np.asarray(knots.u, float)
    assert judge(problem, u, np.asarray(starts)).success[0]


def test_theorem_2_where_the_answer_is_known():
    """A = diag(mu - 1, 1) is positive definite, and the flow is stable, for mu > 1."""
    zero, one = np.zeros(2), np.zeros(1)
    optimum = theorem_2.Optimum(0.0, zero, one, np.diag([-1.0, 1.0]), np.array([[1.0, 0.0]]))
    np.testing.assert_allclose(optimum.definite_from(), 1.0, rtol=2e-3)
    np.testing.assert_allclose(optimum.stable_from(), 1.0, rtol=2e-3)
    assert optimum.decay(0.5, 0.01) < 0 < optimum.decay(3.0, 0.01)
    assert optimum.largest_step(0.5) is None
    # of the iteration [[1 - 2a, -a], [6a, 1]] the determinant is 1 at a = 1 / 3
    np.testing.assert_allclose(optimum.largest_step(3.0), 1 / 3, rtol=2e-3)


@pytest.mark.slow
def test_theorem_2_at_the_pendulums_optimum():
    numbers, figure = theorem_2.make(2, 500, barriers=(1e-2, 1e-1), penalties=(1.0, 10.0))
    row, unstable = numbers["rows"]
    assert unstable["largest α, μ = 10"] is None
    assert 150 < row["mu* (A positive definite)"] < 250
    assert 0.3 < row["linearized flow stable from mu"] < 1.0
    assert 0.030 < row["largest α, μ = 10"] < 0.035
    rises = {(energy["rho"], energy["mu"]): energy for energy in numbers["energies"]}
    assert rises[0.01, 1.0]["rises with μ|h|²"] == rises[0.01, 10.0]["rises with μ|h|²"] == 0.0
    assert (
        rises[0.1, 1.0]["energy left (the proof's)"] > rises[0.01, 1.0]["energy left (the proof's)"]
    )
    assert figure_is_drawn(figure)


@pytest.mark.slow
def test_without_multipliers_defects_stay():
    numbers, figure = multipliers.make(chains=4, iterations=1500, penalties=(10.0,))
    own, none = (row["median |h|²"] for row in numbers["rows"])
    assert own < 0.5 * none
    assert figure_is_drawn(figure)


@pytest.mark.slow
def test_direct_and_shooting_obey_the_dynamics():
    numbers, figure = direct_against_shooting.make(chains=8, iterations=60, grid=(601, 201))
    for row in numbers["rows"]:
        assert row["feasible"] == 1.0
        assert row["upright"] > 0.1
    assert figure_is_drawn(figure)


@pytest.mark.slow
def test_open_questions_answers_each_of_them():
    numbers, figure = open_questions.make(chains=4, iterations=20, limit=80, pairs=(6,))
    assert numbers["preconditioning"][0]["method"] == "identity"
    assert numbers["preconditioning"][-1]["method"] == "Gauss-Newton"
    schedules = [row["annealing"] for row in numbers["annealing"]]
    assert {"geometric", "linear", "adaptive", "no noise"} <= set(schedules)
    sigma = {name: curve["sigma"] for name, curve in numbers["sigmas"].items()}
    assert sigma["geometric"][0] == sigma["adaptive"][0] == 30.0
    assert np.all(np.diff(sigma["adaptive"]) < 0)
    assert max(sigma["no noise"]) == 0
    gradients = {row["method"]: row for row in numbers["gradients"]}
    for method in ("Gauss-Newton, exact", "Gauss-Newton, 6 pairs a knot"):
        assert gradients[method]["reaches goal"] == 1.0
    exact, sampled = (
        gradients[f"identity, {by}"]["median max|h|"] for by in ("exact", "6 pairs a knot")
    )
    assert exact != sampled
    np.testing.assert_allclose(sampled, exact, rtol=0.1)  # both after 80 iterations
    assert figure_is_drawn(figure)


def test_unknown_names_and_folders_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["reproduce", "phase"])
    assert "phase-portrait" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    with pytest.raises(DraxError, match="cannot write"):
        reproduce.run("convergence", tmp_path / "file")
