"""Contacts, against those of MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_drax.physics._mjx import COLLISIONS, mjx
from mjx_drax.physics.collision import CORNERS, collision, plane_box
from mjx_drax.physics.mjx_model import put_model

BOX = """
<mujoco>
  <worldbody>
    <geom type="plane" size="3 3 0.1" euler="5 0 0"/>
    <body><freejoint/><geom type="box" size="0.1 0.2 0.3" margin="0.02"/></body>
  </worldbody>
</mujoco>"""


def test_a_box_stands_on_the_corners_that_the_c_engine_has():
    model = mujoco.MjModel.from_xml_string(BOX)
    wanted, rng, counts = mujoco.MjData(model), np.random.default_rng(0), set()
    with jax.enable_x64(True):
        on_device = put_model(model)
        data = mjx.make_data(on_device)
        find = jax.jit(
            lambda pos, mat: (
                collision(on_device, data.replace(geom_xpos=pos, geom_xmat=mat))._impl.contact
            )
        )
        for _ in range(40):
            wanted.qpos[:] = [0, 0, 0.29, 1, *rng.normal(size=3) * 0.04]
            mujoco.mj_forward(model, wanted)
            mat = jnp.asarray(wanted.geom_xmat).reshape(-1, 3, 3)
            found = find(jnp.asarray(wanted.geom_xpos), mat)
            acting = np.asarray(found.dist) < model.geom_margin.sum()
            one, other = (np.lexsort(p.round(6).T) for p in (found.pos[acting], wanted.contact.pos))
            for name in ("dist", "pos", "frame"):
                here, there = (getattr(c, name) for c in (found, wanted.contact))
                there = there[other].reshape(here[acting].shape)
                np.testing.assert_allclose(here[acting][one], there, atol=1e-12)
            counts.add(wanted.ncon)
    assert counts >= {2, 3, 4}


def test_mjx_keeps_its_own_way():
    boxes = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX
    assert COLLISIONS[boxes] is not plane_box
    assert len(np.unique(CORNERS, axis=0)) == COLLISIONS[boxes].ncon * 2 == plane_box.ncon * 2
