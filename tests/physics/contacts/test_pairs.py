"""Contacts that are chosen by names, and those that a plan has by default."""

import json
import re

import jax
import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError, from_mjcf
from mjx_drax.base.errors import DraxWarning
from mjx_drax.physics import near, report
from mjx_drax.physics.agreement.checks import Findings, Samples, StepErrors, compare, examine
from mjx_drax.physics.c_engine.states import Engine
from mjx_drax.physics.contacts.pairs import contact_pairs, left_out
from mjx_drax.physics.dynamics import MjxDynamics
from mjx_drax.physics.mjx_model import contact_points, put_model
from mjx_drax.physics.report import check

XML = """
<mujoco model="walker">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <geom type="sphere" size="0.1" pos="2 0 0.1"/>
    <body name="left"><joint name="one" type="slide" axis="0 0 1"/>
      <geom name="foot_left" size="0.1" pos="0 0 0.1"/></body>
    <body name="right"><joint type="slide" axis="0 0 1"/>
      <geom name="foot_right" size="0.1" pos="0.25 0 0.1"/>
      <geom name="shin" type="box" size="0.1 0.1 0.1" pos="0.25 0 0.4"/></body>
  </worldbody>
  <actuator><motor joint="one"/></actuator>
  {more}
</mujoco>"""


def walker(more=""):
    return mujoco.MjModel.from_xml_string(XML.format(more=more))


def kept(model, contacts):
    pairs = set(contact_pairs(model)) - left_out(model, contacts)
    return {" ".join(sorted(model.geom(g).name or "-" for g in pair)) for pair in pairs}


def test_pairs_are_chosen_by_names_of_geoms_and_bodies():
    model = walker()
    assert kept(model, [("foot_*", "floor")]) == {"floor foot_left", "floor foot_right"}
    assert kept(model, [("left", "shin"), ("world", "left")]) == {
        "foot_left shin",
        "floor foot_left",
        "- foot_left",
    }
    assert len(kept(model, True)) == 8
    assert kept(model, False) == set()


@pytest.mark.parametrize(
    ("contacts", "words"),
    [
        ([("foot_lift", "floor")], "names 'foot_lift'.*nearest names are 'foot_left'"),
        ([("foot_*", "shins")], "names 'shins'.*'shin'"),
        ([("floor", "floor")], "MuJoCo makes no contact between them"),
        (("foot_left", "floor"), r"contacts is 'foot_left': .*\[\(\"foot_\*\", \"floor\"\)\]"),
        ([("foot_left", 99)], "contacts is 99"),
    ],
)
def test_what_cannot_touch_is_refused(contacts, words):
    with pytest.raises(DraxError, match=words):
        put_model(walker(), contacts)


PAIR = '<contact><pair geom1="foot_right" geom2="floor"/></contact>'


def test_a_step_has_the_contacts_that_were_chosen():
    """Both feet stand; without its contact the right one falls, in both engines."""
    x, u = np.array([-0.01, -0.01, 0, 0]), np.zeros(1)
    contacts = [("foot_left", "floor")]
    for model in (walker(), walker(PAIR)):
        assert len(contact_points(put_model(model, contacts))) == 1
        end = Engine(model, contacts).step(x, u)
        assert end[3] == pytest.approx(-0.0981)
        assert end[2] > 0
        assert mujoco.get_mjcb_contactfilter() is None
    assert compare(model, Samples(x[None], u[None]), contacts).velocity[0] < 1e-9


def test_dynamics_know_their_contacts_by_number():
    model = walker()
    planned = put_model(model, [("foot_*", "floor")])
    dynamics = MjxDynamics(planned, 0.01, model, 1)
    assert dynamics.contacts == dynamics.in_float64().contacts == [(0, 2), (0, 3)]
    again = put_model(model, json.loads(json.dumps(dynamics.contacts)))
    assert jax.tree.structure(again) == jax.tree.structure(planned)


def test_dynamics_say_where_a_contact_is_that_they_leave_out():
    model = walker()
    dynamics = MjxDynamics(put_model(model, [("foot_*", "floor")]), 0.01, model, 1)
    states = np.array([[0.0, 0, 0, 0], [-0.01, -0.01, 0, 0], [0.0, -0.31, 0, 0]])
    assert dynamics.left_out(states) == (2, "'floor' touches 'shin'")
    assert dynamics.left_out(states[:2]) is None
    assert MjxDynamics(put_model(model), 0.01, model, 1).left_out(states) is None
    none = MjxDynamics(put_model(model, contacts=False), 0.01, model, 1)
    assert none.left_out(states) == (1, "'floor' touches 'foot_left'")


@pytest.mark.parametrize(("height", "said"), [(0.0, True), (-1e-4, False), (1e-4, False)])
def test_geoms_that_just_touch_at_x_init_are_named(height, said):
    model = walker('<default><geom mass="0.01"/></default>')
    model.actuator_gear[0, 0], bounded = 100.0, np.zeros(2, bool)
    x_init, contacts = np.array([height, -0.01, 0.0, 0.0]), [("foot_left", "floor")]
    notes = examine(model, "walker", x_init, contacts, bounded, None).notes
    assert any("'floor' and 'foot_left' touch by so little" in note for note in notes) == said


def test_of_too_many_contacts_the_nearest_are_kept(monkeypatch):
    model, x, none = walker(), np.zeros(4), np.zeros(2, bool)
    assert near.affordable(model, "walker", x, none, True) == (True, None)
    monkeypatch.setattr(near, "MOST_WORK", 8)
    monkeypatch.setattr(near, "EACH", 2)
    found, note = near.affordable(model, "walker", x, none, True)
    assert found == [(0, 2), (0, 3)]
    assert re.search("8 pairs .* 2 that come closest .* no other, such as", note)
    assert note in check(model)["notes"]
    with pytest.warns(DraxWarning, match="8 pairs .* 2 that come closest"):
        from_mjcf(model, horizon=0.1, running_cost=lambda data, u: u @ u)
    assert near.affordable(model, "walker", x, none, 3) == (3, None)


CROSSED = """
<mujoco model="crossed"><option timestep="0.01"/><asset>
  <mesh name="hull" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="trunk" pos="0 0 1"><freejoint/><geom size="0.05" mass="1"/>
    <body pos="0.2 0 0"><joint name="one" axis="0 1 0"/>
      <geom name="left" {shape} mass="1"/></body>
    <body pos="0.2 0.085 0"><joint name="two" axis="1 0 0"/>
      <geom name="right" {shape} euler="0 60 0" mass="1"/></body></body>
  {more}</worldbody><actuator><motor joint="one"/><motor joint="two"/></actuator></mujoco>"""


def crossed(shape='type="cylinder" size="0.05 0.2"', more=""):
    return mujoco.MjModel.from_xml_string(CROSSED.format(shape=shape, more=more))


def test_parts_of_one_robot_that_differ_may_be_left_out(monkeypatch):
    other = '<body pos="9 0 0"><freejoint/><geom name="box" type="cylinder" size="0.1 0.1"/></body>'
    model, hulls = crossed(more=other), crossed('type="mesh" mesh="hull"', other)
    seen, helps = [], 1

    def examine(model, name, x_init, contacts, *rest):
        seen.append(contacts)
        return Findings(None, ("else",), "it still differs" if len(seen) > helps else None)

    monkeypatch.setattr(near, "examine", examine)
    x, bounded = np.concatenate([model.qpos0, np.zeros(model.nv)]), np.zeros(model.njnt, bool)
    _, found = near.without_own(model, "crossed", x, bounded, True)
    contacts = seen[0]
    left, right, box = (model.geom(name).id for name in ("left", "right", "box"))
    assert contacts == sorted({*contact_pairs(model)} - {(left, right)})
    assert (left, box) in contacts  # what it handles is not a part of it
    assert "1 pairs of parts of crossed with each other, such as 'left' with" in found.notes[0]
    assert near.without_own(model, "crossed", x, bounded, True) is None
    assert near.without_own(model, "crossed", x, bounded, contacts) is None
    helps = 9
    planned, _ = near.without_own(hulls, "crossed", x, bounded, True)
    assert seen[-1] == sorted({*contact_pairs(hulls)} - {(left, right)})
    assert len(contact_points(planned)) < len(contact_points(put_model(hulls, True)))


@pytest.mark.parametrize(
    ("aside", "obstacle", "wanted"),
    [(0.0, "it differs", [False, True]), (0.0, None, [False, True]), (0.5, "it differs", [True])],
)
def test_derivatives_are_compared_once_it_is_known_which_contacts_are_planned(
    monkeypatch, aside, obstacle, wanted
):
    """Where cylinders of one robot touch (not where one is moved aside)."""
    model, asked = crossed(), []
    model.body_pos[3, 1] += aside

    def examine(*arguments, derivatives=False):
        asked.append(derivatives)
        return Findings(StepErrors(np.zeros(1), 0.25), (), obstacle)

    def without_own(model, name, x_init, bounded, contacts, derivatives):
        if not asked[0]:
            asked.append(derivatives)
            return put_model(model), Findings(StepErrors(np.zeros(1), 0.25), (), None)

    monkeypatch.setattr(report, "examine", examine)
    monkeypatch.setattr(report, "without_own", without_own)
    found = check(model)
    assert asked == wanted
    assert found["agreement"]["jacobian_error_at_x_init"] == 0.25
    assert (found["obstacle"] is None) == (asked[0] is False)


@pytest.mark.slow
def test_a_robot_whose_parts_differ_is_planned_without_them():
    model = crossed()
    found = check(model)
    assert found["obstacle"] is None
    assert "of 1 pairs of parts of crossed" in found["notes"][0]
    with pytest.warns(DraxWarning, match="of 1 pairs of parts of crossed"):
        problem = from_mjcf(model, horizon=0.1, running_cost=lambda data, u: u @ u)
    left, right = (model.geom(name).id for name in ("left", "right"))
    assert left_out(model, problem.dynamics.contacts) == {(left, right)}
    assert found["contact_points"]["kept"] == len(contact_points(problem.dynamics.model))
    with pytest.raises(DraxError, match=r"differs .* by .* that of 'left' with 'right' differ"):
        from_mjcf(
            model, horizon=0.1, running_cost=lambda data, u: u @ u, contacts=[("left", "right")]
        )
