"""Problems whose actuators' forces have ends: solved without these first."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax import Restarts, Trajectory, from_mjcf, solve
from mjx_drax.search import unlimited
from mjx_drax.search.unlimited import both_of, is_motion

ARM = """
<mujoco model="arm"><option timestep="0.01" {option}/><compiler angle="radian"/><worldbody>
  <body><joint name="one" axis="0 1 0" damping="0.3" {joint}/>
    <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1" contype="0" conaffinity="0"/>
  </body></worldbody>
<actuator>{actuator}</actuator></mujoco>"""
SERVO = '<position joint="one" kp="60" kv="4" ctrlrange="-300 300" forcerange="{}"/>'

NARROW = SERVO.replace("300", "4")


def posed(forces="-4 4", joint="", option="", actuator=SERVO, **settings):
    text = ARM.format(joint=joint, option=option, actuator=actuator.format(forces))

    def end(data):
        return jnp.concatenate([14 * (data.qpos - 1.0), 3 * data.qvel])

    def running(data, u):
        return jnp.concatenate([0.3 * data.qvel, 3.0 * (u - data.qpos)])

    costs = {"running_residual": running, "terminal_residual": end}
    model = mujoco.MjModel.from_xml_string(text)
    return from_mjcf(model, **{"horizon": 1.0, **costs, **settings})


@pytest.mark.parametrize(
    "problem",
    [
        posed(),
        posed("-4 3", option='integrator="implicitfast"'),
        posed(actuator='<motor joint="one" gear="-3" ctrlrange="-300 300" forcerange="{}"/>'),
        posed(joint='actuatorfrcrange="-3 2"', actuator=SERVO.replace('forcerange="{}"', "")),
        posed(joint='frictionloss="0.1"'),
    ],
    ids=["servo", "implicit", "motor", "joint", "dry"],
)
def test_forces_have_no_ends_at_first_and_then_no_motion_is_lost(problem):
    first, then, rows, held = both_of(problem)
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(8, 2)), jnp.float32)
    far = jnp.asarray([[-290.0], [290.0]] * 4, jnp.float32)

    def slopes(dynamics):
        return np.abs(jax.vmap(jax.jacfwd(dynamics.step, argnums=1))(x, far)).max(axis=(1, 2))

    assert slopes(first.dynamics).min() > 1e-3
    assert slopes(problem.dynamics).max() < 1e-6
    assert first.dynamics.mj_model is problem.dynamics.mj_model  # which certifies
    assert rows == 2

    def passed(of, u):
        return np.asarray(jax.vmap(of.running_constraint)(x, u))

    # at first no force is beyond its range where a knot begins
    low, high = problem.dynamics.unlimited().useful(x)
    np.testing.assert_allclose(passed(first, far), np.hstack([far - high, low - far]), rtol=1e-5)
    # then controls may go on to where f does not change any more
    at_0 = passed(then, jnp.zeros_like(far))
    last, least = -at_0[:, :1], at_0[:, 1:]
    assert np.all(least <= low)
    assert np.all(high <= last)
    step = jax.vmap(problem.dynamics.step)
    np.testing.assert_allclose(step(x, last), step(x, last + 9.0), atol=1e-6)
    np.testing.assert_allclose(step(x, least), step(x, least - 9.0), atol=1e-6)
    # where controls are held within the ends, f is as if there were none
    given = np.array([held(*each) for each in zip(np.asarray(x), np.asarray(far), strict=True)])
    inside = jnp.asarray(given, jnp.float32)
    true, free = (jax.vmap(of.dynamics.step)(x, inside) for of in (problem, first))
    np.testing.assert_allclose(true, free, atol=1e-6)
    assert np.all(passed(first, inside) < 0)
    assert np.all(passed(first, inside).max(axis=1) > -1e-2 * np.ravel(high - low))
    middle = 0.5 * np.asarray(low + high, float)
    np.testing.assert_array_equal(held(np.asarray(x)[0], middle[0]), middle[0])


def test_forces_are_kept_in_range_beside_rates_but_not_where_parameters_change_the_model():
    def rated(data, u, knot):
        return 0.01 * knot.rate

    given = {"running_residual": rated, "rates": 1}
    x, u = jnp.array([0.3, -2.0]), jnp.array([290.0])
    for plain, other in zip(both_of(posed())[:2], both_of(posed(**given))[:2], strict=True):
        here = other.at(other.knots.at(0))
        expected = plain.running_constraint(x, u)
        np.testing.assert_allclose(here.running_constraint(jnp.append(x, 0.0), u), expected)
        steps = plain.dynamics.step(x, u), here.dynamics.step(jnp.append(x, 0.0), u)
        np.testing.assert_allclose(steps[1], jnp.append(steps[0], u))
    changed = posed(
        **given,
        parameters={"k": (50.0, 70.0)},
        model_numbers=lambda model, p: {
            "actuator_gainprm": model.actuator_gainprm.at[0, 0].set(p["k"])
        },
    )
    assert both_of(changed) is None


def test_both_are_solved_by_one_program():
    problem = posed()
    first, then, *_ = both_of(problem)
    assert jax.tree.structure(first) == jax.tree.structure(then)
    shapes = [[jnp.shape(a) for a in jax.tree.leaves(problem)] for problem in (first, then)]
    assert shapes[0] == shapes[1]


def test_nothing_is_solved_twice_where_no_force_is_in_the_way():
    assert both_of(posed(actuator=SERVO.replace('forcerange="{}"', ""))) is None
    assert both_of(posed("-4e5 4e5")) is None
    assert (
        both_of(posed(actuator='<motor joint="one" ctrlrange="-9 9" forcerange="-9 9"/>')) is None
    )
    assert both_of(posed(actuator=SERVO.replace("60", "0"))) is None  # gives no force


@pytest.fixture
def searches(monkeypatch):
    """The problems that a solve in steps searches, as it does."""
    every, in_steps = [], unlimited.found_in_steps

    def watched(problem, both, settings, searched):
        def counted(posed, *arguments):
            every.append(posed)
            return searched(posed, *arguments)

        return in_steps(problem, both, settings, counted)

    monkeypatch.setattr("mjx_drax.solution.solve.found_in_steps", watched)
    return every


def test_chains_become_optimal_and_answers_are_those_of_the_problem_as_given(searches):
    """Almost all random controls are beyond the ends, and true forces let no chain go on."""

    def slow_enough(data, u):
        return 1e6 * (data.qvel - 2.5)  # which plans measure in a unit of their own

    once = Restarts(attempts=1)
    problem = posed("-6 6", inequality=slow_enough, actuator=NARROW)
    solution = solve(problem, chains=4, seed=0, solver=once)
    assert len(searches) == 2
    assert solution.optimal_chains.all()
    assert solution.certified
    free = replace(problem, dynamics=posed("-4e5 4e5", actuator=NARROW).dynamics)
    least = solve(free, chains=4, seed=0, solver=once).replay_cost.min()
    assert len(searches) == 2
    np.testing.assert_allclose(solution.replay_cost, least, rtol=1e-5)
    knots, K = solution.trajectories, problem.horizon
    assert knots.slack.stage.shape == (4, K, 1)
    assert solution.multipliers.constraints.stage.shape == (4, K, 1)
    assert solution.problem.constraint.rows == 1
    assert solution.problem.constraint.unit.shape == (1,)
    done = solution.history["iteration"]
    assert (np.diff(done) >= 0).all()
    assert solution.feasible_since.max() <= done[-1] == solution.iterations


@pytest.mark.slow
def test_what_needs_more_than_the_ends_at_once_is_searched_for_anew(searches):
    """No control holds the arm at 1 rad within the range of its force."""
    tasks = {"equality": lambda data, u: 10.0 * (data.qpos - 1.0), "x_init": [1.0, 0.0]}
    problem = posed("-1 1", actuator=NARROW, **tasks)
    solution = solve(problem, chains=2, solver=Restarts(attempts=1))
    assert len(searches) == 2
    assert not solution.feasible.any()


@pytest.mark.slow
def test_nothing_is_optimal_that_leans_on_a_constraint_of_a_step(searches):
    """The cost rewards controls beyond the ends; two chains seemed optimal at 23.2."""

    def running(data, u):
        return jnp.concatenate([0.3 * data.qvel, 0.3 * (u - 3.9)])

    problem = posed(actuator=NARROW, running_residual=running)
    solution = solve(problem, chains=4, seed=0, solver=Restarts(attempts=1))
    assert [posed.constraint.inequalities for posed in searches] == [2, 2, 0]
    assert solution.certified
    assert solution.replay_cost[solution.best_chain] < 18.0
    assert np.all(solution.replay_cost[solution.optimal_chains] < 18.0)


def line(problem):
    """Knots on a straight line to the end, which no control makes."""
    share = np.linspace(0.0, 1.0, problem.horizon + 1)[1:, None]
    return Trajectory(share * [1.0, 1.0], share)


def test_a_guess_is_a_motion_if_one_chain_obeys_the_dynamics():
    problem = posed(actuator=NARROW)
    no_motion, rest = line(problem), np.zeros((problem.horizon, 2))
    u = np.zeros((problem.horizon, 1))
    assert not is_motion(problem, None, 2)
    assert not is_motion(problem, no_motion, 2)
    assert is_motion(problem, Trajectory(rest, u), 2)  # it hangs where it is
    either = jax.tree.map(lambda a, b: np.stack([a, b]), no_motion, Trajectory(rest, u))
    assert is_motion(problem, either, 2)


@pytest.mark.slow
def test_a_guess_that_is_no_motion_is_improved_without_ends_first(searches):
    problem = posed("-6 6", actuator=NARROW)
    found = solve(problem, chains=2, solver=Restarts(attempts=1), guess=line(problem))
    assert len(searches) == 2
    assert found.certified
    assert found.optimal_chains.all()


@pytest.mark.slow
def test_no_chain_is_worse_than_a_guess(monkeypatch):
    problem = posed(actuator=NARROW)
    best = solve(problem, chains=2, solver=Restarts(attempts=1)).best
    monkeypatch.setattr("mjx_drax.solution.solve.found_in_steps", lambda *_: 1 / 0)
    again = solve(problem, chains=2, solver=Restarts(attempts=1), guess=best)
    assert float(again.cost.max()) <= float(problem.cost(best)) * 1.001
