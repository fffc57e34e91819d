"""`constraint_solver` on NVIDIA GPUs, without cones: a block of threads for each state.

One kernel, `constraints.cu`, makes all iterations of a state. Its matrices are in shared memory,
or, while the Hessian is eliminated, in registers, a tile in each thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jax import Array

from mjx_drax.kernels import cuda
from mjx_drax.kernels.riccati_cuda import WARP, tile, triangle

KERNEL = Path(__file__).with_name("constraints.cu")

MAX_THREADS, MOST_TILES = 128, 4
"""In a block; and that a thread may have, as more would not fit its registers."""

ITERATIONS, SIZES = 20, 16
"""Most iterations, and how many step sizes each chooses from, 1, 1/2, 1/4, ..., and one between."""

DIGITS = 32.0
"""A step shorter, measured by M, than so many roundings of all that came before is the last."""


def serves(rows: int, nv: int, itemsize: int) -> bool:
    """Whether there is such a GPU, and what J (rows, nv) needs fits its shared memory."""
    threads = threads_for(rows, nv)
    fits = tiles(nv) <= MOST_TILES * threads
    return fits and shared_numbers(rows, nv, threads) * itemsize <= cuda.shared_memory()


def minima(arrays: Sequence[Array]) -> Array:
    """The accelerations (states, nv), of M, J, D, aref, lower, upper and a0 of each state."""
    states, rows, nv = arrays[1].shape
    threads, itemsize = threads_for(rows, nv), arrays[0].dtype.itemsize
    macros = {
        "REAL": "float" if arrays[0].dtype == np.float32 else "double",
        "NV": nv,
        "NEFC": rows,
        "TILE": tile(nv),
        "THREADS": threads,
        "ITERATIONS": ITERATIONS,
        "SIZES": SIZES,
        "DIGITS": f"REAL({DIGITS})",
    }
    [found] = cuda.call(
        KERNEL,
        "minimum",
        macros,
        blocks=states,
        warps=threads // WARP,
        shared=shared_numbers(rows, nv, threads) * itemsize,
        arrays=arrays,
        shapes=[(states, nv)],
        numbers=[],
    )
    return found


def threads_for(rows: int, nv: int) -> int:
    """Threads that work on a state: one for each tile, or for each two rows, if these are more."""
    work = max(tiles(nv), rows // 2)
    return min(-(-work // WARP) * WARP, MAX_THREADS)


def tiles(nv: int) -> int:
    """Tiles of [H; g']: COUNT in the kernel."""
    blocks = -(-nv // tile(nv))
    return triangle(blocks) + blocks


def shared_numbers(rows: int, nv: int, threads: int) -> int:
    """Numbers in shared memory: SHARED in the kernel."""
    size, blocks = tile(nv), -(-nv // tile(nv))
    along, padded = (blocks | 1) * size, blocks * size
    panels, sums = 2 * size * (blocks + 1) * size, 2 * SIZES * (threads // WARP)
    numbers = (padded + rows) * along + panels + 6 * padded + 8 * rows + sums
    return -(-numbers // 8) * 8
