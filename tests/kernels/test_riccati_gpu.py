"""The kernels of the Riccati recursion, interpreted, against the plain recursion of the method."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels import riccati_blocks, riccati_gpu, riccati_threads
from mjx_drax.kernels.riccati_gpu import arrays_of, kernels_for
from mjx_drax.kernels.riccati_segments import newton_steps, segments
from mjx_drax.kernels.riccati_threads import MAX_NDX, THREADS, Given
from mjx_drax.method.model import Linearization, QuadraticCost
from mjx_drax.method.riccati import White, newton

K, NDX, NU = 3, 3, 2
JAX = tuple(map(int, jax.__version__.split(".")[:2]))


def batch(chains, dtype, noisy=True, ndx=NDX, soft=True, K=K):
    """A different problem for every chain, penalties included; none if not `soft`."""
    rng = np.random.default_rng(0)
    n = ndx + NU
    A, B, h = (rng.normal(size=(chains, K, ndx, *m)) for m in [(ndx,), (NU,), ()])
    half = rng.normal(size=(chains, K + 1, n, n))
    H, g = half @ half.swapaxes(-1, -2) + 0.1 * np.eye(n), rng.normal(size=(chains, K + 1, n))
    cost = QuadraticCost(
        g[..., :ndx],
        g[:, :-1, ndx:],
        H[..., :ndx, :ndx],
        H[:, :-1, ndx:, :ndx],
        H[:, :-1, ndx:, ndx:],
    )
    white = White(rng.normal(size=(chains, K, NU)), rng.normal(size=(chains, K, ndx)))
    multipliers, penalties = rng.normal(size=(chains, K, ndx)), np.geomspace(10.0, 1e4, chains)
    penalties = penalties if soft else None
    arguments = (Linearization(A, B, h), cost, multipliers, penalties, white if noisy else None)
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), arguments)


def agree(seen, wanted, tolerance):
    for name in ("dx", "du", "noise_x", "noise_u", "rate", "gains"):
        a, b = seen[name], getattr(wanted, name)
        assert (a is None) == (b is None), name
        if a is not None:
            scale = np.abs(b).max()
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * scale, err_msg=name)


KINDS = [(True, True), (False, True), (False, False), (True, False)]
"""Noise, and a penalty: the flow has one, the polish neither."""

INFINITE = (False, True, np.inf)
"""A penalty that is a number all the same."""


@pytest.mark.parametrize(("noisy", "soft"), KINDS)
def test_it_agrees_with_the_plain_recursion(noisy, soft):
    with jax.enable_x64(True):
        arguments = batch(THREADS + 5, np.float64, noisy, soft=soft)  # two warps, one not full
        plain = jax.jit(jax.vmap(newton))(*arguments)
        seen = newton_steps(riccati_threads, arrays_of(arguments), interpret=True)
        agree(seen, plain, 1e-9)


@pytest.mark.parametrize(("noisy", "soft", "penalty"), [(*k, None) for k in KINDS] + [INFINITE])
def test_blocks_agree_with_the_plain_recursion(noisy, soft, penalty):
    with jax.enable_x64(True):
        arguments = batch(2, np.float64, noisy, ndx=17, soft=soft)  # a tile of 32
        if penalty:
            arguments = (*arguments[:3], jnp.full(2, penalty), arguments[-1])
        plain = jax.jit(jax.vmap(newton))(*arguments)
        seen = newton_steps(riccati_blocks, arrays_of(arguments), interpret=True)
        agree(seen, plain, 1e-9)


@pytest.mark.parametrize(("kernels", "ndx"), [(riccati_threads, NDX), (riccati_blocks, 17)])
@pytest.mark.parametrize("noisy", [True, False])
def test_in_segments_they_agree_with_the_plain_recursion(kernels, ndx, noisy):
    """Seven stages in three segments, of which the last is filled up; penalties up to 1e4."""
    with jax.enable_x64(True):
        arguments = batch(2, np.float64, noisy, ndx=ndx, K=7)
        plain = jax.jit(jax.vmap(newton))(*arguments)
        seen = newton_steps(kernels, arrays_of(arguments), 3, interpret=True)
        agree(seen, plain, 1e-9)


@pytest.mark.parametrize("kernels", [riccati_threads, riccati_blocks])
def test_in_segments_what_no_control_moves_is_no_trouble(kernels):
    """C is singular to rounding where a penalty is large and controls move one state of three."""
    linear, cost, multipliers, _, white = batch(2, np.float32, K=8)
    linear = replace(linear, A=0.5 * linear.A, B=linear.B.at[:, :, 1:].set(0.0))
    arguments = linear, cost, multipliers, jnp.full(2, 1e8, np.float32), white
    plain = jax.jit(jax.vmap(newton))(*arguments)
    seen = newton_steps(kernels, arrays_of(arguments), 4, interpret=True)
    agree(seen, plain, 1e-3)


def test_segments_are_for_few_chains_and_many_stages():
    def count(kernels, chains, K, ndx, penalty=True):
        h = np.zeros((chains, K, ndx))
        return segments(kernels, Given(*[h] * 9, penalty=h[:, 0, 0] if penalty else None))

    assert count(riccati_blocks, 1, 60, 36) == 11
    assert count(riccati_blocks, 32, 60, 36) == 8
    assert count(riccati_threads, 1, 1000, 4) == 45
    assert count(riccati_blocks, 100, 60, 36) == count(riccati_blocks, 1, 20, 36) == 1
    assert count(riccati_threads, 1, 100, 4) == count(riccati_threads, 1, 1000, 6) == 1
    assert count(riccati_blocks, 1, 60, 36, penalty=False) == 1  # as in the polish


def test_blocks_that_are_not_positive_definite_are_not_numbers():
    """The polish sees from it that the model needs more damping."""
    linear, cost, *rest = batch(2, np.float32, noisy=False)
    cost = replace(cost, Huu=cost.Huu.at[1].add(-1e4 * jnp.eye(NU)))
    given = arrays_of((linear, cost, *rest))
    seen = newton_steps(riccati_blocks, given, interpret=True)
    assert [bool(jnp.isfinite(dx).all()) for dx in seen["dx"]] == [True, False]


def test_a_kernel_is_chosen_by_the_size_of_blocks():
    def kernels(ndx, nu, dtype=np.float32):
        A, B = np.zeros((ndx, ndx), dtype), np.zeros((ndx, nu), dtype)
        return kernels_for(Given(A, B, *[A] * 7))

    assert kernels(6, 4) is kernels(6, 4, np.float64) is riccati_threads
    assert kernels(7, 4) is kernels(64, 32) is riccati_blocks
    assert kernels(7, 4, np.float64) is kernels(65, 4) is kernels(8, 0) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noisy", "ndx"), [(True, NDX), (False, NDX), (False, riccati_blocks.MAX_NDX + 1)]
)
def test_on_gpus_it_serves_all_maps_of_blocks_that_are_small(noisy, ndx, monkeypatch):
    """As on a GPU, but interpreted: chains within problems are one launch."""
    arguments = batch(6, np.float32, noisy, ndx)
    plain = jax.jit(jax.vmap(newton))(*arguments)
    calls = []

    def interpreted(kernels, given, count):
        calls.append(len(given.A))
        return newton_steps(kernels, given, count, interpret=True)

    def as_on_gpus(*arguments, default, **own):
        return own.get("cuda", default)(*arguments)

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(riccati_gpu, "newton_steps", interpreted)
    if ndx <= MAX_NDX:
        monkeypatch.setattr(jax.lax, "platform_dependent", as_on_gpus)
    folded = jax.tree.map(lambda a: a.reshape(2, 3, *a.shape[1:]), arguments)
    step = jax.jit(jax.vmap(jax.vmap(newton)))(*folded)
    seen = jax.tree.map(lambda a: a.reshape(6, *a.shape[2:]), step)
    agree(vars(seen), plain, 1e-4)
    assert set(calls[-1:]) == ({6} if ndx <= MAX_NDX else set())


@pytest.mark.skipif(
    JAX >= (0, 11),
    reason="since jax 0.11, Triton kernels are lowered only where there is a GPU",
)
@pytest.mark.parametrize("kernels", [riccati_threads, riccati_blocks])
@pytest.mark.parametrize("noisy", [pytest.param(True, marks=pytest.mark.slow), False])
def test_it_lowers_for_cuda_without_a_gpu(noisy, kernels):
    given = arrays_of(batch(4, np.float32, noisy))
    for count, launches in ((1, 2), (2, 6)):
        steps = jax.jit(lambda given, count=count: newton_steps(kernels, given, count))
        text = steps.trace(given).lower(lowering_platforms=("cuda",)).as_text()
        assert text.count("triton") >= launches
