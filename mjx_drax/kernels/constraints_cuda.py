"""`constraint_solver` on NVIDIA GPUs: a block of threads for each state.

One kernel, `constraints.cu`, makes all iterations of a state. Its matrices are in shared memory,
or, while the Hessian is eliminated, in registers, a tile in each thread.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jax import Array

from mjx_drax.kernels import cuda
from mjx_drax.kernels.cuda import WARP, tile, triangle

KERNEL = Path(__file__).with_name("constraints.cu")

MAX_THREADS, MOST_TILES = 128, 4
"""In a block; and that a thread may have, as more would not fit its registers."""

ITERATIONS, SIZES = 20, 16
"""Most iterations, and how many step sizes each chooses from, 1, 1/2, 1/4, ..., and one between."""

DIGITS = 32.0
"""A step shorter, measured by M, than so many roundings of all that came before is the last."""


DIMS = 3, 4, 6
"""Rows that contacts with elliptic cones have."""

NO_CONES = 0, 0, 0

Counts = tuple[int, ...]
"""How many contacts there are with each of `DIMS`."""


def serves(rows: int, nv: int, itemsize: int, contacts: Counts = NO_CONES) -> bool:
    """Whether there is such a GPU, and what J (rows, nv) needs fits its shared memory."""
    threads = threads_for(rows, nv)
    fits = tiles(nv) <= MOST_TILES * threads
    return fits and shared_numbers(rows, nv, threads, contacts) * itemsize <= cuda.shared_memory()


def minima(arrays: Sequence[Array], contacts: Counts = NO_CONES) -> Array:
    """The accelerations (states, nv).

    Args:
        arrays: M, J, D, aref, lower, upper and a0 of each state, and if there are cones, scale,
            mu and weight. J and aref end with the rows of cones, contact by contact; D, lower and
            upper have those before alone.
        contacts: those with cones, in the order of `DIMS`.
    """
    states, rows, nv = arrays[1].shape
    threads, itemsize = threads_for(rows, nv), arrays[0].dtype.itemsize
    macros = {
        "REAL": "float" if arrays[0].dtype == np.float32 else "double",
        "NV": nv,
        "NLAW": arrays[2].shape[1],
        **{f"C{dim}": count for dim, count in zip(DIMS, contacts, strict=True)},
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
        shared=shared_numbers(rows, nv, threads, contacts) * itemsize,
        arrays=arrays,
        shapes=[(states, nv)],
        numbers=[],
    )
    return found


def rows_of_cones(contacts: Counts) -> int:
    """Rows of J that contacts with cones have."""
    return sum(map(operator.mul, DIMS, contacts))


def threads_for(rows: int, nv: int) -> int:
    """Threads that work on a state: one for each tile, or for each two rows, if these are more."""
    work = max(tiles(nv), rows // 2)
    return min(-(-work // WARP) * WARP, MAX_THREADS)


def tiles(nv: int) -> int:
    """Tiles of [H; g']: COUNT in the kernel."""
    blocks = -(-nv // tile(nv))
    return triangle(blocks) + blocks


def shared_numbers(rows: int, nv: int, threads: int, contacts: Counts) -> int:
    """Numbers in shared memory: SHARED in the kernel."""
    size, blocks = tile(nv), -(-nv // tile(nv))
    along, padded = (blocks | 1) * size, blocks * size
    panels, sums = 2 * size * (blocks + 1) * size, 2 * SIZES * (threads // WARP)
    of_cones = rows_of_cones(contacts)
    terms, law = rows + 2 * sum(contacts), rows - of_cones
    numbers = (padded + terms) * along + panels + 6 * padded + 3 * law + 2 * rows + 3 * terms
    return -(-(numbers + 3 * of_cones + 2 * sum(contacts) + sums) // 8) * 8
