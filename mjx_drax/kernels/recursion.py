"""Solutions of affine recursions x_{k+1} = F_k x_k + f_k from x_0 = 0.

Several right-hand sides at once: f_k and x_k are (n, m). On a CPU a loop over k does the least
work. On GPUs each step of such a loop costs the launch of a kernel. There many chains are one
kernel, which does all steps: a thread for each chain where blocks are small, else a block of
threads. Elsewhere an associative scan does the same in about 2 log2(K) rounds.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels import riccati_blocks, riccati_threads
from mjx_drax.kernels.batching import merged_vmaps, of_one_precision, on_gpu, repeated
from mjx_drax.kernels.linalg import product

MAX_ENTRIES = 64
"""Entries of F_k or of f_k that one thread keeps in its registers."""


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
        elif n <= riccati_blocks.MAX_NDX and F.dtype == np.float32:
            kernel = riccati_blocks.recursion
    if kernel is None:
        return plain(F, f)
    states: Array = lax.platform_dependent(F, f, cuda=kernel, default=plain)
    return states


affine_recursion = merged_vmaps(_one, _all_chains)
"""x_1..x_K, (K, n, m), for F (K, n, n) and f (K, n, m)."""
