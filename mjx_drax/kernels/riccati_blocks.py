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
    penalty: Array | None = None,
    xi_u: Array | None = None,
    xi_e: Array | None = None,
    interpret: bool = False,
) -> dict[str, Array | None]:
    """Newton step, noise and feedback of many chains, as `riccati_gpu.newton_steps` returns them.

    In plain JAX it is `method.riccati.newton`.
    """
    chains, K, n, m = B.shape
    N, M = tile(n), tile(m)
    soft = [] if penalty is None else [(1.0 / penalty)[:, None]]
    A, Hxx = (padded(a, N, N) for a in (A, Hxx))
    B, Hux, Huu = padded(B, N, M), padded(Hux, M, N), padded(Huu, M, M)
    h, gx, multipliers = (padded(a, N) for a in (h, gx, multipliers))

    def launch(body: Any, shapes: dict[str, tuple[int, ...]], *arrays: Array) -> dict[str, Array]:
        full = {k: (chains, K, *s) for k, s in shapes.items()}
        return block_for_each_row(body, full, arrays, WARPS, interpret)

    multiply = products(interpret)
    shapes = {"K": (M, N), "kff": (M,), "P": (N, N), "p": (N,), "Q": (M, M)}
    shapes |= {"T": (N, N)} if soft else {}
    given = A, B, h, multipliers, gx, padded(gu, M), Hxx, Hux, Huu, *soft
    left = launch(partial(backward, K, n, m, multiply, bool(soft)), shapes, *given)
    factors = [left[name] for name in shapes if name != "Q"] + soft
    shapes = {"dx": (N,), "du": (M,), "rate": (N,)}
    white = []
    if xi_u is not None and xi_e is not None:

        def colored(soft: Array, Q: Array, P: Array, xi_u: Array, xi_e: Array) -> tuple[Any, Any]:
            Ls = cholesky(jnp.eye(n, dtype=P.dtype) + soft * P[:n, :n])
            kicks = jnp.sqrt(soft) * solve_upper(Ls, xi_e)
            return solve_upper(cholesky(Q[:m, :m]), xi_u), kicks

        over_stages = jax.vmap(colored, in_axes=(None, 0, 0, 0, 0))
        amounts = soft[0][:, 0] if soft else jnp.zeros(chains, A.dtype)
        of_u, of_x = jax.vmap(over_stages)(amounts, left["Q"], left["P"], xi_u, xi_e)
        white = [padded(of_u, M), padded(of_x, N)]
        shapes |= {"noise_x": (N,), "noise_u": (M,)}
    program = partial(forward, K, bool(soft), bool(white))
    step = launch(program, shapes, A, B, h, multipliers, *factors, *white)
    sizes = {"du": m, "noise_u": m}
    found = {name: a[..., : sizes.get(name, n)] for name, a in step.items()}
    return {"noise_x": None, "noise_u": None, **found, "gains": left["K"][..., :m, :n]}


def backward(horizon: int, n: int, m: int, product: Any, soft: bool, *refs: Any) -> None:
    """`method.riccati.factorize` of one chain, with inverses for factors."""
    A, B, h, multipliers, gx, gu, Hxx, Hux, Huu, *rest = refs
    s = rest.pop(0)[0, 0] if soft else None
    gains, offsets, values, slopes, of_u, *inverses = rest

    def relaxed(k: Array, P: Array, p: Array) -> tuple[Array, Array]:
        """P~ and p~; T = mu S^{-1} is kept."""
        if s is None:
            return P, p
        T = -swept(diagonal(P.shape[0], P.dtype) + s * P, n)
        inverses[0][0, k] = T
        return symmetric(product(T, P)), times(T, p + s * times(P, multipliers[0, k]))

    def stage(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        P, p = carry
        k = horizon - 1 - i
        a, b = A[0, k], B[0, k]
        P_relaxed, p_relaxed = relaxed(k, P, p)
        slope = times(P_relaxed, h[0, k]) + p_relaxed
        PA, PB = product(P_relaxed, a), product(P_relaxed, b)
        Qux, Quu = Hux[0, k] + product(b.T, PA), Huu[0, k] + product(b.T, PB)
        qu = gu[0, k] + transposed_times(b, slope)
        inverse = -swept(Quu, m)
        K, kff = -product(inverse, Qux), -times(inverse, qu)
        K = K - product(inverse, Qux + product(Quu, K))  # one refinement
        gains[0, k], offsets[0, k], of_u[0, k], values[0, k], slopes[0, k] = K, kff, Quu, P, p
        before = Hxx[0, k] + product(a.T, PA) + product(Qux.T, K)
        return symmetric(before), gx[0, k] + transposed_times(a, slope) + transposed_times(Qux, kff)

    lax.fori_loop(0, horizon, stage, (Hxx[0, horizon], gx[0, horizon]))


def forward(horizon: int, soft: bool, noisy: bool, *refs: Any) -> None:
    """`method.riccati.solve_and_sample` of one chain; noise comes colored."""
    A, B, h, multipliers, gains, offsets, values, slopes, *more = refs
    rest = iter(more)
    inverses, s = (next(rest), next(rest)[0, 0]) if soft else (None, None)
    white = [next(rest), next(rest)] if noisy else []
    dx, du, rate, *noise = rest

    def stage(k: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        a, b, K, p, multiplier = (ref[0, k] for ref in (A, B, gains, slopes, multipliers))
        T = None if inverses is None else inverses[0, k]
        x = carry[0]
        u = times(K, x) + offsets[0, k]
        x = h[0, k] + times(a, x) + times(b, u)
        if T is not None:
            x = times(T, x + s * (multiplier - p))
        dx[0, k], du[0, k] = x, u
        rate[0, k] = times(values[0, k], x) + p - multiplier
        if not noisy:
            return (x,)
        u = times(K, carry[1]) + white[0][0, k]
        nx = times(a, carry[1]) + times(b, u)
        nx = (nx if T is None else times(T, nx)) - white[1][0, k]
        noise[0][0, k], noise[1][0, k] = nx, u
        return x, nx

    zero = jnp.zeros_like(h[0, 0])
    lax.fori_loop(0, horizon, stage, (zero, zero) if noisy else (zero,))
