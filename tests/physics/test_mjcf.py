"""Dynamics, bounds and initial states from MJCF, against MuJoCo's C engine; and what is refused."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError, Trajectory, from_mjcf
from mjx_drax.base.errors import DraxWarning
from mjx_drax.base.pytrees import with_host_fields
from mjx_drax.method.model import linearize
from mjx_drax.models import path
from mjx_drax.physics import step as physics
from mjx_drax.physics.c_engine.states import difference, set_state
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.report import check
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.search.iterate import evaluate

MODELS = ["pendulum", "cartpole", "acrobot"]
K = 8

ARM = """
<mujoco model="arm">
  <option timestep="0.005"><flag contact="disable"/></option>
  <worldbody>
    <body><joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.25" limited="true"/>
      <geom name="hand" size="0.1"/>
      <body pos="0.3 0 0"><joint name="wrist" axis="0 1 0" {joint}/>
        <geom name="finger" size="0.1" pos="1 0 0"/></body>
    </body>
    {world}
  </worldbody>
  <actuator>{actuator}</actuator>
  {more}
</mujoco>"""
MOTOR = '<motor joint="lift" ctrlrange="-2 3" ctrllimited="true"/>'
MOTORS = MOTOR + '<general joint="wrist" dyntype="filter" dynprm="0.1" gainprm="1"/>'


def arm(joint="", world="", actuator=MOTORS, more="", contact=False):
    xml = ARM.format(joint=joint, world=world, actuator=actuator, more=more)
    return xml.replace('<flag contact="disable"/>', "") if contact else xml


def effort(data, u):
    return u


def pose(data):
    return data.qpos


def problem(model, horizon=0.16, **rest):
    model = path(model) if model in MODELS else model
    return from_mjcf(model, **{"horizon": horizon, "running_residual": effort, **rest})


def drawn(problem, seed=0):
    """Random states x_0..x_K inside the bounds, and controls."""
    rng = np.random.default_rng(seed)
    upper = problem.bounds.x_upper
    half = np.where(np.isfinite(upper), upper, 3.0)
    x = rng.uniform(-half, half, (K + 1, problem.dynamics.nx))
    return x, rng.uniform(-1, 1, (K, problem.dynamics.nu))


def c_step(model, x, u, substeps):
    """The C engine, from x under u."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = np.split(x, [model.nq, model.nq + model.nv])
    data.ctrl[:] = u
    mujoco.mj_step(model, data, substeps)
    return np.concatenate([data.qpos, data.qvel, data.act])


def c_jacobian(model, x, u, substeps, eps=1e-5):
    """[A B] by central differences of the C engine."""
    z = np.concatenate([x, u])

    def f(z):
        return c_step(model, *np.split(z, [len(x)]), substeps)

    return np.stack([f(z + e) - f(z - e) for e in eps * np.eye(len(z))], axis=1) / (2 * eps)


@pytest.mark.parametrize(
    "model",
    ["pendulum", *(pytest.param(m, marks=pytest.mark.slow) for m in ("cartpole", "acrobot"))],
)
def test_step_and_jacobians_are_the_c_engines_in_float64(model):
    with jax.enable_x64(True):
        task = problem(model, horizon=K * 0.02, dt=0.02)
        x, u = drawn(task)
        at = replace(task, x_init=jnp.asarray(x[0]))
        knots = Trajectory(jnp.asarray(x[1:]), jnp.asarray(u))
        keys = jax.random.split(jax.random.key(0), K)
        linear = jax.jit(linearize)(at, knots, Autodiff(), keys)
        linear = jax.tree.map(np.asarray, linear)
    mj_model, substeps = task.dynamics.mj_model, task.dynamics.substeps
    assert substeps == 2
    for k in range(K):
        stepped = c_step(mj_model, x[k], u[k], substeps)
        np.testing.assert_allclose(linear.h[k] + x[k + 1], stepped, atol=1e-10)
        AB = np.hstack([linear.A[k], linear.B[k]])
        np.testing.assert_allclose(AB, c_jacobian(mj_model, x[k], u[k], substeps), atol=1e-7)


@pytest.mark.slow
def test_states_hold_activations():
    task = problem(arm())
    (nx, na), (x, u) = (task.dynamics.nx, task.dynamics.mj_model.na), drawn(task)
    assert (nx, na, task.dynamics.substeps) == (5, 1, 4)
    seen = jax.vmap(task.dynamics.step)(x[:-1].astype(np.float32), u.astype(np.float32))
    for k in range(K):
        np.testing.assert_allclose(
            seen[k], c_step(task.dynamics.mj_model, x[k], u[k], 4), atol=1e-4
        )


@pytest.mark.parametrize("model", MODELS)
def test_one_step_is_the_c_engines_in_float32(model):
    task = problem(model, dt=0.01)
    assert task.dynamics.substeps == 1
    x, u = drawn(task, seed=1)
    seen = jax.vmap(task.dynamics.step)(x[:-1].astype(np.float32), u.astype(np.float32))
    assert seen.dtype == np.float32
    for k in range(K):
        wanted = c_step(task.dynamics.mj_model, x[k], u[k], 1)
        np.testing.assert_allclose(seen[k], wanted, atol=1e-4)


def test_costs_observe_what_the_c_engine_computes():
    task = problem("acrobot")
    x, u = drawn(task)
    seen = jax.jit(task.dynamics.observe)(x[0].astype(np.float32), u[0].astype(np.float32))
    wanted = task.dynamics.observe_replayed(x[0], 0.0)
    for part in ("qpos", "qvel", "site_xpos", "xpos"):
        np.testing.assert_allclose(getattr(seen, part), getattr(wanted, part), atol=1e-5)


def test_what_a_cost_does_not_read_is_not_computed():
    def flops(residual):
        task = problem("acrobot", running_residual=residual)
        x, u = drawn(task)
        cost = jax.jit(task.running_cost).lower(x[0], u[0]).compile()
        return cost.cost_analysis()["flops"]

    assert 20 * flops(lambda data, u: data.qpos) < flops(lambda data, u: data.site_xpos[0])


def test_ranges_become_bounds():
    bounds = problem(arm()).bounds
    inf = np.inf
    np.testing.assert_allclose(bounds.x_lower, [-0.5, -inf, -inf, -inf, -inf])
    np.testing.assert_allclose(bounds.x_upper, [0.25, inf, inf, inf, inf])
    np.testing.assert_allclose(bounds.u_lower, [-2.0, -inf])
    np.testing.assert_allclose(bounds.u_upper, [3.0, inf])


def test_muscles_have_controls_from_0_to_1():
    muscle = '<muscle joint="lift" force="10" lengthrange="0.1 1"{}/>'
    three = muscle.format("") + '<motor joint="lift"/>' + muscle.format(' ctrlrange="0 0.5"')
    bounds = problem(arm(actuator=three)).bounds
    np.testing.assert_array_equal(bounds.u_lower, [0.0, -np.inf, 0.0])
    np.testing.assert_array_equal(bounds.u_upper, [1.0, np.inf, 0.5])


def test_a_joint_may_lean_on_its_stop():
    """As MuJoCo has it; without `stops` it is a bound that no plan comes to."""
    kept, leaning = problem(arm()), problem(arm(), stops=["*"])
    assert kept.bounds.x_upper[0] == pytest.approx(0.25)
    assert not np.isfinite(leaning.bounds.x_upper).any()
    assert leaning.dynamics.stops
    x, u = np.zeros((1, 9, 5)), np.tile([-2.0, 0.0], (1, 8, 1))
    x[:, :, 0] = -0.49
    states, _ = leaning.replay(x, u, np.zeros((1, 8, 2, leaning.dynamics.ndx)))
    assert -0.52 < states[0, -1, 0] < -0.5
    for k in range(8):  # f is the engine's, also where it leans
        after = leaning.dynamics.step(jnp.asarray(states[0, k]), jnp.asarray(u[0, k]))
        np.testing.assert_allclose(after, states[0, k + 1], atol=2e-3)
    with pytest.raises(DraxError, match="stops names 'knee', which no joint with a range"):
        problem(arm(), stops=["knee"])
    with pytest.raises(DraxError, match="stops is 'elbow'"):
        problem(arm(), stops="elbow")


def test_given_bounds_are_added_to_the_ranges():
    bounds = problem(arm(), x_bounds=(-0.1, 1.0), u_bounds=([-1.0, -5.0], [9.0, 5.0])).bounds
    np.testing.assert_allclose(bounds.x_lower, [-0.1] * 5)
    np.testing.assert_allclose(bounds.x_upper, [0.25, 1, 1, 1, 1])
    np.testing.assert_allclose(bounds.u_lower, [-1.0, -5.0])
    np.testing.assert_allclose(bounds.u_upper, [3.0, 5.0])


@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize("contact", [False, True])
def test_controls_are_drawn_within_bounds_of_their_own_at_each_knot(contact):
    late = np.array([0.0, 0.0, 1.0, 2.0, 2.0])[:, None] * np.ones(2)
    made = problem(arm(world=FLOOR, contact=contact), horizon=0.1, u_bounds=(-late, late))
    assert made.dynamics.kinked is contact
    for seed in range(3):
        u = np.asarray(made.draw(jax.random.key(seed)).u)
        np.testing.assert_allclose(u[:2], 0.0, atol=1e-6)
        assert np.abs(u[2:]).max() > 0.1


def test_no_velocities_are_drawn_where_damping_ends_them_within_a_step():
    """As where a robot's base is held by an enormous damping, and not by a weld."""
    held = """
    <mujoco><worldbody><body>
      <joint name="base" type="slide" damping="1e11"/><geom size="0.1"/>
      <body><joint name="arm" damping="1" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body>
    </body></worldbody><actuator><motor joint="arm"/></actuator></mujoco>
    """
    with pytest.warns(DraxWarning, match="damping holds base, and in a plan inertia does"):
        task = from_mjcf(held, horizon=0.2, running_cost=lambda data, u: u @ u)
    np.testing.assert_array_equal(task.scatter.x_upper[2:], [0.0, 5.0])


def test_scatter_is_finite_and_inside_the_bounds():
    task = problem(arm())
    z = task.draw(jax.random.key(0))
    assert np.isfinite(z.x).all()
    assert task.bounds.violation(z) == 0
    np.testing.assert_allclose(task.scatter.x_upper, [0.25, np.pi, 5, 5, 1], rtol=1e-6)


@pytest.mark.parametrize(("timestep", "substeps"), [(0.01, 2), (0.005, 4), (0.003, 7), (0.05, 1)])
def test_default_dt_is_the_multiple_closest_to_20_ms(timestep, substeps):
    dynamics = problem(arm().replace("0.005", str(timestep)), horizon=1.0).dynamics
    assert dynamics.substeps == substeps
    assert dynamics.dt == pytest.approx(substeps * timestep)


def test_horizon_counts_knots():
    task = problem(arm(), horizon=0.5, dt=0.01)
    assert task.horizon == 50
    assert task.times[-1] == pytest.approx(0.5)


@pytest.mark.usefixtures("trusted")
def test_the_initial_state_is_the_default_pose_or_the_first_keyframe_or_what_is_given():
    np.testing.assert_array_equal(problem(arm()).x_init, np.zeros(5))
    key = '<keyframe><key qpos="0.1 2" qvel="3 4" act="5"/><key qpos="0 9"/></keyframe>'
    np.testing.assert_allclose(problem(arm(more=key)).x_init, [0.1, 2, 3, 4, 5])
    given = [0.2, 1.0, 0.0, 0.0, 0.5]
    np.testing.assert_allclose(problem(arm(more=key), x_init=given).x_init, given)


def test_a_model_is_a_file_a_string_a_spec_or_an_mjmodel():
    file = str(path("pendulum"))
    models = [path("pendulum"), file, path("pendulum").read_text(), mujoco.MjSpec.from_file(file)]
    for model in [*models, mujoco.MjModel.from_xml_path(file)]:
        assert from_mjcf(model, horizon=0.1, running_residual=effort).name == "pendulum"


def test_a_spec_may_be_changed_after_it_was_given_and_gets_motors():
    spec = mujoco.MjSpec.from_string(arm())
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    made = from_mjcf(spec, horizon=0.1, running_residual=effort, actuators="torque")
    assert made.dynamics.nu == made.dynamics.mj_model.njnt > 0
    assert not spec.actuators
    spec.option.timestep *= 2
    assert made.dynamics.mj_model.opt.timestep == 0.5 * spec.option.timestep
    spec.bodies[1].add_joint(name="another", range=[2.0, 1.0], limited=True)
    with pytest.raises(DraxError, match="MuJoCo cannot compile"):
        from_mjcf(spec, horizon=0.1, running_residual=effort)


@pytest.mark.slow
def test_another_mass_changes_the_motion_without_recompiling():
    model = mujoco.MjModel.from_xml_path(str(path("pendulum")))
    light = problem(model)
    model.body_mass[1:] *= 2
    heavy = problem(model)
    z = jax.tree.map(lambda a: a[None], light.draw(jax.random.key(0)))
    before = evaluate._cache_size()
    defects = [evaluate(task, z).max_defect for task in (light, heavy, problem("pendulum"))]
    assert evaluate._cache_size() - before == 1
    assert defects[0] == defects[2]
    assert defects[0] != defects[1]


def test_the_model_of_the_c_engine_is_no_part_of_the_pytree():
    xml = path("pendulum").read_text()
    one, other = (problem(xml).dynamics for _ in range(2))
    assert one.mj_model is not other.mj_model
    assert jax.tree.structure(one) == jax.tree.structure(other)
    mapped = jax.tree.map(lambda a: a, one)
    assert (mapped.mj_model, mapped.origin) == (None, None)
    again = with_host_fields(mapped, one)
    assert (again.mj_model, again.origin) == (one.mj_model, xml)
    assert again.source() == other.source()
    assert mujoco_model(one) is one.mj_model


def test_a_result_fed_back_does_not_recompile():
    task = problem("pendulum")
    move = jax.jit(lambda task, x: x + task.dynamics.model.body_mass[1])
    move(task, move(task, jnp.zeros(2)))
    assert move._cache_size() == 1


def test_a_model_is_left_as_it_was():
    model = mujoco.MjModel.from_xml_string(arm())
    flags = model.opt.disableflags
    problem(model)
    assert model.opt.disableflags == flags


def test_geoms_that_cannot_touch_are_no_reason_to_refuse():
    harmless = '<geom type="plane" size="1 1 1" contype="0" conaffinity="0"/>'
    problem(arm(world=harmless, contact=True))  # hand and finger: parent and child


BALL = '<body><joint name="hip" type="ball"/><geom size="1"/></body>'
FREE = '<body><freejoint name="base"/><geom size="1"/></body>'
FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'
COUPLED = '<equality><joint joint1="lift" joint2="wrist"/></equality>'
STRING = (
    '<tendon><fixed limited="true" range="0 1"><joint joint="wrist" coef="1"/></fixed></tendon>'
)
TWICE = """<mujoco model="twins"><worldbody><body><joint name="one"/>
  <joint/><geom size="1" pos="2 0 0"/></body></worldbody>
  <actuator><motor joint="one"/></actuator></mujoco>"""
STILL = '<mujoco model="rock"><worldbody><geom size="1"/></worldbody></mujoco>'


@pytest.mark.parametrize(
    ("model", "sizes", "kinked"),
    [
        (arm(), (5, 5), False),
        (arm(world=FREE), (18, 17), False),
        (arm(world=BALL), (12, 11), False),
        (arm(world=FLOOR, contact=True), (5, 5), True),
        pytest.param(arm(more=COUPLED), (5, 5), True, marks=pytest.mark.slow),
        pytest.param(arm(joint='frictionloss="0.1"'), (5, 5), True, marks=pytest.mark.slow),
        pytest.param(arm(more=STRING), (5, 5), True, marks=pytest.mark.slow),
        (arm(joint='range="-90 90" limited="true" margin="0.1"'), (5, 5), False),
        pytest.param(
            arm(joint='range="-1 1" limited="true"', actuator=MOTOR),
            (4, 4),
            True,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["plain", "free", "ball", "contact", "equal", "friction", "tendon", "margin", "passive"],
)
def test_models_that_are_built(model, sizes, kinked):
    dynamics = problem(model).dynamics
    assert (dynamics.nx, dynamics.ndx) == sizes
    assert dynamics.kinked is kinked


@pytest.mark.filterwarnings("ignore:x_init of arm:mjx_drax.base.errors.DraxWarning")
@pytest.mark.parametrize("start", [0.25, 0.3])
def test_a_joint_that_starts_at_or_beyond_its_limit_keeps_it_in_the_dynamics(start):
    task = problem(arm(), x_init=[start, 0, 0, 0, 0])
    assert not np.isfinite(task.bounds.x_upper).any()
    assert task.dynamics.kinked


def test_margins_narrow_the_bounds_to_where_the_limit_has_no_force():
    bounds = problem(arm(joint='range="-90 90" limited="true" margin="0.1"')).bounds
    np.testing.assert_allclose(bounds.x_lower[:2], [-0.5, 0.1 - np.pi / 2])
    np.testing.assert_allclose(bounds.x_upper[:2], [0.25, np.pi / 2 - 0.1])


def test_contacts_can_be_left_out():
    assert not problem(arm(world=FLOOR, contact=True), contacts=False).dynamics.kinked


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (arm(actuator=""), "no actuators"),
        (STILL, "rock has no joints"),
        ("nowhere.xml", "no model file 'nowhere.xml'"),
        (path("nowhere"), "no model file .*nowhere.xml"),
        (arm().replace('contact="disable"', 'actuation="disable"'), "all actuators of arm are dis"),
        (arm().replace("<option", '<option actuatorgroupdisable="0"'), "actuatorgroupdisable"),
        (TWICE, r"inertia of twins is singular, because joints .* \(one, 1\): leave"),
        ("<mujoco><worldbody><geom/></mujoco>", "MuJoCo cannot compile"),
        ("<sdf/>", "cannot compile.*Give an MJCF, which begins with <mujoco>, or a URDF"),
        ("<mujocoinclude/>", "cannot compile.*a part that models include: give the model's own"),
        (arm(more='<asset><mesh file="hull.stl"/></asset>'), "'hull.stl' Put that file there, or"),
        ("<mujoco><worldbody><geom sise='1'/></worldbody></mujoco>", "(?s)cannot compile.*sise"),
    ],
)
def test_models_that_are_refused(model, words):
    with pytest.raises(DraxError, match=words):
        problem(model)


def test_models_may_come_compiled(tmp_path):
    file = tmp_path / "arm.mjb"
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_string(arm()), str(file), None)
    assert problem(file).name == "arm"
    file.write_bytes(b"none")
    with pytest.raises(DraxError, match="MuJoCo cannot compile"):
        problem(file)


def test_every_second_chain_starts_nearer_than_the_default_scatter():
    def spread(problem):
        """How far the wrist turns in the initial knots of 64 chains, as shares of the scatter."""
        keys = jax.random.split(jax.random.key(0), 64)
        turned = jax.vmap(problem.draw)(keys).x[..., 1] - problem.x_init[1]
        return np.abs(turned).max(1) / np.asarray(problem.scatter.x_upper - problem.x_init)[1]

    near, told = spread(problem(arm())), spread(problem(arm(), x_scatter=(-np.pi, np.pi)))
    assert near.min() < 0.06
    np.testing.assert_allclose(np.mean(near > 0.99 * told), 0.5, atol=0.1)
    assert told.min() > 0.3


def test_a_singular_inertia_is_reported_once(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert check(TWICE)["obstacle"].startswith("the inertia of twins is singular")
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


def test_what_mjx_fails_in_is_refused(monkeypatch):
    def missing(*_):
        raise TypeError("no gather")

    monkeypatch.setattr(physics.mjx, "transmission", missing)
    words = r"MJX fails in a step of arm \(TypeError: no gather\): leave out sensors"
    model = arm(joint='damping="0.0123"')  # one that has not been traced before
    with pytest.raises(DraxError, match=words):
        problem(model)
    assert re.match(words, check(model)["obstacle"])


def test_sensors_that_mjx_fails_in_are_refused(monkeypatch):
    def missing(*_):
        raise TypeError("no gather")

    monkeypatch.setattr(physics.mjx, "sensor_vel", missing)
    model = arm(more='<sensor><jointvel joint="wrist"/></sensor>')
    words = r"MJX fails in a step of arm \(TypeError: no gather\): leave out sensors"
    with pytest.raises(DraxError, match=words):
        problem(model)
    assert re.match(words, check(model)["obstacle"])


@pytest.mark.parametrize("side", [0, 1])
def test_bounds_of_quaternions_are_refused(side):
    ends = [np.full(12, -np.inf), np.full(12, np.inf)]
    ends[side][3] = 0.5
    with pytest.raises(
        DraxError, match=r"x_bounds are finite at entries \[2, 3, 4, 5\].*inequality"
    ):
        problem(arm(world=BALL), x_bounds=tuple(ends))


@pytest.mark.slow
def test_quaternions_of_x_init_have_length_1():
    x = np.zeros(12)
    with pytest.raises(DraxError, match=r"x_init holds the quaternion .* at 2: scale it"):
        problem(arm(world=BALL), x_init=x)
    x[2:6] = [0.6, 0.0, 0.8001, 0.0]
    seen = problem(arm(world=BALL), x_init=x).x_init
    assert np.linalg.norm(seen[2:6]) == pytest.approx(1.0, abs=1e-6)
    with jax.enable_x64(True):  # where nothing is copied for its precision
        np.testing.assert_allclose(problem(arm(world=BALL), x_init=x).x_init, seen, rtol=1e-6)


def fails(data, *u):
    raise KeyError("no such sensor")


def branches(data, *u):
    return 1.0 if data.qpos[0] > 0 else 2.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"dt": 0.013}, r"dt is 0.013 s, not a multiple .* 0.005 s: give 0.015"),
        ({"dt": 0.001}, r"not a multiple .* give 0.005"),
        ({"dt": -0.01}, "dt is -0.01"),
        ({"dt": np.nan}, "dt is nan"),
        ({"horizon": 0.0}, "horizon is 0.0"),
        ({"horizon": -1.0}, "horizon is -1.0"),
        ({"horizon": np.inf}, "horizon is inf"),
        ({"horizon": 0.004}, "horizon is 0.004 s, shorter"),
        ({"x_init": [0.0, 0.0]}, r"x_init has 2 numbers; arm has 5: qpos \(2\)"),
        ({"x_init": np.zeros((2, 5))}, "(?s)x_init is .*give a vector"),
        (
            {"x_init": [0.2, 0, 0, 0, 0], "x_bounds": (-1, 0.15)},
            r"x_init = .*outside the bounds of x by 0.05",
        ),
        ({"x_init": [0, np.nan, 0, 0, 0]}, "x_init is .*nan.*finite"),
        ({"x_init": "down"}, "x_init is 'down'"),
        ({"x_bounds": (0.3, 1.0)}, "bounds of x cross at element 0: lower 0.3.*, upper 0.25"),
        ({"u_bounds": (-1, [1, -2])}, "bounds of u cross at element 1: lower -1.0, upper -2.0"),
        ({"u_bounds": (np.nan, 1.0)}, "lower end of u is nan: give numbers"),
        ({"x_bounds": ([0, 0], 1.0)}, r"lower end of x .*shape \(5,\)"),
        ({"u_scatter": (1.0, -1.0)}, "scatter of u cross at element 0"),
        ({"terminal_cost": pose}, r"terminal_cost returned shape \(2,\).*scalar.*residual"),
        ({"running_cost": effort}, r"running_cost returned shape \(2,\).*scalar"),
        ({"terminal_cost": fails}, "terminal_cost failed .*KeyError: 'no such sensor'"),
        ({"running_residual": fails}, "running_residual failed .*no such sensor"),
        ({"running_cost": branches}, "running_cost failed.*Python branches"),
        ({"terminal_cost": lambda data: None}, "terminal_cost returned None"),
        ({"terminal_cost": lambda data: 1}, "terminal_cost returned .*floats"),
        ({"terminal_cost": lambda data, u: 1.0}, "terminal_cost failed .*TypeError"),
        ({"running_residual": None}, "arm has no cost"),
        ({"goal": lambda data: data.qpos > 0}, r"goal returned shape \(2,\)"),
        ({"goal": lambda data: data.qqpos > 0}, "goal failed at x = .*AttributeError.*MjData"),
    ],
)
def test_arguments_that_are_refused(arguments, words):
    with pytest.raises(DraxError, match=words):
        problem(arm(), **arguments)


def test_another_initial_state_is_checked_too():
    task = problem(arm())
    moved = task.with_x_init([0.1, 0, 0, 0, 0])
    np.testing.assert_allclose(moved.x_init, [0.1, 0, 0, 0, 0])
    with pytest.raises(DraxError, match="outside the bounds"):
        task.with_x_init([9.0, 0, 0, 0, 0])
    with pytest.raises(DraxError, match="x_init"):
        task.with_x_init([0.1])


FALLING = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 0.15"><freejoint/><geom size="0.1"/></body>
<body pos="0 1 1"><joint name="j" axis="1 0 0"/>
<geom type="capsule" size="0.05" fromto="0 0 0 0 0 -0.5"/></body></worldbody>
<actuator><motor joint="j"/></actuator></mujoco>"""


@pytest.mark.usefixtures("trusted")
def test_replays_are_those_of_the_c_engine_and_a_chain_that_blows_up_leaves_others_alone():
    dynamics = from_mjcf(FALLING, horizon=0.4, dt=0.02, running_residual=lambda data, u: u).dynamics
    model, rng, chains, K = dynamics.mj_model, np.random.default_rng(0), 20, 20
    x0 = np.concatenate([model.qpos0, np.zeros(model.nv)])
    plan = np.broadcast_to(x0, (chains, K + 1, len(x0))).copy()
    plan[:, 0, 2] += rng.uniform(0, 0.1, chains)  # the ball falls on the plane
    plan[:, 0, 8:] = rng.normal(size=(chains, 7))
    u = rng.normal(size=(chains, K, 1))
    gains = 0.1 * rng.normal(size=(chains, K, 1, dynamics.ndx))
    plan[7, 0, 8] = 5e10  # more than the engine takes
    limits = (np.array([-0.5]), np.array([0.5]))
    states, applied = dynamics.replay(plan, u, gains, limits)
    assert np.isnan(states[7, 1:]).all()
    sound = [c for c in range(chains) if c != 7]
    for c in sound:
        data = mujoco.MjData(model)
        set_state(model, data, plan[c, 0])
        for k in range(K):
            off = difference(model, states[c, k], plan[c, k])
            data.ctrl[:] = np.clip(u[c, k] + gains[c, k] @ off, *limits)
            np.testing.assert_allclose(applied[c, k], data.ctrl, atol=1e-12)
            mujoco.mj_step(model, data, dynamics.substeps)
            x = np.concatenate([data.qpos, data.qvel])
            np.testing.assert_allclose(states[c, k + 1], x, atol=1e-6)
    assert states[sound, -1, 2].min() < 0.11  # it lies on the plane


@pytest.mark.parametrize("substeps", [1, 2])
def test_what_the_engine_would_reset_is_no_replay(substeps):
    xml = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="j" type="slide"/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
    <actuator><motor joint="j"/></actuator></mujoco>"""
    dynamics = problem(xml, dt=0.01 * substeps).dynamics
    u = np.zeros((2, 5, 1))
    u[1, 2:] = 9e9  # [N], less than a control may be, and velocities stay below 1e10 m/s
    mj_model = dynamics.mj_model
    mj_model.actuator_gear[0, 0] = 2.0  # but 1.8e10 m/s^2 is more than an acceleration may be
    limits = (np.array(-np.inf), np.array(np.inf))
    states, _ = dynamics.replay(np.zeros((2, 6, 2)), u, np.zeros((2, 5, 1, 2)), limits)
    assert np.isfinite(states[0]).all()
    assert np.isfinite(states[1, :3]).all()
    assert np.isnan(states[1, 3:]).all()


def test_a_start_outside_of_a_joints_range_is_said(recwarn):
    words = r"x_init of arm .*lift is at 0\.5, its range is -0\.5 to 0\.25 m\): move it inside"
    with pytest.warns(DraxWarning, match=words):
        problem(arm(), x_init=[0.5, 0.0, 0.0, 0.0, 0.0])
    problem(arm(), x_init=[0.25, 9.0, 0.0, 0.0, 0.0])  # on the limit; and a joint without a range
    assert not [w for w in recwarn if w.category is DraxWarning]
