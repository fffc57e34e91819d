"""Any argument makes a problem, or a DraxError says why not; nothing else is raised."""

import numpy as np
import pytest
from builders import outcome, point
from hypothesis import given
from hypothesis import strategies as st
from strategies import anything, bounded

from mjx_drax import DraxError, from_function

pytestmark = pytest.mark.slow

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


ROLES = {
    "f": lambda value: {"f": lambda x, u: value},
    "running_cost": lambda value: {"running_cost": lambda x, u: value},
    "running_residual": lambda value: {"running_residual": lambda x, u: value},
    "equality": lambda value: {"equality": lambda x, u: value},
    "goal": lambda value: {"goal": lambda x: value},
    "guess": lambda value: {"guess": lambda key: value},
}


@bounded
@given(role=st.sampled_from(sorted(ROLES)), value=anything)
def test_any_value_of_a_function_makes_a_problem_or_a_complaint(role, value):
    outcome(lambda: point(**ROLES[role](value)))


def test_problems_that_are_good_are_built():
    """That all is not refused."""
    assert from_function(lambda x, u: u, x_init=[0], nu=1, dt=1, horizon=3, running_cost=_cost)


def _cost(x, u):
    return u @ u
