"""One step of MJX and its tangent-space Jacobian, against MuJoCo's C engine in float64.

Few models that have many features each, because every one is compiled.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax import Autodiff, Smoothed, from_mjcf, tasks
from mjx_drax.base.errors import DraxWarning
from mjx_drax.method.model import linearize
from mjx_drax.physics.agreement.checks import Samples, compare
from mjx_drax.physics.c_engine.states import Engine, difference, moved, quiet, without
from mjx_drax.physics.c_engine.stepper import Spare, Stepper, cores
from mjx_drax.problem.trajectory import Trajectory

SWINGING = """
<mujoco model="swinging">
  <worldbody>
    <body><joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.7" size="0.03" mass="0.3"/></body>
  </worldbody>
  <actuator><motor joint="hinge" gear="0.7"/></actuator>
</mujoco>
"""

FLOATING = """
<mujoco model="floating">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body mocap="true" pos="0 0 3"><geom size="0.1" contype="0" conaffinity="0"/></body>
    <body pos="0 0 0.0997">
      <freejoint/>
      <geom size="0.1" mass="1"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0.1" size="0.05" mass="0.3"
            contype="0" conaffinity="0"/>
      <site name="thruster" pos="0.1 0.1 0"/>
      <body pos="0 0 0.2">
        <joint type="ball" stiffness="2" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0.05 0.3" size="0.03" mass="0.2"
              contype="0" conaffinity="0"/>
        <body pos="0 0 0.3">
          <joint name="flap" axis="1 0 0" range="-0.5 0.5" limited="true" frictionloss="0.05"/>
          <geom size="0.03" pos="0 0.1 0.05" mass="0.1" contype="0" conaffinity="0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><general site="thruster" gear="0 0 1 0 0.1 0" dyntype="filter" dynprm="0.1"/></actuator>
</mujoco>
"""

LINKED = """
<mujoco model="linked">
  <option timestep="0.005" integrator="RK4" cone="elliptic"/>
  <worldbody>
    <body>
      <joint name="cart" type="slide" axis="1 0 0" armature="0.1"/>
      <geom size="0.1" mass="1" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.2">
        <joint name="upper" axis="0 1 0" damping="0.2" actuatorfrcrange="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" contype="0" conaffinity="0"/>
        <site name="elbow" pos="0.05 0 -0.3"/>
        <body pos="0 0 -0.3">
          <joint name="lower" axis="0 1 0" stiffness="0.5" springref="0.3"/>
          <geom size="0.08" pos="0 0 -0.2" mass="0.4" condim="3"/>
        </body>
      </body>
    </body>
    <geom type="plane" size="1 1 1" pos="0 0 -0.775"/>
    <site name="wall" pos="1 0 0"/>
  </worldbody>
  <tendon>
    <fixed name="sum" limited="true" range="-0.2 0.2" frictionloss="0.02">
      <joint joint="cart" coef="1"/><joint joint="upper" coef="0.5"/>
    </fixed>
    <spatial name="rope" stiffness="3" damping="0.3"><site site="wall"/><site site="elbow"/>
    </spatial>
  </tendon>
  <equality><joint joint1="upper" joint2="lower" polycoef="0.1 1 0 0 0"/></equality>
  <actuator>
    <intvelocity joint="cart" kp="20" actrange="-1 1" ctrlrange="-2 2"/>
    <position tendon="sum" kp="3" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def at(model, **parts):
    """x = [qpos, qvel, act], the default pose at rest but for what is given."""
    data = mujoco.MjData(model)
    for name, values in parts.items():
        for i, value in values.items():
            getattr(data, name)[i] = value
    mujoco.mj_normalizeQuat(model, data.qpos)
    return np.concatenate([data.qpos, data.qvel, data.act])


TUMBLING = dict(enumerate([0.3, -0.2, -0.4, 1.0, -2.0, 0.5, 0.7, -1.0, 0.4, 1.5]))
STATES = {
    FLOATING: {
        "rest in contact": {},
        "rest in the air": {"qpos": {2: 1.0}},
        "rotated, in flight": {
            "qpos": {2: 1.0, 3: 0.5, 4: 0.5, 5: -0.5, 6: 0.5, 7: 0.6, 8: 0.8, 11: 0.1},
            "qvel": TUMBLING,
            "act": {0: 0.5},
        },
        "sliding": {"qvel": {**TUMBLING, 2: -0.1}},
        "at a limit": {"qpos": {2: 1.0, 11: 0.51}, "qvel": {9: 0.1}},
        "stuck by friction": {"qpos": {2: 1.0}, "qvel": {9: 1e-5}},
    },
    LINKED: {
        "rest": {},
        "moving": {"qpos": {0: 0.1, 1: 0.1, 2: 0.2}, "qvel": {0: 1.0, 1: -0.5, 2: 0.3}},
        "tendon limit": {"qpos": {0: 0.19, 1: 0.05, 2: 0.1}, "act": {0: 0.3}},
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("xml", STATES, ids=("floating", "linked"))
def test_a_step_and_its_jacobian_are_the_c_engines(xml):
    assert_steps_like_the_c_engine(mujoco.MjModel.from_xml_string(xml), STATES[xml])


def assert_steps_like_the_c_engine(model, states, **options):
    """The values and the derivatives of one step, in float64, at states that `at` makes."""
    engine = Engine(model)
    control = np.array([1.0, 0.2])[: model.nu]
    with jax.enable_x64(True):
        task = from_mjcf(
            model,
            horizon=0.1,
            dt=model.opt.timestep,
            running_residual=lambda d, u: u,
            **options,
        )
        dynamics, ndx = task.dynamics, task.dynamics.ndx

        def moved(x, end, dz):
            near = dynamics.step(dynamics.integrate(x, dz[:ndx]), control + dz[ndx:])
            return dynamics.difference(near, end)

        @jax.jit
        def expanded(x):
            end = dynamics.step(x, control)
            return end, jax.jacfwd(partial(moved, x, end))(jnp.zeros(ndx + model.nu))

        for name, parts in states.items():
            x = at(model, **parts)
            end, jacobian = map(np.asarray, expanded(x))
            off = difference(model, end, engine.step(x, control))
            np.testing.assert_allclose(off, 0, atol=1e-9, err_msg=name)
            scale, exact = np.abs(jacobian).max(), engine.slopes(x, control).mean(axis=0)
            np.testing.assert_allclose(jacobian / scale, exact / scale, atol=1e-6, err_msg=name)


IMPLICIT = """
<mujoco model="implicit">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="a" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/>
      <body pos="0 0 -0.3"><joint name="b" axis="1 0 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/></body>
      <body pos="0 0 -0.3"><joint name="c" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/></body></body>
    <body pos="2 0 0"><freejoint/><site name="hook" pos="0.1 0.1 0"/>
      <geom type="box" size="0.1 0.2 0.05" pos="0.1 0 0.05" mass="1"/></body>
    <site name="wall" pos="1 0 1"/>
  </worldbody>
  <tendon>
    <fixed name="branches" damping="0.2" armature="0.01">
      <joint joint="b" coef="1"/><joint joint="c" coef="2"/></fixed>
    <spatial name="rope" damping="0.3"><site site="wall"/><site site="hook"/></spatial>
  </tendon>
  <actuator>
    <velocity joint="a" kv="5" forcerange="-1 1"/>
    <velocity tendon="branches" kv="0.5"/>
    <damper joint="b" kv="2" ctrlrange="0 0.5"/>
    <position tendon="rope" kp="3" kv="1"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("friction", "derivatives"),
    [
        (0.0, False),
        pytest.param(0.0, True, marks=pytest.mark.slow),
        pytest.param(0.05, True, marks=pytest.mark.slow),
    ],
)
def test_implicitfast_is_the_c_engines(friction, derivatives):
    """Forces at their ends and within, tendons between trees, and a free body that turns.

    With friction there are constraints; derivatives are in closed form with and without.
    """
    model = mujoco.MjModel.from_xml_string(
        IMPLICIT.replace('damping="0.1"', f'damping="0.1" frictionloss="{friction}"')
    )
    qpos = moved(model, model.qpos0, np.linspace(0.1, 0.6, model.nv))
    x = np.concatenate([qpos, np.linspace(-1.0, 2.0, model.nv)])
    controls = np.array([3.0, 0.1])[:, None] * np.ones(model.nu)
    found = compare(model, Samples(np.stack([x, x]), controls), False, derivatives=derivatives)
    assert found.velocity.max() < 1e-12
    assert not found.jacobian > 1e-7


BALLS = """
<mujoco model="balls">
  <option timestep="0.002"/>
  <custom><numeric name="other" data="1 2 3"/><numeric name="max_contact_points" data="6"/></custom>
  <worldbody>
    <geom type="plane" size="1 1 1" condim="1"/>
    {}
  </worldbody>
  <actuator><motor joint="x0"/></actuator>
</mujoco>
""".format(
    "".join(
        f"""<body pos="{0.5 * i} 0 0.1"><joint name="x{i}" type="slide" axis="1 0 0"/>
        <joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
        <geom size="0.1" mass="1" condim="{dim}"/></body>"""
        for i, dim in enumerate([3, 3, 1, 1])
    )
)
"""Of ten pairs of balls and floor, seven have friction. The custom numbers are set aside."""

X, Z, TURN = 0, 1, 2
"""Joints of a ball."""


def ball(i, joint):
    """Where a joint of a ball stands in qpos and qvel."""
    return 3 * i + joint


@pytest.mark.slow
def test_the_nearest_contacts_are_enough_where_no_more_act():
    """Two contacts of each friction dimension, with ties among those that act and that do not.

    The ball that is turned slides; what is deep inside another is pushed out.
    """
    model = mujoco.MjModel.from_xml_string(BALLS)
    floating = {ball(i, Z): 0.5 for i in range(4)}
    sinking = {ball(i, Z): -1e-4 for i in range(4)}
    deep = {ball(1, X): -0.45, ball(2, X): -0.2, ball(2, Z): 0.7, ball(3, Z): 0.75}
    states = {
        "none acts, all tie": {"qpos": floating},
        "as many as are kept, all tie": {"qpos": sinking, "qvel": {ball(0, X): 0.1}},
        "balls in each other, one in the floor": {
            "qpos": {**floating, **deep, ball(0, Z): 0.5, ball(3, X): -1.0, ball(3, Z): -0.02},
            "qvel": {ball(1, Z): 0.3, ball(0, TURN): 1.0},
        },
    }
    for name, parts in states.items():
        assert Engine(model).active_contacts(at(model, **parts)) <= 2, name
    assert_steps_like_the_c_engine(model, states, contacts=2)


@pytest.mark.slow
def test_contacts_that_act_and_are_left_out_are_told():
    """The plan lets a ball fall through the floor that the C engine keeps it on."""
    model = mujoco.MjModel.from_xml_string(BALLS)
    resting = at(model, qpos={ball(i, Z): -1e-4 * (i + 1) for i in range(4)})
    with pytest.warns(DraxWarning, match=r"2 contacts .* balls .*nearest 1: give contacts=\d\."):
        problem = from_mjcf(
            model,
            horizon=0.1,
            dt=0.002,
            x_init=resting,
            contacts=1,
            running_residual=lambda data, u: u,
        )
    assert problem.dynamics.contacts == 1
    end = np.asarray(problem.dynamics.step(problem.x_init, jnp.zeros(1)))
    falling = end[model.nq :][[ball(i, Z) for i in range(4)]] < -0.01
    assert falling.tolist() == [True, False, True, False]
    wanted = Engine(model).step(resting, np.zeros(1))
    assert np.all(wanted[model.nq :] > -0.01)


@pytest.mark.slow
def test_smoothed_derivatives_feel_a_contact_from_afar():
    """A ball falls towards a floor 2 mm below it; `derivatives` is the problem's own choice."""
    xml = """<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="1 1 0.1"/>
      <body pos="0 0 0.102"><joint name="up" type="slide" axis="0 0 1"/>
      <geom size="0.1" mass="1"/></body></worldbody>
      <actuator><motor joint="up"/></actuator></mujoco>"""
    felt = []
    for derivatives in (None, Smoothed(pairs=32, radius=0.01)):
        problem = from_mjcf(
            xml,
            horizon=0.002,
            dt=0.002,
            running_residual=lambda data, u: u,
            derivatives=derivatives,
        )
        knots = Trajectory(problem.x_init[None], jnp.zeros((1, 1)))
        keys = jax.random.split(jax.random.key(0), 1)
        model = jax.jit(lambda p, z, k: linearize(p, z, Autodiff(), k))(problem, knots, keys)
        felt.append(float(model.A[0, 1, 0]))  # of the velocity by the height
    assert felt[0] == 0.0
    assert felt[1] < -0.1


@pytest.mark.slow
def test_float64_has_the_c_engines_numbers_and_changed_ones():
    """A problem built in float32 steps as the C engine does; a mass that was changed stays."""
    problem = from_mjcf(SWINGING, horizon=0.1, terminal_residual=lambda data: data.qpos)
    jax.jit(problem.dynamics.step)(problem.x_init, jnp.ones(1))  # in float32, before
    exact = problem.in_float64()
    assert exact.dynamics.mj_model is problem.dynamics.mj_model
    engine = Engine(problem.dynamics.mj_model)
    x, u = np.array([0.3, -0.7]), np.array([0.9])
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(exact.dynamics.step)(x, u))
    np.testing.assert_allclose(
        found, engine.step(x, u, exact.dynamics.substeps), rtol=0, atol=1e-14
    )
    model = problem.dynamics.model
    heavier = replace(problem.dynamics, model=model.replace(body_mass=1.5 * model.body_mass))
    masses = np.asarray(heavier.in_float64().model.body_mass)
    np.testing.assert_allclose(masses, 1.5 * problem.dynamics.mj_model.body_mass, rtol=1e-7)


@pytest.mark.usefixtures("trusted")
def test_replays_do_not_depend_on_those_before():
    """They take turns with the same data of the C engine, even after a motion that diverged."""
    d = tasks.load("hopper_jump").make().dynamics
    rng = np.random.default_rng(0)
    plan = np.tile(rng.normal(scale=0.1, size=d.nx), (40, 9, 1))
    u, limits = rng.normal(size=(40, 8, d.nu)), (np.array(-np.inf), np.array(np.inf))
    gains = np.zeros((40, 8, d.nu, d.ndx))
    first = d.replay(plan, u, gains, limits)
    lost, _ = d.replay(plan + 1e6, 1e8 * u, gains, limits)
    assert np.isnan(lost).any()
    for before, after in zip(first, d.replay(plan, u, gains, limits), strict=True):
        np.testing.assert_array_equal(before, after)


def test_what_actuators_remember_is_not_taken_from_a_replay_before():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="j" type="slide"/><geom size="0.1"/></body></worldbody>
      <actuator><motor joint="j" delay="0.006" nsample="4"/></actuator></mujoco>""")
    spare = Spare()

    def ran(force):
        with Stepper(model, 1, np.zeros((1, 2)), spare) as stepper:
            return [stepper(np.full((1, 1), force))[0] for _ in range(8)]

    first, _, again = ran(1.0), ran(-5.0), ran(1.0)
    assert len(spare.data) == 1
    np.testing.assert_array_equal(first, again)


def test_threads_go_by_the_work_of_a_knot(monkeypatch):
    monkeypatch.setattr("mjx_drax.physics.c_engine.stepper.cores", lambda: 16)
    unknown, light, heavy = (Spare(seconds=s) for s in (np.inf, 1.25e-5, 3.5e-4))
    assert [unknown.threads(n) for n in (1, 8, 9, 64, 999)] == [1, 1, 2, 8, 16]
    assert [light.threads(n) for n in (1, 8, 9, 64, 999)] == [1, 1, 2, 8, 16]
    assert [heavy.threads(n) for n in (1, 4, 64)] == [1, 4, 16]


def test_cores_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {3, 5, 8}, raising=False)
    assert cores() == 3
    monkeypatch.delattr("os.sched_getaffinity")
    assert cores() == 64


def test_all_knots_in_one_call_are_the_same_as_one_after_the_other(monkeypatch):
    d = tasks.load("hopper_jump").make().dynamics
    rng, chains, K = np.random.default_rng(0), 9, 12
    x = np.zeros((chains, d.nx)) + 0.02 * rng.standard_normal((chains, d.nx))
    u = rng.uniform(-1.0, 1.0, (chains, K, d.nu))
    u[1, 5], u[2, 0], u[3, 7, 0], x[4, 1] = np.nan, np.inf, 1e12, np.nan
    u[5], x[5, -1] = 0.0, 1e9  # which diverges
    with d.stepper(x) as stepper:
        each = [stepper(u[:, k]) for k in range(K)]
    single = [np.stack(parts, axis=1) for parts in zip(*each, strict=True)]
    before = np.concatenate([x[:, None], single[0][:, :-1]], axis=1)
    single[1][~np.isfinite(before).all(axis=2)] = np.nan  # where feedback would have no number
    lost = np.isnan(single[0]).any(axis=(1, 2))
    np.testing.assert_array_equal(lost, [0, 1, 1, 1, 1, 1, 0, 0, 0])

    def ran():
        with Stepper(d.mj_model, d.substeps, x, knots=K) as stepper:
            return stepper.run(u)

    whole = ran()
    for one, all_knots in zip(single, whole, strict=True):
        np.testing.assert_allclose(all_knots, one, atol=1e-9)
    monkeypatch.setattr("mjx_drax.physics.c_engine.stepper.AT_ONCE", 1)  # chain by chain
    for again, all_knots in zip(ran(), whole, strict=True):
        np.testing.assert_array_equal(again, all_knots)


def test_a_stepper_learns_how_long_a_knot_takes():
    model, spare = mujoco.MjModel.from_xml_string(SWINGING), Spare()
    with Stepper(model, 3, np.zeros((5, model.nq + model.nv + model.na)), spare) as stepper:
        stepper(np.zeros((5, model.nu)))
    first = spare.seconds
    assert 0.0 < first < 1.0
    with Stepper(model, 3, np.zeros((5, model.nq + model.nv + model.na)), spare) as stepper:
        stepper(np.zeros((5, model.nu)))
    assert spare.seconds <= first


def test_mujocos_warnings_return_when_the_last_of_several_threads_is_done():
    before, first, second = mujoco.get_mju_user_warning(), quiet(), quiet()
    first.__enter__()
    second.__enter__()
    assert mujoco.get_mju_user_warning() is not before
    first.__exit__(None, None, None)  # the one that came first goes first
    assert mujoco.get_mju_user_warning() is not before
    second.__exit__(None, None, None)
    assert mujoco.get_mju_user_warning() is before


def test_a_users_filter_of_contacts_comes_back():
    def own(model, data, a, b):
        return False

    mujoco.set_mjcb_contactfilter(own)
    try:
        with without({(0, 1)}):
            assert mujoco.get_mjcb_contactfilter() is not own
        assert mujoco.get_mjcb_contactfilter() is own
    finally:
        mujoco.set_mjcb_contactfilter(None)
