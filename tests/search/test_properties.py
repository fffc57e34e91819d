"""Any setting is accepted, or a DraxError says why not; nothing else is raised."""

import pytest
from builders import outcome, point
from hypothesis import given
from hypothesis import strategies as st
from strategies import anything, bounded

from mjx_drax import Constant, DraxError, Geometric, Langevin, Restarts, Trajectory
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.restarts import settled
from mjx_drax.search.settings import changed, names

pytestmark = pytest.mark.slow


@bounded
@given(chains=anything, seed=anything, x=anything, u=anything)
def test_any_arguments_of_a_solve_are_checked(chains, seed, x, u):
    problem = point()
    outcome(lambda: settled(problem, chains, 0, None))
    outcome(lambda: settled(problem, 1, seed, None))
    guess = outcome(lambda: initial_knots(problem, 2, Trajectory(x, u), None))
    if not isinstance(guess, DraxError):
        assert guess.x.shape == guess.u.shape == (2, 10, 2)


@bounded
@given(
    name=st.sampled_from([n for n in vars(Langevin()) if n != "scale"]),
    value=anything | st.builds(Constant, anything) | st.builds(Geometric, anything, anything),
)
def test_any_setting_is_checked(name, value):
    outcome(lambda: settled(point(), 1, 0, Langevin(**{name: value})))


@bounded
@given(name=st.sampled_from(names(Restarts())), text=st.text(max_size=12))
def test_any_text_of_a_setting_is_checked(name, text):
    outcome(lambda: changed(Restarts(), name, text))
