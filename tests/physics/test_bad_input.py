"""Bad models, and bad arguments and functions of `from_mjcf`, give one clear error."""

import re
from types import SimpleNamespace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import BALL, INF, NAN, At, arm, assert_complains, cases, robot

from mjx_drax import Smoothed, from_mjcf, solve
from mjx_drax.physics.agreement import checks
from mjx_drax.physics.c_engine.states import Engine
from mjx_drax.physics.contacts.pairs import left_out
from mjx_drax.physics.report import check

pytestmark = pytest.mark.usefixtures("nothing_iterates")

GROUNDS = (
    '<body pos="0 0 1"><joint/><geom mass="1" type="hfield" hfield="h"/></body>'
    '<geom type="hfield" hfield="h"/>'
)
FIELD = '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset><worldbody>'
ROPE = (
    '<flexcomp name="rope" type="grid" count="3 1 1" dim="1" spacing=".1 .1 .1" mass="1"/>'
    "</worldbody>"
)
PLUGIN = """<mujoco model="spun"><extension><plugin plugin="mujoco.pid"><instance name="p">
  <config key="kp" value="40"/></instance></plugin></extension>
  <worldbody><body><joint name="elbow"/><geom size="0.1"/></body></worldbody>
  <actuator><plugin name="servo" joint="elbow" plugin="mujoco.pid" instance="p" actdim="0"/>
  </actuator></mujoco>"""
CROSSED = '<motor joint="elbow" ctrlrange="1 -1" ctrllimited="true"/>'
STILL = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"

# fmt: off
MODELS = [
    ("no-xml-syntax", lambda at: robot("<mujoco><worldbody></mujoco>"), "cannot compile", "XML"),
    ("unclosed", lambda at: robot("<mujoco"), "cannot compile", "<mujoco"),
    ("unknown-element", lambda at: robot(arm(more="<robot/>")), "robot", "Correct"),
    ("unknown-attribute", lambda at: robot(arm(joint='colour="1"')), "colour"),
    ("bad-number", lambda at: robot(arm(joint='damping="much"')), "damping"),
    ("too-few-numbers", lambda at: robot(arm(joint='pos="1 2"')), "pos"),
    ("no-such-joint", lambda at: robot(arm(actuator='<motor joint="knee"/>')), "knee"),
    ("repeated-name", lambda at: robot(arm('<body name="link"/>')), "repeated name", "link"),
    ("plugin", lambda at: robot(PLUGIN), "actuators of spun are plugins (servo)", "<position>"),
    ("crossed-range", lambda at: robot(arm(actuator=CROSSED)), "range"),
    ("massless", lambda at: robot("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"),
     "mass", "<inertial>"),
    ("negative-mass", lambda at: robot(arm('<body><geom size="1" mass="-1"/></body>')), "mass"),
    ("bad-size", lambda at: robot(arm('<body><geom size="-1"/></body>')), "size"),
    ("missing-mesh", lambda at: robot(arm(more='<asset><mesh file="gone.obj"/></asset>')),
     "gone.obj"),
    ("mesh-is-no-mesh",
     lambda at: robot(
         at.file("m.xml", arm(more=f'<asset><mesh file="{at.file("m.obj", "junk")}"/></asset>'))
     ),
     "m.xml", "Correct"),
    ("missing-include", lambda at: robot(arm(more='<include file="gone.xml"/>')), "gone.xml"),
    ("urdf", lambda at: robot("<robot name='r'><link name='a'/></robot>"),
     "no joints", "add a <joint>"),
    ("html", lambda at: robot("<html><body>not found</body></html>"), "html"),
    ("json", lambda at: robot('{"mujoco": {}}'), "no model file", '{"mujoco"'),
    ("empty-text", lambda at: robot(""), "no model file", "''"),
    ("empty-file", lambda at: robot(at.file("empty.xml")), "empty.xml"),
    ("binary-file", lambda at: robot(at.file("noise.xml", bytes(range(256)))), "noise.xml"),
    ("picture", lambda at: robot(at.file("a.png", b"\x89PNG\r\n\x1a\n")),
     "a.png", "cannot compile"),
    ("folder", lambda at: robot(at.folder), "no model file", "it is a folder"),
    ("missing-file", lambda at: robot(at.folder / "gone.xml"), "gone.xml", "check the path"),
    ("null-in-path", lambda at: robot("a\0b.xml"), "a\\x00b.xml"),
    ("endless-path", lambda at: robot("a" * 9999), "cannot compile", "aaa ..."),
    ("none", lambda at: from_mjcf(None, horizon=1.0), "the model is None"),
    ("number", lambda at: robot(3), "the model is 3", "MJCF"),
    ("bytes", lambda at: robot(arm().encode()), "the model is b'"),
    ("data", lambda at: robot(mujoco.MjData(mujoco.MjModel.from_xml_string(arm()))), "MjData"),
    ("no-joints", lambda at: robot(STILL), "no joints", "add"),
    ("no-actuators", lambda at: robot(arm(actuator="")), "arm has no actuators", "add"),
    ("timestep-0", lambda at: robot(arm(option='timestep="0"')), "timestep", "0.0 s", "positive"),
    ("timestep-negative", lambda at: robot(arm(option='timestep="-1"')), "timestep", "-1.0 s"),
    ("timestep-nan", lambda at: robot(arm(option='timestep="nan"')), "timestep", "nan"),
    ("gravity-nan", lambda at: robot(arm(option='gravity="0 0 nan"')), "opt.gravity", "nan"),
    ("gravity-infinite", lambda at: robot(arm(option='gravity="0 0 inf"')), "opt.gravity", "inf"),
    ("mass-nan", lambda at: robot(arm(joint='armature="nan"')), "dof_armature", "nan"),
    ("keyframe-nan", lambda at: robot(arm().replace('qpos="0.1"', 'qpos="nan"')),
     "key_qpos", "nan"),
    ("keyframe-infinite", lambda at: robot(arm().replace('qpos="0.1"', 'qpos="inf"')),
     "keyframe", "inf"),
    ("fields-collide", lambda at: robot(arm(GROUNDS).replace("<worldbody>", FIELD)),
     "MJX cannot collide", "contacts=False"),
    ("flex", lambda at: robot(arm().replace('qpos="0.1"', "").replace("</worldbody>", ROPE)),
     "flex", "remove"),
    ("body-transmission", lambda at: robot(arm(actuator='<adhesion body="link" ctrlrange="0 1"/>')),
     "mjTRN_BODY", "drive joints"),
]
# fmt: on

# fmt: off
ARGUMENTS = [
    ("horizon-0", lambda at: robot(horizon=0), "horizon is 0"),
    ("horizon-negative", lambda at: robot(horizon=-1), "horizon is -1", "positive"),
    ("horizon-true", lambda at: robot(horizon=True), "horizon is True"),
    ("horizon-nan", lambda at: robot(horizon=NAN), "horizon is nan"),
    ("dt-nan", lambda at: robot(dt=NAN), "dt is nan"),
    ("dt-text", lambda at: robot(dt="fast"), "dt is 'fast'"),
    ("dt-no-multiple", lambda at: robot(dt=0.015), "dt is 0.015 s", "timestep", "give 0.02"),
    ("dt-below-timestep", lambda at: robot(dt=0.001), "0.001", "give 0.01"),
    ("name-empty", lambda at: robot(name=""), "name is ''"),
    ("x_init-infinite", lambda at: robot(x_init=[INF, 0.0]), "x_init is [inf"),
    ("x_init-short", lambda at: robot(x_init=[0.0]), "x_init has 1 numbers", "Give 2"),
    ("x_init-quaternion", lambda at: at.ball.with_x_init(np.zeros(2)), "x_init", "give 9"),
    ("x_init-no-rotation", lambda at: robot(arm(BALL), x_init=np.zeros(9)), "quaternion", "scale"),
    ("x_bounds-rotation", lambda at: robot(arm(BALL), x_bounds=(-1, 1)), "x_bounds", "quaternions"),
    ("u_bounds-crossed", lambda at: robot(u_bounds=(2.0, 3.0)), "bounds of u cross", "lower 2.0"),
    ("contacts", lambda at: robot(contacts="some"), "contacts is 'some'", "True, False or a"),
    ("derivatives-class", lambda at: robot(derivatives=Smoothed), "derivatives", "Smoothed()"),
    ("derivatives-text", lambda at: robot(derivatives="exact"), "derivatives is 'exact'"),
    ("check-missing", lambda at: check(at.folder / "gone.xml"), "gone.xml", "check"),
]
# fmt: on

# fmt: off
FUNCTIONS = [
    ("model-vector", lambda at: robot(running_cost=lambda data, u: data.qpos),
     "running_cost", "(1,)"),
    ("model-typo", lambda at: robot(running_cost=lambda data, u: data.qpso[0]), "qpso"),
    ("model-index-by-name", lambda at: robot(running_cost=lambda data, u: data.qpos["elbow"]),
     "running_cost failed"),
    ("model-branch", lambda at: robot(terminal_cost=lambda data: 0.0 if data.qpos[0] else 1.0),
     "jnp.where"),
    ("model-data-itself", lambda at: robot(terminal_cost=lambda data: data),
     "terminal_cost returned a"),
    ("model-method", lambda at: robot(terminal_cost=lambda data: data.light("link").xpos[0]),
     "terminal_cost failed"),
    ("model-name", lambda at: robot(terminal_cost=lambda data: data.body("lnk").xpos[0]),
     "no body 'lnk'", "'link'"),
    ("model-log", lambda at: solve(robot(terminal_cost=lambda data: jnp.log(data.qpos[0] - 9)), 1),
     "value of terminal_cost", "last initial state"),
    ("model-sqrt", lambda at: solve(robot(running_cost=lambda data, u: jnp.sqrt(data.qvel[0])), 1),
     "derivative of running_cost", "x_init"),
    ("model-rounds",
     lambda at: solve(robot(running_cost=lambda data, u: jnp.floor(data.qpos[0])), 1),
     "zero everywhere"),
    ("equality-truth", lambda at: robot(equality=lambda data, u: data.qpos == 0),
     "equality", "bool"),
    ("terminal-inequality-class", lambda at: robot(terminal_inequality=list),
     "terminal_inequality"),
    ("goal-none", lambda at: robot(goal=lambda data: None), "goal returned", "truth value"),
    ("goal-typo", lambda at: robot(goal=lambda data: data.site("top").xpos[2] > 0),
     "goal failed", "top"),
]
# fmt: on


@pytest.mark.parametrize(
    ("call", "words"), cases(model=MODELS, argument=ARGUMENTS, function=FUNCTIONS)
)
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)


def test_a_cause_is_looked_for_with_pairs_of_contacts_that_are_named(monkeypatch):
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom name='floor' type='plane' size='1 1 1'/>"
        "<body pos='0 0 1'><freejoint/><geom name='ball' size='0.1'/></body></worldbody></mujoco>"
    )

    def compare(changed, at, contacts, bounded):
        left_out(changed, contacts)  # refuses pairs that cannot touch
        return SimpleNamespace(velocity=np.ones(1))

    monkeypatch.setattr(checks, "compare", compare)
    at = checks.Samples(np.array([[0.0, 0, 1, 1, 0, 0, 0, *np.zeros(6)]]), np.zeros((1, 0)))
    errors = checks.StepErrors(np.ones(1))
    cause = checks.causes(Engine(model), at, [("ball", "floor")], np.zeros(0), errors)
    assert cause == "the reason is not known"


@pytest.mark.parametrize(
    ("margin", "words"),
    [(0.0, "that of 'drum' with 'table' differ: .* choose contacts"), (0.01, "not at a margin")],
)
def test_a_cause_is_of_contacts_that_act(margin, words, monkeypatch):
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1'/></asset><worldbody>
        <geom name='never' type='ellipsoid' size='.1 .1 .2' pos='0 0 -9'/>
        <geom name='table' type='box' size='1 1 .1' margin='{margin}'/>
        <body pos='0 0 {0.105 if margin else 0.19}'><freejoint/>
          <geom name='drum' type='{"mesh' mesh='m" if margin else "cylinder' size='.1 .1"}'/></body>
        </worldbody></mujoco>"""
    )

    def compare(changed, at, contacts, bounded):
        gone = changed.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
        if margin:
            gone = not changed.geom_margin.any()
        return SimpleNamespace(velocity=np.ones(1) * (not gone))

    monkeypatch.setattr(checks, "compare", compare)
    x = np.array([[*model.qpos0, *np.zeros(6)]])
    errors = checks.StepErrors(np.ones(1))
    cause = checks.causes(
        Engine(model), checks.Samples(x, np.zeros((1, 0))), True, np.zeros(0), errors
    )
    assert re.search(words, cause), cause
    assert "never" not in cause
