"""Terms and distances against MuJoCo's C engine; derivatives, errors, and what recompiles."""

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_drax import DraxError, Terms, from_mjcf, solve
from mjx_drax.modelling.distances import DISTANCES, SPHERE, Shape
from mjx_drax.models import path
from mjx_drax.problem.cost import as_partial

ROBOT = """
<mujoco model="robot">
  <option><flag contact="disable"/></option>
  <worldbody>
    <geom name="table" type="box" size="0.5 0.4 0.05" pos="0.3 0.1 -0.3"/>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -1"/>
    <geom name="egg" type="ellipsoid" size="0.1 0.1 0.2" pos="3 0 0"/>
    <body name="upper"><joint name="shoulder" axis="0 1 0"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/>
      <body name="lower" pos="0.4 0 0"><joint name="wrist" type="ball"/>
        <geom name="hand" size="0.06" pos="0.2 0 0"/>
        <site name="tip" pos="0.3 0 0.1" euler="20 30 40"/></body></body>
    <body name="puck" pos="1 1 1"><freejoint name="flight"/>
      <geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>
      <geom size="0.1" pos="0 2 0"/></body>
  </worldbody>
  <actuator><motor name="lift" joint="shoulder"/><motor name="push" joint="rail"/></actuator>
  <sensor><framepos name="where" objtype="site" objname="tip"/>
    <jointvel name="speed" joint="rail"/></sensor>
  <keyframe><key name="home" qpos="0.3 1 0 0 0 1 1 1 1 0 0 0 0.2"/></keyframe>
</mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(ROBOT)
ON = Terms(MODEL)


def random_state(seed=0):
    """The C engine's data at a random state and control."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(MODEL)
    mujoco.mj_integratePos(MODEL, data.qpos, rng.normal(size=MODEL.nv), 1.0)
    data.qvel[:], data.ctrl[:] = rng.normal(size=MODEL.nv), rng.normal(size=MODEL.nu)
    mujoco.mj_forward(MODEL, data)
    return data


DATA = random_state()
SEEN, U = mjx.put_data(MODEL, DATA), jnp.asarray(DATA.ctrl)


def subtracted(q, target):
    """The C engine's rotation vector target^-1 q."""
    out = np.zeros(3)
    mujoco.mju_subQuat(out, np.asarray(q, float), np.asarray(target, float))
    return out


def quaternion(matrix):
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ravel(matrix))
    return out


def close(a, b, tolerance=2e-6):
    np.testing.assert_allclose(np.asarray(a), b, atol=tolerance)


def all_close(pairs, tolerance=2e-6):
    """Compare terms, seen through `mjx.Data` in one compilation, with what they should be."""
    terms, wanted = zip(*pairs, strict=True)
    found = jax.jit(lambda terms, data, u: [term(data, u) for term in terms])(terms, SEEN, U)
    for a, b in zip(found, wanted, strict=True):
        close(a, b, tolerance)


def test_a_posture_is_the_engines_difference_of_positions():
    home = MODEL.key_qpos[0]
    wanted = np.zeros(MODEL.nv)
    mujoco.mj_differentiatePos(MODEL, wanted, 1.0, home, DATA.qpos)
    named = {"wrist": home[1:5], "rail": 0.2, "flight": home[5:12]}
    all_close(
        [
            (ON.posture("home"), wanted),
            (ON.posture(home, weight=4), 2 * wanted),
            (ON.posture(named), np.concatenate([wanted[1:4], wanted[10:], wanted[4:10]])),
        ]
    )


def test_sites_and_bodies_against_positions_and_orientations():
    turn, matrix = np.array([0.5, 0.5, -0.5, 0.5]), np.zeros(9)
    mujoco.mju_quat2Mat(matrix, turn)
    matrix = matrix.reshape(3, 3)
    site, body = DATA.site("tip"), DATA.body("lower")
    of_site, of_body = subtracted(quaternion(site.xmat), turn), subtracted(body.xquat, turn)
    low, wanted = [0, 0, 1], np.concatenate([[0, 0], body.xpos[2:] - 1, of_body * [1, 1, 3]])
    all_close(
        [
            (ON.site("tip", [1, 2, 3], weight=[1, 4, 0]), (site.xpos - [1, 2, 3]) * [1, 2, 0]),
            (ON.site("tip", orientation=2 * turn), of_site),
            (ON.body("lower", position=low), body.xpos - low),
            (ON.body("lower", low, matrix, weight=[0, 0, 1, 1, 1, 9]), wanted),
            (ON.upright("lower", axis=[2, 0, 0]), body.xmat[::3] - [0, 0, 1]),
        ]
    )


def test_velocities_controls_sensors_and_the_centre_of_mass():
    qvel, ctrl, com = DATA.qvel, DATA.ctrl, DATA.subtree_com
    all_close(
        [
            (ON.velocity(), qvel),
            (ON.velocity(["rail", "wrist"], target=1), qvel[[10, 1, 2, 3]] - 1),
            (ON.control(weight=0.25), ctrl / 2),
            (ON.control("push", target=[3]), ctrl[1:] - 3),
            (ON.sensor("where", target=[1, 2, 3]), DATA.site("tip").xpos - [1, 2, 3]),
            (ON.sensor("speed"), qvel[10:]),
            (ON.centre_of_mass([0, 0, 1]), com[0] - [0, 0, 1]),
            (ON.centre_of_mass(np.zeros(3), "upper"), com[MODEL.body("upper").id]),
        ]
    )


def test_sums_stack_terms_and_plain_functions():
    def plain(data, u):
        return data.qpos[:2] * u[0]

    total = sum([ON.velocity("rail"), ON.control("lift", weight=4)])
    close(total(SEEN, U), [DATA.qvel[10], 2 * DATA.ctrl[0]])
    product = DATA.qpos[:2] * DATA.ctrl[0]
    close((plain + total)(SEEN, U), [*product, DATA.qvel[10], 2 * DATA.ctrl[0]])
    close((ON.velocity("rail") + (lambda data: data.qpos[:1]))(SEEN), [DATA.qvel[10], DATA.qpos[0]])


def test_clearances_are_in_the_order_of_the_names():
    geoms, others = ["hand", "arm"], ["floor", "table"]
    wanted = [
        0.02 - mujoco.mj_geomDistance(MODEL, DATA, MODEL.geom(a).id, MODEL.geom(b).id, 10, None)
        for a, b in itertools.product(geoms, others)
    ]
    one = ON.clearance("table", "hand", margin=[0.02])
    all_close([(ON.clearance(geoms, others, margin=0.02), wanted), (one, wanted[1:2])])


@jax.jit
def differences(term, turn):
    """A posture's residual where the ball joint is turned from no rotation, and its derivatives."""
    at = MODEL.joint("wrist").qposadr[0]

    def difference(turn):
        turned = jnp.concatenate([jnp.ones(1), turn / 2])
        return term(SEEN.replace(qpos=SEEN.qpos.at[at : at + 4].set(turned)))

    return difference(turn), jax.jacfwd(difference)(turn), jax.jacrev(difference)(turn)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.03, 1.0, 3.1])
def test_rotations_are_smooth(angle):
    """From no difference to almost half a turn."""
    q, target, by_q = np.array([1.0, 0, 0, 0]), np.zeros(4), np.zeros((3, 3))
    mujoco.mju_axisAngle2Quat(target, np.array([0.6, 0, 0.8]), angle)
    mujoco.mjd_subQuat(q, target, by_q, None)
    value, forward, reverse = differences(ON.posture({"wrist": target}), jnp.zeros(3))
    close(value, subtracted(q, target), 1e-6)
    close(forward, by_q, 1e-4)
    close(reverse, by_q, 1e-4)


KINDS = {0: "plane", 2: "sphere", 3: "capsule", 5: "cylinder", 6: "box"}
SIZES = {0: "1 1 1", 2: "0.3 7 7", 3: "0.15 0.4", 5: "0.3 0.25", 6: "0.2 0.3 0.4"}


def drawn_pairs(kinds, count=100):
    """Poses (count, 2, 3), (count, 2, 3, 3) of two geoms, sizes (2, 3), the engine's distances."""
    bodies = [
        f'<body mocap="true"><geom type="{KINDS[k]}" size="{SIZES[k]}"/></body>' for k in kinds
    ]
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>"
    )
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(sum(kinds)), []
    for _ in range(count):
        data.mocap_pos[:] = rng.uniform(-0.7, 0.7, (2, 3))
        data.mocap_quat[:] = rng.normal(size=(2, 4))
        mujoco.mj_normalizeQuat(model, data.qpos)
        data.mocap_quat /= np.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 100, None)
        rows.append((data.geom_xpos.copy(), data.geom_xmat.reshape(2, 3, 3).copy(), distance))
    sizes = model.geom_size * np.where(model.geom_type == SPHERE, [[1], [0], [0]], 1).T
    return (*map(np.array, zip(*rows, strict=True)), sizes)


AS_USERS_COMPILE = {(3, 5)}
"""Where two slopes meet, the default tests' quick compilation may give neither of them."""


@pytest.mark.parametrize(
    "kinds",
    [pytest.param(k, marks=[pytest.mark.slow] * (k in AS_USERS_COMPILE)) for k in DISTANCES],
    ids=lambda k: f"{KINDS[k[0]]}-{KINDS[k[1]]}",
)
def test_distances_and_their_derivatives(kinds):
    centres, frames, wanted, sizes = drawn_pairs(kinds)
    # After the random poses some where shapes coincide, or are parallel.
    special = np.zeros((3, 2, 3))
    special[1:, 1] = [[0, 0, 0.4], [0, 0.6, 0]]
    centres = np.concatenate([centres, special])
    frames = np.concatenate([frames, np.broadcast_to(np.eye(3), (3, 2, 3, 3))])

    @jax.jit
    @jax.vmap
    def evaluate(centre, frame, along):
        def distance(centre, frame):
            return DISTANCES[kinds](*map(Shape, centre, frame, jnp.asarray(sizes)))

        value, slopes = jax.value_and_grad(distance, (0, 1))(centre, frame)
        tangent = jax.jvp(distance, (centre, frame), along)[1]
        backward = sum(jnp.sum(s * a) for s, a in zip(slopes, along, strict=True))
        return value, slopes, tangent, backward

    rng = np.random.default_rng(0)
    along = (rng.normal(size=centres.shape), rng.normal(size=frames.shape))
    found, (pull, twist), tangent, backward = evaluate(centres, frames, along)
    assert np.isfinite(pull).all()
    assert np.isfinite(twist).all()
    close(tangent, backward, 1e-4)
    found, pull = np.asarray(found)[: len(wanted)], np.asarray(pull)[: len(wanted)]
    apart = wanted > 0
    assert 10 < apart.sum() < len(wanted) - 10
    exact = np.full(len(wanted), True)
    if kinds == (6, 6):
        exact = ~apart
        assert np.all(found <= wanted + 1e-5)
        assert np.all(found[apart] >= wanted[apart] / np.sqrt(3))
    elif kinds in ((3, 5), (3, 6)):  # the depths of boxes have their own test
        exact = apart
        assert np.all(found[~apart] < 1e-5)
    close(found[exact], wanted[exact], 1e-5)
    close(pull[:, 0], -pull[:, 1], 1e-5)
    close(np.linalg.norm(pull, axis=-1)[exact], 1, 1e-4)  # a metre away is a metre farther


def test_depths_of_capsules_in_boxes_are_exact():
    """The engine's own pair of capsule and box understates depths; its convex solver does not."""
    corners = " ".join(
        f"{x} {y} {z}" for x, y, z in itertools.product((-0.2, 0.2), (-0.3, 0.3), (-0.4, 0.4))
    )
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <asset><mesh name="box" vertex="{corners}"/></asset>
      <worldbody><geom type="mesh" mesh="box"/>
        <body mocap="true"><geom type="capsule" size="0.15 0.4"/></body></worldbody></mujoco>""")
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    found, wanted = [], []
    distance = jax.jit(DISTANCES[3, 6])
    box = Shape(jnp.zeros(3), jnp.eye(3), jnp.array([0.2, 0.3, 0.4]))
    for _ in range(40):
        data.mocap_pos[:], quat = rng.uniform(-0.3, 0.3, 3), rng.normal(size=4)
        data.mocap_quat[:] = quat / np.linalg.norm(quat)
        mujoco.mj_kinematics(model, data)
        capsule = Shape(data.geom_xpos[1], data.geom_xmat[1].reshape(3, 3), model.geom_size[1])
        found.append(distance(capsule, box))
        wanted.append(mujoco.mj_geomDistance(model, data, 0, 1, 100, None))
    close(found, wanted, 1e-4)
    assert np.median(wanted) < -0.2


def test_numbers_do_not_recompile():
    traces = []

    @jax.jit
    def value(term, data):
        traces.append(1)
        return term(data, U)

    def terms(a, weight):
        clear = ON.clearance("hand", ["table", "arm"], margin=a)
        return ON.site("tip", [a, 0, 1], [1, a, 0, 0], weight=weight) + ON.posture(
            {"rail": a}, weight=weight
        ) + ON.control(target=a, weight=weight) + clear  # fmt: skip

    first, second = (value(as_partial(terms(*n)), SEEN) for n in ((0.1, 1.0), (0.2, 2.0)))
    assert len(traces) == 1
    assert np.abs(first - second).min() > 0


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ON.site("top", [0, 0, 0]), "robot has no site 'top': there is 'tip'"),
        (lambda: ON.velocity(["rail", "rails"]), "no joint 'rails': there is 'shoulder', 'wrist'"),
        (lambda: ON.control("arm"), "no actuator 'arm'"),
        (lambda: ON.posture("away"), "no keyframe 'away': there is 'home'"),
        (lambda: ON.posture([1, 2]), "posture is .1, 2.: give 13 number"),
        (lambda: ON.posture({"wrist": 0.2}), "posture of 'wrist' is 0.2: give 4 number"),
        (lambda: ON.posture({"wrist": [0, 0, 0, 0]}), "must not be zero"),
        (lambda: ON.velocity(weight=-1), "weight of velocity is -1: .* not negative"),
        (lambda: ON.velocity(weight=np.nan), "weight of velocity is nan"),
        (lambda: ON.velocity("rail", weight=[1, 2]), "weight of velocity is .1, 2.: give 1"),
        (lambda: ON.velocity([]), "no joint is named"),
        (lambda: ON.posture({}), "no joint is named"),
        (lambda: ON.site("tip"), "site 'tip' has no target"),
        (lambda: ON.site("tip", [0, 0, np.inf]), "position of site 'tip'"),
        (lambda: ON.site("tip", orientation=np.ones((3, 3))), "give a rotation matrix"),
        (lambda: ON.site("tip", orientation="up"), "orientation of site 'tip'"),
        (lambda: ON.clearance("hand", "egg"), r"'hand' \(sphere\) and 'egg' \(ellipsoid\)"),
        (lambda: ON.clearance("hand", "hand"), "'hand' with itself"),
        (lambda: ON.velocity() + 3, "cannot be added"),
        (lambda: ON.control()(SEEN), "a control term was called without u"),
    ],
)
def test_mistakes_are_named(make, says):
    with pytest.raises(DraxError, match=says):
        make()


ARM = """
<mujoco model="arm">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="table" type="box" size="1 1 0.1" pos="0 0 -0.5" contype="0" conaffinity="0"/>
    <body><joint name="shoulder" axis="0 1 0"/>
      <geom name="link" type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"/>
      <site name="tip" pos="0.5 0 0"/></body>
  </worldbody>
  <actuator><motor name="lift" joint="shoulder"/></actuator>
</mujoco>"""


def test_terms_go_where_functions_go():
    """In a problem, seen through MJX: cost and constraints, without solving it."""
    on = Terms(ARM)

    def problem(height=0.3, weight=100.0):
        return from_mjcf(
            ARM,
            horizon=0.04,
            dt=0.02,
            running_residual=on.control(weight=0.1) + on.velocity(weight=0.01),
            terminal_residual=on.site("tip", [0.4, 0, height], weight=weight),
            inequality=on.clearance("link", "table", margin=0.02),
            terminal_inequality=on.clearance("link", "table"),
        )

    first, second = problem(), problem(0.2, 50.0)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    x, u = jnp.array([0.1, 2.0]), jnp.array([3.0])

    @jax.jit
    def values(problem):
        value = problem.constraint(problem.dynamics.observe(x, u), u)
        return problem.running_cost(x, u), problem.terminal_cost(x), value

    tip = 0.5 * np.array([np.cos(0.1), 0, -np.sin(0.1)])
    for p, height, weight in ((first, 0.3, 100), (second, 0.2, 50)):
        running, terminal, gap = values(p)
        close(running, 0.05 * 9 + 0.005 * 4)
        close(terminal, weight / 2 * np.sum((tip - [0.4, 0, height]) ** 2), 1e-4)
        close(gap, [0.02 - (0.4 + tip[2] - 0.05)])
    assert values._cache_size() == 1
    with pytest.raises(DraxError, match="called without u"):
        from_mjcf(ARM, horizon=0.04, terminal_residual=on.control())


def test_the_example_of_the_readme():
    readme = (Path(__file__).parents[2] / "README.md").read_text()
    code = next(c for c in readme.split("```")[1::2] if "from_mjcf(" in c)
    code = code.removeprefix("python").replace('"robot.xml"', repr(str(path("cartpole"))))
    names = {}
    exec(code.split("solution = ")[0], names)
    problem = names["problem"]
    upright = jnp.array([0.0, np.pi, 0.0, 0.0])
    assert problem.horizon == 100
    assert problem.reached(np.asarray(upright))
    close(problem.terminal_cost(upright), 0.0, 1e-9)
    close(problem.terminal_cost(upright.at[0].set(0.1)), 0.5)


def test_terms_of_another_model_are_refused():
    swing = ON.velocity()
    with pytest.raises(DraxError, match="made for a model with 13 positions and 11 velocities"):
        from_mjcf(ARM, horizon=0.1, terminal_residual=swing)


REACHER = """
<mujoco model="reacher">
  <compiler angle="radian"/>
  <option timestep="0.01" integrator="Euler" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="post" type="{}" size="0.1 0.1 0.02" pos="0.42 0.33 0"/>
    <body name="upper">
      <joint name="shoulder" axis="0 0 1" range="-3 3" limited="true" damping="0.1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="1"/>
      <body name="fore" pos="0.4 0 0">
        <joint name="elbow" axis="0 0 1" range="-2.8 2.8" limited="true" damping="0.1"/>
        <geom name="fore" type="capsule" fromto="0 0 0 0.35 0 0" size="0.02" mass="0.7"/>
        <geom name="knob" type="sphere" pos="0.35 0 0" size="0.03" mass="0.05"/>
        <site name="tip" pos="0.35 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="ms" joint="shoulder" ctrlrange="-10 10" ctrllimited="true"/>
    <motor name="me" joint="elbow" ctrlrange="-6 6" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
"""A planar arm of two links beside a post."""


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_two_links_keep_clear_of_one_post(shape):
    """XLA for CPUs failed to compile the polish where distances were made of products `@`."""
    on = Terms(REACHER.format(shape))
    problem = from_mjcf(
        on.model,
        horizon=0.5,
        dt=0.05,
        x_init=[-0.6, 1.1, 0, 0],
        running_residual=on.control(weight=0.01),
        terminal_residual=on.site("tip", [0.5, 0.3, 0.0], weight=50) + on.velocity(weight=1),
        inequality=on.clearance("post", ["upper", "fore"], margin=0.01),
        contacts=False,
    )
    assert solve(problem, chains=8, progress=False).success.all()
