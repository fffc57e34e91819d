"""Numbers of a model that a problem leaves open, in the C engine."""

import mujoco
import numpy as np
import pytest

from mjx_drax.physics.c_engine.model_numbers import set_numbers

KINDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")


def model(size):
    """Bodies of two geoms in a row, one of which has this size, above a floor."""
    bodies = "".join(
        f"""<body pos="{i} 0 .35"><freejoint/><geom type="{kind}" size="{size}" mass="1"/>
          <geom size=".01" pos="0 0 .1" mass="1"/></body>"""
        for i, kind in enumerate(KINDS)
    )
    floor = '<geom type="plane" size="1 1 .1"/>'
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{floor}{bodies}</worldbody></mujoco>"
    )


def test_geoms_of_another_size_touch_as_those_that_were_compiled_with_it():
    small, large = model(".05 .06 .07"), model(".2 .3 .4")
    before = mujoco.MjData(small)
    mujoco.mj_forward(small, before)
    size = small.geom_size.copy()
    size[1::2] = large.geom_size[1::2]
    set_numbers(small, {"geom_size": size})
    for name in ("geom_size", "geom_rbound", "geom_aabb"):
        np.testing.assert_allclose(getattr(small, name), getattr(large, name), err_msg=name)
    here, there = mujoco.MjData(small), mujoco.MjData(large)
    for changed, data in ((small, here), (large, there)):
        mujoco.mj_forward(changed, data)
    assert before.ncon == 0
    assert here.ncon == there.ncon > 4
    depths = np.sort(here.contact.dist)
    assert depths == pytest.approx(np.sort(there.contact.dist))
