"""Contacts of spheres and capsules with boxes, against those of MuJoCo's C engine."""

from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import assert_touch_alike, contacts_of, scattered

from mjx_drax.physics.contacts import boxes
from mjx_drax.physics.contacts.collision import make_data
from mjx_drax.physics.mjx_model import put_model

PAIR = """
<mujoco><worldbody>
  <body><freejoint/><geom name="one" type="{}" size="{}" margin="0.01"/></body>
  <body><freejoint/><geom name="other" type="box" size="{}"/></body>
</worldbody></mujoco>"""
SIZES = {"sphere": ".1", "capsule": ".06 .15"}
BOX = ".1 .15 .07"


def paired(one, size=None, box=BOX):
    return mujoco.MjModel.from_xml_string(PAIR.format(one, size or SIZES[one], box))


@pytest.mark.parametrize(
    ("one", "size", "box"),
    [
        ("sphere", ".1", BOX),
        ("capsule", ".06 .15", BOX),
        ("capsule", ".01 .4", ".1 .15 .07"),  # longer than the box is wide
        ("capsule", ".03 .02", ".2 .2 .002"),  # on a thin plate
    ],
)
def test_they_touch_as_in_the_c_engine_also_deep_inside(one, size, box):
    model, seen = paired(one, size, box), []
    with jax.enable_x64(True):
        find = contacts_of(model)
        for at in scattered(model, 500):
            assert_touch_alike(model, find(at), at.contact, 1e-12)
            seen.extend(at.contact.dist)
    assert len(seen) > 100
    assert min(seen) < -0.01


@pytest.mark.parametrize("turn", [(1, 0, 0, 0), (1, 1, 0, 0), (1, 0, 1, 0), (1, 0.3, 0, 0)])
@pytest.mark.parametrize("x64", [True, False])
def test_a_capsule_that_is_parallel_to_sides_of_a_box_touches_in_the_same_points(turn, x64):
    model, rng = paired("capsule"), np.random.default_rng(0)
    with jax.enable_x64(x64):
        find, at = contacts_of(model), mujoco.MjData(model)
        for _ in range(100):
            at.qpos[:] = 0.0
            at.qpos[:3], at.qpos[3:7], at.qpos[10] = rng.uniform(-0.25, 0.25, 3), turn, 1.0
            mujoco.mj_forward(model, at)
            if not at.ncon or np.abs(at.contact.dist - 0.01).min() < 1e-6:
                continue
            if x64:
                assert_touch_alike(model, find(at), at.contact, 1e-12)
            else:  # in either order of the ends, and of faces that are equally near
                found = find(at)
                acts = np.asarray(found.dist) < 0.01
                assert acts.sum() == at.ncon
                np.testing.assert_allclose(
                    np.sort(np.asarray(found.dist)[acts]), np.sort(at.contact.dist), atol=1e-6
                )


@cache
def slopes(one):
    """Derivatives of contacts by where the geoms are, compiled once for all poses."""
    on_device = put_model(paired(one))
    data, collide = make_data(on_device), getattr(boxes, f"{one}_box")

    def of(pos, mat):
        return collide(on_device, data.replace(geom_xpos=pos, geom_xmat=mat), jnp.array([[0, 1]]))

    return jax.jit(jax.jacfwd(of, (0, 1)))


@pytest.mark.parametrize("one", ["sphere", "capsule"])
@pytest.mark.parametrize(
    "apart",
    [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.13], [0.15, 0.15, 0.2], [0.1, 0.15, 0.22], [0, 0, 0.07]],
)
def test_in_symmetric_poses_derivatives_are_finite(one, apart):
    model = paired(one)
    at = mujoco.MjData(model)
    at.qpos[7:10] = apart
    mujoco.mj_kinematics(model, at)
    pose = jnp.asarray(at.geom_xpos), jnp.asarray(at.geom_xmat).reshape(-1, 3, 3)
    for derivative in jax.tree.leaves(slopes(one)(*pose)):
        assert np.isfinite(derivative).all()
