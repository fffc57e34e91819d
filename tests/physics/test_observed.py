"""What costs read by name is what `mujoco.MjData` has under that name."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError, Terms, from_mjcf
from mjx_drax.kernels.pruning import needed_program
from mjx_drax.physics.dynamics import mjx_dynamics
from mjx_drax.physics.mjx_model import unknown_sensors
from mjx_drax.problem.trajectory import Knot

MODEL = """
<mujoco model="toy"><option timestep="0.01"><flag contact="disable"/></option>
  <worldbody>
    <body name="base"><freejoint name="floating"/><geom name="hull" size="0.1"/>
      <site name="mark" pos="0.1 0.2 0.3" euler="10 20 30"/>
      <body name="arm" pos="0 0 0.3"><joint name="shoulder" type="ball"/><geom size="0.1"/>
        <body name="hand" pos="0.1 0 0.2"><joint name="wrist" axis="0 1 0"/>
          <camera name="eye" pos="0 0 1"/><geom name="palm" type="box" size="0.1 0.2 0.3"/>
          <site name="tip" pos="0 0 0.3"/></body></body></body>
  </worldbody>
  <tendon><fixed name="cord"><joint joint="wrist" coef="2"/></fixed></tendon>
  <actuator><motor name="turn" joint="wrist" gear="3"/><motor name="pull" tendon="cord"/></actuator>
  <sensor><jointpos name="angle" joint="wrist"/><gyro name="rates" site="mark"/></sensor>
</mujoco>"""

NAMED = {
    "body": ("hand", "base", "world"),
    "geom": ("palm", "hull"),
    "site": ("tip", "mark"),
    "camera": ("eye",),
    "joint": ("floating", "shoulder", "wrist"),
    "actuator": ("pull", "turn"),
    "tendon": ("cord",),
    "sensor": ("rates", "angle"),
}


def toy(**functions):
    return from_mjcf(MODEL, horizon=0.02, **{"terminal_residual": lambda d: d.qvel, **functions})


def drawn(problem):
    rng, dynamics = np.random.default_rng(0), problem.dynamics
    x = dynamics.valid(jnp.asarray(rng.normal(size=dynamics.nx), jnp.float32))
    return x, jnp.asarray(rng.normal(size=dynamics.nu), jnp.float32)


def values(data, parts):
    """What the named elements of data have, whichever engine they come from."""
    found = {}
    for kind, names in NAMED.items():
        for name in names:
            element = getattr(data, kind)(name)
            assert element.name == name
            found |= {(kind, name, part): getattr(element, part) for part in parts[kind]}
    return found


@pytest.mark.slow
def test_elements_have_what_the_c_engine_has_in_the_same_shapes():
    problem = toy()
    x, u = drawn(problem)
    shapes = jax.eval_shape(problem.dynamics.observe, x, u)
    parts = {kind: set(dir(getattr(shapes, kind)(0))) - {"id", "name"} for kind in NAMED}
    assert {"xpos", "xquat", "xmat", "cvel"} <= parts["body"]
    seen = jax.jit(lambda x, u: values(problem.dynamics.observe(x, u), parts))(x, u)
    model = problem.dynamics.mj_model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = x[: model.nq], x[model.nq :], u
    mujoco.mj_forward(model, data)
    wanted = values(data, parts)
    for key, value in seen.items():
        assert value.shape == wanted[key].shape, key
        np.testing.assert_allclose(value, wanted[key], rtol=1e-3, atol=2e-3, err_msg=str(key))


@pytest.mark.slow
def test_one_function_is_cost_and_goal_and_its_derivative_is_that_of_the_array():
    def height(data, *_):
        return data.site("tip").xpos[2:]

    problem = toy(running_residual=height, goal=lambda data: height(data)[0] < 9)
    plain = toy(running_residual=lambda data, u: data.site_xpos[1, 2:])
    x, u = drawn(problem)
    ours, theirs = (jax.jit(jax.value_and_grad(p.running_cost))(x, u) for p in (problem, plain))
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)
    assert problem.reached(np.asarray(x, float)) is True


@pytest.mark.slow
def test_knots_in_a_batch_are_read_along_the_last_axes():
    problem = toy()
    x, u = (jnp.stack([a, 2 * a]) for a in drawn(problem))
    shapes = jax.eval_shape(jax.vmap(problem.dynamics.observe), x, u)
    mat = jax.eval_shape(lambda data: data.body("hand").xmat, shapes)
    assert mat.shape == (2, 9)
    assert jax.eval_shape(lambda data: data.joint("shoulder").qpos, shapes).shape == (2, 4)


@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize(
    ("read", "words"),
    [
        (lambda d: d.site("tpi").xpos, "no site 'tpi': there is 'mark', 'tip'"),
        (lambda d: d.camera(3).xpos, "no camera 3: there is 'eye'"),
        (lambda d: d.body(None).xpos, "no body None: there is 'world', 'base', 'arm', 'hand'"),
        (lambda d: d.geom("palm").xquat, "a geom has no 'xquat': it has xpos, xmat"),
        (lambda d: d.qpos_of_tip, "mjx.Data has no 'qpos_of_tip'"),
        (lambda d: d.subtree_linvel, "not computed in a plan: use a sensor subtreelinvel"),
        (lambda d: d.contact.dist, "data.contact is not computed in a plan: use a sensor touch"),
    ],
)
def test_wrong_names_list_those_that_there_are(read, words):
    with pytest.raises(DraxError, match=re.escape(words)):
        toy(terminal_residual=read)


SENSED = """<mujoco><option timestep="0.01"/><worldbody><site name="w" pos="0 0 1"/>{geom}
  <body name="a"><joint name="j" axis="0 1 0" stiffness="3"/><geom size="0.1" pos="0.2 0 0"/>
    <site name="s"/><body name="b" pos="0.5 0 0"><joint type="ball" stiffness="2"/>
      <geom size="0.1" mass="2"/></body></body></worldbody>
  <tendon>{tendon}</tendon><actuator><motor joint="j"/></actuator>
  <sensor><clock name="clock"/><force name="force" site="s"/><rangefinder name="ray" site="s"/>
    <subtreelinvel name="speed" body="a"/></sensor></mujoco>"""
SPATIAL = '<spatial name="t" stiffness="3"><site site="w"/><site site="s"/></spatial>'
FIXED = '<fixed name="t" stiffness="3"><joint joint="j" coef="1"/></fixed>'


@pytest.mark.parametrize(
    ("tendon", "geom", "unknown"),
    [
        (FIXED, "", []),
        (SPATIAL, "", ["force"]),
        (FIXED, '<geom type="cylinder" size="0.1 0.1" pos="0 9 0"/>', ["ray"]),
    ],
)
def test_sensors_that_mjx_computes_otherwise_are_unknown(tendon, geom, unknown):
    model = mujoco.MjModel.from_xml_string(SENSED.format(tendon=tendon, geom=geom))
    found = [model.sensor(int(i)).name for i in np.flatnonzero(unknown_sensors(model))]
    assert found == unknown


@pytest.mark.slow
def test_clocks_passive_forces_and_speeds_of_other_masses_are_those_of_the_c_engine():
    xml = SENSED.format(tendon=FIXED, geom="")
    problem = from_mjcf(
        xml,
        horizon=0.02,
        terminal_residual=lambda data: data.qvel,
        parameters={"mass": (1.0, 9.0)},
        model_numbers=lambda model, p: {"body_mass": model.body_mass.at[2].set(p["mass"])},
    )
    of_body, own = problem.dynamics, mujoco.MjModel.from_xml_string(xml)
    x = np.zeros(of_body.nx)
    x[:5], x[5:9] = [0.3, 0.8, 0.6, 0.0, 0.0], [1.0, 2.0, 3.0, 4.0]
    x[-1] = 5.0  # the mass
    knot = Knot(0.5, 0, 0.01, None, jnp.asarray(x), {"mass": jnp.asarray(5.0)})
    inner = mjx_dynamics(of_body).at(knot)
    seen = jax.jit(inner.observe)(jnp.asarray(x[:9], jnp.float32), jnp.zeros(1))
    own.body_mass[2] = 5.0
    data = mujoco.MjData(own)
    mujoco.mj_setConst(own, data)
    data.qpos[:], data.qvel[:], data.time = x[:5], x[5:9], 0.5
    mujoco.mj_forward(own, data)
    np.testing.assert_allclose(seen.sensor("clock").data, 0.5)
    np.testing.assert_allclose(seen.sensor("speed").data, data.sensor("speed").data, atol=1e-4)
    np.testing.assert_allclose(seen.qfrc_passive, data.qfrc_passive, atol=1e-4)
    np.testing.assert_allclose(seen.qfrc_applied, 0.0)


@pytest.mark.parametrize("read", ["by name", "as a term"])
def test_a_cost_that_reads_a_sensor_does_not_compute_those_of_other_types(read):
    def operations(model):
        problem = from_mjcf(model, horizon=0.02, terminal_residual=lambda data: data.qvel)
        angle = Terms(model).sensor("angle")

        def cost(x):
            data = problem.dynamics.observe(x, jnp.zeros(2))
            return data.sensor("angle").data if read == "by name" else angle(data)

        return str(needed_program(cost, (problem.x_init,))[0]).count("=")

    without = MODEL.replace('<gyro name="rates" site="mark"/>', "")
    more = MODEL.replace("<sensor>", '<sensor><framelinacc objtype="site" objname="tip"/>')
    assert operations(more) <= operations(without) + 5
