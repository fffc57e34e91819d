"""Kinematics: the frames that MJX finds by walking along the tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax._mjx import mjx
from mjx_drax._mujoco import mujoco
from mjx_drax.models import path
from mjx_drax.tree import kinematics

EVERY_JOINT = """<mujoco><worldbody>
<body name="moved" mocap="true" pos="1 0 0" quat="0.6 0.8 0 0"><geom size="0.1"/></body>
<body pos="0 0 1" quat="0.8 0 0.6 0"><freejoint/><geom size="0.1" pos="0.1 0 0"/>
  <body pos="0.2 0 0.1"><joint type="ball" pos="0.1 0.2 0"/><geom size="0.1"/><site name="tip"/>
    <body pos="0 0.3 0" quat="0.6 0 0 0.8"><joint type="slide" axis="1 1 0" ref="0.2"/>
      <joint type="hinge" axis="0 1 1" pos="0 0 0.3" ref="-0.3"/><geom size="0.1"/>
      <body pos="0 0 0.4"><geom size="0.1" quat="0.8 0.6 0 0"/></body></body></body></body>
</worldbody></mujoco>"""
FRAMES = ("xanchor", "xaxis", "xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat")


@pytest.mark.parametrize("model", [EVERY_JOINT, "humanoid"])
def test_frames_are_those_of_mjx(model):
    if model == EVERY_JOINT:
        host = mujoco.MjModel.from_xml_string(model)
    else:
        host = mujoco.MjModel.from_xml_path(str(path(model)))
    with jax.enable_x64(True):
        device = mjx.put_model(host, impl="jax")
        drawn = np.random.default_rng(0).normal(size=host.nq)
        data = mjx.make_data(host, impl="jax").replace(qpos=jnp.asarray(drawn))
        found, expected = (jax.jit(f)(device, data) for f in (kinematics, mjx.kinematics))
        for name in (*FRAMES, "site_xpos", "site_xmat", "qpos"):
            ours, theirs = np.asarray(getattr(found, name)), np.asarray(getattr(expected, name))
            if name == "xquat":  # q and -q are the same rotation
                theirs = theirs * np.sign((ours * theirs).sum(axis=1, keepdims=True))
            np.testing.assert_allclose(ours, theirs, atol=1e-9, err_msg=name)
