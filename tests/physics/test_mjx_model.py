"""Models that MJX does not support: made supported, refused, or named among `differences`."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import collision_driver

from mjx_drax import DraxError, from_mjcf
from mjx_drax.base.errors import DraxWarning
from mjx_drax.modelling.terms import Terms
from mjx_drax.physics.actuators import driven
from mjx_drax.physics.agreement.checks import Samples, compare, examine
from mjx_drax.physics.agreement.differences import differences, set_aside
from mjx_drax.physics.c_engine.states import Engine, integrate
from mjx_drax.physics.c_engine.stepper import Stepper
from mjx_drax.physics.contacts.collision import extended
from mjx_drax.physics.contacts.pairs import contact_pairs
from mjx_drax.physics.mjx_model import (
    MOST_CONTACTS,
    bounded_joints,
    constraint_rows,
    contact_points,
    has_constraints,
    kept_contacts,
    put_model,
)
from mjx_drax.physics.observed import Observed
from mjx_drax.physics.report import check
from mjx_drax.physics.step import forward, step

CHAIN = """
<mujoco model="chain">
  <option timestep="0.01" {option}><flag {flag}/></option>
  {before}
  <worldbody>
    <geom name="floor" type="{floor}" size="1 1 0.1" {floors}/>
    <body name="upper" pos="0 0 1">
      <joint name="one" axis="0 1 0" stiffness="3" damping="0.3" {joint}/>
      <geom name="link" type="{link}" size="0.05 0.3 0.05" mass="1" pos="0 0 -0.3" {links}/>
      <site name="tip" pos="0 0 -0.6"/>
      <body name="lower" pos="0 0 -0.6">
        <joint name="two" axis="0 1 0" armature="0.01"/>
        <geom name="ball" size="0.08" mass="0.5" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="strong" joint="one" gear="5" {motor}/>
    <motor name="weak" joint="two" group="1"/>
    {actuator}
  </actuator>
  {more}
</mujoco>"""
FREE = ["option", "before", "floors", "joint", "links", "motor", "actuator", "more"]
NOTHING = dict.fromkeys(FREE, "") | {"flag": 'contact="enable"'}
NOTHING |= {"floor": "plane", "link": "capsule"}


def chain(**parts):
    return mujoco.MjModel.from_xml_string(CHAIN.format(**(NOTHING | parts)))


def rigid(**parts):
    """Without contacts, whose steps compile faster."""
    return chain(**({"flag": 'contact="disable"'} | parts))


STATES = Samples(
    np.array([[0.3, -0.2, 1.0, -0.5], [0.0, 0.0, 0.0, 0.0]]), np.array([[0.5, 1.0]] * 2)
)


@pytest.mark.parametrize(
    "parts",
    [
        {
            "option": 'solver="PGS" actuatorgroupdisable="1"',
            "flag": 'contact="disable" energy="enable" fwdinv="enable" spring="disable"',
        },
        {"option": 'solver="CG"', "flag": 'contact="disable" damper="disable"'},
        {"flag": 'contact="disable" spring="disable" damper="disable"', "option": 'wind="9 0 0"'},
    ],
    ids=["PGS, energy, groups, springs", "CG, dampers", "springs and dampers, wind in no air"],
)
def test_what_is_made_supported_steps_like_the_c_engine(parts):
    model = rigid(**parts)
    assert differences(model) == []
    np.testing.assert_allclose(compare(model, STATES).velocity, 0, atol=1e-10)


@pytest.mark.parametrize("integrator", ["implicit", "discrete"])
def test_implicit_becomes_implicitfast_and_is_named(integrator):
    model = rigid(option=f'integrator="{integrator}"')
    assert put_model(model).opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert any(f'"{integrator}" is planned' in each.sentence for each in differences(model))


def test_the_model_is_left_as_it_was():
    model = rigid(option='solver="PGS" actuatorgroupdisable="1"', flag='spring="disable"')
    before = (model.opt.solver, model.opt.disableflags, model.jnt_stiffness[0])
    put_model(model, contacts=False, bounded=np.ones(2, bool))
    assert (model.opt.solver, model.opt.disableflags, model.jnt_stiffness[0]) == before
    assert np.all(model.actuator_gainprm[:, 0] == 1)


def test_limits_that_a_flag_disables_are_no_bounds():
    joint = 'range="-1 1" limited="true"'
    bounded = [
        bounded_joints(rigid(joint=joint, flag=flag), np.zeros(4)).tolist()
        for flag in ('contact="enable"', 'limit="disable"', 'constraint="disable"')
    ]
    assert bounded == [[True, False], [False, False], [False, False]]
    report = check(rigid(joint=joint, flag='limit="disable"'))
    assert [each["range_is"] for each in report["joints"]] == ["none", "none"]


def test_limits_that_are_bounds_leave_the_dynamics():
    model = rigid(joint='range="-1 1" limited="true"')
    assert has_constraints(put_model(model))
    assert not has_constraints(put_model(model, bounded=np.array([True, False])))


@pytest.mark.slow
def test_at_a_limit_derivatives_are_those_to_one_side():
    model = rigid(joint='range="-1 0" limited="true"')
    at_limit = Samples(np.zeros((1, 4)), np.zeros((1, 2)))
    ahead, behind = Engine(model).slopes(at_limit.x[0], at_limit.u[0])
    assert np.abs(ahead - behind).max() > 0.1
    assert compare(model, at_limit, derivatives=True).jacobian < 1e-4


@pytest.mark.slow
def test_tendon_springs_have_stiffness_at_rest():
    rope = '<tendon><spatial stiffness="2"><site site="tip"/><site site="wall"/></spatial></tendon>'
    model = rigid(before='<worldbody><site name="wall" pos="1 0 0"/></worldbody>', more=rope)
    rest = Samples(np.zeros((1, 4)), np.zeros((1, 2)))
    found = compare(model, rest, derivatives=True)
    assert found.velocity[0] < 1e-12
    assert found.jacobian < 1e-7


MUSCLE = 'dyntype="user" joint="one"'
TETRAHEDRON = "0 0 0 0.2 0 0 0 0.2 0 0 0 0.2"
GROUND = '<asset><hfield name="ground" nrow="2" ncol="2" size="1 1 0.1 0.1"/></asset>'
FIELDS = {"before": GROUND, "floor": "hfield", "floors": 'hfield="ground"'}
MOVES = '<worldbody><body pos="0 0 9"><joint/><geom mass="1" type="hfield" hfield="ground"/></body>'
APART = {"links": 'contype="0" conaffinity="0"'}


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (
            FIELDS | {"more": f"{MOVES}</worldbody>"},
            r"cannot collide geoms 'floor' and 'geom 3 of body 3' \(hfield with hfield\): make "
            r"them .*contacts=\[...\].*contacts=False",
        ),
        (
            {"option": 'integrator="implicit" density="1"', **APART},
            'set <option integrator="Euler"',
        ),
        (
            {"actuator": '<adhesion body="upper" ctrlrange="0 1"/>'},
            "does not support mjTRN_BODY: drive joints, tendons or sites",
        ),
        ({"actuator": f"<general {MUSCLE}/>"}, "does not support.*use motors"),
        ({"flag": 'override="enable"'}, "does not support.*clear this flag"),
        (
            {
                "more": '<deformable/><worldbody><body name="c" pos="0 0 3"><flexcomp name="f" '
                'type="grid" count="2 2 1" spacing="0.1 0.1 0.1" dim="2"/></body></worldbody>'
            },
            "flex",
        ),
    ],
    ids=["collision", "fluid", "transmission", "dynamics", "flag", "flex"],
)
def test_what_is_refused_says_why_and_what_to_do(parts, words):
    with pytest.raises(DraxError, match=words):
        put_model(chain(**parts))


def test_contacts_that_mjx_cannot_make_can_be_left_out():
    model = chain(**FIELDS, more=f"{MOVES}</worldbody>")
    assert not has_constraints(put_model(model, contacts=False))
    assert has_constraints(put_model(model, [("floor", "ball")]))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    assert not has_constraints(put_model(model))


def test_frictionless_contacts_have_elliptic_cones_too():
    model = chain(option='cone="elliptic"', floors='condim="1" pos="0 0 0.13"')
    model.geom_condim[model.geom("ball").id] = 1
    at = Samples(np.array([[0.0, 0.0, 0.5, 1.0]]), np.zeros((1, 2)))
    assert Engine(model).active_contacts(at.x[0]) > 0
    assert compare(model, at).velocity[0] < 1e-5


SLICK = """
<mujoco><option timestep="0.005" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction=".2 .005 .0001"/>
  <body pos="0 0 .0995">
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <geom name="block" type="box" size=".1 .1 .1" mass="1" condim="1" friction="1.5 .005 .0001"/>
  </body>
  <body pos="1 0 .1"><joint name="push" type="slide" axis="1 0 0" damping=".5"/>
    <geom type="sphere" size=".05" mass="1" condim="1"/></body>
</worldbody><actuator><motor joint="push"/></actuator><contact>{pair}</contact></mujoco>"""


@pytest.mark.parametrize("pair", ["", '<pair geom1="floor" geom2="block" condim="1"/>'])
def test_geoms_that_slip_on_one_another_keep_their_friction_with_others(pair):
    model = mujoco.MjModel.from_xml_string(SLICK.format(pair=pair))
    at = Samples(np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), np.zeros((1, 1)))
    slower = at.x[0, 3] - Engine(model).step(at.x[0], at.u[0])[3]
    assert slower < 1e-6 if pair else slower > 0.3
    assert compare(model, at).velocity[0] < 1e-6


def test_meshes_on_planes_have_margins():
    cube = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name="m" vertex="{cube}"/></asset><worldbody>
        <geom type="plane" size="1 1 1" margin="0.02"/><body><joint type="slide" axis="0 0 1"/>
        <geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
    )
    at = Samples(np.array([[0.11, -0.5], [0.09, 0.0], [0.13, 0.0]]), np.zeros((3, 0)))
    assert compare(model, at).velocity.max() < 1e-9


def test_a_plan_keeps_the_nearest_contacts_of_a_model_that_has_many():
    """Balls in a row: 666 pairs of balls, which have friction, and one of a ball with the floor."""
    balls = "".join(
        f'<body pos="{i} 0 0"><joint axis="0 1 0"/><geom size="0.1" pos="0.1 0 0"/></body>'
        for i in range(37)
    )
    custom = '<custom><numeric name="pair" data="1 2"/></custom>'
    floor = '<contact><pair geom1="floor" geom2="ball" condim="1"/></contact>'
    model = chain(before=f"{custom}<worldbody>{balls}</worldbody>", more=floor)
    found = [put_model(model, number) for number in (10_000, True, 2, 1)]
    few = [np.bincount(contact_points(t))[[1, 3]].tolist() for t in found]
    assert few == [[1, few[0][1]], [1, MOST_CONTACTS], [1, 2], [1, 1]]
    assert few[0][1] > 666
    assert [kept_contacts(t) for t in found] == [None, MOST_CONTACTS, 2, 1]
    assert [constraint_rows(t) for t in found[1:]] == [1 + 4 * n for n in (MOST_CONTACTS, 2, 1)]
    assert not has_constraints(put_model(model, 0))


def test_a_model_with_few_contacts_keeps_them_as_they_were():
    model = chain()
    same = put_model(model)
    assert kept_contacts(same) is None
    assert (same.nnumeric, same.names) == (model.nnumeric, model.names)
    assert jax.tree.structure(same) == jax.tree.structure(put_model(model, 3))
    assert jax.tree.structure(same) != jax.tree.structure(put_model(model, 2))


@pytest.mark.parametrize("number", [-1, 2.5, "all", None])
def test_numbers_of_contacts_are_whole(number):
    with pytest.raises(DraxError, match=r"contacts is .*give True, False or a whole number"):
        put_model(chain(), number)


TOUCH = "<sensor><{}/></sensor>"


def test_touch_sensors_feel_nothing_where_contacts_are_left_out():
    model = chain(more=TOUCH.format('touch site="tip"'))
    assert compare(model, STATES, contacts=False).velocity.max() < 1e-10


@pytest.mark.parametrize(
    "parts",
    [
        {"more": TOUCH.format('contact geom1="link" num="1" data="found force"')},
        {"more": TOUCH.format('rangefinder site="tip"')},
        {"option": 'cone="elliptic"', "joint": 'range="-20 20" limited="true"'},
    ],
    ids=["contact-sensor", "rangefinder", "elliptic"],
)
def test_what_mjx_fails_in_without_contacts_or_materials_is_stepped(parts):
    on_device = put_model(rigid(**parts))
    end = jax.eval_shape(partial(step, on_device), jnp.zeros(4), jnp.zeros(2))
    assert end.shape == (4,)


@pytest.mark.parametrize(
    "contact",
    [
        'body1="upper"',
        'site="tip"',
        'geom1="link" reduce="netforce" data="force"',
        'geom1="link" reduce="none"',
    ],
)
def test_contact_sensors_that_mjx_refuses_are_left_out(contact):
    model = chain(more=TOUCH.format(f'contact name="odd" {contact}'))
    assert set_aside(model) == ["sensor 'odd' is unknown to MJX: a cost cannot read it"]
    assert put_model(model).nsensor == 1


def test_a_touch_sensor_in_a_cylinder_is_left_out():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .1"><freejoint/>
        <geom size=".1"/><site name="tip" type="cylinder" size=".1 .1"/></body></worldbody>
        <sensor><touch name="odd" site="tip"/></sensor></mujoco>"""
    )
    assert set_aside(model) == ["sensor 'odd' is unknown to MJX: a cost cannot read it"]
    on_device = put_model(model)
    assert jax.eval_shape(partial(forward, on_device), jnp.zeros(13), jnp.zeros(0)) is not None


@pytest.mark.parametrize("late", ['delay="0.05" nsample="8"', 'interval="0.05"'])
def test_a_sensor_that_reads_late_is_left_out(late):
    model = rigid(more=f'<sensor><jointpos name="odd" joint="one" {late}/></sensor>')
    assert set_aside(model) == ["sensor 'odd' is unknown to MJX: a cost cannot read it"]


def test_a_mocap_body_that_a_keyframe_moves_is_told():
    more = '<worldbody><body name="hand" mocap="true"{}/></worldbody>'
    more += '<keyframe><key qpos="0 0" mpos="1 0 0"/></keyframe>'
    (sentence,) = set_aside(rigid(more=more.format("")))
    assert "'hand' stays where the file has it, and not where the first keyframe" in sentence
    assert set_aside(rigid(more=more.format(' pos="1 0 0"'))) == []


def test_a_cost_that_reads_an_unknown_sensor_is_refused():
    model = rigid(
        more='<sensor><user name="odd" dim="1"/><jointpos name="fine" joint="one"/></sensor>'
    )
    planned = put_model(model)
    at = Observed.of(planned, *forward(planned, jnp.zeros(4), jnp.zeros(2)))
    assert at.sensor("fine").data.shape == (1,)
    with pytest.raises(DraxError, match="'odd' is of a kind that MJX does not compute"):
        _ = at.sensor("odd").data
    with pytest.raises(DraxError, match="'odd' is of a kind that MJX does not compute"):
        Terms(model).sensor("odd")
    assert np.isnan(at.sensordata).tolist() == [True, False]


HELD = """
<mujoco><option timestep="0.005" {option}/><worldbody>
  <body name="a" pos="0 0 1"><joint axis="0 1 0" damping=".1"/>
    <geom size=".05" pos=".2 0 0" mass="1"/>
    <body name="b" pos=".4 0 0"><joint type="ball"/><geom size=".05" pos=".2 .05 0" mass=".7"/>
      <site name="b" pos=".4 0 0" euler="20 0 10"/></body></body>
  <body name="c" pos=".8 0 1"><freejoint/>
    <geom type="box" size=".04 .06 .08" pos="0 0 -.2" mass=".3"/>
    <site name="c" pos=".1 0 0"/></body>
  <body name="d" pos=".8 .5 1"><joint type="slide" axis="1 1 0"/><joint axis="0 0 1"/>
    <geom size=".04" pos="0 0 -.2" mass=".3"/></body>
  <site name="fixed" pos=".8 0 1"/></worldbody><equality>{equalities}</equality></mujoco>"""
DAMPED = """
<mujoco><worldbody>
  <body name="hand" pos=".5 0 .6" mocap="true"/>
  <body><joint name="base" type="slide" axis="0 0 1" damping="1e11"/><geom size=".1" mass="50"/>
    <body><joint name="lift" type="slide" axis="0 0 1" range=".03 .3" limited="true"/>
      <geom size=".1" mass="20"/><body><joint name="arm" axis="0 1 0"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .5 0 0"/><body name="tip" pos=".5 0 0">
          <joint axis="0 1 0"/><geom size=".02"/></body></body></body></body>
</worldbody><equality><weld body1="hand" body2="tip"/></equality>
<actuator><motor joint="arm"/></actuator></mujoco>"""


def test_a_base_that_damping_holds_is_held_by_inertia_in_both_engines():
    """Until its load has settled the C engine lets it fall, in the sum of forces of constraints."""
    model = mujoco.MjModel.from_xml_string(DAMPED)
    x, bounded = np.zeros(2 * model.nv), np.zeros(model.njnt, bool)
    found = examine(model, "robot", x, True, bounded, None)
    assert found.errors.velocity.max() < 1e-9
    assert any("damping holds base" in note for note in found.notes)
    assert model.dof_damping[0] == 1e11


EQUALITIES = """
  <weld body1="d" body2="c" torquescale=".3"/><connect body1="b" body2="c" anchor=".4 0 0"/>
  <connect site1="b" site2="fixed" active="{active}"/><weld site1="b" site2="c"/>
  <weld body1="c" torquescale="2"/>"""


def _compared(equalities, option="", derivatives=False):
    """Errors of steps from states in which the constraints are not met and bodies turn."""
    model = mujoco.MjModel.from_xml_string(HELD.format(option=option, equalities=equalities))
    rng, rest = np.random.default_rng(0), np.concatenate([model.qpos0, np.zeros(model.nv)])
    states = [integrate(model, rest, 0.2 * rng.normal(size=2 * model.nv)) for _ in range(6)]
    assert differences(model) == []
    at = Samples(np.stack(states), np.zeros((6, 0)))
    return compare(model, at, derivatives=derivatives)


def test_connect_and_weld_pull_bodies_that_turn_as_in_the_c_engine():
    weld = '<weld body1="d" body2="c" torquescale=".3"/>'
    errors = _compared(weld + '<connect site1="b" site2="fixed"/>')
    assert errors.velocity.max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "active"),
    [("", "true"), ('integrator="implicitfast"', "false"), ('integrator="RK4"', "true")],
)
def test_several_connects_and_welds_pull_as_in_the_c_engine(option, active):
    errors = _compared(EQUALITIES.format(active=active), option, derivatives=True)
    assert errors.velocity.max() < 1e-9
    assert errors.jacobian < 1e-5


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"option": 'integrator="implicit"'}, 'choose that, or "Euler"'),
        ({"option": 'noslip_iterations="3"'}, "noslip_iterations"),
        ({"joint": 'springref="0"', "stiff": True}, "polynomial stiffness"),
        ({"damp": True}, "polynomial damping"),
        ({"actuator": '<general joint="two" dyntype="filter" actearly="true"/>'}, "actearly"),
        ({"motor": 'delay="0.02" nsample="4"'}, "delays"),
        ({"motor": 'armature="0.1"'}, "own damping and armature"),
        ({"joint": 'range="-5 5" margin="0.1"'}, "its margin of both ends of its range"),
        ({"option": 'density="1"', "links": 'fluidshape="ellipsoid"'}, "ellipsoid fluid"),
        ({"floor": "cylinder"}, "contacts like that of 'link' with 'floor'"),
        (
            {
                "before": f'<asset><mesh name="m" vertex="{TETRAHEDRON}"/></asset>',
                "more": '<worldbody><body pos="3 0 3"><joint/><geom name="tip" type="mesh" '
                'mesh="m" contype="2"/></body></worldbody>',
            },
            "contacts like that of 'floor' with 'tip'",
        ),
        (
            {
                "before": '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>',
                "more": '<worldbody><geom type="hfield" hfield="h" pos="0 0 -5"/></worldbody>',
            },
            "contacts like that of 'geom 1 of body world' with 'link'",
        ),
    ],
)
def test_differences_have_a_sentence_each(parts, words):
    parts = dict(parts)
    stiff, damp = parts.pop("stiff", False), parts.pop("damp", False)
    model = chain(**parts)
    if stiff:
        model.jnt_stiffnesspoly[0] = 0.1
    if damp:
        model.dof_dampingpoly[0] = 0.1
    found = differences(model)
    assert len(found) == 1, found
    assert words in found[0].sentence
    found[0].without(model)
    gone = "contacts" in words  # these stay, switched off
    assert gone or not differences(model)


def test_contacts_that_are_left_out_do_not_differ():
    assert differences(chain(floor="cylinder"), contacts=False) == []


def test_a_plain_model_has_no_differences():
    assert differences(chain()) == []


def names(model):
    return {frozenset(model.geom(g).name for g in pair) for pair in contact_pairs(model)}


@pytest.mark.slow
def test_states_of_actuators_that_are_off_stay():
    filtered = '<general joint="two" dyntype="filter" dynprm="0.1" group="1"/>'
    model = rigid(option='actuatorgroupdisable="1"', actuator=filtered)
    x, u = np.array([0.3, -0.2, 1.0, -0.5, 0.4]), np.array([0.5, 1.0, 2.0])
    with jax.enable_x64(True):
        reached = jax.jit(step)(put_model(model), jnp.asarray(x), jnp.asarray(u))
    np.testing.assert_allclose(reached, Engine(model).step(x, u), atol=1e-10)
    assert float(reached[-1]) == 0.4


def test_mocap_bodies_touch_nothing_of_the_world():
    marker = (
        '<worldbody><body name="m" mocap="true"><geom name="mark" size="1"/></body></worldbody>'
    )
    found = names(chain(more=marker))
    assert frozenset({"mark", "floor"}) not in found
    assert frozenset({"mark", "link"}) in found
    forced = marker + '<contact><pair geom1="floor" geom2="mark"/></contact>'
    assert frozenset({"mark", "floor"}) in names(chain(more=forced))
    with extended():
        here = {frozenset(pair[:2]) for pair in collision_driver.geom_pairs(chain(more=marker))}
    assert here == {frozenset(pair) for pair in contact_pairs(chain(more=marker))}


def test_contact_pairs_are_those_of_mujoco():
    assert names(chain()) == {frozenset({"floor", "link"}), frozenset({"floor", "ball"})}
    assert names(rigid()) == set()
    assert names(chain(links='contype="0" conaffinity="0"')) == {frozenset({"floor", "ball"})}
    excluded = '<contact><exclude body1="world" body2="lower"/></contact>'
    assert names(chain(more=excluded)) == {frozenset({"floor", "link"})}
    pair = '<contact><pair geom1="link" geom2="ball"/></contact>'
    assert frozenset({"link", "ball"}) in names(chain(more=pair))
    parents = chain(flag='filterparent="disable"')
    assert frozenset({"link", "ball"}) in names(parents)


def test_joints_that_are_driven():
    assert driven(rigid()).tolist() == [True, True]
    assert driven(rigid(motor='group="0"', joint='group="0"')).tolist() == [True, True]
    off = 'actuatorgroupdisable="1"'  # as "weak" has
    assert driven(rigid(option=off)).tolist() == [True, False]
    assert driven(rigid(option=off, motor='group="-1"')).tolist() == [True, False]


def test_models_that_step_too_differently_are_refused_or_warned_of():
    def build(**parts):
        return from_mjcf(rigid(**parts), horizon=0.1, running_residual=lambda data, u: u)

    with pytest.raises(DraxError, match=r"differs from MuJoCo's C engine by .* armature .*joints"):
        build(motor='armature="0.5"')
    with pytest.warns(DraxWarning, match="own damping and armature"):
        build(motor='armature="0.0001"')


def test_causes_are_named_if_the_error_comes_and_goes_with_them():
    """Delays do nothing in a step from rest controls; the armature makes the error."""
    model = rigid(motor='armature="0.5"', option='noslip_iterations="3"')
    assert len(differences(model)) == 2
    found = examine(model, "chain", STATES.x[0], True, np.zeros(2, bool), None)
    assert "armature" in found.obstacle
    assert "noslip" not in found.obstacle


CUSTOM = (
    '<custom><numeric name="max_geom_pairs" data="1"/>'
    '<numeric name="max_contact_points" data="1"/></custom>'
)


def test_numbers_of_the_model_for_mjx_are_set_aside_and_said():
    plain, custom = chain(), chain(before=CUSTOM)
    counts = [contact_points(put_model(model)).tolist() for model in (plain, custom)]
    assert counts[0] == counts[1]
    assert len(counts[1]) > 1
    assert ["max_geom_pairs and max_contact_points" in text for text in set_aside(custom)] == [True]
    assert set_aside(plain) == []


PILE = """
<mujoco model="pile">
  <option timestep="0.005" iterations="1" ls_iterations="1"/>
  <worldbody><geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.099"><freejoint/><geom size="0.1" mass="1"/></body>
    <body pos="0.02 0 0.295"><freejoint/><geom size="0.1" mass="1"/><site name="top"/></body>
  </worldbody>
  <actuator><general site="top" gear="1 0 0 0 0 0"/></actuator>
</mujoco>"""


def test_contact_solvers_converge_and_options_that_stop_them_are_told():
    model = mujoco.MjModel.from_xml_string(PILE)
    x = np.concatenate([model.qpos0, np.full(model.nv, -0.3)])
    with Stepper(model, 1, x[None]) as stepper:
        replayed = stepper(np.ones((1, 1)))[0][0]
    exact = Engine(model).step(x, np.ones(1))
    assert np.abs(Engine(model, as_given=True).step(x, np.ones(1)) - exact).max() > 0.01
    np.testing.assert_allclose(replayed, exact, rtol=0, atol=1e-12)
    found = examine(model, "pile", x, True, np.zeros(2, bool), None)
    assert found.obstacle is None
    assert found.errors.velocity.max() < 1e-9
    assert ["stop early (iterations=1, ls_iterations=1" in note for note in found.notes] == [True]


@pytest.mark.parametrize(
    ("stiffness", "fix"),
    [
        (1e4, r"make its timestep of 0\.02 s ten times smaller\."),
        (1e9, "make stiff springs and servos softer"),  # a tenth diverges too
    ],
)
def test_a_timestep_at_which_the_c_engine_diverges_is_refused(stiffness, fix):
    stiff = rigid(joint='springref="1"')
    stiff.jnt_stiffness[0], stiff.opt.timestep = stiffness, 0.02
    with pytest.raises(DraxError, match=f"diverges in MuJoCo's C engine .*: {fix}"):
        examine(stiff, "chain", STATES.x[0], True, np.zeros(2, bool), None)


def test_a_base_that_enormous_damping_holds_is_held_by_inertia():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.002"/><worldbody><body>
        <joint type="slide" axis="1 0 0" damping="1e11"/><geom size="0.3" mass="100"/>
        <body pos="0 0 0.5"><joint name="elbow" axis="0 1 0" damping="2"/>
          <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.04" mass="2"/></body>
        </body></worldbody><actuator><motor joint="elbow"/></actuator></mujoco>"""
    )
    planned = put_model(model)
    np.testing.assert_allclose(planned.dof_damping, [0.0, 2.0])
    np.testing.assert_allclose(planned.dof_armature, [0.002 * 1e11, 0.0])
    states = np.array([[0.0, 0.5, 0.0, 0.3], [0.0, -1.0, 0.0, -2.0]])
    assert compare(model, Samples(states, np.array([[1.0], [-1.0]]))).velocity.max() < 1e-6
