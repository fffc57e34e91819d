"""States with quaternions: MuJoCo's conventions, inverses, and derivatives that hold at rest."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax.physics import quaternion
from mjx_drax.physics.c_engine.states import difference, differences
from mjx_drax.physics.joints import Joints

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody>
  <body><joint type="slide"/><geom size="1"/>
    <body><joint type="ball"/><geom size="1"/>
      <body><joint type="hinge"/><geom size="1"/></body></body></body>
  <body><freejoint/><geom size="1"/></body>
</worldbody></mujoco>""")
JOINTS = Joints.of(MODEL)
NQ, NV = MODEL.nq, MODEL.nv


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def drawn(seed, turn=2.0):
    """x = [qpos, qvel], and a change of it whose rotations have length `turn`."""
    rng = np.random.default_rng(seed)
    x, dx = rng.normal(size=NQ + NV), rng.normal(size=2 * NV)
    mujoco.mj_normalizeQuat(MODEL, x[:NQ])
    for _, v in JOINTS.quaternions:
        dx[v : v + 3] *= turn / np.linalg.norm(dx[v : v + 3])
    return x, dx


def test_the_places_of_quaternions():
    assert (JOINTS.nq, JOINTS.nv, JOINTS.quaternions) == (13, 11, ((1, 1), (9, 8)))
    np.testing.assert_array_equal(np.flatnonzero(JOINTS.is_quaternion), [1, 2, 3, 4, 9, 10, 11, 12])


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-3, 1.0, 3.14159])
def test_integration_and_difference_are_mujocos(turn):
    x, dx = drawn(0, turn)
    y = np.asarray(JOINTS.integrate(x, dx))
    qpos, off = x[:NQ].copy(), np.empty(NV)
    mujoco.mj_integratePos(MODEL, qpos, dx[:NV], 1.0)
    np.testing.assert_allclose(y, [*qpos, *(x[NQ:] + dx[NV:])], atol=1e-12)
    mujoco.mj_differentiatePos(MODEL, off, 1.0, x[:NQ], qpos)
    np.testing.assert_allclose(JOINTS.difference(y, x)[:NV], off, atol=1e-10)
    np.testing.assert_allclose(JOINTS.difference(y, x), dx, atol=1e-10)


def test_differences_of_many_states_are_mujocos():
    pairs = [drawn(seed) for seed in range(20)]
    x, y = np.array([x for x, _ in pairs]), np.array([x for x, _ in reversed(pairs)])
    x[0], x[1, :NQ] = y[0], -y[1, :NQ]  # at rest, and with -q for q, the same rotations
    one_by_one = [difference(MODEL, *pair) for pair in zip(x, y, strict=True)]
    np.testing.assert_allclose(differences(JOINTS, x, y), one_by_one, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_integrating_a_difference_arrives(seed):
    (x, _), (y, _) = drawn(seed), drawn(seed + 100)
    z = JOINTS.integrate(y, JOINTS.difference(x, y))
    np.testing.assert_allclose(JOINTS.difference(z, x), 0, atol=1e-12)  # or with -q


def test_q_and_minus_q_are_the_same_orientation():
    x, _ = drawn(0)
    y = np.where(np.append(JOINTS.is_quaternion, np.zeros(NV, bool)), -x, x)
    np.testing.assert_allclose(JOINTS.difference(x, y), 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_at_no_difference_are_the_identity(derivative):
    x, _ = drawn(0)
    near = derivative(lambda dx: JOINTS.difference(JOINTS.integrate(x, dx), x))
    np.testing.assert_allclose(near(jnp.zeros(2 * NV)), np.eye(2 * NV), atol=1e-12)


@pytest.mark.parametrize("turn", [1e-4, 0.0019, 0.0021, 1.0, 3.1415926])
def test_derivatives_are_those_of_finite_differences(turn):
    x, dx = drawn(3, turn)

    def there_and_back(dx):
        return JOINTS.difference(JOINTS.integrate(x, dx), x)

    np.testing.assert_allclose(jax.jacfwd(there_and_back)(dx), np.eye(2 * NV), atol=1e-6)


def test_maps_are_smooth_where_series_take_over():
    lengths = 2 * np.sqrt(quaternion.SMALL) * (1 + np.array([-1e-9, 1e-9]))
    ends = [np.asarray(quaternion.exp(jnp.array([length, 0, 0]))) for length in lengths]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-11)
    for end, length in zip(ends, lengths, strict=True):
        np.testing.assert_allclose(quaternion.log(jnp.asarray(end))[0], length, rtol=1e-9)


def test_quaternions_are_scaled_to_unit_length():
    x, _ = drawn(0)
    long = np.where(np.append(JOINTS.is_quaternion, np.zeros(NV, bool)), 3 * x, x)
    np.testing.assert_allclose(JOINTS.normalized(jnp.asarray(long)), x, atol=1e-12)
    np.testing.assert_array_equal(quaternion.normalized(jnp.zeros(4)), [1, 0, 0, 0])


def test_numbers_of_entries_in_tangent_space():
    seen = JOINTS.tangent(jnp.arange(1.0, NQ + NV + 1))
    np.testing.assert_array_equal(seen[:NV], [1, 0, 0, 0, 6, 7, 8, 9, 0, 0, 0])
    np.testing.assert_array_equal(seen[NV:], np.arange(NQ + 1, NQ + NV + 1))


def test_without_quaternions_everything_adds():
    flat = Joints(2, 2, ())
    x, dx = np.array([0.5, 1.0, 2.0, 3.0]), np.ones(4)
    np.testing.assert_array_equal(flat.integrate(x, dx), x + dx)
    np.testing.assert_array_equal(flat.difference(x + dx, x), dx)
