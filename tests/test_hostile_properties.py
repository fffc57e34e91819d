"""Whatever is given: it is accepted, or a DraxError says why not; nothing else is ever raised.

The examples are the same in every run. MJCF goes to MuJoCo's own parser, in C++: four thousand
mutations of a model were tried in a process of their own and none of them ended it.
"""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("hypothesis")  # one of the packages for development

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_hostile import arm, made_up, point, robot

from mjx_drax import (
    Constant,
    DraxError,
    Geometric,
    Langevin,
    Restarts,
    Solution,
    Trajectory,
    from_function,
)
from mjx_drax.physics.mjcf import load
from mjx_drax.search.restarts import as_restarts, initial_knots
from mjx_drax.search.settings import changed, names

bounded = settings(
    max_examples=100,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


def outcome(call):
    """What a call returns, or the DraxError, which must have something to say."""
    try:
        return call()
    except DraxError as error:
        message = str(error)
        assert 10 < len(message) <= 600
        assert "\n" not in message
        return error


# Files


@pytest.fixture(scope="module", params=["robot", "point"])
def saved(request, tmp_path_factory):
    """A folder with a saved solution, and what its files hold."""
    folder = tmp_path_factory.mktemp("saved")
    made_up(robot() if request.param == "robot" else point()).save(folder)
    return folder, {n: (folder / n).read_bytes() for n in ("result.json", "result.npz")}


def content(solution):
    """All that a solution holds, in a form that can be compared."""
    arrays = {
        "x": solution.trajectories.x,
        "u": solution.trajectories.u,
        "gains": solution.gains,
        "multipliers": solution.multipliers.dynamics,
        "cost": solution.cost,
        "died_at": solution.died_at,
        "states": solution.feedback.states,
        "success": solution.open_loop.success,
        "x_init": solution.problem.x_init,
        "upper": solution.problem.bounds.u_upper,
        **solution.history,
    }
    said = (
        solution.seed,
        solution.solver,
        solution.iterations,
        solution.engine,
        solution.problem.name,
        solution.problem.horizon,
        solution.problem.dynamics.dt,
        solution.solve_time,
    )
    return said, {name: (a.dtype, a.shape, np.asarray(a).tobytes()) for name, a in arrays.items()}


@bounded
@given(data=st.data())
def test_damaged_files_load_as_they_were_or_not_at_all(saved, data):
    folder, whole = saved
    for name, original in whole.items():
        (folder / name).write_bytes(original)
    expected = content(Solution.load(folder))
    name = data.draw(st.sampled_from(sorted(whole)))
    damaged = bytearray(whole[name])
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.none() | st.integers(0, len(damaged)))
    (folder / name).write_bytes(bytes(damaged[:cut]))
    found = outcome(lambda: Solution.load(folder))
    assert isinstance(found, DraxError) or content(found) == expected


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=5), inner, max_size=2)
    ),
    max_leaves=3,
)


@bounded
@given(data=st.data())
def test_any_value_in_the_summary_is_refused_or_harmless(saved, data):
    folder, whole = saved
    said = json.loads(whole["result.json"])
    del said["json_sha256"]
    name = data.draw(st.sampled_from(sorted(said)))
    (folder / "result.npz").write_bytes(whole["result.npz"])
    (folder / "result.json").write_text(json.dumps({**said, name: data.draw(json_values)}))
    found = outcome(lambda: Solution.load(folder))
    if isinstance(found, Solution):
        assert found.problem.times.shape == (found.problem.horizon + 1,)


# Arguments

anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-3, 20),
    st.floats(),
    st.floats(0.01, 3.0),
    st.complex_numbers(),
    st.text(max_size=6),
    st.binary(max_size=4),
    st.lists(st.floats(), max_size=3),
    st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=2),
    st.tuples(st.floats(), st.floats()),
    st.tuples(st.floats(-2.0, 0.0), st.floats(0.0, 2.0)),
    st.dictionaries(st.text(max_size=2), st.floats(), max_size=2),
    st.sampled_from(
        [
            object(),
            float,
            np.float16(1.5),
            np.int8(3),
            np.bool_(True),
            np.zeros((0, 2)),
            np.zeros((10, 2)),
            np.zeros((2, 10, 2)),
            np.full(2, math.nan),
            np.array([None, 1.0]),
            np.array(["1", "2"]),
            np.array([1, 2], "M8[s]"),
            jnp.ones(2),
            jnp.ones(2, bool),
            10**400,
            [[1.0], [2.0, 3.0]],
            {1.0, 2.0},
            range(2),
        ]
    ),
)

ARGUMENTS = ("x_init", "horizon", "dt", "nu", "x_bounds", "u_bounds", "x_scatter", "u_scatter")
FUNCTIONS = ("f", "running_cost", "terminal_residual", "equality", "inequality", "goal", "guess")


@bounded
@given(name=st.sampled_from([*ARGUMENTS, *FUNCTIONS, "name"]), value=anything)
def test_any_argument_makes_a_problem_or_a_complaint(name, value):
    problem = outcome(lambda: point(**{name: value}))
    if not isinstance(problem, DraxError):
        assert np.isfinite(problem.x_init).all()
        assert problem.horizon >= 1
        for side in (problem.scatter.x_upper, problem.scatter.u_lower):
            assert np.isfinite(side).all()


@bounded
@given(name=st.sampled_from([*ARGUMENTS[:3], *ARGUMENTS[4:], "contacts", "goal"]), value=anything)
def test_any_argument_makes_a_robot_or_a_complaint(name, value):
    outcome(lambda: robot(**{name: value}))


@bounded
@given(value=anything)
def test_any_value_of_a_function_makes_a_problem_or_a_complaint(value):
    for name in ("running_cost", "running_residual", "equality"):
        outcome(lambda name=name: point(**{name: lambda x, u: value}))
    outcome(lambda: point(f=lambda x, u: value))
    outcome(lambda: point(goal=lambda x: value))
    outcome(lambda: point(guess=lambda key: value))


@bounded
@given(chains=anything, seed=anything, x=anything, u=anything)
def test_any_arguments_of_a_solve_are_checked(chains, seed, x, u):
    problem = point()
    outcome(lambda: as_restarts(problem, chains, 0, Restarts()))
    outcome(lambda: as_restarts(problem, 1, seed, Restarts()))
    guess = outcome(lambda: initial_knots(problem, 2, Trajectory(x, u), None))
    if not isinstance(guess, DraxError):
        assert guess.x.shape == guess.u.shape == (2, 10, 2)


@bounded
@given(
    name=st.sampled_from([n for n in vars(Langevin()) if n != "scale"]),
    value=anything | st.builds(Constant, anything) | st.builds(Geometric, anything, anything),
)
def test_any_setting_is_checked(name, value):
    outcome(lambda: as_restarts(point(), 1, 0, Langevin(**{name: value})))


@bounded
@given(name=st.sampled_from(names(Restarts())), text=st.text(max_size=12))
def test_any_text_of_a_setting_is_checked(name, text):
    outcome(lambda: changed(Restarts(), name, text))


# Models

CHARACTERS = st.characters(codec="utf-8", categories=None) | st.sampled_from('<>"/= &;')


@bounded
@given(text=st.text(CHARACTERS, max_size=60), xml=st.booleans())
def test_any_text_is_a_model_or_a_complaint(text, xml):
    outcome(lambda: load("<" * xml + text))


@settings(bounded, max_examples=250)
@given(data=st.data())
def test_a_garbled_model_is_a_model_or_a_complaint(data):
    text = arm()
    for _ in range(data.draw(st.integers(1, 3))):
        first = data.draw(st.integers(0, len(text)))
        last = min(len(text), first + data.draw(st.integers(0, 12)))
        new = data.draw(
            st.sampled_from(["", "-", "nan", "inf", "-1", "0", "1e308", '"', "<", ">", "/>", "&"])
            | st.text(max_size=4)
            | st.just(text[first:last] * 2)
        )
        text = text[:first] + new + text[last:]
    outcome(lambda: robot(text))


def test_problems_that_are_good_are_built():
    """That all is not refused."""
    assert from_function(lambda x, u: u, x_init=[0], nu=1, dt=1, horizon=3, running_cost=_cost)


def _cost(x, u):
    return u @ u
