"""Bad arguments of MPC, of the simulated robot and of pushes give one clear error."""

import numpy as np
import pytest
from builders import INF, NAN, At, arm, assert_complains, cases, parts, point

from mjx_drax import MPC, Background, Identity, Langevin, Plant, Push
from mjx_drax.control.trials import simulate


@pytest.fixture(scope="module", autouse=True)
def policy():
    """A policy that has a plan, made once: `at.policy`."""
    made = MPC(parts()["point"], chains=2)
    made.reset(np.zeros(2))
    parts()["policy"] = made


@pytest.fixture(autouse=True)
def no_more_plans(policy, nothing_iterates):
    """What is tried here complains before it plans."""


# fmt: off
LOOPS = [
    ("mpc-problem", lambda at: MPC(arm()), "the problem is"),
    ("mpc-chains", lambda at: MPC(at.robot, chains=0), "chains is 0"),
    ("mpc-chains-half", lambda at: MPC(at.robot, chains=2.5), "chains is 2.5"),
    ("mpc-explorers", lambda at: MPC(at.robot, chains=4, explorers=4), "explorers is 4", "leave"),
    ("mpc-explorers-negative", lambda at: MPC(at.robot, explorers=-1), "explorers is -1"),
    ("mpc-iterations", lambda at: MPC(at.robot, iterations=0), "iterations is 0"),
    ("mpc-iterations-many", lambda at: MPC(at.robot, iterations=999), "iterations is 999", "tail"),
    ("mpc-every", lambda at: MPC(at.robot, every="step"), "every is 'step'"),
    ("mpc-hold", lambda at: MPC(at.robot, hold=-0.1), "hold is -0.1"),
    ("mpc-hold-nan", lambda at: MPC(at.robot, hold=NAN), "hold is nan"),
    ("mpc-seed", lambda at: MPC(at.robot, seed=-1), "seed is -1"),
    ("mpc-solver", lambda at: MPC(at.robot, solver="fast"), "solver is 'fast'"),
    ("mpc-metric", lambda at: MPC(at.robot, solver=Langevin(preconditioner=Identity())),
     "Identity", "GaussNewton()"),
    ("mpc-knot-bounds", lambda at: MPC(point(u_bounds=(-np.ones((10, 2)), 1))),
     "bounds of point", "give"),
    ("mpc-no-plan", lambda at: MPC(at.robot).latest, "no plan yet", "policy.reset"),
    ("mpc-no-plan-control", lambda at: MPC(at.robot).control([0.0, 0.0], 0.0), "no plan yet"),
    ("mpc-rewind", lambda at: MPC(at.robot).rewind(), "nothing to go back to", "reset"),
    ("mpc-reset-shape", lambda at: MPC(at.robot).reset([0.0]), "x_init has shape (1,)"),
    ("mpc-reset-nan", lambda at: MPC(at.robot).reset([0.0, NAN]), "x_init is [0.0, nan]"),
    ("mpc-reset-outside", lambda at: MPC(at.robot).reset([9.0, 0.0]), "outside the bounds"),
    ("mpc-reset-outside-one-side",
     lambda at: MPC(point(x_bounds=(-1.0, INF))).reset([-9.0, 0.0]), "outside the bounds"),
    ("mpc-reset-time", lambda at: MPC(at.robot).reset([0.0, 0.0], "now"), "time t is 'now'"),
    ("mpc-plan-shape", lambda at: at.policy.plan(np.zeros(3), 0.0),
     "state x has shape (3,)", "2"),
    ("mpc-plan-text", lambda at: at.policy.plan("here", 0.0), "state x is 'here'"),
    ("mpc-control-shape", lambda at: at.policy.control(np.zeros((1, 2)), 0.0), "(1, 2)"),
    ("mpc-control-none", lambda at: at.policy.control(None, 0.0), "state x"),
    ("mpc-control-time", lambda at: at.policy.control(np.zeros(2), NAN), "time t is nan"),
    ("mpc-call-shape", lambda at: at.policy(np.zeros(1), 0.1), "state x has shape (1,)"),
    ("background-no-plan", lambda at: Background(MPC(at.robot)), "no plan yet"),
    ("background-shape", lambda at: Background(at.policy)(np.zeros(5), 0.0), "(5,)"),
    ("plant-function", lambda at: Plant(at.point), "point has no model", "from_mjcf"),
    ("plant-mass", lambda at: Plant(at.robot, mass=0.0), "mass is 0.0"),
    ("plant-mass-text", lambda at: Plant(at.robot, mass="heavy"), "mass is 'heavy'"),
    ("plant-noise", lambda at: Plant(at.robot, noise=-1.0), "noise is -1.0"),
    ("plant-shaking", lambda at: Plant(at.robot, shaking=NAN), "shaking is nan"),
    ("push-body", lambda at: Plant(at.robot, pushes=[Push(0.0, "leg", (1, 0, 0))]),
     "'leg'", "'link'"),
    ("push-force", lambda at: Plant(at.robot, pushes=[Push(0.0, "link", (1, 0))]),
     "force", "(1, 0)"),
    ("push-nan", lambda at: Plant(at.robot, pushes=[Push(0.0, "link", (NAN, 0, 0))]),
     "force", "nan"),
    ("push-time", lambda at: Plant(at.robot, pushes=[Push("soon", "link", (1, 0, 0))]), "'soon'"),
    ("push-before", lambda at: Plant(at.robot, pushes=[Push(-1.0, "link", (1, 0, 0))]),
     "a push begins at -1.0"),
    ("push-tuple", lambda at: Plant(at.robot, pushes=[(0.0, "link")]), "a push is (0.0, 'link')"),
    ("pushes", lambda at: Plant(at.robot, pushes=3), "pushes are 3", "list"),
    ("plant-none", lambda at: Plant(None), "the problem is None"),
    ("step-nan", lambda at: Plant(at.robot).step([NAN]), "control u is [nan]", "1 finite"),
    ("step-shape", lambda at: Plant(at.robot).step(np.zeros(3)), "control u", "1 finite"),
    ("step-none", lambda at: Plant(at.robot).step(None), "control u is None"),
    ("simulate-nan", lambda at: simulate(at.policy, Plant(at.robot), NAN), "duration is nan"),
]
# fmt: on


@pytest.mark.parametrize(("call", "words"), cases(loop=LOOPS))
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)
