"""Solutions of affine recursions x_{k+1} = F_k x_k + f_k from x_0 = 0.

Several right-hand sides at once: f_k and x_k are (n, m). On a CPU a loop over k does the least
work. On GPUs each step of such a loop costs the launch of a kernel. There many chains are one
kernel, which does all steps: a thread for each chain where blocks are small, else a block of
threads. Elsewhere an associative scan does the same in about 2 log2(K) rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels import riccati_threads, tiles
from mjx_drax.kernels.batching import (
    block_for_each_row,
    merged_vmaps,
    of_one_precision,
    on_gpu,
    repeated,
)
from mjx_drax.kernels.linalg import product

MAX_ENTRIES = 64
"""Entries of F_k or of f_k that one thread keeps in its registers."""

MAX_TILE, WARPS = 64, 4
"""Rows of F_k that a block of threads keeps in its registers, and its groups of 32 threads."""


def step_by_step(F: Array, f: Array) -> Array:
    """`affine_recursion` by a loop over k."""

    def step(x: Array, stage: tuple[Array, Array]) -> tuple[Array, Array]:
        x = product(stage[0], x) + stage[1]
        return x, x

    return jax.lax.scan(step, jnp.zeros_like(f[0]), (F, f))[1]


def in_parallel(F: Array, f: Array) -> Array:
    """`affine_recursion` in about 2 log2(K) rounds of products."""

    def compose(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        return second[0] @ first[0], second[0] @ first[1] + second[1]

    return jax.lax.associative_scan(compose, (F, f))[1]


def by_tiles(F: Array, f: Array, interpret: bool = False) -> Array:
    """`affine_recursion` of many chains, (chains, K, ...), by a block of threads for each."""
    chains, K, n, m = f.shape
    N, M, multiply = tiles.tile(n), tiles.tile(m), tiles.products(interpret)

    def body(F_ref: Any, f_ref: Any, x_ref: Any) -> None:
        def stage(k: Array, x: Array) -> Array:
            x = multiply(F_ref[0, k], x) + f_ref[0, k]
            x_ref[0, k] = x
            return x

        lax.fori_loop(0, K, stage, jnp.zeros_like(f_ref[0, 0]))

    arrays = tiles.padded(F, N, N), tiles.padded(f, N, M)
    shapes: dict[str, tuple[int, ...]] = {"x": (chains, K, N, M)}
    found = block_for_each_row(body, shapes, arrays, WARPS, interpret)
    return found["x"][..., :n, :m]


def _one(F: Array, f: Array) -> Array:
    states: Array = lax.platform_dependent(F, f, cpu=step_by_step, default=in_parallel)
    return states


def _all_chains(has_rows: Sequence[bool], *arguments: Array) -> Array:
    F, f = repeated(has_rows, arguments)
    n, m = f.shape[-2:]
    plain, kernel = jax.vmap(_one), None
    if on_gpu() and min(n, m) and of_one_precision((F, f)):
        if max(n * n, n * m) <= MAX_ENTRIES:
            kernel = riccati_threads.recursion
        elif n <= MAX_TILE and F.dtype == np.float32:
            kernel = by_tiles
    if kernel is None:
        return plain(F, f)
    states: Array = lax.platform_dependent(F, f, cuda=kernel, default=plain)
    return states


affine_recursion = merged_vmaps(_one, _all_chains)
"""x_1..x_K, (K, n, m), for F (K, n, n) and f (K, n, m)."""
