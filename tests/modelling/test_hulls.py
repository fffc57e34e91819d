"""Distances from meshes against MuJoCo's C engine; derivatives, and where they are not smooth."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_drax import DraxError, Terms
from mjx_drax.modelling.distances import CYLINDER, PLANE, SPHERE, Shape
from mjx_drax.modelling.hulls import (
    ELLIPSOID,
    HULL_DISTANCES,
    MESH,
    VERTICES,
    _to_hull,
    hull_of,
    stand_in,
)
from mjx_drax.physics import quaternion

RNG = np.random.default_rng(0)
BRICK = np.array(list(itertools.product((-0.2, 0.2), (-0.3, 0.3), (-0.4, 0.4))))
STONE = RNG.normal(size=(30, 3)) * [0.2, 0.3, 0.4]
ROUND = RNG.normal(size=(400, 3))
ROUND *= np.array([0.2, 0.3, 0.4]) / np.linalg.norm(ROUND, axis=1, keepdims=True)


def text(vertices):
    return " ".join(f"{number:.7g}" for number in np.ravel(vertices))


XML = f"""
<mujoco model="quarry"><option ccd_iterations="200"/>
  <asset><mesh name="brick" vertex="{text(BRICK + np.arange(1, 4))}"/>
    <mesh name="stone" vertex="{text(STONE)}"/><mesh name="round" vertex="{text(ROUND)}"/></asset>
  <worldbody>
    <body name="1" mocap="true"><geom name="brick" type="mesh" mesh="brick" pos="-1 -2 -3"/></body>
    <body name="2" mocap="true"><geom name="stone" type="mesh" mesh="stone"
      contype="0" conaffinity="0"/></body>
    <body name="3" mocap="true"><geom name="round" type="mesh" mesh="round"/></body>
    <body name="4" mocap="true"><geom name="ball" size="0.1"/></body>
    <body name="5" mocap="true"><geom name="rod" type="capsule" size="0.1 0.3"/></body>
    <body name="6" mocap="true"><geom name="floor" type="plane" size="1 1 1"/></body>
    <body name="7" mocap="true"><geom name="box" type="box" size="0.3 0.2 0.1"/></body>
    <body name="8" mocap="true"><geom name="egg" type="ellipsoid" size="0.1 0.2 0.3"
      contype="0" conaffinity="0"/></body>
    <body name="9" mocap="true"><geom name="can" type="cylinder" size="0.2 0.3"
      contype="0" conaffinity="0"/></body>
    <body name="10" mocap="true"><geom name="gem" type="mesh" mesh="stone"
      contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)
ON = Terms(MODEL)
STAND_INS = {CYLINDER: [0.2, 0.3, 0.0], ELLIPSOID: [0.1, 0.2, 0.3]}
MESHES, OTHERS = ["brick", "stone", "round"], ["ball", "rod", "floor", "box"]


def close(a, b, tolerance=2e-6):
    np.testing.assert_allclose(np.asarray(a), b, atol=tolerance)


def hull(name):
    return hull_of(MODEL, MODEL.mesh(name).id)


@pytest.mark.slow
def test_clearances_of_meshes_against_the_engine():
    """All pairs at random poses; also in the order of the names, whichever comes first."""
    term, data = ON.clearance(MESHES, OTHERS, margin=0.5), mujoco.MjData(MODEL)
    turned = ON.clearance(OTHERS, MESHES, margin=0.5)
    seen, rng = mjx.put_data(MODEL, data), np.random.default_rng(0)

    @jax.jit
    def values(centres, frames):
        now = seen.replace(geom_xpos=centres, geom_xmat=frames)
        return term(now), turned(now)

    found, wanted = [], []
    for _ in range(100):
        data.mocap_pos[:] = rng.uniform(-0.5, 0.5, (10, 3))
        quaternions = rng.normal(size=(10, 4))
        data.mocap_quat[:] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        mujoco.mj_kinematics(MODEL, data)
        forth, back = values(data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3))
        close(forth, np.reshape(back, (4, 3)).T.ravel(), 1e-7)
        pairs = itertools.product(
            *([MODEL.geom(n).id for n in names] for names in (MESHES, OTHERS))
        )
        found.append(0.5 - np.reshape(forth, (3, 4)))
        wanted.append([mujoco.mj_geomDistance(MODEL, data, *pair, 9, None) for pair in pairs])
    found, wanted = np.array(found), np.reshape(wanted, (-1, 3, 4))
    assert min((wanted > 0).sum(axis=0).min(), (wanted < 0).sum(axis=0).min()) > 5
    ball, rod, floor, box = np.moveaxis(found - wanted, -1, 0)
    depth = wanted[..., 3] < 0
    excess = np.array([float(hull(name).excess) for name in MESHES])
    assert 0.005 < excess[2] < 0.025
    for error in (ball, rod, floor, np.where(depth, box, 0)):
        assert error.max() < 1e-5
        assert (error > -excess - 1e-5).all()
    assert np.where(depth, 0, found[..., 3] - wanted[..., 3] / np.sqrt(3) + excess).min() > -1e-5
    assert box.max() < 1e-5


@pytest.mark.slow
def test_clearances_between_hulls_against_the_engine():
    """Meshes to rounding, apart and not; others are lower bounds by what their hulls leave out."""
    others = ["stone", "can", "egg"]
    term, data = ON.clearance("gem", others), mujoco.MjData(MODEL)
    seen, rng = mjx.put_data(MODEL, data), np.random.default_rng(0)
    values = jax.jit(lambda x, R: -term(seen.replace(geom_xpos=x, geom_xmat=R)))
    pairs, found, wanted = [(MODEL.geom("gem").id, MODEL.geom(n).id) for n in others], [], []
    for _ in range(60):
        data.mocap_pos[:] = rng.uniform(-0.5, 0.5, (10, 3))
        quaternions = rng.normal(size=(10, 4))
        data.mocap_quat[:] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        mujoco.mj_kinematics(MODEL, data)
        found.append(values(data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)))
        wanted.append([mujoco.mj_geomDistance(MODEL, data, *pair, 9, None) for pair in pairs])
    wanted = np.array(wanted)
    assert min((wanted > 0).sum(axis=0).min(), (wanted < 0).sum(axis=0).min()) > 5
    error = np.array(found) - wanted
    assert np.abs(error[:, 0]).max() < 2e-6
    can, egg = (float(stand_in(k, np.array(s)).excess) for k, s in STAND_INS.items())
    assert can < 0.02 * 0.2
    assert egg < 0.06 * 0.3
    for off, excess in ((error[:, 1], can), (error[:, 2], egg)):
        assert off.max() < 1e-6
        assert off.min() > -excess - 1e-5


def test_hulls_have_few_vertices_and_hold_all_others():
    for name, count in (("brick", 8), ("round", VERTICES)):
        made = hull(name)
        assert len(made.vertices) == count
        assert len(made.normals) == 2 * count - 4
        assert len(made.edges) == 3 * count - 6
    mesh = MODEL.mesh("round")
    vertices = MODEL.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
    made = hull("round")
    heights = vertices @ np.asarray(made.normals).T - made.offsets
    assert heights.max() < made.excess + 1e-6
    assert float(hull("stone").excess) < 1e-6


@pytest.mark.slow
def test_derivatives_are_those_of_the_values():
    with jax.enable_x64(True):
        made, h = hull("stone"), 1e-6
        distance = jax.jit(jax.vmap(lambda p: _to_hull(made, p)))
        slope = jax.jit(jax.vmap(jax.jacfwd(lambda p: _to_hull(made, p))))
        curvature = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(lambda p: _to_hull(made, p)))))
        p, steps = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 3)), h * np.eye(3)
        first = np.stack([(distance(p + s) - distance(p - s)) / (2 * h) for s in steps], -1)
        second = np.stack([(slope(p + s) - slope(p - s)) / (2 * h) for s in steps], -1)
        assert 10 < (distance(p) < 0).sum() < 100
        close(slope(p), first, 1e-7)
        close(curvature(p), second, 1e-4)
        close(jax.vmap(jax.grad(lambda p: _to_hull(made, p)))(p), first, 1e-7)


def test_on_faces_edges_and_corners_derivatives_are_finite_and_lead_out():
    made = hull("brick")
    both = jax.jit(
        lambda p: (
            _to_hull(made, p),
            jax.jacfwd(lambda p: _to_hull(made, p))(p),
            jax.jacfwd(jax.jacfwd(lambda p: _to_hull(made, p)))(p),
        )
    )
    starts, edges = np.asarray(made.starts), np.asarray(made.edges)
    places = [
        *np.asarray(made.vertices),
        *(starts + 0.3 * edges),
        *(starts + edges / 2),
        np.zeros(3),
    ]
    for place, shift in itertools.product(places, (0.0, 1e-12, -1e-7, 1e-7)):
        p = jnp.array(place + shift)
        value, slope, curvature = both(p)
        assert np.isfinite(curvature).all()
        assert 0.5 < np.linalg.norm(slope) < 1.001
        assert both(p + 1e-2 * slope)[0] > value + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param(kinds, marks=[pytest.mark.slow] * (kinds[0] in (*STAND_INS, MESH)))
        for kinds in HULL_DISTANCES
    ],
    ids=str,
)
def test_derivatives_of_pairs_are_those_of_their_distances(kinds):
    """By pose, in float64; at special poses too they are finite."""
    size = {PLANE: [1, 1, 1], SPHERE: [0.1, 0, 0]}.get(kinds[0], [0.1, 0.3, 0.2])
    with jax.enable_x64(True):
        hulls = {kind: stand_in(kind, np.array(size)) for kind, size in STAND_INS.items()}
        size = {**hulls, MESH: hull("brick")}.get(kinds[0], jnp.array(size, float))
        made, rng, h = hull("stone"), np.random.default_rng(0), 1e-6

        @jax.jit
        @jax.vmap
        def distance(pose):
            shape = Shape(pose[:3], quaternion.matrix(quaternion.exp(pose[3:])), size)
            return HULL_DISTANCES[kinds](shape, Shape(jnp.zeros(3), jnp.eye(3), made))

        slope = jax.jit(jax.vmap(jax.jacfwd(lambda pose: distance(pose[None])[0])))
        poses = np.concatenate(
            [rng.uniform(-0.8, 0.8, (100, 3)), rng.normal(size=(100, 3))], axis=1
        )
        steps = h * np.eye(6)
        first = [(distance(poses + s) - distance(poses - s)) / (2 * h) for s in steps]
        close(slope(poses), np.stack(first, -1), 1e-5)
        special = np.zeros((4, 6))
        special[1:3, 2] = 0.5, 1e-12
        special[3, 3] = np.pi / 2
        assert np.isfinite(slope(special)).all()
        bend = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(lambda pose: distance(pose[None])[0]))))
        assert np.isfinite(bend(np.concatenate([poses, special]))).all()


def test_pairs_without_a_distance_say_what_to_do():
    with pytest.raises(DraxError, match=r"'egg' .ellipsoid. and 'box'.* Put spheres"):
        ON.clearance("egg", "box")
