"""Kinematics and smooth dynamics: what MJX finds by a loop over the levels of the tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.models import path
from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import Joints
from mjx_drax.physics.tree import (
    com_pos,
    com_vel,
    frame_derivatives,
    inverse_derivatives,
    kinematics,
    mass_matrix,
    rne,
)

EVERY_JOINT = """<mujoco><worldbody>
<body name="moved" mocap="true" pos="1 0 0" quat="0.6 0.8 0 0"><geom size="0.1"/></body>
<body pos="0 0 1" quat="0.8 0 0.6 0"><freejoint/><geom size="0.1" pos="0.1 0 0"/>
  <body pos="0.2 0 0.1"><joint type="ball" pos="0.1 0.2 0"/><geom size="0.1"/><site name="tip"/>
    <body pos="0 0.3 0" quat="0.6 0 0 0.8"><joint type="slide" axis="1 1 0" ref="0.2"/>
      <joint type="hinge" axis="0 1 1" pos="0 0 0.3" ref="-0.3"/><geom size="0.1"/>
      <body pos="0 0 0.4"><geom size="0.1" quat="0.8 0.6 0 0"/></body></body></body></body>
</worldbody></mujoco>"""
FRAMES = ("xanchor", "xaxis", "xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat")


def drawn(model, gravity=True):
    """A model, in MuJoCo and on the device, and data at random positions and velocities."""
    if model == EVERY_JOINT:
        mj_model = mujoco.MjModel.from_xml_string(model)
    else:
        mj_model = mujoco.MjModel.from_xml_path(str(path(model)))
    mj_model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    if not gravity:
        mj_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
    device, random = mjx.put_model(mj_model, impl="jax"), np.random.default_rng(0)
    qpos, qvel = (jnp.asarray(random.normal(size=n)) for n in (mj_model.nq, mj_model.nv))
    return mj_model, device, mjx.make_data(mj_model, impl="jax").replace(qpos=qpos, qvel=qvel)


@pytest.mark.parametrize("model", [EVERY_JOINT, "double_pendulum"])
def test_frames_are_those_of_mjx(model):
    with jax.enable_x64(True):
        _, device, data = drawn(model)
        found, expected = (jax.jit(f)(device, data) for f in (kinematics, mjx.kinematics))
        for name in (*FRAMES, "site_xpos", "site_xmat", "qpos"):
            ours, theirs = np.asarray(getattr(found, name)), np.asarray(getattr(expected, name))
            if name == "xquat":  # q and -q are the same rotation
                theirs = theirs * np.sign((ours * theirs).sum(axis=1, keepdims=True))
            np.testing.assert_allclose(ours, theirs, atol=1e-9, err_msg=name)


def test_compilers_compute_each_round_of_frames_once():
    _, device, data = drawn(EVERY_JOINT)
    program = jax.make_jaxpr(kinematics)(device, data)
    # three rounds for five frames in a row, of positions with matrices, and of quaternions
    assert str(program).count("optimization_barrier") == 2 * 3


@pytest.mark.parametrize(
    ("model", "gravity"), [(EVERY_JOINT, True), (EVERY_JOINT, False), ("humanoid", True)]
)
def test_inertias_velocities_and_bias_forces_are_those_of_the_c_engine(model, gravity):
    with jax.enable_x64(True):
        mj_model, device, data = drawn(model, gravity)
        c_data = mujoco.MjData(mj_model)
        c_data.qpos[:], c_data.qvel[:] = data.qpos, data.qvel
        mujoco.mj_forward(mj_model, c_data)

        @jax.jit
        def everything(data):
            data = com_vel(device, com_pos(device, kinematics(device, data)))
            return rne(device, mass_matrix(device, data))

        found, M = everything(data), np.zeros((mj_model.nv, mj_model.nv))
        mujoco.mj_fullM(mj_model, c_data, M)
        np.testing.assert_allclose(found._impl.M, M, atol=1e-9)
        np.testing.assert_allclose(found._impl.cinert[1:], c_data.cinert[1:], atol=1e-9)
        for name in ("subtree_com", "cdof", "cvel", "cdof_dot", "qfrc_bias"):
            np.testing.assert_allclose(
                getattr(found, name), getattr(c_data, name), atol=1e-9, err_msg=name
            )


@pytest.mark.slow
def test_closed_derivatives_are_those_of_differences():
    """Of frames by positions, and of M a + bias by positions and velocities, in one direction."""
    with jax.enable_x64(True):
        _, device, start = drawn(EVERY_JOINT)
        start = kinematics(device, start)
        a, w, way = np.random.default_rng(1).normal(size=(3, device.nv))

        @jax.jit
        def everything(dq, dv):
            qpos = Joints.of(device).integrate(start.qpos, dq)
            data = kinematics(device, start.replace(qpos=qpos, qvel=start.qvel + dv))
            data = rne(device, com_vel(device, mass_matrix(device, com_pos(device, data))))
            M = data._impl.M - jnp.diag(device.dof_armature)
            return data, M @ a + data.qfrc_bias, M @ w

        def slopes(dq, dv):
            return jax.tree.map(
                lambda x, y: (np.asarray(x, float) - np.asarray(y, float)) / 2e-6,
                everything(1e-6 * dq, 1e-6 * dv),
                everything(-1e-6 * dq, -1e-6 * dv),
            )

        still = np.zeros(device.nv)
        data = everything(still, still)[0]
        frames, by_q, more_by_q = slopes(way, still)
        _, by_v, _ = slopes(still, way)
        for name, found in jax.jit(frame_derivatives)(device, data).items():
            along = np.tensordot(way, found, 1)
            np.testing.assert_allclose(along, getattr(frames, name), atol=1e-7, err_msg=name)
        found = jax.jit(inverse_derivatives)(device, data, a, w)
        for mine, wanted in zip(found, (by_q, by_v, more_by_q), strict=True):
            np.testing.assert_allclose(mine @ way, wanted, atol=1e-6)
