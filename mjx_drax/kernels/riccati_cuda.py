"""The Riccati recursion of `method.riccati` on NVIDIA GPUs: a group of threads for each chain.

One kernel, `riccati.cu`, goes backward and forward through all stages of a chain. The matrices of a
stage are in shared memory, or, while they are eliminated, in registers, a tile in each thread.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jax import Array

from mjx_drax.kernels import cuda
from mjx_drax.kernels.cuda import WARP, tile, triangle
from mjx_drax.kernels.riccati_threads import Given

KERNEL = Path(__file__).with_name("riccati.cu")

MAX_THREADS = 256
"""With more a chain is done a tenth sooner, and many chains a fifth later."""


def serves(given: Given) -> bool:
    """Whether there is such a GPU, and the matrices of a stage fit its shared memory."""
    ndx, nu = given.B.shape[-2:]
    needed = shared_numbers(ndx, nu, soft=True) * given.A.dtype.itemsize
    return needed <= cuda.shared_memory()


def newton_steps(given: Given) -> dict[str, Array | None]:
    """Newton step, noise and feedback of many chains; see `riccati_segments.newton_steps`."""
    rows, K, n, m = given.B.shape
    soft, noisy = given.penalty is not None, given.xi_u is not None
    threads = threads_for(n, m)
    chains_in_block = max(WARP // threads, 1)
    sizes = {
        "REAL": "float" if given.A.dtype == np.float32 else "double",
        "NX": n,
        "NU": m,
        "SOFT": int(soft),
        "NOISY": int(noisy),
        "TILE": tile(n),
        "THREADS": threads,
    }
    of_stage = {"dx": (n,), "du": (m,), "rate": (n,), "gains": (m, n)}
    of_stage |= {"noise_x": (n,), "noise_u": (m,)} if noisy else {}
    shapes = [(rows, K, *shape) for shape in (*of_stage.values(), (left_numbers(n, m, soft),))]
    found = cuda.call(
        KERNEL,
        "newton",
        sizes,
        blocks=-(-rows // chains_in_block),
        warps=-(-threads // WARP),
        shared=chains_in_block * shared_numbers(n, m, soft) * given.A.dtype.itemsize,
        arrays=[a for a in given if a is not None],
        shapes=shapes,
        numbers=[rows, K],
    )
    return {"noise_x": None, "noise_u": None, **dict(zip(of_stage, found, strict=False))}


def threads_for(ndx: int, nu: int) -> int:
    """Threads that work on a chain: one for each tile that is eliminated, as far as that goes."""
    x, u = blocks(ndx, nu)
    tiles = max(triangle(x) + x * (x + 1), x * (x + u + 1))
    if tiles <= WARP:
        return max(8, 1 << (tiles - 1).bit_length())
    return min(-(-tiles // WARP) * WARP, MAX_THREADS)


def blocks(ndx: int, nu: int) -> tuple[int, int]:
    """How many tiles x and u take."""
    return -(-ndx // tile(ndx)), -(-nu // tile(ndx))


def shared_numbers(ndx: int, nu: int, soft: bool) -> int:
    """Numbers in shared memory for one chain: SHARED in the kernel."""
    size, (x, u) = tile(ndx), blocks(ndx, nu)
    along_x, along_u = (x | 1) * size, (u | 1) * size
    panel = (max(2 * x, x + u) + 1) * size
    x, u = x * size, u * size
    vectors = 2 * (4 * x + 3 * u) + 2 * size * panel + 2 * x
    backward = 2 * x * x + 2 * x * (x + u + size)
    squares = (3 if soft else 1) * x * x
    forward = ndx * (along_x + along_u) + nu * along_x + squares + 6 * x + 2 * u
    return -(-(vectors + max(backward, forward)) // 8) * 8


def left_numbers(ndx: int, nu: int, soft: bool) -> int:
    """Numbers that a stage backward leaves for the way forward: LEFT in the kernel."""
    x, u = (n * tile(ndx) for n in blocks(ndx, nu))
    return -(-((3 if soft else 1) * x * x + x + 2 * u) // 4) * 4
