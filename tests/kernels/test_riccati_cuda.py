"""The CUDA kernel of the Riccati recursion, on a CPU, against the plain recursion of the method."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from riccati_problems import agree, batch

from mjx_drax.kernels import riccati_cuda
from mjx_drax.kernels.riccati_gpu import arrays_of
from mjx_drax.method.riccati import newton

pytestmark = pytest.mark.skipif(not shutil.which("g++"), reason="it needs a C++ compiler")

PROGRAM = """
#include "cuda_on_cpu.h"
#include "riccati.cu"
extern "C" int shared() { return SHARED; }
extern "C" int left() { return LEFT; }
extern "C" void run(int rows, int horizon, REAL** p) {
  const int chains = BLOCK_SIZE / THREADS;
  launch((rows + chains - 1) / chains, BLOCK_SIZE, chains * SHARED, [=] {
    newton(POINTERS, rows, horizon);
  });
}
"""


@pytest.fixture
def on_cpu(tmp_path, monkeypatch):
    """Kernels that are called from now on are compiled for this CPU; how often, in a list."""
    calls = []

    def call(source, kernel, sizes, blocks, warps, shared, arrays, shapes, numbers):
        results = [np.full(shape, np.nan, arrays[0].dtype) for shape in shapes]
        given = [*(np.ascontiguousarray(a) for a in arrays), *results]
        pointers = ", ".join(f"p[{i}]" for i in range(len(given)))
        program = tmp_path / f"{len(calls)}.cpp"
        program.write_text(PROGRAM.replace("POINTERS", pointers))
        # -Bsymbolic: its sync() is not that of the C library
        compiler = ["g++", "-std=c++20", "-shared", "-fPIC", "-pthread", "-Wl,-Bsymbolic"]
        folders = [f"-I{Path(__file__).parent}", f"-I{source.parent}"]
        macros = [f"-D{name}={value}" for name, value in sizes.items()]
        library = program.with_suffix(".so")
        subprocess.run([*compiler, *folders, *macros, "-o", library, program], check=True)
        compiled = ctypes.CDLL(str(library))
        chains = warps * 32 // sizes["THREADS"]
        assert shared == chains * compiled.shared() * arrays[0].dtype.itemsize
        assert shapes[-1][-1] == compiled.left()
        assert blocks * chains >= arrays[0].shape[0]
        compiled.run(*numbers, (ctypes.c_void_p * len(given))(*(a.ctypes.data for a in given)))
        calls.append(sizes)
        return results

    monkeypatch.setattr(riccati_cuda.cuda, "call", call)
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
