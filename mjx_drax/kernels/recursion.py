"""The affine recursion x_{k+1} = F_k x_k + f_k from x_0 = 0, for all k.

GPUs solve it in parallel over time, by an associative scan: a loop of K steps would be bound by
its launches. CPUs take the steps one by one, which is less work and compiles in less time.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def affine_recursion(F: Array, f: Array) -> Array:
    """x_1..x_K, (K, n, m), for F (K, n, n) and f (K, n, m)."""
    states: Array = jax.lax.platform_dependent(F, f, cpu=step_by_step, default=in_parallel)
    return states


def step_by_step(F: Array, f: Array) -> Array:
    """`affine_recursion` by a loop over k."""

    def step(x: Array, stage: tuple[Array, Array]) -> tuple[Array, Array]:
        x = stage[0] @ x + stage[1]
        return x, x

    return jax.lax.scan(step, jnp.zeros_like(f[0]), (F, f))[1]


def in_parallel(F: Array, f: Array) -> Array:
    """`affine_recursion` in about 2 log2(K) rounds of products."""

    def compose(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        return second[0] @ first[0], second[0] @ first[1] + second[1]

    return jax.lax.associative_scan(compose, (F, f))[1]
