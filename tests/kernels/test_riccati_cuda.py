"""The CUDA kernel of the Riccati recursion, on a CPU, against the plain recursion of the method."""

import shutil

import jax
import numpy as np
import pytest
from cuda_on_cpu import caller
from riccati_problems import agree, batch

from mjx_drax.kernels import riccati_cuda
from mjx_drax.kernels.riccati_gpu import arrays_of
from mjx_drax.method.riccati import newton

pytestmark = pytest.mark.skipif(not shutil.which("g++"), reason="it needs a C++ compiler")


@pytest.fixture
def on_cpu(tmp_path, monkeypatch):
    """Kernels that are called from now on are compiled for this CPU; their sizes, in a list."""
    calls = []
    call = caller(tmp_path, calls, "LEFT")

    def checked(source, kernel, sizes, blocks, warps, shared, arrays, shapes, numbers):
        chains = max(32 // sizes["THREADS"], 1)
        assert blocks * chains >= arrays[0].shape[0] > (blocks - 1) * chains
        found = call(source, kernel, sizes, blocks, warps, shared, arrays, shapes, numbers)
        assert shapes[-1][-1] == calls[-1]["LEFT"]
        return found

    monkeypatch.setattr(riccati_cuda.cuda, "call", checked)
    return calls


@pytest.mark.parametrize(
    ("ndx", "noisy", "soft"),
    [
        (3, True, True),  # several chains in a warp
        (3, False, False),
        (17, True, True),  # larger tiles, padded, of several warps
        pytest.param(17, False, True, marks=pytest.mark.slow),
        pytest.param(17, True, False, marks=pytest.mark.slow),
        pytest.param(7, True, True, marks=pytest.mark.slow),
    ],
)
def test_it_agrees_with_the_plain_recursion(ndx, noisy, soft, on_cpu):
    with jax.enable_x64(True):
        arguments = batch(3, np.float64, noisy, ndx=ndx, soft=soft)
        plain = jax.jit(jax.vmap(newton))(*arguments)
        agree(riccati_cuda.newton_steps(arrays_of(arguments)), plain, 1e-9)
    assert len(on_cpu) == 1


def test_a_penalty_may_be_infinite(on_cpu):
    with jax.enable_x64(True):
        *arguments, _, white = batch(2, np.float64, ndx=5)
        arguments = (*arguments, np.full(2, np.inf), white)
        plain = jax.jit(jax.vmap(newton))(*arguments)
        agree(riccati_cuda.newton_steps(arrays_of(arguments)), plain, 1e-9)


def test_blocks_that_are_not_positive_definite_are_not_numbers(on_cpu):
    """The polish sees from it that the model needs more damping."""
    linear, cost, *rest = batch(2, np.float32, noisy=False, ndx=5)
    given = arrays_of((linear, cost, *rest))
    given = given._replace(Huu=given.Huu.at[1].add(-1e4 * np.eye(2)))
    seen = riccati_cuda.newton_steps(given)
    assert [bool(np.isfinite(dx).all()) for dx in seen["dx"]] == [True, False]


def test_more_numbers_than_threads(on_cpu, monkeypatch):
    """A thread has several tiles where a block is large."""
    monkeypatch.setattr(riccati_cuda, "MAX_THREADS", 32)
    with jax.enable_x64(True):
        arguments = batch(1, np.float64, ndx=18, K=2)
        plain = jax.jit(jax.vmap(newton))(*arguments)
        agree(riccati_cuda.newton_steps(arrays_of(arguments)), plain, 1e-9)
    assert on_cpu[0]["THREADS"] == 32
