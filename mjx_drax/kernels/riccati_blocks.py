"""The Riccati recursion of `method.riccati` as two GPU kernels: a block of threads for each chain.

For blocks too large for the registers of one thread (`riccati_gpu`). Matrices are `tiles`. Where
the method factorizes, the kernel inverts S / mu and Quu, by sweeps.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mjx_drax.kernels.batching import block_for_each_row
from mjx_drax.kernels.linalg import cholesky, solve_upper, symmetric
from mjx_drax.kernels.tiles import (
    diagonal,
    padded,
    products,
    swept,
    tile,
    times,
    transposed_times,
)

MAX_NDX, MAX_NU = 64, 32
"""The largest blocks: beyond, registers do not hold them."""

WARPS = 4
"""Warps of 32 threads that work on a chain: more of them wait for each other longer."""


def newton_steps(
    A: Array,
    B: Array,
    h: Array,
    gx: Array,
    gu: Array,
    Hxx: Array,
    Hux: Array,
    Huu: Array,
    multipliers: Array,
    penalty: Array,
    xi_u: Array | None = None,
    xi_e: Array | None = None,
    interpret: bool = False,
) -> dict[str, Array | None]:
    """Newton step, noise and feedback of many chains, as `riccati_gpu.newton_steps` returns them.

    In plain JAX it is `method.riccati.newton`.
    """
    chains, K, n, m = B.shape
    N, M = tile(n), tile(m)
    soft = (1.0 / penalty)[:, None]
    A, Hxx = (padded(a, N, N) for a in (A, Hxx))
    B, Hux, Huu = padded(B, N, M), padded(Hux, M, N), padded(Huu, M, M)
    h, gx, multipliers = (padded(a, N) for a in (h, gx, multipliers))

    def launch(body: Any, shapes: dict[str, tuple[int, ...]], *arrays: Array) -> dict[str, Array]:
        full = {k: (chains, K, *s) for k, s in shapes.items()}
        return block_for_each_row(body, full, arrays, WARPS, interpret)

    multiply = products(interpret)
    shapes = {"K": (M, N), "kff": (M,), "Q": (M, M), "T": (N, N), "P": (N, N), "p": (N,)}
    given = soft, A, B, h, multipliers, gx, padded(gu, M), Hxx, Hux, Huu
    left = launch(partial(backward, K, n, m, multiply), shapes, *given)
    factors = [left[name] for name in ("K", "kff", "T", "P", "p")]
    shapes = {"dx": (N,), "du": (M,), "rate": (N,)}
    white = []
    if xi_u is not None and xi_e is not None:

        def colored(soft: Array, Q: Array, P: Array, xi_u: Array, xi_e: Array) -> tuple[Any, Any]:
            Ls = cholesky(jnp.eye(n, dtype=P.dtype) + soft * P[:n, :n])
            kicks = jnp.sqrt(soft) * solve_upper(Ls, xi_e)
            return solve_upper(cholesky(Q[:m, :m]), xi_u), kicks

        over_stages = jax.vmap(colored, in_axes=(None, 0, 0, 0, 0))
        of_u, of_x = jax.vmap(over_stages)(soft[:, 0], left["Q"], left["P"], xi_u, xi_e)
        white = [padded(of_u, M), padded(of_x, N)]
        shapes |= {"noise_x": (N,), "noise_u": (M,)}
    step = launch(partial(forward, K), shapes, soft, A, B, h, multipliers, *factors, *white)
    sizes = {"du": m, "noise_u": m}
    found = {name: a[..., : sizes.get(name, n)] for name, a in step.items()}
    return {"noise_x": None, "noise_u": None, **found, "gains": left["K"][..., :m, :n]}


def backward(horizon: int, n: int, m: int, product: Any, *refs: Any) -> None:
    """`method.riccati.factorize` of one chain, with inverses for factors."""
    soft, A, B, h, multipliers, gx, gu, Hxx, Hux, Huu = refs[:10]
    gains, offsets, of_u, inverses, values, slopes = refs[10:]
    s, identity = soft[0, 0], diagonal(Hxx.shape[-1], Hxx.dtype)

    def softened(P: Array) -> tuple[Array, Array]:
        T = -swept(identity + s * P, n)
        return T, symmetric(product(T, P))

    def stage(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        P, p = carry
        k = horizon - 1 - i
        a, b = A[0, k], B[0, k]
        T, relaxed = lax.cond(s == 0.0, lambda P: (identity, P), softened, P)
        slope = times(relaxed, h[0, k]) + times(T, p + s * times(P, multipliers[0, k]))
        PA, PB = product(relaxed, a), product(relaxed, b)
        Qux, Quu = Hux[0, k] + product(b.T, PA), Huu[0, k] + product(b.T, PB)
        qu = gu[0, k] + transposed_times(b, slope)
        inverse = -swept(Quu, m)
        K, kff = -product(inverse, Qux), -times(inverse, qu)
        K = K - product(inverse, Qux + product(Quu, K))  # one refinement
        gains[0, k], offsets[0, k], of_u[0, k] = K, kff, Quu
        inverses[0, k], values[0, k], slopes[0, k] = T, P, p
        before = Hxx[0, k] + product(a.T, PA) + product(Qux.T, K)
        return symmetric(before), gx[0, k] + transposed_times(a, slope) + transposed_times(Qux, kff)

    lax.fori_loop(0, horizon, stage, (Hxx[0, horizon], gx[0, horizon]))


def forward(horizon: int, *refs: Any) -> None:
    """`method.riccati.solve_and_sample` of one chain; noise comes colored."""
    soft, A, B, h, multipliers, gains, offsets, inverses, values, slopes, *rest = refs
    s = soft[0, 0]
    noisy = len(rest) > 3
    white, (dx, du, rate, *noise) = (rest[:2], rest[2:]) if noisy else ([], rest)

    def stage(k: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        a, b, K, T, p, multiplier = (
            ref[0, k] for ref in (A, B, gains, inverses, slopes, multipliers)
        )
        x = carry[0]
        u = times(K, x) + offsets[0, k]
        x = times(T, h[0, k] + times(a, x) + times(b, u) + s * (multiplier - p))
        dx[0, k], du[0, k] = x, u
        rate[0, k] = times(values[0, k], x) + p - multiplier
        if not noisy:
            return (x,)
        u = times(K, carry[1]) + white[0][0, k]
        nx = times(T, times(a, carry[1]) + times(b, u)) - white[1][0, k]
        noise[0][0, k], noise[1][0, k] = nx, u
        return x, nx

    zero = jnp.zeros_like(h[0, 0])
    lax.fori_loop(0, horizon, stage, (zero, zero) if noisy else (zero,))
