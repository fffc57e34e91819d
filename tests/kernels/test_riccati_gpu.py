"""The kernels of the Riccati recursion for small blocks, interpreted, against the plain one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from riccati_problems import NDX, agree, batch

from mjx_drax.kernels import riccati_cuda, riccati_gpu, riccati_segments
from mjx_drax.kernels.riccati_gpu import arrays_of, kernel_for
from mjx_drax.kernels.riccati_segments import newton_steps, segments
from mjx_drax.kernels.riccati_threads import MAX_NDX, THREADS, Given
from mjx_drax.method.riccati import newton

JAX = tuple(map(int, jax.__version__.split(".")[:2]))


KINDS = [(True, True), (False, True), (False, False), (True, False)]
"""Noise, and a penalty: the flow has one, the polish neither."""


def interpreted(arguments, count):
    return jax.jit(lambda given: newton_steps(given, count, interpret=True))(arrays_of(arguments))


@pytest.mark.parametrize(("noisy", "soft"), KINDS)
def test_it_agrees_with_the_plain_recursion(noisy, soft):
    with jax.enable_x64(True):
        arguments = batch(THREADS + 5, np.float64, noisy, soft=soft)  # two warps, one not full
        plain = jax.jit(jax.vmap(newton))(*arguments)
        seen = interpreted(arguments, 1)
        agree(seen, plain, 1e-9)


@pytest.mark.parametrize("noisy", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_in_segments_it_agrees_with_the_plain_recursion(noisy):
    """Seven stages in three segments, of which the last is filled up; penalties up to 1e4."""
    with jax.enable_x64(True):
        arguments = batch(2, np.float64, noisy, K=7)
        plain = jax.jit(jax.vmap(newton))(*arguments)
        agree(interpreted(arguments, 3), plain, 1e-9)


def test_in_segments_what_no_control_moves_is_no_trouble():
    """C is singular to rounding where a penalty is large and controls move one state of three."""
    linear, cost, multipliers, _, white = batch(2, np.float32, K=8)
    linear = replace(linear, A=0.5 * linear.A, B=linear.B.at[:, :, 1:].set(0.0))
    arguments = linear, cost, multipliers, jnp.full(2, 1e8, np.float32), white
    plain = jax.jit(jax.vmap(newton))(*arguments)
    agree(interpreted(arguments, 4), plain, 1e-3)


def test_segments_are_for_few_chains_and_many_stages():
    def count(chains, K, penalty=True):
        h = np.zeros((chains, K, 4))
        return segments(Given(*[h] * 9, penalty=h[:, 0, 0] if penalty else None))

    assert count(1, 1000) == 45
    assert count(500, 1000) == 16
    assert count(1, 100) == count(4000, 1000) == 1
    assert count(1, 1000, penalty=False) == 1  # as in the polish


@pytest.mark.parametrize("there", [True, False])
def test_a_kernel_is_chosen_by_the_size_of_blocks(there, monkeypatch):
    def kernel(ndx, nu, dtype=np.float32):
        A, B = np.zeros((ndx, ndx), dtype), np.zeros((ndx, nu), dtype)
        return kernel_for(Given(A, B, *[A] * 7))

    monkeypatch.setattr(riccati_cuda.cuda, "shared_memory", lambda: 227 * 1024 * there)
    larger = riccati_cuda.newton_steps if there else None
    assert kernel(4, 4) is kernel(4, 4, np.float64) is riccati_segments.newton_steps
    assert kernel(5, 4) is kernel(5, 4, np.float64) is kernel(4, 5) is kernel(100, 40) is larger
    assert kernel(100, 40, np.float64) is kernel(200, 4) is kernel(8, 0) is None


@pytest.mark.slow
@pytest.mark.parametrize(("noisy", "ndx"), [(True, NDX), (False, NDX), (False, MAX_NDX + 1)])
def test_on_gpus_it_serves_all_maps_of_blocks_that_are_small(noisy, ndx, monkeypatch):
    """As on a GPU, but interpreted: chains within problems are one launch."""
    arguments = batch(6, np.float32, noisy, ndx)
    plain = jax.jit(jax.vmap(newton))(*arguments)
    calls = []

    def interpreted(given):
        calls.append(len(given.A))
        return newton_steps(given, interpret=True)

    def as_on_gpus(*arguments, default, **own):
        return own.get("cuda", default)(*arguments)

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(riccati_gpu.riccati_segments, "newton_steps", interpreted)
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
@pytest.mark.parametrize("noisy", [pytest.param(True, marks=pytest.mark.slow), False])
def test_it_lowers_for_cuda_without_a_gpu(noisy):
    given = arrays_of(batch(4, np.float32, noisy))
    for count, launches in ((1, 2), (2, 6)):
        steps = jax.jit(lambda given, count=count: newton_steps(given, count))
        text = steps.trace(given).lower(lowering_platforms=("cuda",)).as_text()
        assert text.count("triton") >= launches
