"""Any argument or text makes a robot, or a DraxError says why not; nothing else is raised.

MJCF goes to MuJoCo's own parser, in C++: four thousand mutations of a model were tried in a process
of their own and none of them ended it.
"""

import pytest
from builders import arm, outcome, robot
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import anything, bounded

from mjx_drax.physics.source import load

pytestmark = pytest.mark.slow

NUMBERS = ("x_init", "horizon", "dt", "x_bounds", "u_bounds", "x_scatter", "u_scatter")


@settings(bounded, max_examples=25)
@given(name=st.sampled_from([*NUMBERS, "contacts", "goal"]), value=anything)
def test_any_argument_makes_a_robot_or_a_complaint(name, value):
    outcome(lambda: robot(**{name: value}))


CHARACTERS = st.characters(codec="utf-8", categories=None) | st.sampled_from('<>"/= &;')


@bounded
@given(text=st.text(CHARACTERS, max_size=60), xml=st.booleans())
def test_any_text_is_a_model_or_a_complaint(text, xml):
    outcome(lambda: load("<" * xml + text))


@settings(bounded, max_examples=150)
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
