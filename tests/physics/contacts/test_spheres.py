"""Contacts of spheres, capsules, cylinders and ellipsoids, against those of MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import assert_touch_alike, contacts_of, scattered

from mjx_drax.physics.contacts import solids, spheres
from mjx_drax.physics.contacts.collision import make_data
from mjx_drax.physics.mjx_model import put_model

PAIR = """
<mujoco><worldbody>
  <body><freejoint/><geom name="one" type="{}" size="{}" margin="0.01"/></body>
  <body><freejoint/><geom name="other" type="{}" size="{}"/></body>
</worldbody></mujoco>"""
KINDS = {
    "sphere": ".1",
    "capsule": ".06 .15",
    "cylinder": ".12 .1",
    "tip": ".01 .012",
    "ellipsoid": ".15 .1 .05",
}
FUNCTIONS = {
    "sphere capsule": spheres.sphere_capsule,
    "sphere cylinder": solids.sphere_cylinder,
    "sphere ellipsoid": solids.sphere_ellipsoid,
    "capsule capsule": spheres.two_capsules,
    "capsule cylinder": solids.capsule_cylinder,
    "capsule ellipsoid": solids.capsule_ellipsoid,
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
    ("one", "other"), [("capsule", "cylinder"), ("capsule", "ellipsoid"), ("sphere", "ellipsoid")]
)
def test_they_touch_solids_as_in_the_c_engine(one, other):
    """Whose own search ends at 1e-6; a capsule on an end of a cylinder is another test's."""
    model, seen = paired(one, other), []
    with jax.enable_x64(True):
        find = contacts_of(model)
        for at in scattered(model, 400):
            found = find(at)
            acting = np.asarray(found.dist) < 0.01
            assert acting.any() == (at.ncon > 0)
            deep = at.ncon > 0 and at.contact.dist.min() < -0.98 * model.geom_size[0, 0]
            if at.ncon == 1 and not deep:  # deep: the capsule's axis is inside
                assert acting.sum() == 1
                seen.append(at.contact.dist[0])
                np.testing.assert_allclose(found.dist[acting], seen[-1], atol=1e-5)
                np.testing.assert_allclose(found.pos[acting], at.contact.pos, atol=3e-5)
                wanted = at.contact.frame[:, :3]
                np.testing.assert_allclose(found.frame[acting, 0], wanted, atol=1e-4)
    assert len(seen) > 30
    assert min(seen) < -0.04


@pytest.mark.parametrize("tilt", [0.0, 0.02, 0.2])
def test_a_capsule_on_an_end_of_a_cylinder_touches_both_ends_of_it(tilt):
    model = paired("capsule", "cylinder")
    at = mujoco.MjData(model)
    at.qpos[:3], at.qpos[7:] = [0.05, 0, 0.155], [0, 0, 0, 1, 0, 0, 0]
    turn = np.pi / 2 + tilt
    at.qpos[3:7] = [np.cos(turn / 2), 0, np.sin(turn / 2), 0]
    mujoco.mj_forward(model, at)
    with jax.enable_x64(True):
        found = contacts_of(model)(at)
    acting = np.asarray(found.dist) < 0.01
    assert acting.sum() == at.ncon == (2 if tilt < solids.FLAT else 1)
    order = np.argsort(at.contact.pos[:, 0])
    mine = np.argsort(np.asarray(found.pos[acting])[:, 0])
    np.testing.assert_allclose(found.pos[acting][mine], at.contact.pos[order], atol=5e-3)
    np.testing.assert_allclose(found.dist[acting][mine], at.contact.dist[order], atol=5e-4)


@pytest.mark.parametrize("other", ["cylinder", "ellipsoid"])
def test_derivatives_of_capsules_on_solids_are_those_of_differences(other):
    model, rng, seen = paired("capsule", other), np.random.default_rng(3), 0
    with jax.enable_x64(True):
        on_device = put_model(model)
        data, pair = make_data(on_device), jnp.array([[0, 1]])

        def of(pos, turn):
            changed = data.replace(geom_xpos=data.geom_xpos.at[0].set(pos), geom_xmat=turn)
            return [array[0] for array in FUNCTIONS[f"capsule {other}"](on_device, changed, pair)]

        both = jax.jit(lambda pos, turn: (of(pos, turn), jax.jacfwd(of)(pos, turn)))
        for at in scattered(model, 60):
            turn = jnp.asarray(at.geom_xmat).reshape(-1, 3, 3)
            pos, step = jnp.asarray(at.qpos[:3] - at.qpos[7:10]), 1e-6 * rng.normal(size=3)
            value, slopes = both(pos, turn)
            if not -0.05 < value[0] < 0.2:
                continue
            ends = [both(pos + sign * step, turn)[0] for sign in (1, -1)]
            for slope, end, start in zip(slopes, *ends, strict=True):
                np.testing.assert_allclose(slope @ step, (end - start) / 2, atol=1e-9)
            seen += 1
    assert seen > 10


@pytest.mark.parametrize(
    ("one", "other", "apart"),
    [
        ("sphere", "capsule", [0, 0, 0]),
        ("sphere", "cylinder", [0, 0, 0]),
        ("sphere", "cylinder", [0, 0, 0.15]),
        ("sphere", "ellipsoid", [0, 0, 0]),
        ("sphere", "ellipsoid", [0, 0, 0.14]),
        ("capsule", "ellipsoid", [0, 0, 0]),
        ("capsule", "ellipsoid", [0.2, 0, 0]),
        ("capsule", "cylinder", [0, 0, 0]),
        ("capsule", "cylinder", [0, 0, 0.3]),
        ("capsule", "cylinder", [0.175, 0, 0]),
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
    collide = FUNCTIONS[f"{one} {other}"]

    def of(pos):
        return collide(on_device, data.replace(geom_xpos=pos), jnp.array([[0, 1]]))

    for derivative in jax.jit(jax.jacfwd(of))(jnp.asarray(at.geom_xpos)):
        assert np.isfinite(derivative).all()
