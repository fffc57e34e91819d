"""Bad settings of a solve give one clear error, before anything iterates."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from builders import INF, NAN, At, assert_complains, cases, parts

from mjx_drax import (
    LBFGS,
    Constant,
    GaussNewton,
    Geometric,
    Identity,
    Langevin,
    LogBarrier,
    Polish,
    Restarts,
    Smoothed,
    Tolerances,
    Trajectory,
    minimize,
    solve,
    solve_batch,
)
from mjx_drax.search.settings import changed, from_data

pytestmark = pytest.mark.usefixtures("nothing_iterates")


def flow(**settings):
    """A solve of a good problem with some settings of Langevin."""
    return solve(parts()["point"], 2, solver=Langevin(**settings))


# fmt: off
SETTINGS = [
    ("solver-text", lambda at: solve(at.point, solver="newton"),
     "solver is 'newton'", "Langevin"),
    ("solver-class", lambda at: solve(at.point, solver=Restarts), "solver is <class", "Restarts"),
    ("solver-0", lambda at: solve(at.point, solver=0), "solver is 0"),
    ("solver-dict", lambda at: solve(at.point, solver={"attempts": 3}), "solver is {'attempts'"),
    ("tolerance-text", lambda at: solve(at.point, tolerance="1e-6"), "tolerance is '1e-6'"),
    ("tolerance-0", lambda at: solve(at.point, tolerance=0), "tolerance is 0", "1e-6"),
    ("tolerance-float32", lambda at: solve(at.point, tolerance=1e-9),
     "tolerance is 1e-09, less than what float32 can tell apart", "precision=64"),
    ("tolerance-nan", lambda at: minimize(at.program, tolerance=NAN), "tolerance is nan"),
    ("tolerance-violations", lambda at: solve(at.point, tolerance=Tolerances()),
     "tolerance is Tolerances", "tolerances, plural"),
    ("tolerance-langevin", lambda at: solve(at.point, solver=Langevin(), tolerance=1e-6),
     "tolerance is 1e-06", "Langevin", "leave tolerance out"),
    ("tolerances-number", lambda at: solve(at.point, tolerances=1e-6),
     "tolerances are 1e-06", "tolerance, singular"),
    ("max_iterations-half", lambda at: solve(at.point, max_iterations=0.5),
     "max_iterations is 0.5"),
    ("max_seconds-0", lambda at: solve(at.point, max_seconds=0), "max_seconds is 0"),
    ("max_iterations-0", lambda at: solve(at.point, max_iterations=0), "max_iterations is 0"),
    ("max_iterations-none-there",
     lambda at: solve(at.point, solver=Restarts(polish=Polish(iterations=0)), max_iterations=9),
     "max_iterations is 9", "leave max_iterations out"),
    ("tolerance-batch",
     lambda at: solve_batch(lambda x: replace(at.point, x_init=x), np.zeros((2, 2)), tolerance=-1),
     "tolerance is -1"),
    ("tolerance-metric",
     lambda at: solve(
         at.point, solver=Restarts(Langevin(preconditioner=Identity())), tolerance=1e-3
     ),
     "the polish needs derivatives", "Identity", "GaussNewton()"),
    ("precision-16", lambda at: solve(at.point, precision=16), "precision is 16", "give 64 or 32"),
    ("precision-text", lambda at: minimize(at.program, precision="64"), "precision is '64'"),
    ("precision-less", lambda at: solve(at.point.in_float64(), precision=32),
     "precision is 32", "point is in float64", "leave precision out"),
    ("precision-batch",
     lambda at: solve_batch(lambda x: replace(at.point, x_init=x), np.zeros((2, 2)), precision=8),
     "precision is 8"),
    ("iterations-half", lambda at: flow(iterations=1.5), "iterations is 1.5", "whole"),
    ("iterations-negative", lambda at: flow(iterations=-1), "iterations is -1"),
    ("iterations-none", lambda at: flow(iterations=None), "iterations is None"),
    ("tail-nan", lambda at: flow(tail=NAN), "tail is nan"),
    ("nothing-to-do", lambda at: flow(iterations=0, tail=0), "iterations + tail is 0", "give"),
    ("step_size-negative", lambda at: flow(step_size=-0.1), "step_size is -0.1"),
    ("step_size-nan", lambda at: flow(step_size=NAN), "step_size is nan"),
    ("step_size-ragged", lambda at: flow(step_size=[[0.1], [0.2, 0.3]]), "step_size is [[0.1]"),
    ("step_size-vector", lambda at: flow(step_size=[0.1, 0.2]), "step_size is [0.1, 0.2]"),
    ("noise-number", lambda at: flow(noise=0.1), "noise is 0.1", "Constant(0.1)"),
    ("noise-nan", lambda at: flow(noise=Geometric(NAN, 0.1)), "noise.start is nan"),
    ("noise-negative", lambda at: flow(noise=Constant(-1.0)), "noise.value is -1.0"),
    ("noise-infinite", lambda at: flow(noise=Geometric(1.0, INF)), "noise.end is inf"),
    ("noise-text", lambda at: flow(noise=Geometric("hot", "cold")), "noise.start is 'hot'"),
    ("noise-class", lambda at: flow(noise=Geometric), "noise is <class", "Constant(0.1)"),
    ("penalty-none", lambda at: flow(penalty=None), "penalty is None", "schedule"),
    ("penalty-final", lambda at: flow(penalty=Geometric(1, 2, -3)), "penalty.final is -3"),
    ("damping-list", lambda at: flow(damping=[1, 2]), "damping is [1, 2]"),
    ("barrier-nan", lambda at: flow(barrier_weight=Constant(NAN)), "barrier_weight.value is nan"),
    ("metric-text", lambda at: flow(preconditioner="newton"), "preconditioner is 'newton'"),
    ("metric-class", lambda at: flow(preconditioner=LBFGS), "preconditioner is a class", "LBFGS()"),
    ("metric-pairs", lambda at: flow(preconditioner=LBFGS(pairs=0)), "preconditioner.pairs is 0"),
    ("metric-derivatives", lambda at: flow(preconditioner=GaussNewton("exact")),
     "preconditioner.derivatives"),
    ("samples-0", lambda at: flow(preconditioner=GaussNewton(Smoothed(pairs=0))),
     "derivatives.pairs is 0"),
    ("samples-radius", lambda at: flow(preconditioner=GaussNewton(Smoothed(radius=0.0))),
     "radius is 0.0"),
    ("bounds-pair", lambda at: flow(bounds=(-1, 1)), "bounds is (-1, 1)", "LogBarrier()"),
    ("bounds-floor", lambda at: flow(bounds=LogBarrier(floor=-1.0)), "bounds.floor is -1.0"),
    ("bounds-fraction", lambda at: flow(bounds=LogBarrier(fraction=1.5)), "bounds.fraction is 1.5"),
    ("adjusted-metric", lambda at: flow(adjusted=True), "adjusted=True", "needs Identity()"),
    ("restarts-flow", lambda at: solve(at.point, solver=Restarts(flow=None)), "flow is None"),
    ("restarts-attempts", lambda at: solve(at.point, solver=Restarts(attempts=0)), "attempts is 0"),
    ("restarts-descent", lambda at: solve(at.point, solver=Restarts(descent=-5)), "descent is -5"),
    ("restarts-within", lambda at: solve(at.point, solver=Restarts(within=NAN)), "within is nan"),
    ("restarts-enough", lambda at: solve(at.point, solver=Restarts(done_share="most")),
     "done_share is 'most'"),
    ("set-part", lambda at: changed(Restarts(), "flow.preconditioner", "Newton"),
     "'Newton'", "LBFGS"),
    ("set-number", lambda at: changed(Restarts(), "attempts", "many"), "attempts is 'many'"),
    ("set-schedule", lambda at: changed(Restarts(), "flow.noise", "Geometric(1, 2, 3, 4)"),
     "flow.noise"),
    ("read-part", lambda at: from_data({"part": "Nonsense"}), "Nonsense", "version"),
    ("chains-0", lambda at: solve(at.point, 0), "chains is 0"),
    ("chains-half", lambda at: solve(at.point, 2.5), "chains is 2.5"),
    ("chains-text", lambda at: solve(at.point, "many"), "chains is 'many'"),
    ("chains-true", lambda at: solve(at.point, True), "chains is True"),
    ("chains-none", lambda at: minimize(at.program, None), "chains is None"),
    ("seed-negative", lambda at: solve(at.point, 2, -1), "seed is -1"),
    ("seed-big", lambda at: solve(at.point, 2, 2**32), "seed is 4294967296"),
    ("seed-key", lambda at: solve(at.point, 2, jax.random.key(0)), "seed is"),
    ("guess-array", lambda at: solve(at.point, 2, guess=np.zeros((10, 2))), "guess is array"),
    ("guess-knots",
     lambda at: solve(at.point, 2, guess=Trajectory(np.zeros((9, 2)), np.zeros((10, 2)))),
     "guess.x has shape (9, 2)", "(10, 2)"),
    ("guess-chains",
     lambda at: solve(at.point, 2, guess=Trajectory(np.zeros((3, 10, 2)), np.zeros((10, 2)))),
     "(3, 10, 2)", "(2, 10, 2)"),
    ("guess-nan",
     lambda at: solve(at.point, 2, guess=Trajectory(np.zeros((10, 2)), np.full((10, 2), NAN))),
     "guess.u holds NaN"),
    ("guess-text", lambda at: solve(at.point, 2, guess=Trajectory("x", "u")), "guess.x is 'x'"),
    ("guess-none", lambda at: solve(at.point, 2, guess=Trajectory(None, None)), "guess.x"),
    ("progress", lambda at: solve(at.point, 2, progress=3), "progress is 3"),
    ("record-0", lambda at: solve(at.point, 2, record=0), "record is 0"),
    ("record-half", lambda at: solve(at.point, 2, record=0.5), "record is 0.5"),
    ("devices-99", lambda at: solve(at.point, 2, devices=99), "devices is 99", "1 to"),
    ("devices-text", lambda at: solve(at.point, 2, devices="gpu"), "devices is 'gpu'"),
    ("devices-0", lambda at: solve(at.point, 2, devices=0), "devices is 0"),
]
# fmt: on


@pytest.mark.parametrize(("call", "words"), cases(setting=SETTINGS))
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)
