"""Contacts of spheres, capsules and cylinders, against those of MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import assert_touch_alike, contacts_of, scattered

from mjx_drax.physics.contacts import spheres
from mjx_drax.physics.contacts.collision import make_data
from mjx_drax.physics.mjx_model import put_model

PAIR = """
<mujoco><worldbody>
  <body><freejoint/><geom name="one" type="{}" size="{}" margin="0.01"/></body>
  <body><freejoint/><geom name="other" type="{}" size="{}"/></body>
</worldbody></mujoco>"""
KINDS = {"sphere": ".1", "capsule": ".06 .15", "cylinder": ".12 .1", "tip": ".01 .012"}
FUNCTIONS = {
    "capsule": spheres.sphere_capsule,
    "cylinder": spheres.sphere_cylinder,
    "two": spheres.two_capsules,
}


def paired(one, other):
    kinds = [("capsule" if kind == "tip" else kind, KINDS[kind]) for kind in (one, other)]
    return mujoco.MjModel.from_xml_string(PAIR.format(*kinds[0], *kinds[1]))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("sphere", "capsule"),
        ("sphere", "tip"),
        ("capsule", "capsule"),
        ("capsule", "tip"),
        ("sphere", "cylinder"),
    ],
)
def test_they_touch_as_in_the_c_engine_also_deep_inside(one, other):
    model, seen = paired(one, other), []
    with jax.enable_x64(True):
        find = contacts_of(model)
        for at in scattered(model, 400):
            assert_touch_alike(model, find(at), at.contact, 1e-12)
            seen.extend(at.contact.dist)
    assert len(seen) > 30
    assert min(seen) < -0.03


@pytest.mark.parametrize(
    ("one", "other", "apart"),
    [
        ("sphere", "capsule", [0, 0, 0]),
        ("sphere", "cylinder", [0, 0, 0]),
        ("sphere", "cylinder", [0, 0, 0.15]),
        ("capsule", "capsule", [0.1, 0, 0]),
        ("capsule", "capsule", [0, 0, 0.3]),
        ("capsule", "capsule", [0, 0, 0]),
    ],
)
def test_in_symmetric_poses_derivatives_are_finite(one, other, apart):
    model = paired(one, other)
    on_device, at = put_model(model), mujoco.MjData(model)
    at.qpos[7:10] = apart
    mujoco.mj_kinematics(model, at)
    data = make_data(on_device).replace(geom_xmat=jnp.asarray(at.geom_xmat).reshape(-1, 3, 3))
    collide = FUNCTIONS["two" if one == other else other]

    def of(pos):
        return collide(on_device, data.replace(geom_xpos=pos), jnp.array([[0, 1]]))

    for derivative in jax.jit(jax.jacfwd(of))(jnp.asarray(at.geom_xpos)):
        assert np.isfinite(derivative).all()
