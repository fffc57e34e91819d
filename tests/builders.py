"""What many tests are made of: small problems, solutions, and what a good error looks like."""

import functools
import json
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax import (
    DraxError,
    Restarts,
    Solution,
    Terms,
    Trajectory,
    from_dynamics,
    from_function,
    from_mjcf,
    from_program,
)
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.model import Multipliers
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.problem.trajectory import Stagewise
from mjx_drax.search.family import Family
from mjx_drax.solution.export import NothingToExport
from mjx_drax.solution.replay import Replays, judged
from mjx_drax.solution.violations import KINDS, Tolerances, Violations, driven_extents

INF, NAN = math.inf, math.nan

# Problems


def arm(body="", option='timestep="0.01"', actuator=None, more="", joint=""):
    """MJCF of one link that a motor turns, and what is put into it."""
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
"""A body of `arm` that turns freely."""


def point(**changes):
    """A problem from a function; the defaults are good."""
    given = {"f": lambda x, u: x + 0.1 * u, "x_init": [0.0, 0.0], "nu": 2, "dt": 0.1}
    given |= {"horizon": 1.0, "terminal_residual": lambda x: x - 1.0, "name": "point"}
    return from_function(**{**given, **changes})


DT, K = 0.1, 20
"""Of `double_integrator`."""


def double_integrator(f=None, **changes):
    """x = [p, v] pushed by u."""
    given = {"x_init": [0.0, 0.0], "nu": 1, "dt": DT, "horizon": K * DT, "name": "cart"}
    return from_function(f or (lambda x, u: x + DT * jnp.stack([x[1], u[0]])), **given | changes)


GOAL = np.array([1.0, 0.0])
"""Of `fastest`."""


def pushed(x, u, knot):
    """A unit mass pushed by u, held over the step."""
    h = knot.dt
    return jnp.stack([x[0] + h * x[1] + 0.5 * h * h * u[0], x[1] + h * u[0]])


def fastest(**changes):
    """The double integrator from rest to rest in the least time, |u| <= 1."""
    given = {
        "f": pushed,
        "x_init": np.zeros(2),
        "nu": 1,
        "horizon": (0.5, 5.0),
        "knots": 20,
        "running_cost": lambda x, u, knot: knot.dt,
        "terminal_equality": lambda x: x - GOAL,
        "u_bounds": (-1.0, 1.0),
        "name": "fastest",
    }
    return from_function(**given | changes)


def matrices(push=None):
    """G and c of x_1..x_K = G u + c for the double integrator with an acceleration push (K,)."""
    A, B = np.array([[1, DT], [0, 1.0]]), np.array([0, DT])
    G, c = np.zeros((K, 2, K)), np.zeros((K, 2))
    push = np.zeros(K) if push is None else push
    for k in range(K):
        before = (G[k - 1], c[k - 1]) if k else (np.zeros((2, K)), np.zeros(2))
        G[k], c[k] = A @ before[0], A @ before[1] + B * push[k]
        G[k, :, k] += B
    return G, c


def robot(model=None, **changes):
    """A problem from MJCF; the defaults are good."""
    given = {"horizon": 0.1, "terminal_residual": lambda data: data.qpos}
    return from_mjcf(arm() if model is None else model, **{**given, **changes})


@register_dataclass
@dataclass(frozen=True)
class Bouncing(FunctionDynamics):
    """A ball on a stiff floor: f has a kink where they touch."""

    kinked = True


def bouncing(kinked=Bouncing):
    """A ball of 1 kg that bounces on a floor of 300 N/m, with a thrust of 3 N to help it up.

    kinked is the class of its dynamics; None for one that does not tell of the kink.
    """

    def ball(x, u):
        v = x[1] + 0.05 * (u[0] - 9.81 + 300.0 * jnp.maximum(0.0, -x[0]))
        return jnp.array([x[0] + 0.05 * v, v])

    rest = {
        "x_init": [1.0, 0.0],
        "horizon": 2.0,
        "running_residual": lambda x, u: 0.1 * u,
        "terminal_residual": lambda x: 10.0 * (x - jnp.array([0.9, 0.0])),
        "u_bounds": (-3.0, 3.0),
        "x_scatter": ([-0.5, -8.0], [1.5, 8.0]),
        "goal": lambda x: abs(x[0] - 0.9) < 0.1 and abs(x[1]) < 0.5,
    }
    if kinked is None:
        return from_function(ball, nu=1, dt=0.05, **rest)
    return from_dynamics(kinked(Partial(ball), 0.05, 2, 1), **rest)


def replays(problem, trajectories, gains, tolerances=None):
    """Every chain's controls, applied from x_0 with the given feedback gains, and judged."""
    with problem.arithmetic():
        plan = np.asarray(problem.with_start(trajectories), float)
    u = np.asarray(trajectories.u)
    family, ran = Family.of_one(problem), problem.replay(plan, u, gains)
    extent = driven_extents(family, np.zeros(len(u), int), plan, u)
    return judged(family, plan, extent, ran, tolerances or Tolerances())


def made_up(problem, chains=2):
    """A solution that was never solved for."""
    K, d = problem.horizon, problem.dynamics
    x, u = np.zeros((chains, K, d.nx), np.float32), np.zeros((chains, K, d.nu), np.float32)
    zero, whole = np.zeros(chains, np.float32), np.zeros(chains, int)
    states, good = np.zeros((chains, K + 1, d.nx)), np.ones(chains, bool)
    none = np.zeros((chains, len(KINDS)))
    kept = Violations(none, none + NAN, none.astype(int) - 1, none.astype(int) - 1)
    replays = Replays(states, u, zero, zero, zero, zero, good, kept)
    constraints = Stagewise(np.zeros((chains, K, 0)), np.zeros((chains, 0)))
    return Solution(
        problem=problem,
        solver=Restarts(),
        seed=0,
        trajectories=Trajectory(x, u),
        multipliers=Multipliers(np.zeros((chains, K, d.ndx)), constraints, None),
        gains=np.zeros((chains, K, d.nu, d.ndx)),
        cost=zero,
        max_defect=zero,
        max_violation=zero,
        residual=zero + NAN,
        stalled=zero > 0,
        tolerance=1e-4,
        feasible_since=whole,
        died_at=whole - 1,
        interrupted=False,
        plan=kept,
        open_loop=replays,
        feedback=replays,
        tolerances=Tolerances(),
        history={
            "iteration": np.arange(2),
            "cost": np.zeros((2, chains)),
            "max_defect": np.zeros((2, chains)),
            "residual": np.full((2, chains), NAN),
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
        "bounded": point(x_bounds=(-1, 1)),
        "terms": Terms(arm()),
        "program": from_program(2, cost=lambda x: x @ x),
    }
    good["answer"] = made_up(good["robot"])
    good["point_answer"] = made_up(good["point"])
    good["uncertified"] = replace(good["answer"], max_defect=np.ones(2, np.float32))
    return good


# Bad input: each case is (name, call, words). The call gets an `At` and must raise a DraxError
# whose message holds the words, which name what is wrong and its value.


@dataclass
class At:
    """Where a case takes place: a folder of its own, and the `parts` by name."""

    folder: Path

    def __getattr__(self, name):
        return parts()[name]

    def file(self, name, content=b""):
        """A file with some content."""
        path = self.folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def saved(self, name="answer", **summary):
        """A folder with a saved solution, some entries of result.json replaced."""
        folder = parts()[name].save(self.folder / "result")
        if summary:
            path = folder / "result.json"
            said = {k: v for k, v in json.loads(path.read_text()).items() if k != "json_sha256"}
            path.write_text(json.dumps({**said, **summary}))
        return folder


def cut_short(path):
    """Leaves the first 500 bytes of a file."""
    path.write_bytes(path.read_bytes()[:500])


def cases(**groups):
    """The parameters of a test, from lists of cases; no name twice."""
    found = [
        pytest.param(call, words, id=f"{group}-{name}")
        for group, rows in groups.items()
        for name, call, *words in rows
    ]
    assert len({case.id for case in found}) == len(found)
    return found


FIXES = re.compile(
    r"\b(add|call|change|check|choose|clear|correct|drive|give|install|keep|leave|load|make|map|"
    r"move|must|narrow|needs|pass|remove|rename|return|route|scale|see|set|solve|stack|there is|"
    r"undo|use|widen)\b",
    re.IGNORECASE,
)
"""Words that say what to do; where names are listed, that is what to choose from."""


def assert_complains(call, words):
    """A call raises a DraxError of one short line that says what to do, and holds the words."""
    with pytest.raises(DraxError) as caught:
        call()
    assert type(caught.value) in (DraxError, NothingToExport)
    message = str(caught.value)
    assert len(message) <= 400, message
    for mark in ("\n", "Traced<", "Tracer<", "Traceback", "jax._src", "0x7f", "ShapedArray("):
        assert mark not in message, message
    assert FIXES.search(message), message
    for word in words:
        assert word in message, message


def outcome(call):
    """What a call returns, or the DraxError, which must have something to say."""
    try:
        return call()
    except DraxError as error:
        message = str(error)
        assert 10 < len(message) <= 600
        assert "\n" not in message
        return error


def contacts_of(model):
    """A function that gives the contacts of MJX where the geoms of `mujoco.MjData` are."""
    from mjx_drax.physics.contacts.collision import collision, make_data  # MJX: it takes a second
    from mjx_drax.physics.mjx_model import put_model

    on_device = put_model(model)
    data = make_data(on_device)
    find = jax.jit(
        lambda pos, mat: (
            collision(on_device, data.replace(geom_xpos=pos, geom_xmat=mat))._impl.contact
        )
    )
    return lambda at: find(jnp.asarray(at.geom_xpos), jnp.asarray(at.geom_xmat).reshape(-1, 3, 3))


def assert_touch_alike(model, found, wanted, atol):
    """The contacts of MJX that act are those of the C engine, in any order."""
    acting = np.asarray(found.dist) < model.geom_margin.sum()
    one, other = (np.lexsort(p.round(6).T) for p in (found.pos[acting], wanted.pos))
    for name in ("dist", "pos", "frame"):
        here, there = (np.asarray(getattr(c, name)) for c in (found, wanted))
        there = there[other].reshape(here[acting].shape)
        np.testing.assert_allclose(here[acting][one], there, atol=atol)


def scattered(model, count):
    """Data of the C engine with two free bodies in random poses about each other."""
    import mujoco

    at, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(count):
        at.qpos[:] = rng.normal(size=14)
        at.qpos[:3], at.qpos[7:10] = 0.0, rng.uniform(-0.2, 0.2, 3)
        mujoco.mj_forward(model, at)
        yield at
