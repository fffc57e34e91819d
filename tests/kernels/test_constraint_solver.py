"""Accelerations under constraints: the plain solver, and its GPU kernel, interpreted."""

import shutil
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cuda_on_cpu import caller

from mjx_drax.kernels import constraint_solver, constraints_cuda
from mjx_drax.kernels import elliptic_cones as elliptic
from mjx_drax.kernels.constraint_solver import (
    Constraints,
    changes,
    constrained_minimum,
    excess,
    law,
    minima,
)


def drawn(rows=6, nv=5, m=7):
    """Of every two rows of J one has friction, which may slide; two more have two sides."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(rows, nv, nv))
    D = rng.uniform(0.5, 20.0, size=(rows, m))
    lower, upper = np.full((rows, m), -np.inf), np.zeros((rows, m))
    upper[:, :2] = np.inf
    lower[:, 2:4], upper[:, 2:4] = -0.3 / D[:, 2:4], 0.3 / D[:, 2:4]
    given = Constraints(
        half @ half.swapaxes(1, 2) + np.eye(nv),
        rng.normal(size=(rows, m, nv)),
        D,
        rng.normal(size=(rows, m)),
        lower,
        upper,
        rng.normal(size=(rows, nv)),
    )
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given)


def drawn_with_cones(rows=8, nv=5):
    """Two contacts, of 3 and 4 rows, and a limit."""
    given, rng = drawn(rows, nv, 1), np.random.default_rng(1)
    cones = tuple(_contacts(rng, rows, d, nv) for d in (3, 4))
    bounds = np.full((rows, 1), -np.inf), np.zeros((rows, 1))
    given = given._replace(lower=bounds[0], upper=bounds[1], cones=cones)
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given)


def _contacts(rng, rows, d, nv, c=1):
    friction = rng.uniform(0.3, 2.0, size=(rows, d - 1, c))
    mu = friction[:, 0] / 3.0
    return elliptic.Cones(
        rng.normal(size=(rows, d, c, nv)),
        rng.normal(size=(rows, d, c)),
        np.concatenate([mu[:, None], friction], axis=1),
        mu,
        rng.uniform(1.0, 30.0, size=(rows, c)),
    )


def potential(cones, y):
    """s(y) of the contacts, zone by zone as MuJoCo's documentation has it."""
    N, *tangents = cones.scale * y
    T, mu, g = jnp.sqrt(sum(t**2 for t in tangents)), cones.mu, cones.weight
    sliding = 0.5 * g * (N - mu * T) ** 2 / (1.0 + mu**2)
    sticking = jnp.where(mu * N + T <= 0.0, 0.5 * g * (N**2 + T**2), sliding)
    return jnp.sum(jnp.where(mu * T <= N, 0.0, sticking))


def test_cones_have_the_derivatives_and_the_changes_of_their_potential():
    units = np.eye(8).reshape(4, 2, 8)  # so that s'' J is s''

    def compared(cones, y, size, direction):
        at, slope = elliptic.place(cones, y), jax.grad(potential, 1)
        h, ray = size * direction, elliptic.ray(cones, at, direction)
        change, rise = elliptic.changes(cones, at, ray, size)
        grown = potential(cones, y + h) - potential(cones, y) - jnp.sum(slope(cones, y) * h)
        bent = elliptic.curved(cones._replace(J=units), at).reshape(8, 8)
        pairs = (
            (-elliptic.forces(cones, at), slope(cones, y)),
            (bent, jax.hessian(potential, 1)(cones, y).reshape(8, 8)),
            (change.sum(), grown),
            (rise, slope(cones, y + h) - slope(cones, y)),
        )
        return at.zone, pairs

    rng = np.random.default_rng(2)
    with jax.enable_x64(True):
        cones = jax.tree.map(lambda a: jnp.asarray(a[0], float), _contacts(rng, 1, 4, 8, c=2))
        y, direction = rng.normal(size=(2, 200, 4, 2))
        y[:, 0] *= 5.0  # some press hard enough to stick
        sizes = rng.choice([1e-3, 1.0, 4.0], size=200)
        zones, pairs = jax.jit(jax.vmap(partial(compared, cones)))(y, sizes, direction)
    for found, wanted in pairs:
        np.testing.assert_allclose(found, wanted, atol=1e-8)
    assert set(np.unique(zones)) == {elliptic.STICKS, elliptic.SLIDES, elliptic.OPEN}


@pytest.mark.slow
def test_among_cones_the_gradient_is_zero_and_the_hessian_is_that_of_what_is_minimized():
    given = drawn_with_cones()

    def least(given, a):
        limits, *of_cones = excess(given, a)
        limits = 0.5 * jnp.sum(given.D * jnp.clip(limits, max=0.0) ** 2)
        apart = a - given.a0
        contacts = sum(map(potential, given.cones, of_cones))
        return 0.5 * apart @ given.M @ apart + limits + contacts

    a, H = jax.jit(jax.vmap(constrained_minimum))(given)
    slope, bent = (jax.vmap(d(least, 1))(given, a) for d in (jax.grad, jax.hessian))
    assert np.abs(slope).max() < 1e-4
    np.testing.assert_allclose(H, bent, rtol=1e-3, atol=1e-3)


def gradient(given, a):
    return given.M @ (a - given.a0) - given.J.T @ law(given, given.J @ a - given.aref)[0]


def test_the_gradient_is_zero_and_the_hessian_is_that_of_what_is_minimized():
    given = drawn()

    @jax.jit
    @jax.vmap
    def checked(given):
        a, H = constrained_minimum(given)
        return gradient(given, a), H, jax.jacfwd(gradient, argnums=1)(given, a)

    slope, seen, hessian = checked(given)
    assert np.abs(slope).max() < 1e-4
    np.testing.assert_allclose(seen, hessian, rtol=1e-4, atol=1e-3)


def test_a_stiff_contact_early_on_the_way_does_not_end_the_search():
    """Minimize 1/2 |a|^2 + 1/2 (a_1 - 1000)^2, where a_1 <= a_2 / 2 + 0.01, almost."""
    rows = [jnp.array([[1.0, 0.0], [-1.0, 0.5]]), jnp.array([1.0, 1e6]), jnp.array([1e3, -0.01])]
    bounds = jnp.full(2, -jnp.inf), jnp.zeros(2)
    found, _ = constrained_minimum(Constraints(jnp.eye(2), *rows, *bounds, jnp.zeros(2)))
    np.testing.assert_allclose(found, [1e3 / 6, 1e3 / 3], rtol=1e-3)


def test_an_enormous_force_elsewhere_changes_nothing():
    given = drawn()
    apart = given._replace(
        M=jnp.pad(given.M, ((0, 0), (0, 1), (0, 1))).at[:, -1, -1].set(1.0),
        J=jnp.pad(given.J, ((0, 0), (0, 0), (0, 1))),
        a0=jnp.pad(given.a0, ((0, 0), (0, 1)), constant_values=1e12),
    )
    wanted, _ = jax.jit(jax.vmap(constrained_minimum))(given)
    found, _ = jax.jit(jax.vmap(constrained_minimum))(apart)
    np.testing.assert_allclose(found[:, :-1], wanted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found[:, -1], 1e12)


@pytest.mark.parametrize("make", [pytest.param(drawn, marks=pytest.mark.slow), drawn_with_cones])
def test_the_kernel_finds_the_same_accelerations(make):
    given = make()
    wanted, _ = jax.jit(jax.vmap(constrained_minimum))(given)
    found = minima(given, interpret=True)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.skipif(not shutil.which("g++"), reason="it needs a C++ compiler")
@pytest.mark.parametrize(
    ("nv", "m", "dtype", "iterations"),
    [
        (5, 7, np.float64, 1),  # one warp, small tiles
        (5, 7, np.float64, 20),
        pytest.param(18, 140, np.float64, 1, marks=pytest.mark.slow),
        (18, 140, np.float64, 20),  # several warps, large tiles
        pytest.param(5, 7, np.float32, 1, marks=pytest.mark.slow),
        (5, 7, np.float32, 20),
    ],
)
def test_the_kernel_of_cuda_finds_the_same_accelerations(
    nv, m, dtype, iterations, tmp_path, monkeypatch
):
    calls = []
    monkeypatch.setattr(constraints_cuda.cuda, "call", caller(tmp_path, calls))
    for module in (constraints_cuda, constraint_solver):
        monkeypatch.setattr(module, "ITERATIONS", iterations)
    with jax.enable_x64(dtype == np.float64):
        given = jax.tree.map(lambda a: jnp.asarray(a, dtype), drawn(3, nv, m))
        wanted, _ = jax.jit(jax.vmap(lambda given: constraint_solver._plain(given)))(given)
        found = constraints_cuda.minima(given[:-1])
    close = 1e-9 if dtype == np.float64 else 1e-4
    np.testing.assert_allclose(found, wanted, rtol=close, atol=close)
    assert [sizes["THREADS"] for sizes in calls] == [32 if m < 100 else 96]


@pytest.mark.skipif(not shutil.which("g++"), reason="it needs a C++ compiler")
@pytest.mark.parametrize(
    ("nv", "law", "contacts", "dtype", "iterations"),
    [
        pytest.param(5, 3, (2, 1, 1), np.float64, 1, marks=pytest.mark.slow),
        (5, 3, (2, 1, 1), np.float64, 20),  # one warp, small tiles
        (18, 0, (0, 40, 0), np.float64, 20),  # several warps, large tiles, more than 32 contacts
        (5, 1, (0, 2, 0), np.float32, 20),
    ],
)
def test_the_kernel_of_cuda_finds_the_same_accelerations_among_cones(
    nv, law, contacts, dtype, iterations, tmp_path, monkeypatch
):
    calls = []
    monkeypatch.setattr(constraints_cuda.cuda, "call", caller(tmp_path, calls))
    for module in (constraints_cuda, constraint_solver):
        monkeypatch.setattr(module, "ITERATIONS", iterations)
    rng, counts = np.random.default_rng(4), dict(zip((3, 4, 6), contacts, strict=True))
    with jax.enable_x64(dtype == np.float64):
        cones = tuple(_contacts(rng, 3, d, nv, c) for d, c in reversed(counts.items()) if c)
        given = drawn(3, nv, max(law, 1))._replace(cones=cones)
        if not law:
            rows = {name: getattr(given, name)[:, :0] for name in ("J", "D", "aref")}
            given = given._replace(**rows, lower=given.lower[:, :0], upper=given.upper[:, :0])
        given = jax.tree.map(lambda a: jnp.asarray(a, dtype), given)
        wanted, _ = jax.jit(jax.vmap(lambda given: constraint_solver._plain(given)))(given)
        zones = jax.vmap(lambda given, a: elliptic.place(given.cones[0], excess(given, a)[1]).zone)
        slide = elliptic.SLIDES in np.asarray(zones(given, wanted))
        found = constraint_solver._by_cuda(contacts, given)
    close = 1e-9 if dtype == np.float64 else 1e-4
    np.testing.assert_allclose(found, wanted, rtol=close, atol=close)
    assert slide
    assert [(sizes["C3"], sizes["C4"], sizes["C6"]) for sizes in calls] == [contacts]


def test_which_kernel_a_gpu_takes(monkeypatch):
    monkeypatch.setattr(constraint_solver, "on_gpu", lambda: True)
    limits, contacts = drawn(), drawn_with_cones()
    in_float64 = jax.tree.map(lambda a: np.asarray(a, float), limits)

    def taken(given):
        kernel = constraint_solver._kernel_for(given)
        return "cuda" if kernel not in (None, minima) else kernel

    for memory, of_each in ((227 * 1024, ["cuda", "cuda", "cuda"]), (0, [minima, minima, None])):
        monkeypatch.setattr(constraints_cuda.cuda, "shared_memory", lambda memory=memory: memory)
        assert [taken(given) for given in (limits, contacts, in_float64)] == of_each
    monkeypatch.setattr(constraints_cuda.cuda, "shared_memory", lambda: 227 * 1024)
    served = [constraints_cuda.serves(112, nv, 4) for nv in (35, 100, 160)]
    assert served == [True, True, False]  # registers end before shared memory
    assert not constraints_cuda.serves(2000, 35, 4)


def test_changes_are_those_of_a_function_whose_slope_is_the_law():
    given = jax.tree.map(lambda a: a[0], drawn())
    y = jnp.linspace(-1.0, 1.0, 7 * 41).reshape(41, 7)
    h = jnp.asarray(np.random.default_rng(1).normal(size=(41, 7)), jnp.float32)
    push, slope = law(given, y)
    change, of_slope = changes(given, y, h)
    np.testing.assert_allclose(of_slope, push - law(given, y + h)[0], atol=1e-4)
    np.testing.assert_allclose(changes(given, y, -h)[0] >= 0, True)
    np.testing.assert_allclose(change, _integral(given, y, h), atol=2e-2)
    assert np.all(np.asarray(slope) >= 0)


def _integral(given, y, h, n=2000):
    """Of s'(y + t) - s'(y) over t from 0 to h."""
    shares = (jnp.arange(n) + 0.5)[:, None, None] / n
    return jnp.mean((law(given, y)[0] - law(given, y + shares * h)[0]) * h, axis=0)
