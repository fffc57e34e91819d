"""Bad names, targets and weights of terms, and bad guesses, give one clear error."""

import numpy as np
import pytest
from builders import BALL, NAN, At, arm, assert_complains, cases, robot

from mjx_drax import Terms, Trajectory, guesses

POST = '<geom name="post" size="1"/>'

# fmt: off
TERMS = [
    ("terms-model", lambda at: Terms("gone.xml"), "gone.xml"),
    ("terms-problem", lambda at: Terms(at.robot), "the model is"),
    ("posture-joint", lambda at: at.terms.posture({"knee": 0.0}), "no joint 'knee'", "'elbow'"),
    ("posture-keyframe", lambda at: at.terms.posture("hoem"), "no keyframe 'hoem'", "'home'"),
    ("posture-length", lambda at: at.terms.posture([0.0, 0.0]),
     "posture is [0.0, 0.0]", "1 number"),
    ("posture-nan", lambda at: at.terms.posture([NAN]), "posture is [nan]", "finite"),
    ("posture-empty", lambda at: at.terms.posture({}), "no joint is named"),
    ("posture-text-value", lambda at: at.terms.posture({"elbow": "up"}), "'elbow' is 'up'"),
    ("posture-rotation", lambda at: Terms(arm(BALL)).posture({"hip": [0, 0, 0, 0]}),
     "must not be zero"),
    ("velocity-joint", lambda at: at.terms.velocity("wrist"), "no joint 'wrist'"),
    ("velocity-number", lambda at: at.terms.velocity(0), "no joint 0"),
    ("velocity-target", lambda at: at.terms.velocity(target=[1, 2, 3]),
     "target of velocity", "[1, 2, 3]"),
    ("control-actuator", lambda at: at.terms.control("motor"), "no actuator 'motor'", "'torque'"),
    ("control-weight", lambda at: at.terms.control(weight=-1.0), "weight of control is -1.0"),
    ("control-weight-nan", lambda at: at.terms.control(weight=NAN), "weight of control is nan"),
    ("control-at-end", lambda at: robot(terminal_residual=at.terms.control()),
     "no control at the end"),
    ("sensor", lambda at: at.terms.sensor("gyro"), "no sensor 'gyro'", "'angle'"),
    ("site", lambda at: at.terms.site("top", [0, 0, 0]), "no site 'top'", "'tip'"),
    ("site-none", lambda at: at.terms.site(None, [0, 0, 0]), "no site None"),
    ("site-target", lambda at: at.terms.site("tip"), "site 'tip' has no target", "give"),
    ("site-plane", lambda at: at.terms.site("tip", [0, 0]), "position of site 'tip' is [0, 0]"),
    ("site-matrix", lambda at: at.terms.site("tip", orientation=2 * np.eye(3)), "rotation matrix"),
    ("site-weight", lambda at: at.terms.site("tip", [0, 0, 0], weight=[1, 2]),
     "weight of site 'tip'"),
    ("body", lambda at: at.terms.body("lnik", [0, 0, 0]), "no body 'lnik'", "'link'"),
    ("upright-axis", lambda at: at.terms.upright("link", axis=[0, 0, 0]), "axis", "not be zero"),
    ("upright-body", lambda at: at.terms.upright("torso"), "no body 'torso'"),
    ("com-text", lambda at: at.terms.centre_of_mass("here"), "centre_of_mass is 'here'"),
    ("clearance-geom", lambda at: at.terms.clearance("stick", "tray"), "no geom 'stick'", "'rod'"),
    ("clearance-itself", lambda at: at.terms.clearance("rod", "rod"), "'rod' with itself", "give"),
    ("clearance-kind", lambda at: at.terms.clearance("tray", "tray2"), "no geom 'tray2'"),
    ("clearance-margin", lambda at: Terms(arm(POST)).clearance("rod", "post", margin=NAN),
     "margin of clearance is nan"),
    ("clearance-none", lambda at: at.terms.clearance([], "rod"), "no geom is named"),
    ("still-none", lambda at: guesses.waypoints(at.point, []), "point has no MuJoCo model"),
    ("waypoints-time", lambda at: guesses.waypoints(at.robot, [(-1.0, [0.0])]), "-1.0", "waypoint"),
    ("waypoints-time-text", lambda at: guesses.waypoints(at.robot, [("home", 1.0)]),
     "waypoint is 'home'"),
    ("waypoints-twice", lambda at: guesses.waypoints(at.robot, [(1, [0.0]), (1, [0.1])]),
     "two waypoints", "give"),
    ("waypoints-flat", lambda at: guesses.waypoints(at.robot, [0.0, 1.0]), "poses are [0.0, 1.0]"),
    ("waypoints-keyframe", lambda at: guesses.waypoints(at.robot, [(1.0, "up")]),
     "no keyframe 'up'", "'home'"),
    ("waypoints-nan", lambda at: guesses.waypoints(at.robot, [(1.0, [NAN])]), "pose is [nan]"),
    ("waypoints-length", lambda at: guesses.waypoints(at.robot, [(1.0, [0, 0, 0])]),
     "[0, 0, 0]", "1 finite"),
    ("keyframes-name", lambda at: guesses.keyframes(at.robot, ["up"]), "no keyframe 'up'"),
    ("keyframes-text", lambda at: guesses.keyframes(at.robot, "home"), "names are 'home'", "list"),
    ("keyframes-number", lambda at: guesses.keyframes(at.robot, 0), "names are 0"),
    ("keyframes-none",
     lambda at: guesses.keyframes(
         robot(arm().replace("<key ", "<!-- ").replace('"0.1"/>', "-->")), None
     ),
     "no keyframe"),
    ("path-text", lambda at: guesses.path(at.robot, "straight"), "path is 'straight'"),
    ("path-empty", lambda at: guesses.path(at.robot, []), "path is empty", "give"),
    ("path-dt", lambda at: guesses.path(at.robot, [[0.0], [1.0]], dt=0), "dt of the path is 0"),
    ("path-width", lambda at: guesses.path(at.robot, np.zeros((4, 3))), "shape (3,)", "1 finite"),
    ("path-nan", lambda at: guesses.path(at.robot, [[0.0], [NAN]]), "nan"),
    ("spread-chains", lambda at: guesses.spread(at.robot, guesses.still(at.robot), 0),
     "chains is 0"),
    ("spread-half", lambda at: guesses.spread(at.robot, guesses.still(at.robot), 1.5),
     "chains is 1.5"),
    ("spread-scale", lambda at: guesses.spread(at.robot, guesses.still(at.robot), 2, scale=NAN),
     "scale is nan"),
    ("spread-seed", lambda at: guesses.spread(at.robot, guesses.still(at.robot), 2, seed=-1),
     "seed is -1"),
    ("spread-shape", lambda at: guesses.spread(at.robot, guesses.still(at.point), 2),
     "(10, 2)", "x (5, 2)"),
    ("spread-texts", lambda at: guesses.spread(at.robot, Trajectory("x", "u"), 2),
     "Trajectory(x='x'"),
    ("spread-tuple", lambda at: guesses.spread(at.robot, (0, 0), 2), "trajectory is (0, 0)"),
]
# fmt: on


@pytest.mark.parametrize(("call", "words"), cases(term=TERMS))
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)
