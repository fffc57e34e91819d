"""Bad input gives one clear error, before anything iterates: what, which value, what to do.

Each case is (id, call, words): the call gets an `At` and must raise a DraxError whose message holds
the words, which name what is wrong and its value. Cases are grouped by what they attack. What the
library cannot find out, and so is not here:

- a cost that reads a global which changes after the solve has compiled it: JAX keeps what it read;
- a cost that is wrong in one region of the state space only: its chains diverge, and are marked;
- a cost that never returns, or a file that changes while it is read.
"""

import functools
import hashlib
import json
import math
import pickle
import random
import re
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax import (
    LBFGS,
    MPC,
    Background,
    Constant,
    DraxError,
    GaussNewton,
    Geometric,
    Identity,
    Langevin,
    LogBarrier,
    Plant,
    Push,
    Restarts,
    Smoothed,
    Solution,
    Terms,
    Trajectory,
    cli,
    from_function,
    from_mjcf,
    from_program,
    guesses,
    minimize,
    render,
    render_diffusion,
    render_timelapse,
    save_csv,
    save_dataset,
    save_html,
    solve,
    solve_batch,
    tasks,
)
from mjx_drax.control.mpc import Plan
from mjx_drax.control.trials import simulate
from mjx_drax.method.metrics import Multipliers
from mjx_drax.physics.check import check
from mjx_drax.problem.problem import Stagewise
from mjx_drax.search.settings import changed, from_data
from mjx_drax.solution.export import export_keyframes
from mjx_drax.solution.optima import distinct
from mjx_drax.solution.solution import Replays
from mjx_drax.view.plotting import plot_optima, plot_solution
from mjx_drax.view.portraits import plot_phase
from mjx_drax.view.rendering import render_frames

INF, NAN = math.inf, math.nan


def arm(body="", option='timestep="0.01"', actuator=None, more="", joint=""):
    motor = '<motor name="torque" joint="elbow" ctrlrange="-1 1" ctrllimited="true"/>'
    home = "0.1 1 0 0 0" if "hip" in body else "0.1"
    return f"""
<mujoco model="arm"><option {option}/><worldbody>
  <body name="link"><joint name="elbow" axis="0 1 0" range="-90 90" limited="true" {joint}/>
    <geom name="rod" type="capsule" size="0.02 0.1" mass="1"/>
    <geom name="tray" type="cylinder" size="0.1 0.01" mass="1"/><site name="tip"/></body>{body}
</worldbody><actuator>{motor if actuator is None else actuator}</actuator>
<sensor><jointpos name="angle" joint="elbow"/></sensor>
<keyframe><key name="home" qpos="{home}"/></keyframe>{more}</mujoco>
"""


BALL = (
    '<body name="egg" pos="1 0 0"><joint name="hip" type="ball"/>'
    '<geom mass="1" size="0.1" contype="0" conaffinity="0"/></body>'
)
CUPS = (
    '<body pos="0 0 1"><geom name="cup" type="ellipsoid" size="1 1 1"/></body>'
    '<geom name="can" type="box" size="1 1 1"/>'
)
ROPE = (
    '<flexcomp name="rope" type="grid" count="3 1 1" dim="1" spacing=".1 .1 .1" mass="1"/>'
    "</worldbody>"
)
WIDE = '<motor joint="elbow" ctrlrange="1 -1" ctrllimited="true"/>'
POST = '<geom name="post" size="1"/>'
STILL = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"


def point(**changes):
    """A problem from a function; the defaults are good."""
    given = {"f": lambda x, u: x + 0.1 * u, "x_init": [0.0, 0.0], "nu": 2, "dt": 0.1}
    given |= {"horizon": 1.0, "terminal_residual": lambda x: x - 1.0, "name": "point"}
    return from_function(**{**given, **changes})


def robot(model=None, **changes):
    """A problem from MJCF; the defaults are good."""
    given = {"horizon": 0.1, "terminal_residual": lambda data: data.qpos}
    return from_mjcf(arm() if model is None else model, **{**given, **changes})


def pondered(**changes):
    """A solve of two chains, of a problem from a function."""
    return solve(point(**changes), 2)


def weighed(l):
    """A solve with another running cost."""
    return pondered(running_cost=l)


def made_up(problem, chains=2):
    """A solution that was never solved for."""
    K, d = problem.horizon, problem.dynamics
    x, u = np.zeros((chains, K, d.nx), np.float32), np.zeros((chains, K, d.nu), np.float32)
    zero, whole = np.zeros(chains, np.float32), np.zeros(chains, int)
    states, good = np.zeros((chains, K + 1, d.nx)), np.ones(chains, bool)
    replays = Replays(states, u, zero, zero, zero, zero, good)
    constraints = Stagewise(np.zeros((chains, K, 0)), np.zeros((chains, 0)))
    return Solution(
        problem=problem,
        solver=Langevin(),
        seed=0,
        trajectories=Trajectory(x, u),
        multipliers=Multipliers(np.zeros((chains, K, d.ndx)), constraints, None),
        gains=np.zeros((chains, K, d.nu, d.ndx)),
        cost=zero,
        max_defect=zero,
        max_violation=zero,
        converged_at=whole,
        died_at=whole - 1,
        open_loop=replays,
        feedback=replays,
        history={
            "iteration": np.arange(2),
            "cost": np.zeros((2, chains)),
            "max_defect": np.zeros((2, chains)),
            "began": np.zeros(1, int),
            "noise_ends": np.zeros(1, int),
        },
        iterations=1,
        compile_time=0.0,
        solve_time=0.0,
        engine=problem.dynamics.engine,
    )


@functools.cache
def parts():
    """What many cases share: problems, terms, and solutions of them."""
    good = {
        "robot": robot(),
        "ball": robot(arm(BALL)),
        "point": point(),
        "kept": point(x_bounds=(-1, 1)),
        "on": Terms(arm()),
    }
    good["program"] = from_program(2, cost=lambda x: x @ x)
    good["seen"], good["sketch"] = made_up(good["robot"]), made_up(good["point"])
    good["lost"] = replace(good["seen"], max_defect=np.ones(2, np.float32))
    return good


@dataclass
class At:
    """Where a case takes place: a folder of its own, and what all share by name."""

    folder: Path

    def __getattr__(self, name):
        return parts()[name]

    def file(self, name, content=b""):
        """A file with some content."""
        path = self.folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def saved(self, name="seen", **summary):
        """A folder with a saved solution, some entries of result.json replaced."""
        folder = parts()[name].save(self.folder / "result")
        if summary:
            path = folder / "result.json"
            said = {k: v for k, v in json.loads(path.read_text()).items() if k != "json_sha256"}
            path.write_text(json.dumps({**said, **summary}))
        return folder

    def repacked(self, change):
        """A folder whose arrays somebody has changed, with a digest that fits."""
        path = self.saved() / "result.npz"
        change(path)
        return self.saved_digest(path)

    def saved_digest(self, path):
        said = json.loads((path.parent / "result.json").read_text())
        said["npz_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        said.pop("json_sha256", None)
        (path.parent / "result.json").write_text(json.dumps(said))
        return path.parent

    def arrays(self, **arrays):
        """A folder in which some arrays are others; None leaves them out."""

        def change(path):
            with np.load(path) as old:
                new = {**old, **{k.replace("__", "."): v for k, v in arrays.items()}}
            np.savez(path, **{k: v for k, v in new.items() if v is not None})

        return self.repacked(change)

    def policy(self, **settings):
        """A policy that has a plan."""
        policy, d = MPC(self.robot, **{"chains": 2, **settings}), self.robot.dynamics
        K = self.robot.horizon
        x, u = np.zeros((K + 1, d.nx)), np.zeros((K, d.nu))
        policy._plan = Plan(x, u, np.zeros((K, d.nu, d.ndx)), 0.0, 0.0, True, False)
        return policy


def cut_short(path):
    path.write_bytes(path.read_bytes()[:500])


def without_members(path):
    with zipfile.ZipFile(path, "w"):
        pass


def with_pickle(path):
    with np.load(path) as old:
        arrays = {**old, "chain_cost": np.array([{}, {}], object)}
    np.savez(path, **arrays)


def garbled_member(path):
    """The bytes of one array are not those of an array."""
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w") as new:
        for name, content in members.items():
            new.writestr(name, b"junk" if name == "solution.gains.npy" else content)


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
    ("crossed-range", lambda at: robot(arm(actuator=WIDE)), "range"),
    ("massless", lambda at: robot("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"),
     "mass"),
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
    ("cylinder-collides", lambda at: robot(arm(CUPS)), "MJX cannot collide", "contacts=False"),
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
    ("horizon-infinite", lambda at: point(horizon=INF), "horizon is inf"),
    ("horizon-text", lambda at: point(horizon="10"), "horizon is '10'", "seconds"),
    ("horizon-none", lambda at: point(horizon=None), "horizon is None"),
    ("horizon-list", lambda at: point(horizon=[1.0]), "horizon is [1.0]"),
    ("horizon-complex", lambda at: point(horizon=1j), "horizon is 1j"),
    ("horizon-short", lambda at: point(horizon=0.01), "horizon is 0.01 s", "at least 0.1 s"),
    ("horizon-endless", lambda at: point(horizon=1e300), "1e+300", "less than"),
    ("horizon-knots-0", lambda at: solve(replace(at.point, horizon=0)), "horizon", "is 0"),
    ("horizon-knots-half", lambda at: solve(replace(at.point, horizon=1.5)), "horizon", "1.5"),
    ("dt-0", lambda at: point(dt=0), "dt is 0"),
    ("dt-nan", lambda at: robot(dt=NAN), "dt is nan"),
    ("dt-text", lambda at: robot(dt="fast"), "dt is 'fast'"),
    ("dt-no-multiple", lambda at: robot(dt=0.015), "dt is 0.015 s", "timestep", "give 0.02"),
    ("dt-below-timestep", lambda at: robot(dt=0.001), "0.001", "give 0.01"),
    ("nu-0", lambda at: point(nu=0), "nu is 0", "at least 1"),
    ("nu-negative", lambda at: point(nu=-2), "nu is -2"),
    ("nu-text", lambda at: point(nu="2"), "nu is '2'"),
    ("nu-huge", lambda at: point(nu=10**12), "nu is 1000000000000", "at most"),
    ("nu-half", lambda at: point(nu=1.5), "nu is 1.5"),
    ("name-number", lambda at: point(name=3), "name is 3"),
    ("name-empty", lambda at: robot(name=""), "name is ''"),
    ("x_init-nan", lambda at: point(x_init=[0.0, NAN]), "x_init is [0.0, nan]", "finite"),
    ("x_init-infinite", lambda at: robot(x_init=[INF, 0.0]), "x_init is [inf"),
    ("x_init-beyond-float32", lambda at: point(x_init=[1e39, 0.0]), "x_init", "1e+39", "finite"),
    ("x_init-short", lambda at: robot(x_init=[0.0]), "x_init has 1 numbers", "Give 2"),
    ("x_init-matrix", lambda at: point(x_init=np.zeros((2, 2))), "x_init is array", "vector"),
    ("x_init-number", lambda at: point(x_init=0.0), "x_init is 0.0", "vector"),
    ("x_init-texts", lambda at: point(x_init=["0", "1"]), "x_init is ['0', '1']"),
    ("x_init-none", lambda at: point(x_init=None), "x_init is None"),
    ("x_init-objects", lambda at: point(x_init=[object(), None]), "x_init is [<object"),
    ("x_init-dict", lambda at: point(x_init={"x": 0}), "x_init is {'x': 0}"),
    ("x_init-endless", lambda at: point(x_init=[10**400, 0]), "x_init is [1000000", "..."),
    ("x_init-ragged", lambda at: point(x_init=[[0.0], [0.0, 1.0]]), "x_init is [[0.0]"),
    ("x_init-complex", lambda at: point(x_init=[0j, 1.0]), "x_init", "numbers"),
    ("x_init-huge", lambda at: point(x_init=np.full((99, 99), NAN)), "x_init is array", "..."),
    ("x_init-replaced", lambda at: solve(replace(at.point, x_init=[0, 0])),
     "x_init is array", "floats"),
    ("x_init-replaced-nan", lambda at: solve(replace(at.point, x_init=jnp.full(2, NAN))), "nan"),
    ("x_init-later", lambda at: at.point.with_x_init([1.0]), "x_init has shape (1,)", "give 2"),
    ("x_init-quaternion", lambda at: at.ball.with_x_init(np.zeros(2)), "x_init", "give 9"),
    ("x_init-no-rotation", lambda at: robot(arm(BALL), x_init=np.zeros(9)), "quaternion", "scale"),
    ("x_init-outside", lambda at: point(x_bounds=(1.0, 2.0)), "outside the bounds", "by 1"),
    ("x_init-below-one", lambda at: point(x_bounds=([-1, 0.5], [1, 1])), "x_init", "by 0.5"),
    ("x_bounds-number", lambda at: point(x_bounds=3.0), "bounds of x are 3.0", "pair"),
    ("x_bounds-three", lambda at: point(x_bounds=(1, 2, 3)), "bounds of x are (1, 2, 3)"),
    ("x_bounds-crossed", lambda at: point(x_bounds=(1.0, -1.0)),
     "cross", "lower 1.0", "upper -1.0"),
    ("x_bounds-nan", lambda at: point(x_bounds=(NAN, 1.0)), "lower end of x is nan", "-inf"),
    ("x_bounds-shut", lambda at: point(x_bounds=(INF, INF)), "leave nothing", "lower inf"),
    ("x_bounds-shape", lambda at: point(x_bounds=(np.zeros(3), 1)), "lower end of x", "(2,)"),
    ("x_bounds-knots", lambda at: point(x_bounds=(np.zeros((7, 2)), 1)), "(7, 2)", "(10, 2)"),
    ("x_bounds-text", lambda at: point(x_bounds=("low", "high")), "lower end of x is 'low'"),
    ("x_bounds-rotation", lambda at: robot(arm(BALL), x_bounds=(-1, 1)), "x_bounds", "quaternions"),
    ("u_bounds-crossed", lambda at: robot(u_bounds=(2.0, 3.0)), "bounds of u cross", "lower 2.0"),
    ("u_bounds-nan", lambda at: point(u_bounds=(-1.0, [1.0, NAN])), "upper end of u is [1.0, nan]"),
    ("u_bounds-one-end", lambda at: point(u_bounds=(1.0,)), "bounds of u are (1.0,)"),
    ("u_bounds-complex", lambda at: point(u_bounds=(0j, 1j)), "lower end of u is 0j"),
    ("u_bounds-minus-infinite", lambda at: point(u_bounds=(-INF, -INF)), "bounds of u", "-inf"),
    ("scatter-crossed", lambda at: point(x_scatter=(1, -1)), "scatter of x cross"),
    ("scatter-nan", lambda at: point(u_scatter=(NAN, NAN)), "lower end of u is nan"),
    ("scatter-text", lambda at: point(u_scatter="wide"), "bounds of u are 'wide'"),
    ("no-cost", lambda at: point(terminal_residual=None), "point has no cost", "give"),
    ("contacts", lambda at: robot(contacts="some"), "contacts is 'some'", "True, False or a"),
    ("derivatives-class", lambda at: robot(derivatives=Smoothed), "derivatives", "Smoothed()"),
    ("derivatives-text", lambda at: robot(derivatives="exact"), "derivatives is 'exact'"),
    ("problem-none", lambda at: solve(None), "the problem is None", "from_mjcf"),
    ("problem-model", lambda at: solve(arm()), "the problem is", "from_mjcf"),
    ("task-unknown", lambda at: tasks.load("cartpoel"), "cartpoel", "cartpole_swingup"),
    ("task-ambiguous", lambda at: tasks.load("car"), "several tasks begin with 'car'", "choose"),
    ("task-number", lambda at: tasks.load(3), "no task 3", "choose"),
    ("check-missing", lambda at: check(at.folder / "gone.xml"), "gone.xml", "check"),
]
# fmt: on

COUNTS = []


def counting(x, u):
    """Costs more each time it is called."""
    COUNTS.append(1)
    return len(COUNTS) * (x @ x)


KEPT = []


def keeping(x, u):
    """Uses what it was first called with."""
    KEPT.append(x)
    return KEPT[0] @ x


@jax.custom_vjp
def backwards(x):
    return x @ x


backwards.defvjp(lambda x: (backwards(x), x), lambda x, g: (2 * g * x,))


def called_back(x, u):
    """Computed by numpy."""
    return jax.pure_callback(lambda x: np.float32(x @ x), jax.ShapeDtypeStruct((), x.dtype), x)


def fails(*_):
    raise KeyError("no such sensor")


def shouts(*_):
    raise RuntimeError("line\n" * 500)


# fmt: off
COSTS = [
    ("raises", lambda at: weighed(fails), "running_cost failed", "KeyError", "no such sensor"),
    ("raises-at-length", lambda at: weighed(shouts), "running_cost failed", "RuntimeError: line"),
    ("raises-nothing", lambda at: weighed(lambda x, u: 1 / 0), "ZeroDivisionError"),
    ("assertion", lambda at: weighed(lambda x, u: exec("assert False")), "AssertionError"),
    ("no-function", lambda at: weighed(3), "running_cost is 3", "function"),
    ("class", lambda at: weighed(dict), "running_cost is <class 'dict'>"),
    ("text", lambda at: point(terminal_cost="x @ x"), "terminal_cost is 'x @ x'"),
    ("residual-list", lambda at: point(running_residual=[]), "running_residual is []"),
    ("no-arguments", lambda at: weighed(lambda: 0.0),
     "running_cost failed", "takes 0", "2 arguments"),
    ("one-argument", lambda at: weighed(lambda x: x @ x), "running_cost failed", "2 arguments"),
    ("terminal-with-control", lambda at: point(terminal_cost=lambda x, u: 0.0),
     "terminal_cost failed", "'u'", "1 argument"),
    ("vector", lambda at: weighed(lambda x, u: x), "running_cost returned shape (2,)", "residual"),
    ("matrix", lambda at: point(terminal_cost=lambda x: jnp.outer(x, x)), "shape (2, 2)"),
    ("none", lambda at: weighed(lambda x, u: None), "running_cost returned None"),
    ("string", lambda at: weighed(lambda x, u: "cheap"), "running_cost returned 'cheap'"),
    ("whole", lambda at: weighed(lambda x, u: 1), "running_cost returned 1"),
    ("truth", lambda at: weighed(lambda x, u: True), "running_cost returned True"),
    ("truths", lambda at: weighed(lambda x, u: x[0] > 0), "running_cost", "bool", "floats"),
    ("integers", lambda at: weighed(lambda x, u: jnp.argmax(x)), "running_cost", "int32"),
    ("complex", lambda at: weighed(lambda x, u: x[0] * 1j), "running_cost", "complex64"),
    ("imaginary", lambda at: weighed(lambda x, u: 1j), "running_cost returned 1j"),
    ("tuple", lambda at: weighed(lambda x, u: (x[0], u[0])), "running_cost returned a tuple"),
    ("dict", lambda at: weighed(lambda x, u: {"cost": x[0]}), "running_cost returned a dict"),
    ("generator", lambda at: weighed(lambda x, u: (a for a in x)), "returned a generator"),
    ("function", lambda at: weighed(lambda x, u: lambda: x[0]), "returned a function"),
    ("objects", lambda at: weighed(lambda x, u: np.array(None)), "running_cost", "object"),
    ("residual-none", lambda at: point(running_residual=lambda x, u: None), "running_residual"),
    ("residual-list-of-arrays", lambda at: point(terminal_residual=lambda x: [x, x]), "a list"),
    ("residual-integers", lambda at: point(terminal_residual=lambda x: jnp.arange(2)), "int32"),
    ("branch", lambda at: weighed(lambda x, u: 1.0 if x[0] > 0 else 0.0), "`if`", "jnp.where"),
    ("loop", lambda at: weighed(lambda x, u: sum(1.0 for _ in range(int(x[0])))), "int()"),
    ("numpy", lambda at: weighed(lambda x, u: np.sin(x).sum()), "numpy", "jax.numpy"),
    ("float", lambda at: weighed(lambda x, u: float(x[0])), "float()"),
    ("math", lambda at: weighed(lambda x, u: math.sin(x[0])), "running_cost failed", "float()"),
    ("in-place", lambda at: weighed(lambda x, u: x.__setitem__(0, 1.0)), "running_cost failed"),
    ("wrong-shapes", lambda at: weighed(lambda x, u: x @ jnp.zeros(3)), "running_cost failed"),
    ("counter", lambda at: weighed(counting), "running_cost", "global"),
    ("random", lambda at: weighed(lambda x, u: random.random() * (x @ x)), "random numbers"),
    ("random-array",
     lambda at: weighed(lambda x, u: x @ np.random.default_rng().normal(size=2).astype("f")),
     "random numbers"),
    ("random-inside", lambda at: weighed(lambda x, u: jax.jit(lambda x: random.random() * x)(x[0])),
     "running_cost", "random"),
    ("leaked", lambda at: weighed(keeping), "running_cost", "global"),
    ("rounds", lambda at: weighed(lambda x, u: jnp.round(x).sum()),
     "running_cost", "zero everywhere"),
    ("argmax", lambda at: weighed(lambda x, u: 1.0 * jnp.argmax(u)), "zero everywhere", "Smoothed"),
    ("stopped", lambda at: weighed(lambda x, u: jax.lax.stop_gradient(x @ x)), "zero everywhere"),
    ("compares", lambda at: point_solved(terminal_residual=lambda x: jnp.where(x > 0, 1.0, 0.0)),
     "terminal_residual", "zero"),
    ("callback", lambda at: weighed(called_back), "cannot be differentiated", "allbacks"),
    ("reverse-only", lambda at: weighed(lambda x, u: backwards(x)), "custom_vjp", "custom_jvp"),
    ("reverse-only-identity",
     lambda at: solve(
         point(running_cost=lambda x, u: backwards(x)),
         1,
         solver=Langevin(preconditioner=Identity()),
     ),
     "custom_vjp"),
    ("forward-only",
     lambda at: solve(
         point(
             running_cost=lambda x, u: jax.lax.while_loop(
                 lambda c: c < 9, lambda c: c + 1.0, x @ x
             )
         ),
         1,
         solver=Langevin(preconditioner=LBFGS()),
     ),
     "cannot be differentiated", "everse"),
    ("sqrt", lambda at: weighed(lambda x, u: jnp.sqrt(x @ x)),
     "derivative of running_cost", "x_init"),
    ("norm", lambda at: pondered(running_residual=lambda x, u: jnp.linalg.norm(x)[None]),
     "derivative of running_residual"),
    ("power", lambda at: weighed(lambda x, u: (jnp.abs(x) ** 1.5).sum()),
     "second derivative of running_cost"),
    ("nan", lambda at: weighed(lambda x, u: x @ x + jnp.nan),
     "value of running_cost", "not finite"),
    ("nan-number", lambda at: weighed(lambda x, u: NAN), "value of running_cost"),
    ("infinite", lambda at: pondered(terminal_cost=lambda x: 1 / (0 * x[0])), "terminal_cost"),
    ("log", lambda at: pondered(running_residual=lambda x, u: jnp.log(x)),
     "running_residual", "log"),
    ("model-vector", lambda at: robot(running_cost=lambda data, u: data.qpos),
     "running_cost", "(1,)"),
    ("model-typo", lambda at: robot(running_cost=lambda data, u: data.qpso[0]), "qpso"),
    ("model-index-by-name", lambda at: robot(running_cost=lambda data, u: data.qpos["elbow"]),
     "running_cost failed"),
    ("model-branch", lambda at: robot(terminal_cost=lambda data: 0.0 if data.qpos[0] else 1.0),
     "jnp.where"),
    ("model-data-itself", lambda at: robot(terminal_cost=lambda data: data),
     "terminal_cost returned a"),
    ("model-method", lambda at: robot(terminal_cost=lambda data: data.body("link").xpos[0]),
     "terminal_cost failed"),
    ("model-log", lambda at: solve(robot(terminal_cost=lambda data: jnp.log(data.qpos[0] - 9)), 1),
     "value of terminal_cost", "last initial state"),
    ("model-sqrt", lambda at: solve(robot(running_cost=lambda data, u: jnp.sqrt(data.qvel[0])), 1),
     "derivative of running_cost", "x_init"),
    ("model-rounds",
     lambda at: solve(robot(running_cost=lambda data, u: jnp.floor(data.qpos[0])), 1),
     "zero everywhere"),
]
# fmt: on


def point_solved(**changes):
    return pondered(**{"running_residual": lambda x, u: u, **changes})


# fmt: off
FUNCTIONS = [
    ("f-none", lambda at: point(f=None), "f is None"),
    ("f-array", lambda at: point(f=np.eye(2)), "f is array"),
    ("f-shape", lambda at: point(f=lambda x, u: x[:1]), "f(x, u) returned shape (1,)", "(2,)"),
    ("f-scalar", lambda at: point(f=lambda x, u: x @ u), "shape ()"),
    ("f-integers", lambda at: point(f=lambda x, u: x.astype(int)), "dynamics", "int32"),
    ("f-complex", lambda at: point(f=lambda x, u: x + 1j), "dynamics", "complex64"),
    ("f-tuple", lambda at: point(f=lambda x, u: (x, u)), "returned a tuple"),
    ("f-none-returned", lambda at: point(f=lambda x, u: None), "returned None"),
    ("f-raises", lambda at: point(f=fails), "dynamics", "no such sensor"),
    ("f-one-argument", lambda at: point(f=lambda x: x), "dynamics", "2 arguments"),
    ("f-numpy", lambda at: point(f=lambda x, u: np.cos(x)), "dynamics", "jax.numpy"),
    ("f-random", lambda at: point(f=lambda x, u: x + random.random()), "dynamics", "random"),
    ("f-nan", lambda at: pondered(f=lambda x, u: x / 0 + u), "dynamics", "not finite"),
    ("f-no-derivative", lambda at: pondered(f=lambda x, u: jnp.round(x + u)), "dynamics", "zero"),
    ("f-derivative-nan", lambda at: pondered(f=lambda x, u: jnp.sqrt(x) + u),
     "derivative of the dynamics"),
    ("f-callback", lambda at: pondered(f=lambda x, u: x * called_back(x, u)),
     "dynamics", "differentiated"),
    ("equality-raises", lambda at: point(equality=fails), "equality failed", "no such sensor"),
    ("equality-text", lambda at: point(equality="x = 0"), "equality is 'x = 0'"),
    ("equality-none", lambda at: point(equality=lambda x, u: None), "equality returned None"),
    ("equality-truth", lambda at: robot(equality=lambda data, u: data.qpos == 0),
     "equality", "bool"),
    ("inequality-truth", lambda at: point(inequality=lambda x, u: x <= 1), "inequality", "bool"),
    ("inequality-tuple", lambda at: point(inequality=lambda x, u: (x, u)), "inequality", "tuple"),
    ("inequality-random", lambda at: point(inequality=lambda x, u: x - random.random()), "random"),
    ("inequality-sign", lambda at: point_solved(inequality=lambda x, u: jnp.sign(x) - 1),
     "inequality", "zero"),
    ("inequality-nan", lambda at: point_solved(inequality=lambda x, u: x / 0),
     "inequality", "not finite"),
    ("inequality-norm", lambda at: point_solved(inequality=lambda x, u: jnp.linalg.norm(x) - 1),
     "derivative of inequality"),
    ("terminal-equality-arity", lambda at: point(terminal_equality=lambda x, u: x),
     "terminal_equality", "1 argument"),
    ("terminal-inequality-text", lambda at: point(terminal_inequality=lambda x: "no"), "'no'"),
    ("terminal-inequality-class", lambda at: robot(terminal_inequality=list),
     "terminal_inequality"),
    ("goal-text", lambda at: point(goal="upright"), "goal is 'upright'"),
    ("goal-raises", lambda at: point(goal=fails), "goal failed", "no such sensor"),
    ("goal-text-returned", lambda at: point(goal=lambda x: "yes"), "goal returned", "truth value"),
    ("goal-vector", lambda at: point(goal=lambda x: x > 0), "goal returned shape (2,)"),
    ("goal-none", lambda at: robot(goal=lambda data: None), "goal returned", "truth value"),
    ("goal-typo", lambda at: robot(goal=lambda data: data.site("top").xpos[2] > 0),
     "goal failed", "top"),
    ("guess-number", lambda at: point(guess=3), "guess is 3"),
    ("guess-raises", lambda at: point(guess=fails), "guess failed", "no such sensor"),
    ("guess-none", lambda at: point(guess=lambda key: None),
     "guess returned a NoneType", "x (10, 2)"),
    ("guess-shape",
     lambda at: point(guess=lambda key: Trajectory(jnp.zeros((9, 2)), jnp.zeros((10, 2)))),
     "(9, 2)", "x (10, 2)"),
    ("guess-tuple", lambda at: point(guess=lambda key: (jnp.zeros((10, 2)), jnp.zeros((10, 2)))),
     "guess returned a tuple"),
    ("program-size", lambda at: from_program(0, cost=lambda x: 0.0), "size is 0"),
    ("program-text", lambda at: from_program("2", cost=lambda x: 0.0), "size is '2'"),
    ("program-no-cost", lambda at: from_program(2), "program has no cost"),
    ("program-cost", lambda at: from_program(2, cost=7), "cost is 7"),
    ("program-vector", lambda at: from_program(2, cost=lambda x: x), "shape (2,)", "residual"),
    ("program-solved", lambda at: solve(at.program), "use mjx_drax.minimize"),
    ("program-trajectory", lambda at: minimize(at.point), "use mjx_drax.solve"),
    ("program-guess", lambda at: minimize(at.program, 2, guess=[1.0, 2.0, 3.0]),
     "guess has shape (3,)"),
    ("program-guess-text", lambda at: minimize(at.program, 2, guess="origin"), "guess is 'origin'"),
    ("program-nan", lambda at: minimize(from_program(2, cost=lambda x: x @ x / 0), 2),
     "value of cost"),
]
# fmt: on


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
    ("restarts-enough", lambda at: solve(at.point, solver=Restarts(enough="most")),
     "enough is 'most'"),
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
    ("progress", lambda at: solve(at.point, 2, progress=True), "progress is True"),
    ("record-0", lambda at: solve(at.point, 2, record=0), "record is 0"),
    ("record-half", lambda at: solve(at.point, 2, record=0.5), "record is 0.5"),
    ("devices-99", lambda at: solve(at.point, 2, devices=99), "devices is 99", "1 to"),
    ("devices-text", lambda at: solve(at.point, 2, devices="gpu"), "devices is 'gpu'"),
    ("devices-0", lambda at: solve(at.point, 2, devices=0), "devices is 0"),
    ("tolerance", lambda at: distinct(at.seen, 0), "tolerance is 0"),
    ("tolerance-nan", lambda at: distinct(at.seen, NAN), "tolerance is nan"),
]
# fmt: on

MOVED = np.linspace(-0.1, 0.1, 6).reshape(3, 2).astype(np.float32)


def moved(x):
    """The good problem, from elsewhere."""
    return replace(parts()["point"], x_init=x)


def family(make=moved, values=MOVED, **arguments):
    return solve_batch(make, values, **{"chains": 2, **arguments})


def bounded(x):
    """A problem with bounds that x may leave."""
    return replace(parts()["kept"], x_init=x)


# fmt: off
BATCHES = [
    ("make-none", lambda at: family(None), "make is None"),
    ("make-raises", lambda at: family(fails), "make failed for value 0", "no such sensor"),
    ("make-returns-none", lambda at: family(lambda x: None), "the problem is None"),
    ("make-constant", lambda at: family(lambda x: at.point), "same problem for every value"),
    ("make-checks-traced", lambda at: family(at.point.with_x_init),
     "make failed when it was traced", "replace"),
    ("make-branches", lambda at: family(lambda x: moved(x if x[0] > 0 else -x)),
     "make failed when it was traced"),
    ("make-other-model", lambda at: family(lambda g: robot(arm(option=f'gravity="0 0 {g[0]}"'))),
     "make failed when it was traced", "takes numbers"),
    ("values-none", lambda at: family(values=None), "values", "first axis"),
    ("values-empty", lambda at: family(values=np.zeros((0, 2))), "values", "stack"),
    ("values-number", lambda at: family(values=1.0), "values", "stack"),
    ("values-texts", lambda at: family(values=["a", "b"]), "values are ['a', 'b']"),
    ("values-unequal", lambda at: family(lambda v: moved(v[0]), (MOVED, np.zeros(2))),
     "(2,), (3,)"),
    ("values-nan", lambda at: family(values=np.where(MOVED > 0, MOVED, NAN)), "x_init is", "nan"),
    ("values-one-nan", lambda at: family(values=np.array([[0, 0], [0, NAN], [1, 1.0]], "f")),
     "problem 1 of 3"),
    ("values-infinite", lambda at: family(values=np.array([[0, 0], [INF, 0]], "f")),
     "problem 1 of 2", "finite"),
    ("values-outside", lambda at: family(bounded, 9 * np.eye(2, dtype="f")[[1, 1]] * [[0], [1]]),
     "problem 1 of 2", "outside"),
    ("values-crossed",
     lambda at: family(
         lambda b: replace(
             at.point,
             bounds=replace(at.point.bounds, x_upper=b + jnp.zeros(2), x_lower=jnp.zeros(2) - 1),
         ),
         np.array([1.0, -2.0], "f"),
     ),
     "problem 1 of 2", "cross"),
    ("values-shape", lambda at: family(values=np.zeros((3, 5), "f")), "x_init has shape (5,)", "2"),
    ("chunk-0", lambda at: family(chunk=0), "chunk is 0"),
    ("chunk-text", lambda at: family(chunk="all"), "chunk is 'all'"),
    ("batch-chains", lambda at: family(chains=-1), "chains is -1"),
    ("batch-seed", lambda at: family(seed=0.5), "seed is 0.5"),
    ("batch-solver", lambda at: family(solver="fast"), "solver is 'fast'"),
    ("batch-devices", lambda at: family(devices=7), "devices is 7"),
    ("batch-progress", lambda at: family(progress="bar"), "progress is 'bar'"),
]
# fmt: on

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
    ("mpc-reset-time", lambda at: MPC(at.robot).reset([0.0, 0.0], "now"), "time t is 'now'"),
    ("mpc-plan-shape", lambda at: at.policy().plan(np.zeros(3), 0.0),
     "state x has shape (3,)", "2"),
    ("mpc-plan-text", lambda at: at.policy().plan("here", 0.0), "state x is 'here'"),
    ("mpc-control-shape", lambda at: at.policy().control(np.zeros((1, 2)), 0.0), "(1, 2)"),
    ("mpc-control-none", lambda at: at.policy().control(None, 0.0), "state x"),
    ("mpc-control-time", lambda at: at.policy().control(np.zeros(2), NAN), "time t is nan"),
    ("mpc-call-shape", lambda at: at.policy()(np.zeros(1), 0.1), "state x has shape (1,)"),
    ("background-no-plan", lambda at: Background(MPC(at.robot)), "no plan yet"),
    ("background-shape", lambda at: Background(at.policy())(np.zeros(5), 0.0), "(5,)"),
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
    ("push-tuple", lambda at: Plant(at.robot, pushes=[(0.0, "link")]), "a push is (0.0, 'link')"),
    ("simulate-nan", lambda at: simulate(at.policy(), Plant(at.robot), NAN), "duration is nan"),
]
# fmt: on

# fmt: off
TERMS = [
    ("terms-model", lambda at: Terms("gone.xml"), "gone.xml"),
    ("terms-problem", lambda at: Terms(at.robot), "the model is"),
    ("posture-joint", lambda at: at.on.posture({"knee": 0.0}), "no joint 'knee'", "'elbow'"),
    ("posture-keyframe", lambda at: at.on.posture("hoem"), "no keyframe 'hoem'", "'home'"),
    ("posture-length", lambda at: at.on.posture([0.0, 0.0]), "posture is [0.0, 0.0]", "1 number"),
    ("posture-nan", lambda at: at.on.posture([NAN]), "posture is [nan]", "finite"),
    ("posture-empty", lambda at: at.on.posture({}), "no joint is named"),
    ("posture-text-value", lambda at: at.on.posture({"elbow": "up"}), "'elbow' is 'up'"),
    ("posture-rotation", lambda at: Terms(arm(BALL)).posture({"hip": [0, 0, 0, 0]}),
     "must not be zero"),
    ("velocity-joint", lambda at: at.on.velocity("wrist"), "no joint 'wrist'"),
    ("velocity-number", lambda at: at.on.velocity(0), "no joint 0"),
    ("velocity-target", lambda at: at.on.velocity(target=[1, 2, 3]),
     "target of velocity", "[1, 2, 3]"),
    ("control-actuator", lambda at: at.on.control("motor"), "no actuator 'motor'", "'torque'"),
    ("control-weight", lambda at: at.on.control(weight=-1.0), "weight of control is -1.0"),
    ("control-weight-nan", lambda at: at.on.control(weight=NAN), "weight of control is nan"),
    ("control-at-end", lambda at: robot(terminal_residual=at.on.control()),
     "no control at the end"),
    ("sensor", lambda at: at.on.sensor("gyro"), "no sensor 'gyro'", "'angle'"),
    ("site", lambda at: at.on.site("top", [0, 0, 0]), "no site 'top'", "'tip'"),
    ("site-none", lambda at: at.on.site(None, [0, 0, 0]), "no site None"),
    ("site-target", lambda at: at.on.site("tip"), "site 'tip' has no target", "give"),
    ("site-plane", lambda at: at.on.site("tip", [0, 0]), "position of site 'tip' is [0, 0]"),
    ("site-matrix", lambda at: at.on.site("tip", orientation=2 * np.eye(3)), "rotation matrix"),
    ("site-weight", lambda at: at.on.site("tip", [0, 0, 0], weight=[1, 2]), "weight of site 'tip'"),
    ("body", lambda at: at.on.body("lnik", [0, 0, 0]), "no body 'lnik'", "'link'"),
    ("upright-axis", lambda at: at.on.upright("link", axis=[0, 0, 0]), "axis", "not be zero"),
    ("upright-body", lambda at: at.on.upright("torso"), "no body 'torso'"),
    ("com-text", lambda at: at.on.centre_of_mass("here"), "centre_of_mass is 'here'"),
    ("clearance-geom", lambda at: at.on.clearance("stick", "tray"), "no geom 'stick'", "'rod'"),
    ("clearance-itself", lambda at: at.on.clearance("rod", "rod"), "'rod' with itself", "give"),
    ("clearance-kind", lambda at: at.on.clearance("tray", "tray2"), "no geom 'tray2'"),
    ("clearance-margin", lambda at: Terms(arm(POST)).clearance("rod", "post", margin=NAN),
     "margin of clearance is nan"),
    ("clearance-none", lambda at: at.on.clearance([], "rod"), "no geom is named"),
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

# fmt: off
FILES = [
    ("load-missing", lambda at: Solution.load(at.folder / "gone"), "gone", "result.json", "Give"),
    ("load-none", lambda at: Solution.load(None), "path is None"),
    ("load-number", lambda at: Solution.load(3), "path is 3"),
    ("load-null", lambda at: Solution.load("a\0b"), "null character"),
    ("load-file", lambda at: Solution.load(at.file("result.json", "{}")),
     "result.json", "cannot read"),
    ("load-empty-folder", lambda at: Solution.load(at.folder), "result.json", "Give a folder"),
    ("load-no-arrays",
     lambda at: ((at.saved() / "result.npz").unlink(), Solution.load(at.folder / "result")),
     "result.npz", "cannot read"),
    ("load-folder-as-file",
     lambda at: (
         (at.saved() / "result.npz").unlink(),
         (at.folder / "result/result.npz").mkdir(),
         Solution.load(at.folder / "result"),
     ),
     "result.npz"),
    ("json-empty",
     lambda at: (at.file("result.json"), at.file("result.npz"), Solution.load(at.folder)),
     "no JSON object"),
    ("json-list",
     lambda at: (at.file("result.json", "[1]"), at.file("result.npz"), Solution.load(at.folder)),
     "no JSON object"),
    ("json-binary",
     lambda at: (
         at.file("result.json", b"\xff\xfe\0"),
         at.file("result.npz"),
         Solution.load(at.folder),
     ),
     "damaged"),
    ("json-other",
     lambda at: (
         at.file("result.json", '{"a": 1}'),
         at.file("result.npz"),
         Solution.load(at.folder),
     ),
     "no format number"),
    ("json-deep",
     lambda at: (
         at.file("result.json", "[" * 99999),
         at.file("result.npz"),
         Solution.load(at.folder),
     ),
     "damaged"),
    ("json-versions", lambda at: Solution.load(at.saved(format=2, versions=[])), "format 2"),
    ("json-future", lambda at: Solution.load(at.saved(format=99)), "format 99", "solve again"),
    ("json-edited",
     lambda at: (
         at.saved(),
         (at.folder / "result/result.json").write_text(
             (at.folder / "result/result.json").read_text().replace('"seed": 0', '"seed": 1')
         ),
         Solution.load(at.folder / "result"),
     ),
     "changed after", "json_sha256"),
    ("json-horizon", lambda at: Solution.load(at.saved(horizon="five")), "damaged"),
    ("json-horizon-other", lambda at: Solution.load(at.saved(horizon=7)), "damaged", "(2, 7, 2)"),
    ("json-dt", lambda at: Solution.load(at.saved("sketch", dt=-1.0)),
     "dt of the saved solution is -1.0"),
    ("json-dt-text", lambda at: Solution.load(at.saved(dt=None)), "damaged"),
    ("json-seed", lambda at: Solution.load(at.saved(seed="lucky")), "seed", "'lucky'"),
    ("json-solver", lambda at: Solution.load(at.saved(settings={"part": "GaussNewton"})),
     "solver", "GaussNewton"),
    ("json-settings", lambda at: Solution.load(at.saved(settings={"part": "Langevin", "speed": 9})),
     "speed"),
    ("json-no-certificate", lambda at: Solution.load(at.saved(certificate={})),
     "damaged", "'engine'"),
    ("json-mujoco", lambda at: Solution.load(at.saved("seen", versions={})), "damaged", "mujoco"),
    ("npz-digest",
     lambda at: (cut_short(at.saved() / "result.npz"), Solution.load(at.folder / "result")),
     "does not belong"),
    ("npz-cut-short", lambda at: Solution.load(at.repacked(cut_short)), "result.npz", "damaged"),
    ("npz-empty", lambda at: Solution.load(at.repacked(lambda path: path.write_bytes(b""))),
     "damaged"),
    ("npz-text", lambda at: Solution.load(at.repacked(lambda path: path.write_text("x = 3"))),
     "damaged"),
    ("npz-is-a-pickle",
     lambda at: Solution.load(at.repacked(lambda path: path.write_bytes(pickle.dumps({"x": 1})))),
     "damaged", "pickle"),
    ("npz-holds-a-pickle", lambda at: Solution.load(at.repacked(with_pickle)),
     "damaged", "allow_pickle"),
    ("npz-no-members", lambda at: Solution.load(at.repacked(without_members)),
     "damaged", "Solve again"),
    ("npz-garbled", lambda at: Solution.load(at.repacked(garbled_member)), "damaged"),
    ("npz-npy",
     lambda at: Solution.load(at.repacked(lambda path: np.save(path.open("wb"), np.zeros(3)))),
     "damaged"),
    ("npz-no-gains", lambda at: Solution.load(at.arrays(solution__gains=None)),
     "damaged", "solution.gains"),
    ("npz-fewer-costs", lambda at: Solution.load(at.arrays(chain_cost=np.zeros(1))),
     "cost", "(2,)"),
    ("npz-texts", lambda at: Solution.load(at.arrays(chain_cost=np.array(["a", "b"]))),
     "cost is <U1"),
    ("npz-flat", lambda at: Solution.load(at.arrays(solution__trajectories__x=np.zeros(3))),
     "damaged"),
    ("npz-controls",
     lambda at: Solution.load(at.arrays(solution__trajectories__u=np.zeros((2, 5, 9)))),
     "damaged"),
    ("npz-replay",
     lambda at: Solution.load(at.arrays(solution__feedback__states=np.zeros((2, 1, 2)))),
     "feedback.states"),
    ("npz-replay-extra",
     lambda at: Solution.load(at.arrays(solution__feedback__colour=np.zeros(2))),
     "damaged", "colour"),
    ("npz-model", lambda at: Solution.load(at.arrays(model__binary=np.zeros(99, np.uint8))),
     "damaged", "mj_loadModel"),
    ("load-problem", lambda at: Solution.load(at.saved(), at.point), "K = 10", "has 5"),
    ("load-problem-text", lambda at: Solution.load(at.saved(), arm()), "the problem is"),
    ("save-none", lambda at: at.seen.save(None), "path is None"),
    ("save-under-file", lambda at: at.seen.save(at.file("f") / "out"), "cannot write", "Choose"),
    ("save-on-file", lambda at: at.seen.save(at.file("f")), "cannot write", "/f/"),
    ("certify-loaded", lambda at: Solution.load(at.saved("sketch")).certify(),
     "not saved", "Solution.load(folder, problem)"),
    ("solve-loaded", lambda at: solve(Solution.load(at.saved()).problem, 1),
     "is code, which is not saved"),
]
# fmt: on


def frames(**arguments):
    model = parts()["robot"].dynamics.mj_model
    return render_frames(
        model, **{"qpos": np.zeros((2, 1)), "times": [0, 1], "size": (16, 16), **arguments}
    )


def film(at, **arguments):
    return render(at.seen, at.folder / "a.gif", **{"size": (16, 16), "fps": 1, **arguments})


# fmt: off
PICTURES = [
    ("film-suffix", lambda at: render(at.seen, at.folder / "film.avi"),
     "film.avi", ".mp4", "change"),
    ("film-none", lambda at: render(at.seen, None), "path is None"),
    ("film-folder",
     lambda at: ((at.folder / "a.mp4").mkdir(), render(at.seen, at.folder / "a.mp4")),
     "folder"),
    ("film-under-file", lambda at: render(at.seen, at.file("f") / "a.mp4"),
     "cannot write", "choose"),
    ("fps-nan", lambda at: film(at, fps=NAN), "fps is nan"),
    ("fps-0", lambda at: film(at, fps=0), "fps is 0"),
    ("fps-text", lambda at: film(at, fps="fast"), "fps is 'fast'"),
    ("speed-negative", lambda at: film(at, speed=-1.0), "speed is -1.0"),
    ("speed-infinite", lambda at: film(at, speed=INF), "speed is inf"),
    ("size-0", lambda at: film(at, size=(0, 0)), "size is (0, 0)", "(height, width)"),
    ("size-one", lambda at: film(at, size=(480,)), "size is (480,)"),
    ("size-number", lambda at: film(at, size=480), "size is 480"),
    ("size-text", lambda at: film(at, size="640x480"), "size is '640x480'"),
    ("size-nan", lambda at: film(at, size=(NAN, 480)), "size is (nan, 480)"),
    ("size-huge", lambda at: film(at, size=(480, 10**9)), "size is (480, 1000000000)", "8192"),
    ("camera-name", lambda at: film(at, camera="side"), "no camera 'side'", "'free'"),
    ("camera-number", lambda at: film(at, camera=7), "no camera 7"),
    ("camera-half", lambda at: film(at, camera=0.5), "no camera 0.5"),
    ("film-no-model", lambda at: render(at.sketch, at.folder / "a.gif"), "no model", "pass draw="),
    ("motion-nan", lambda at: frames(qpos=[[0.0], [NAN]]), "qpos", "finite"),
    ("motion-shape", lambda at: frames(qpos=np.zeros((2, 3))), "(2, 3)"),
    ("motion-times", lambda at: frames(times=[1, 0]), "times"),
    ("overlay", lambda at: frames(overlay="hello"), "overlay is 'hello'", "list"),
    ("diffusion-unrecorded", lambda at: render_diffusion(at.seen, at.folder / "a.gif"),
     "no recording", "record=1"),
    ("timelapse-count", lambda at: render_timelapse(at.seen, at.folder / "a.png", count=0),
     "count is 0"),
    ("timelapse-suffix", lambda at: render_timelapse(at.seen, at.folder / "a.jpg"),
     "a.jpg", ".png"),
    ("timelapse-no-model", lambda at: render_timelapse(at.sketch, at.folder / "a.png"),
     "point has no model"),
    ("plot-suffix", lambda at: plot_solution(at.seen, at.folder / "a.svg"),
     "a.svg", ".png", "rename"),
    ("plot-under-file", lambda at: plot_solution(at.seen, at.file("f") / "a.png"), "cannot write"),
    ("plot-no-optima", lambda at: plot_optima(at.lost, at.folder / "a.png"), "no optima", "See"),
    ("phase-function",
     lambda at: plot_phase(made_up(point(x_init=[0.0] * 3, nu=3)), at.folder / "a.png"),
     "point"),
    ("csv-suffix", lambda at: save_csv(at.seen, at.folder / "a.txt"), "a.txt", ".csv", "rename"),
    ("csv-folder",
     lambda at: ((at.folder / "a.csv").mkdir(), save_csv(at.seen, at.folder / "a.csv")),
     "it is a folder"),
    ("csv-none", lambda at: save_csv(at.seen, None), "path is None"),
    ("keyframes-function", lambda at: export_keyframes(at.sketch, at.folder / "a.xml"),
     "no MuJoCo model", "save_csv"),
    ("keyframes-model",
     lambda at: export_keyframes(
         made_up(robot(mujoco.MjModel.from_xml_string(arm()))), at.folder / "a.xml"
     ),
     "cannot be written", "give"),
    ("keyframes-suffix", lambda at: export_keyframes(at.seen, at.folder / "a.mjb"),
     "a.mjb", ".xml"),
    ("dataset-suffix", lambda at: save_dataset(at.seen, at.folder / "a.csv"), "a.csv", ".h5"),
    ("dataset-uncertified", lambda at: save_dataset(at.lost, at.folder / "a.h5"),
     "no chain is certified", "everything=True"),
    ("dataset-none", lambda at: save_dataset([], at.folder / "a.h5"), "empty"),
    ("html-function", lambda at: save_html(at.sketch, at.folder / "a.html"),
     "no MuJoCo model", "see"),
    ("html-ghosts", lambda at: save_html(at.seen, at.folder / "a.html", ghosts=-1), "ghosts is -1"),
    ("html-ghosts-half", lambda at: save_html(at.seen, at.folder / "a.html", ghosts=1.5),
     "ghosts is 1.5"),
    ("html-suffix", lambda at: save_html(at.seen, at.folder / "a.pdf"), "a.pdf", ".html", "rename"),
]
# fmt: on

GROUPS = {
    "model": MODELS,
    "argument": ARGUMENTS,
    "cost": COSTS,
    "function": FUNCTIONS,
    "setting": SETTINGS,
    "batch": BATCHES,
    "loop": LOOPS,
    "term": TERMS,
    "file": FILES,
    "picture": PICTURES,
}
CASES = [
    pytest.param(call, words, id=f"{group}-{name}")
    for group, cases in GROUPS.items()
    for name, call, *words in cases
]

FIXES = re.compile(
    r"\b(add|call|change|check|choose|clear|correct|drive|give|install|keep|leave|load|make|map|"
    r"move|must|narrow|needs|pass|remove|rename|return|route|scale|see|set|solve|stack|there is|"
    r"undo|use|widen)\b",
    re.IGNORECASE,
)
"""Words that say what to do; where names are listed, that is what to choose from."""


@pytest.fixture(autouse=True)
def nothing_iterates(monkeypatch):
    """A solve that gets as far as its first iteration has not complained in time."""

    def far(*_, **__):
        pytest.fail("it got as far as iterating")

    monkeypatch.setattr("mjx_drax.search.restarts._init", far)
    monkeypatch.setattr("mjx_drax.search.restarts._advance", far)
    monkeypatch.setattr("mjx_drax.solution.batch._flowed", far)
    monkeypatch.setattr("mjx_drax.control.mpc._plan", far)


def complaint(call):
    """What a call complains of, if it does so properly."""
    with pytest.raises(DraxError) as caught:
        call()
    assert type(caught.value) is DraxError
    message = str(caught.value)
    assert len(message) <= 400, message
    for mark in ("\n", "Traced<", "Tracer<", "Traceback", "jax._src", "0x7f", "ShapedArray("):
        assert mark not in message, message
    assert FIXES.search(message), message
    return message


@pytest.mark.parametrize(("call", "words"), CASES)
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    message = complaint(lambda: call(At(tmp_path)))
    for word in words:
        assert word in message, message


def test_there_are_hundreds_of_cases():
    assert len({case.id for case in CASES}) == len(CASES) >= 200


GOOD_COST = (
    "import jax.numpy as jnp\nhorizon = 0.1\ndef terminal_residual(data):\n    return data.qpos\n"
)


def own(at, cost=GOOD_COST, model=None, *more):
    """A solve of one's own model and cost file."""
    files = at.file("arm.xml", arm() if model is None else model), at.file("cost.py", cost)
    return ["solve", "--model", *map(str, files[:1]), "--cost", str(files[1]), *more]


def task(*more):
    return lambda at: ["solve", "pendulum", "--out", str(at.folder), *more]


# fmt: off
COMMANDS = [
    ("none", lambda at: [], "COMMAND"),
    ("unknown", lambda at: ["sovle"], "sovle"),
    ("option", lambda at: ["solve", "pendulum", "--chain-count", "3"], "--chain-count"),
    ("nothing-to-solve", lambda at: ["solve"], "give a task"),
    ("task", lambda at: ["solve", "pendulumm"], "pendulumm", "pendulum_swingup"),
    ("task-and-model", task("--model", "a.xml"), "choose one"),
    ("chains-0", task("--chains", "0"), "--chains", "'0'", "whole number"),
    ("chains-text", task("--chains", "many"), "--chains", "'many'"),
    ("iterations-negative", task("--iterations", "-5"), "--iterations"),
    ("seed-text", task("--seed", "lucky"), "--seed", "'lucky'"),
    ("seed-negative", task("--seed", "-1", "--no-video"), "seed is -1"),
    ("horizon-text", task("--horizon", "long"), "--horizon", "'long'"),
    ("horizon-nan", task("--horizon", "nan"), "horizon is nan"),
    ("horizon-negative", task("--horizon", "-1"), "horizon is -1.0"),
    ("set-without-value", task("--set", "attempts"), "NAME=VALUE"),
    ("set-unknown", task("--set", "attempt=1"), "no setting 'attempt'", "choose one of"),
    ("set-text", task("--set", "attempts=many"), "attempts is 'many'"),
    ("set-0", task("--set", "attempts=0"), "attempts is 0"),
    ("set-nan", task("--set", "flow.noise=nan"), "flow.noise is 'nan'"),
    ("set-negative", task("--set", "flow.noise=-1"), "noise.value is -1.0"),
    ("set-part", task("--set", "flow.bounds=Wall"), "flow.bounds is 'Wall'", "Projection"),
    ("size", task("--size", "640"), "--size", "640x480"),
    ("size-0", lambda at: ["solve", "cartpole_swingup", "--size", "0x0"], "size is (0, 0)"),
    ("fps", task("--fps", "fast"), "--fps"),
    ("fps-nan", lambda at: ["solve", "cartpole_swingup", "--fps", "nan"], "fps is nan"),
    ("speed-0", lambda at: ["solve", "cartpole_swingup", "--speed", "0"], "speed is 0.0"),
    ("camera", lambda at: ["solve", "cartpole_swingup", "--camera", "x"], "no camera 'x'"),
    ("film-no-model", task("--film"), "draw="),
    ("film-suffix", lambda at: ["solve", "bug_trap", "--film", "a.avi", "--out", str(at.folder)],
     "a.avi", ".gif"),
    ("html-no-model", task("--html"), "no MuJoCo model"),
    ("keyframes-no-model", task("--keyframes"), "no MuJoCo model"),
    ("out-under-file", lambda at: ["solve", "pendulum", "--out", str(at.file("f") / "out")],
     "cannot write", "--out"),
    ("model-missing",
     lambda at: ["solve", "--model", "gone.xml", "--cost", str(at.file("cost.py", GOOD_COST))],
     "gone.xml"),
    ("model-alone", lambda at: ["solve", "--model", "gone.xml"], "--cost"),
    ("model-broken", lambda at: own(at, model="<mujoco"), "cannot compile"),
    ("model-empty", lambda at: own(at, model=""), "arm.xml"),
    ("cost-missing",
     lambda at: ["solve", "--model", str(at.file("arm.xml", arm())), "--cost", "gone.py"],
     "gone.py"),
    ("cost-no-python",
     lambda at: [
         "solve",
         "--model",
         str(at.file("arm.xml", arm())),
         "--cost",
         str(at.file("cost.txt", "hi")),
     ],
     "cost.txt", ".py"),
    ("cost-syntax", lambda at: own(at, "def cost(:"), "cost.py", "SyntaxError"),
    ("cost-binary", lambda at: own(at, bytes(range(256))), "cost.py", "Correct"),
    ("cost-raises", lambda at: own(at, "1 / 0"), "ZeroDivisionError"),
    ("cost-exits", lambda at: own(at, "raise SystemExit(0)"), "SystemExit"),
    ("cost-import", lambda at: own(at, "import no_such_module"), "no_such_module"),
    ("cost-empty", lambda at: own(at, "horizon = 0.1"), "no cost"),
    ("cost-no-horizon", lambda at: own(at, "def terminal_cost(data):\n    return data.qpos[0]"),
     "--horizon"),
    ("cost-vector",
     lambda at: own(at, "horizon = 0.1\ndef terminal_cost(data):\n    return data.qpos"),
     "terminal_cost", "scalar"),
    ("cost-no-function", lambda at: own(at, "horizon = 0.1\nterminal_cost = 3"),
     "terminal_cost is 3"),
    ("cost-solver", lambda at: own(at, GOOD_COST + "solver = 'fast'"), "'fast'", "Restarts"),
    ("cost-x_init", lambda at: own(at, GOOD_COST + "x_init = [1, 2, 3]"), "x_init has 3"),
    ("export-missing", lambda at: ["export", str(at.folder / "gone"), "--csv"], "gone"),
    ("export-nothing", lambda at: ["export", str(at.folder)], "--csv", "at least one"),
    ("export-damaged",
     lambda at: (
         cut_short(at.saved() / "result.npz"),
         ["export", str(at.folder / "result"), "--csv"],
     )[1],
     "does not belong"),
    ("export-no-model", lambda at: ["export", str(at.saved("sketch")), "--keyframes"],
     "no MuJoCo model"),
    ("check-missing", lambda at: ["check", "gone.xml"], "gone.xml"),
    ("check-binary", lambda at: ["check", str(at.file("a.xml", b"\0\1"))], "a.xml"),
    ("benchmark-task", lambda at: ["benchmark", "tetris"], "tetris"),
    ("benchmark-suite", lambda at: ["benchmark", "--suite", "tpu"], "tpu"),
    ("benchmark-seed", lambda at: ["benchmark", "pendulum", "--seeds", "x"], "--seeds"),
    ("reproduce", lambda at: ["reproduce", "figure-9"], "figure-9"),
    ("mpc-task", lambda at: ["mpc", "tetris"], "tetris"),
    ("mpc-function", lambda at: ["mpc", "pendulum", "--out", str(at.folder)], "no model"),
    ("mpc-chains", lambda at: ["mpc", "cartpole", "--chains", "0"], "--chains"),
    ("mpc-explorers", lambda at: ["mpc", "cartpole", "--explorers", "9"], "explorers is 9"),
    ("mpc-mass", lambda at: ["mpc", "cartpole", "--mass", "nan"], "mass is nan"),
    ("mpc-noise", lambda at: ["mpc", "cartpole", "--noise", "-1"], "noise is -1.0"),
    ("mpc-pushes", lambda at: ["mpc", "cartpole", "--pushes", "-1"], "pushes is -1"),
    ("mpc-push", lambda at: ["mpc", "cartpole", "--push", "nan"], "push is nan"),
    ("mpc-duration", lambda at: ["mpc", "cartpole", "--duration", "nan"], "duration is nan"),
    ("mpc-duration-short",
     lambda at: ["mpc", "cartpole", "--duration", "1", "--out", str(at.folder)],
     "leaves no time for pushes"),
    ("mpc-hold", lambda at: ["mpc", "cartpole", "--hold", "inf"], "hold is inf"),
]
# fmt: on


@pytest.mark.parametrize(
    ("arguments", "words"), [pytest.param(call, words, id=name) for name, call, *words in COMMANDS]
)
def test_bad_commands_give_one_line(arguments, words, tmp_path, capsys):
    given = arguments(At(tmp_path))
    capsys.readouterr()
    try:
        status = cli.main(given)
    except SystemExit as stop:  # of argparse
        status = stop.code
    printed = capsys.readouterr()
    assert status == 2, printed
    assert "Traceback" not in printed.err
    *usage, line = printed.err.strip().splitlines()
    assert line.startswith("mjx-drax"), line
    assert not any(text.startswith("mjx-drax") for text in usage), usage
    for word in words:
        assert word in line, line
    assert printed.out == ""


NOTED = []


def noting(x, u):
    """Keeps count without reading it."""
    NOTED.append(1)
    return x @ x


def jumps(x, u):
    """As no exact derivative follows it."""
    return jnp.round(x).sum()


SAMPLED = Langevin(preconditioner=GaussNewton(derivatives=Smoothed()))


@pytest.mark.parametrize(
    ("cost", "solver"),
    [
        (lambda x, u: 1.0, Restarts()),
        (lambda x, u: jnp.zeros(()), Restarts()),
        (lambda x, u: jax.nn.relu(x).sum() + jnp.abs(u).sum(), Restarts()),
        (lambda x, u: jnp.where(x > 0, x, 0.0).sum(), Restarts()),
        (lambda x, u: jax.lax.cond(x[0] > 0, jnp.sum, jnp.prod, x), Restarts()),
        (lambda x, u: jumps(x, u) + u @ u, Restarts()),
        (noting, Restarts()),
        (called_back, SAMPLED),
        (jumps, SAMPLED),
        (jumps, Langevin(preconditioner=Identity(), adjusted=True)),
    ],
    ids=[
        "constant",
        "zero",
        "relu",
        "where",
        "cond",
        "partly",
        "notes",
        "callback",
        "jumps",
        "law",
    ],
)
def test_what_only_looks_bad_is_accepted(cost, solver):
    solver.check(point(running_cost=cost))


def test_a_reverse_rule_is_enough_for_a_flow_that_needs_no_other():
    Langevin(preconditioner=LBFGS()).check(from_program(2, cost=backwards))


@pytest.mark.parametrize("bounds", [None, (-INF, INF), (-INF, 1.0), np.array([[-1, -1], [1, 1]])])
def test_bounds_that_leave_room_are_accepted(bounds):
    assert np.isfinite(point(x_bounds=bounds).scatter.x_upper).all()
