"""Contacts, against those of MuJoCo's C engine."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import assert_touch_alike, contacts_of

from mjx_drax.physics._mjx import COLLISIONS, collision_driver, mjx
from mjx_drax.physics.contacts import polytopes
from mjx_drax.physics.contacts.collision import (
    CORNERS,
    collision,
    extended,
    hull_of,
    hulls_of_one_size,
    make_data,
    plane_box,
)
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
        find = contacts_of(model)
        for _ in range(40):
            wanted.qpos[:] = [0, 0, 0.29, 1, *rng.normal(size=3) * 0.04]
            mujoco.mj_forward(model, wanted)
            assert_touch_alike(model, find(wanted), wanted.contact, 1e-12)
            counts.add(wanted.ncon)
    assert counts >= {2, 3, 4}


def _prism(sides):
    around = np.arange(sides) * 2 * np.pi / sides
    return [[0.1 * np.cos(a), 0.1 * np.sin(a), z] for a in around for z in (-0.05, 0.05)]


def _blob(corners):
    points = np.random.default_rng(5).normal(size=(corners, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [0.1, 0.08, 0.12]


@pytest.mark.parametrize("corners", [0.1 * CORNERS, _prism(6), _prism(12), _blob(30)])
def test_a_mesh_stands_on_the_face_that_the_c_engine_has(corners):
    numbers = " ".join(map(str, np.ravel(corners)))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="m" vertex="{numbers}"/></asset><worldbody>'
        '<geom type="plane" size="0 0 1" euler="5 0 0"/><body><freejoint/>'
        '<geom type="mesh" mesh="m" margin="0.003"/></body></worldbody></mujoco>'
    )
    wanted, rng, counts = mujoco.MjData(model), np.random.default_rng(0), set()
    with jax.enable_x64(True):
        find = contacts_of(model)
        for tilt in [0.05] * 20 + [2.0] * 20:
            wanted.qpos[:] = [0, 0, 0, 1, *rng.normal(size=3) * tilt]
            mujoco.mj_kinematics(model, wanted)
            up, turn = wanted.geom_xmat[0].reshape(3, 3)[:, 2], wanted.geom_xmat[1].reshape(3, 3)
            low = ((model.mesh_vert @ turn.T + wanted.geom_xpos[1]) @ up).min()
            wanted.qpos[:3] -= (low + rng.uniform(-0.002, 0.03)) * up
            mujoco.mj_forward(model, wanted)
            assert_touch_alike(model, find(wanted), wanted.contact, 1e-7)
            counts.add(wanted.ncon)
    assert counts >= {1, 2}
    assert max(counts) > 2


def test_mjx_keeps_its_own_way():
    boxes = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX
    assert COLLISIONS[boxes] is not plane_box
    assert len(np.unique(CORNERS, axis=0)) == COLLISIONS[boxes].ncon * 2 == plane_box.ncon * 2


PRISM = "-.1 -.1 -.1 .1 -.1 -.1 0 .12 -.1 -.1 -.1 .1 .1 -.1 .1 0 .12 .1"
MEETING = """
<mujoco>
  <asset><mesh name="m" vertex="{mesh}"/></asset>
  <worldbody>
    <geom {other} margin="{margin}"/>
    <body><freejoint/><geom type="{kind}" size="0.06 0.1 0.04"/></body>
  </worldbody>
</mujoco>"""
BOXES, MESHES = 'type="box" size=".1 .12 .08"', 'type="mesh" mesh="m"'


def meeting(kind, other, margin=0.0):
    xml = MEETING.format(kind=kind, other=other, margin=margin, mesh=PRISM)
    return mujoco.MjModel.from_xml_string(xml)


def approached(model, count, depth, seed=0):
    """Data of the C engine with geoms in random poses that overlap by up to `depth` [m].

    With a negative depth they are apart.
    """
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    for _ in range(count):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        data.qpos[3:] = rng.normal(size=4)
        near, far = 0.0, 0.5
        for _ in range(30):
            middle = (near + far) / 2
            data.qpos[:3] = middle * direction
            mujoco.mj_kinematics(model, data)
            apart = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) > 0
            near, far = (near, middle) if apart else (middle, far)
        data.qpos[:3] = (near - depth * rng.uniform()) * direction
        mujoco.mj_forward(model, data)
        yield data


def laid(model, count):
    """Data of the C engine with one geom nearly flat on the other."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(count):
        data.qpos[3:] = 1.0, *(0.02 * rng.normal(size=2)), rng.uniform(-1, 1)
        data.qpos[:3] = *rng.uniform(-0.05, 0.05, 2), 0.5
        mujoco.mj_kinematics(model, data)
        data.qpos[2] -= mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) + 0.002
        mujoco.mj_forward(model, data)
        yield data


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "other", "usual", "worst"),
    [
        ("cylinder", MESHES, 1e-4, 3e-3),
        ("ellipsoid", BOXES, 2e-5, 1e-4),
    ],
)
def test_cylinders_and_ellipsoids_meet_boxes_and_meshes_as_in_the_c_engine(
    kind, other, usual, worst
):
    model = meeting(kind, other)
    contacts_of(model)(mujoco.MjData(model))  # constants of float32 are not those of float64
    with jax.enable_x64(True):
        find = contacts_of(model)
        depths, normals = [], []
        for wanted in approached(model, 100, 0.004):
            found = find(wanted)
            here, there = int(found.dist.argmin()), int(wanted.contact.dist.argmin())
            depths.append(abs(float(found.dist[here]) - wanted.contact.dist[there]))
            # MuJoCo's normals point from the first geom to the second one
            sign = 1 if wanted.contact.geom[there, 0] == found.geom[here, 0] else -1
            normals.append(sign * found.frame[here, 0] @ wanted.contact.frame[there, :3])
            wanted.qpos[:3] *= 1.2
            mujoco.mj_forward(model, wanted)
            apart = find(wanted).dist.min()
            assert wanted.ncon or float(apart) > 0
    assert np.quantile(depths, 0.85) < usual
    assert np.max(depths) < worst
    assert np.quantile(normals, 0.2) > 0.99


def test_the_side_of_a_cylinder_touches_an_edge_once_as_in_the_c_engine():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="box" size=".1 .12 .08"/>
        <body><freejoint/><geom type="cylinder" size=".06 .1"/></body></worldbody></mujoco>"""
    )
    wanted = mujoco.MjData(model)
    with jax.enable_x64(True):
        find = contacts_of(model)
        for depth in (0.001, 0.003):
            away = (0.06 - depth) * np.array([0.6, 0, 0.8])
            # The axis leans over the edge along y, at an angle with it
            wanted.qpos[:3], wanted.qpos[3:] = np.array([0.1, 0.01, 0.08]) + away, [1, 0.9, 0.3, 0]
            axis = np.cross(away, [0.6, 1.0, -0.45])
            mujoco.mju_quatZ2Vec(wanted.qpos[3:], axis / np.linalg.norm(axis))
            mujoco.mj_forward(model, wanted)
            found = find(wanted)
            assert wanted.ncon == 1
            assert np.sum(found.dist < 0) == 1
            np.testing.assert_allclose(found.dist.min(), wanted.contact.dist[0], atol=1e-6)


@pytest.mark.parametrize("kind", ["box", 'mesh" mesh="m'], ids=["box", "mesh"])
def test_meshes_touch_boxes_and_meshes_as_in_the_c_engine(kind):
    """In any pose, and nearly flat on each other: as many contacts, where it has them."""
    model, counts = meeting(kind, MESHES), []
    with jax.enable_x64(True):
        find = contacts_of(model)
        for wanted in itertools.chain(approached(model, 60, 0.004), laid(model, 40)):
            found, there = find(wanted), wanted.contact
            acts = np.asarray(found.dist) < 0
            assert acts.sum() == wanted.ncon > 0
            sign = 1 if there.geom[0, 0] == found.geom[0, 0] else -1
            here = np.c_[found.dist, found.pos, sign * np.asarray(found.frame)[:, 0]][acts]
            apart = np.abs(here[:, None] - np.c_[there.dist, there.pos, there.frame[:, :3]])
            counts.append((wanted.ncon, max(apart.max(axis=2).min(axis=i).max() for i in (0, 1))))
    ncon, errors = np.array(counts).T
    assert set(ncon) >= {1, 2, 3, 4}
    assert np.quantile(errors, 0.9) < 1e-9


@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_spheres_and_capsules_meet_meshes(kind):
    model = meeting(kind, MESHES)
    with jax.enable_x64(True):
        find, errors = contacts_of(model), []
        for wanted in approached(model, 30, 0.004):
            errors.append(float(find(wanted).dist.min()) - wanted.contact.dist.min())
    assert np.median(np.abs(errors)) < 1e-6  # MJX has other contacts of some capsules


def test_meshes_lie_on_height_fields():
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name="m" vertex="{PRISM}"/>
        <hfield name="h" nrow="4" ncol="4" size=".5 .5 .1 .1"/></asset><worldbody>
        <geom type="hfield" hfield="h"/>
        <body pos=".02 .03 .098"><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>
        </mujoco>"""
    )
    model.hfield_data[:] = 0.0
    wanted = mujoco.MjData(model)
    mujoco.mj_forward(model, wanted)
    with jax.enable_x64(True):
        found = contacts_of(model)(wanted)
    assert wanted.ncon
    np.testing.assert_allclose(found.dist.min(), wanted.contact.dist.min(), atol=1e-3)


def _bumpy(seed):
    """Corners of a box whose sides are bent by 0.01 rad; one corner is there twice."""
    at = np.array(list(itertools.product((-1, -0.4, 0.3, 1), repeat=3)))
    at = at[np.abs(at).max(axis=1) == 1]
    at = at / np.linalg.norm(at, axis=1, keepdims=True) ** 0.01
    points = np.random.default_rng(seed).uniform(0.999, 1.001, at.shape) * at * [0.1, 0.08, 0.06]
    return np.concatenate([points, points[[0]] * (1 + 1e-6)])


def test_hulls_with_faces_that_are_almost_one_touch_as_in_the_c_engine():
    """It takes triangles within 0.01 rad for one polygon, and measures depths from that."""
    meshes = "".join(
        f'<mesh name="{name}" vertex="{" ".join(map(str, _bumpy(seed).ravel()))}"/>'
        for seed, name in enumerate("ab")
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset>{meshes}</asset><worldbody><geom type="mesh" mesh="a"/>
        <body><freejoint/><geom type="mesh" mesh="b"/></body></worldbody></mujoco>"""
    )
    model.opt.ccd_iterations = 200
    with jax.enable_x64(True):
        find, errors, counts = contacts_of(model), [], []
        for wanted in itertools.chain(approached(model, 40, 0.03), laid(model, 20)):
            found, there = find(wanted), wanted.contact
            acts = np.asarray(found.dist) < 0
            here = np.c_[found.dist, found.pos, np.asarray(found.frame)[:, 0]][acts]
            apart = np.abs(here[:, None] - np.c_[there.dist, there.pos, there.frame[:, :3]])
            errors.append(max(apart.max(axis=2).min(axis=i).max() for i in (0, 1)))
            counts.append((wanted.ncon, acts.sum()))
    of_c, own = np.array(counts).T
    assert set(of_c) >= {1, 2, 3, 4}
    assert np.mean(of_c == own) > 0.9
    assert np.quantile(errors, 0.7) < 1e-8


def test_a_box_lies_on_a_box_however_its_sides_lie_as_in_the_c_engine():
    """In up to eight points; edges that overlap a little less than faces do not touch instead."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="box" size=".1 .1 .05"/>
        <body><freejoint/><geom type="box" size=".1 .1 .04"/></body></worldbody></mujoco>"""
    )
    at, rng, counts = mujoco.MjData(model), np.random.default_rng(0), set()
    with jax.enable_x64(True):
        find = contacts_of(model)
        for tilt in [0.0] * 5 + [0.002] * 10 + [0.03] * 10:
            turn = 0.3 * len(counts)
            at.qpos[:] = [0.01, 0.02, 0.0885, 1, *rng.normal(size=2) * tilt, turn]
            mujoco.mj_forward(model, at)
            assert_touch_alike(model, find(at), at.contact, 1e-6)
            counts.add(at.ncon)
    assert counts >= {4, 8}


def test_two_boxes_touch_at_every_point_once():
    model = meeting("box", BOXES)
    with jax.enable_x64(True):
        find = contacts_of(model)
        for wanted in approached(model, 30, 0.004):
            found = find(wanted)
            acting = np.asarray(found.pos)[np.asarray(found.dist) < 0].round(5)
            assert len(np.unique(acting, axis=0)) == len(acting)


def test_a_box_lies_on_a_box_as_in_the_c_engine():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="box" size=".25 .35 .2"/>
        <body><freejoint/><geom type="box" size=".02 .03 .04"/></body></worldbody></mujoco>"""
    )
    wanted, rng, counts = mujoco.MjData(model), np.random.default_rng(0), set()
    with jax.enable_x64(True):
        find = contacts_of(model)
        for tilt in [0.0] + [0.01] * 20:
            wanted.qpos[:] = [0.01, 0.02, 0.2395, 1, *rng.normal(size=3) * tilt]
            mujoco.mj_forward(model, wanted)
            assert_touch_alike(model, find(wanted), wanted.contact, 1e-9)
            counts.add(wanted.ncon)
    assert counts >= {2, 3, 4}


@pytest.mark.parametrize("depth", [0.004, -0.008])
def test_boxes_that_overlap_or_are_within_their_margin_touch_as_in_the_c_engine(depth):
    model = meeting("box", BOXES, margin=0.01)
    with jax.enable_x64(True):
        find, close = contacts_of(model), []
        for wanted in approached(model, 60, depth):
            found, there = find(wanted), wanted.contact
            nearest = int(np.argmin(found.dist))
            if not wanted.ncon:
                close.append(found.dist[nearest] > 0.01)
                continue
            off = np.linalg.norm(there.pos - found.pos[nearest], axis=1).min()
            close.append(abs(found.dist[nearest] - there.dist.min()) < 1e-6 and off < 1e-5)
    assert np.mean(close) >= 0.95


def test_hulls_of_meshes_have_no_corner_outside_of_a_face():
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 45)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    cone = np.concatenate([ring, ring * 0.7 + np.array([0, 0, 0.5])])
    for points in (rng.normal(size=(60, 3)), cone):
        vertex = " ".join(f"{x:.9f}" for x in (0.1 * points).ravel())
        model = mujoco.MjModel.from_xml_string(
            MEETING.replace("{mesh}", vertex).format(kind="sphere", other=MESHES, margin=0.0)
        )
        hull = hull_of(model, 0)
        inside = (hull.face_normal * hull.face[:, 0]).sum(axis=1)
        assert (hull.vert @ hull.face_normal.T - inside).max() < 1e-6
        corners, edges = len(hull.vert), len(hull.edge)
        assert edges == hull.edge_face_normal.shape[0] == corners + len(hull.face) - 2


CAPSULE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="3 3 0.1" euler="5 0 0"/>
    <body><freejoint/><geom type="capsule" size="0.05 0.1" margin="0.02"/></body>
  </worldbody>
</mujoco>"""


def test_capsules_at_any_angle_slide_as_in_the_c_engine():
    """Directions of friction along and across a capsule; MJX has others where it is steep."""
    model = mujoco.MjModel.from_xml_string(CAPSULE)
    wanted, rng, steep = mujoco.MjData(model), np.random.default_rng(0), 0
    with jax.enable_x64(True):
        find = contacts_of(model)
        for _ in range(40):
            tilt, turn = rng.uniform(0.0, np.pi / 2), rng.uniform(-np.pi, np.pi)
            axis = [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
            mujoco.mju_quatZ2Vec(wanted.qpos[3:], np.array(axis))
            wanted.qpos[:3] = 0, 0, 0.04 + 0.1 * np.cos(tilt)
            mujoco.mj_forward(model, wanted)
            found = find(wanted)
            acting = np.asarray(found.dist) < model.geom_margin.sum()
            assert acting.sum() == wanted.ncon > 0
            one, other = (np.lexsort(p.round(6).T) for p in (found.pos[acting], wanted.contact.pos))
            for name in ("dist", "pos", "frame"):
                here, there = (getattr(c, name) for c in (found, wanted.contact))
                there = there[other].reshape(here[acting].shape)
                np.testing.assert_allclose(here[acting][one], there, atol=1e-12)
            steep += tilt < np.pi / 6
        mujoco.mj_resetData(model, wanted)  # upright: any direction is as good, and finite
        assert np.isfinite(find(wanted).frame).all()
    assert steep > 5


def test_pairs_one_by_one_touch_as_all_at_once():
    spec = mujoco.MjSpec()
    for x, turn in ((0.0, 0.0), (0.19, 0.3), (0.4, 0.0), (1.5, 0.0)):  # on each other, far away
        body = spec.worldbody.add_body(pos=[x, 0.0, 0.0], quat=[1.0, 0.0, turn, 0.0])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1] * 3, margin=0.05)
    with jax.enable_x64(True):
        model = put_model(spec.compile())
        data = jax.jit(mjx.kinematics)(model, make_data(model))
        at_once = jax.jit(lambda: collision(model, data)._impl.contact)()
        with hulls_of_one_size():
            one_by_one = jax.jit(lambda: collision(model, data)._impl.contact)()
    near = np.asarray(at_once.dist) < 0.05
    assert {tuple(pair) for pair in np.asarray(at_once.geom)[near].tolist()} == {(0, 1), (1, 2)}
    assert np.array_equal(near, np.asarray(one_by_one.dist) < 0.05)
    orders = [  # points at the same distance come in any order
        np.lexsort([*np.asarray(found.pos)[near].round(6).T, *np.asarray(found.geom)[near].T])
        for found in (at_once, one_by_one)
    ]
    for name in ("dist", "pos", "frame", "geom"):
        one, other = (np.asarray(getattr(found, name))[near] for found in (at_once, one_by_one))
        np.testing.assert_allclose(one[orders[0]], other[orders[1]], atol=1e-12)


CONDIMS = """
<mujoco><worldbody><geom name="floor" type="plane" size="3 3 0.1" condim="1"/>
  <body pos="0 0 0.099"><freejoint/><geom name="a" size="0.1" condim="3"/></body>
  <body pos="0 0.198 0.0985"><freejoint/><geom name="b" size="0.1" condim="1"/></body>
  <body pos="0.198 0 0.098"><freejoint/><geom name="c" size="0.1" condim="6"/></body>
</worldbody></mujoco>"""


def test_pairs_of_one_kind_are_one_computation_whatever_their_condim(monkeypatch):
    model = mujoco.MjModel.from_xml_string(CONDIMS)
    calls, of_planes = [], COLLISIONS[0, 2]

    def counted(model, data, key, geom):
        calls.append(geom.shape)
        return of_planes(model, data, key, geom)

    counted.ncon = 1
    monkeypatch.setitem(COLLISIONS, (0, 2), counted)
    wanted = mujoco.MjData(model)
    mujoco.mj_forward(model, wanted)
    with jax.enable_x64(True):
        found = contacts_of(model)(wanted)
    assert calls == [(3, 2)]
    assert_touch_alike(model, found, wanted.contact, 1e-12)
    acting = np.asarray(found.dist) < 0
    dims = {
        tuple(sorted(pair)): dim
        for pair, dim in zip(wanted.contact.geom.tolist(), wanted.contact.dim, strict=True)
    }
    pairs = np.asarray(found.geom)[acting].tolist()
    assert [dims[tuple(sorted(pair))] for pair in pairs] == found.dim[acting].tolist()
    assert set(dims.values()) == {1, 3, 6}


@pytest.mark.slow
def test_hulls_of_other_sizes_are_one_computation_and_touch_as_each_alone():
    rng, spec = np.random.default_rng(0), mujoco.MjSpec()
    for i, count in enumerate((20, 40, 60)):
        points = rng.normal(size=(count, 3))
        points *= [0.1, 0.08, 0.05] / np.linalg.norm(points, axis=1, keepdims=True)
        spec.add_mesh(name=f"m{i}", uservert=points.ravel())
        body = spec.worldbody.add_body(pos=[0.12 * i, 0.05 * i, 0.0], quat=rng.normal(size=4))
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{i}")
    model = spec.compile()
    with jax.enable_x64(True):
        on_device = put_model(model)
        with extended():
            groups = collision_driver._geom_groups(on_device)
        data = mjx.kinematics(on_device, make_data(on_device))
        contact = collision(on_device, data)._impl.contact
        assert [len(pairs) for pairs in groups.values()] == [3]
        meshes, active = [hull_of(model, mesh) for mesh in range(3)], 0
        for i, (a, b) in enumerate(np.asarray(contact.geom[::4])):
            one, other = (
                polytopes.moved(
                    jax.tree.map(jnp.asarray, meshes[model.geom_dataid[g]]),
                    data.geom_xpos[g],
                    data.geom_xmat[g],
                )
                for g in (a, b)
            )
            dist, pos, normal = polytopes.of_hulls(one, other)
            own, acts = slice(4 * i, 4 * i + 4), np.asarray(dist) < 0
            kept = np.asarray(contact.dist[own]) < 0  # every point once
            found = np.column_stack([contact.dist[own], contact.pos[own]])[kept]
            alone = np.unique(np.column_stack([dist, pos])[acts].round(12), axis=0)
            assert np.allclose(np.unique(found.round(12), axis=0), alone, atol=1e-11)
            assert np.allclose(contact.frame[own, 0], normal, atol=1e-12)
            active += len(alone)
    assert active > 0
