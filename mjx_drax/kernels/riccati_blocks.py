"""The Riccati recursion of `method.riccati` as GPU kernels: a block of threads for each chain.

For blocks too large for the registers of one thread (`riccati_threads`). Matrices are `tiles`.
Where the method factorizes, kernels invert S / mu and Quu, by sweeps. A row is a chain, or a
segment of one (`riccati_segments`).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mjx_drax.kernels.batching import block_for_each_row
from mjx_drax.kernels.linalg import cholesky, solve_upper, symmetric
from mjx_drax.kernels.riccati_threads import Given, Link, Segmented
from mjx_drax.kernels.tiles import (
    diagonal,
    padded,
    products,
    rooted,
    swept,
    tile,
    times,
    transposed_times,
)

MAX_NDX, MAX_NU = 64, 32
"""The largest blocks: beyond, registers do not hold them."""

SEGMENTED = Segmented(ndx=64, stages=32, rows=264)
"""More rows than two for each multiprocessor of an H100 wait for each other."""

WARPS = 4
"""Warps of 32 threads that work on a chain: more of them wait for each other longer."""


class Factors(NamedTuple):
    """What `followed` needs of all stages; T = mu S^{-1}, None without a penalty."""

    K: Array
    kff: Array
    P: Array
    p: Array
    Quu: Array
    T: Array | None = None


def factorized(given: Given, interpret: bool = False) -> Factors:
    """`method.riccati.factorize` of every row."""
    rows, K, n, m = given.B.shape
    N, M = tile(n), tile(m)
    shapes: dict[str, Any] = {"K": (M, N), "kff": (M,), "P": (N, N), "p": (N,), "Quu": (M, M)}
    shapes |= {} if given.penalty is None else {"T": (N, N)}
    full = {name: (rows, K, *shape) for name, shape in shapes.items()}
    return Factors(**_through(backward, given, full, interpret))


def condensed(given: Given, interpret: bool = False) -> Link:
    """The stages of every row as one; of its last knot the cost is counted."""
    rows, n = len(given.h), given.h.shape[-1]
    N = tile(n)
    square, vector = (rows, N, N), (rows, N)
    shapes = {"J": square, "j": vector, "Phi": square, "phi": vector, "R": square}
    found = _through(condense, given, shapes, interpret)
    return Link(*(a[(slice(None), *[slice(n)] * (a.ndim - 1))] for a in found.values()))


def joined(links: Link, interpret: bool = False) -> tuple[Array, Array, Array]:
    """P and p after every segment, and W Phi, (rows, S, ...); see `riccati_segments`."""
    rows, S, n = links.j.shape
    N = tile(n)
    arrays = [padded(a, *[N] * (a.ndim - 2)) for a in links]
    shapes = {"P": (rows, S, N, N), "p": (rows, S, N), "WPhi": (rows, S, N, N)}
    body = partial(join, S, n, products(interpret))
    found = block_for_each_row(body, shapes, arrays, WARPS, interpret)
    return found["P"][..., :n, :n], found["p"][..., :n], found["WPhi"][..., :n, :n]


def followed(
    given: Given, factors: Factors, start: tuple[Array, Array] | None, interpret: bool = False
) -> dict[str, Array | None]:
    """What `riccati_segments.newton_steps` returns: `method.riccati.solve_and_sample`.

    The step starts at dx_0 = 0, and its noise too, or both at what is given, (rows, ndx).
    """
    rows, K, n, m = given.B.shape
    N, M = tile(n), tile(m)
    zero = jnp.zeros((rows, n), given.h.dtype)
    dx, nx = start or (zero, zero)
    arrays: list[Array] = [
        *(padded(a, N) for a in (dx, nx)),
        padded(given.A, N, N),
        padded(given.B, N, M),
        *(padded(a, N) for a in (given.h, given.multipliers)),
        *factors[:4],
    ]
    soft = given.penalty is not None
    if given.penalty is not None:
        assert factors.T is not None
        arrays += [factors.T, (1.0 / given.penalty)[:, None]]
    shapes: dict[str, tuple[int, ...]] = {"dx": (N,), "du": (M,), "rate": (N,)}
    noisy = given.xi_u is not None and given.xi_e is not None
    if given.xi_u is not None and given.xi_e is not None:
        of_u, of_x = _colored(given, factors, given.xi_u, given.xi_e)
        arrays += [padded(of_u, M), padded(of_x, N)]
        shapes |= {"noise_x": (N,), "noise_u": (M,)}
    full: dict[str, tuple[int, ...]] = {name: (rows, K, *s) for name, s in shapes.items()}
    step = block_for_each_row(partial(forward, K, soft, noisy), full, arrays, WARPS, interpret)
    sizes = {"du": m, "noise_u": m}
    found = {name: a[..., : sizes.get(name, n)] for name, a in step.items()}
    return {"noise_x": None, "noise_u": None, **found, "gains": factors.K[..., :m, :n]}


def _colored(given: Given, factors: Factors, xi_u: Array, xi_e: Array) -> tuple[Array, Array]:
    """The noise of controls and of defects, from white numbers."""
    n, m = given.B.shape[2:]

    def colored(soft: Array, Quu: Array, P: Array, xi_u: Array, xi_e: Array) -> tuple[Array, Array]:
        Ls = cholesky(jnp.eye(n, dtype=P.dtype) + soft * P[:n, :n])
        kicks = jnp.sqrt(soft) * solve_upper(Ls, xi_e)
        return solve_upper(cholesky(Quu[:m, :m]), xi_u), kicks

    over_stages = jax.vmap(colored, in_axes=(None, 0, 0, 0, 0))
    none = jnp.zeros(len(given.h), given.h.dtype)
    soft = none if given.penalty is None else 1.0 / given.penalty
    of_u, of_x = jax.vmap(over_stages)(soft, factors.Quu, factors.P, xi_u, xi_e)
    return of_u, of_x


def recursion(F: Array, f: Array, interpret: bool = False) -> Array:
    """`recursion.affine_recursion` of many chains, (chains, K, ...)."""
    chains, K, n, m = f.shape
    N, M, multiply = tile(n), tile(m), products(interpret)

    def body(F_ref: Any, f_ref: Any, x_ref: Any) -> None:
        def stage(k: Array, x: Array) -> Array:
            x = multiply(F_ref[0, k], x) + f_ref[0, k]
            x_ref[0, k] = x
            return x

        lax.fori_loop(0, K, stage, jnp.zeros_like(f_ref[0, 0]))

    arrays = padded(F, N, N), padded(f, N, M)
    shapes: dict[str, tuple[int, ...]] = {"x": (chains, K, N, M)}
    found = block_for_each_row(body, shapes, arrays, WARPS, interpret)
    return found["x"][..., :n, :m]


def _through(
    body: Any, given: Given, shapes: dict[str, tuple[int, ...]], interpret: bool
) -> dict[str, Array]:
    """A kernel that goes backward through all stages."""
    K, n, m = given.B.shape[1:]
    N, M = tile(n), tile(m)
    arrays = [
        padded(given.A, N, N),
        padded(given.B, N, M),
        *(padded(a, N) for a in (given.h, given.multipliers, given.gx)),
        padded(given.gu, M),
        padded(given.Hxx, N, N),
        padded(given.Hux, M, N),
        padded(given.Huu, M, M),
    ]
    soft = given.penalty is not None
    if given.penalty is not None:
        arrays.append((1.0 / given.penalty)[:, None])
    program = partial(body, K, n, m, products(interpret), soft)
    return block_for_each_row(program, shapes, arrays, WARPS, interpret)


class Stage(NamedTuple):
    """What a stage leaves: gains, Quu and its inverse, T, and P, p before it."""

    K: Array
    kff: Array
    Quu: Array
    inverse: Array
    T: Array | None
    P: Array
    p: Array


def before(
    refs: Any, n: int, m: int, product: Any, s: Array | None, k: Array, P: Array, p: Array
) -> Stage:
    """`method.riccati.factorize` of one stage, with inverses for factors."""
    A, B, h, multipliers, gx, gu, Hxx, Hux, Huu = refs
    a, b, T = A[0, k], B[0, k], None
    P_relaxed, p_relaxed = P, p
    if s is not None:
        T = -swept(diagonal(P.shape[0], P.dtype) + s * P, n)
        P_relaxed = symmetric(product(T, P))
        p_relaxed = times(T, p + s * times(P, multipliers[0, k]))
    slope = times(P_relaxed, h[0, k]) + p_relaxed
    PA, PB = product(P_relaxed, a), product(P_relaxed, b)
    Qux, Quu = Hux[0, k] + product(b.T, PA), Huu[0, k] + product(b.T, PB)
    qu = gu[0, k] + transposed_times(b, slope)
    inverse = -swept(Quu, m)
    K, kff = -product(inverse, Qux), -times(inverse, qu)
    K = K - product(inverse, Qux + product(Quu, K))  # one refinement
    P = symmetric(Hxx[0, k] + product(a.T, PA) + product(Qux.T, K))
    p = gx[0, k] + transposed_times(a, slope) + transposed_times(Qux, kff)
    return Stage(K, kff, Quu, inverse, T, P, p)


def backward(horizon: int, n: int, m: int, product: Any, soft: bool, *refs: Any) -> None:
    """`factorized` for one row."""
    given, rest = refs[:9], list(refs[9:])
    s = rest.pop(0)[0, 0] if soft else None
    gains, offsets, values, slopes, of_u, *inverses = rest

    def stage(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        P, p = carry
        k = horizon - 1 - i
        found = before(given, n, m, product, s, k, P, p)
        gains[0, k], offsets[0, k], of_u[0, k] = found.K, found.kff, found.Quu
        values[0, k], slopes[0, k] = P, p
        if found.T is not None:
            inverses[0][0, k] = found.T
        return found.P, found.p

    gx, Hxx = given[4], given[6]
    lax.fori_loop(0, horizon, stage, (Hxx[0, horizon], gx[0, horizon]))


def condense(horizon: int, n: int, m: int, product: Any, soft: bool, *refs: Any) -> None:
    """`condensed` for one row."""
    given, rest = refs[:9], list(refs[9:])
    s = rest.pop(0)[0, 0] if soft else None
    A, B, h, multipliers, gx, _, Hxx, *_ = given

    def stage(i: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        P, p, Phi, phi, C = carry
        k = horizon - 1 - i
        found = before(given, n, m, product, s, k, P, p)
        if s is not None:
            assert found.T is not None
            relaxed = product(Phi, found.T)
            C = C + s * product(relaxed, Phi.T)
            phi, Phi = phi - s * times(relaxed, p - multipliers[0, k]), relaxed
        PhiB = product(Phi, B[0, k])
        phi = phi + times(Phi, h[0, k]) + times(PhiB, found.kff)
        C = symmetric(C + product(product(PhiB, found.inverse), PhiB.T))
        Phi = product(Phi, A[0, k]) + product(PhiB, found.K)
        return found.P, found.p, Phi, phi, C

    end, slope = Hxx[0, horizon], gx[0, horizon]
    nothing, N = jnp.zeros_like(slope), end.shape[0]
    start = end, slope, diagonal(N, end.dtype), nothing, jnp.zeros_like(end)
    *link, C = lax.fori_loop(0, horizon, stage, start)
    for ref, a in zip(rest, (*link, rooted(C, n)), strict=True):
        ref[0] = a


def join(S: int, n: int, product: Any, *refs: Any) -> None:
    """`joined` for one chain."""
    Js, js, Phis, phis, Rs, Ps, ps, WPhis = refs

    def segment(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        P, p = carry
        k = S - 1 - i
        Phi, R = Phis[0, k], Rs[0, k]
        PR = product(P, R)
        M = diagonal(R.shape[0], R.dtype) + symmetric(product(R.T, PR))
        inverse = -swept(M, n)
        X = product(inverse, PR.T)
        X = X + product(inverse, PR.T - product(M, X))  # one refinement
        W = symmetric(P - product(PR, X))
        w = p - transposed_times(X, transposed_times(R, p))
        WPhi = product(W, Phi)
        Ps[0, k], ps[0, k], WPhis[0, k] = P, p, WPhi
        P = symmetric(Js[0, k] + product(Phi.T, WPhi))
        return P, js[0, k] + transposed_times(Phi, times(W, phis[0, k]) + w)

    nothing = jnp.zeros_like(Js[0, 0]), jnp.zeros_like(js[0, 0])
    lax.fori_loop(0, S, segment, nothing)


def forward(horizon: int, soft: bool, noisy: bool, *refs: Any) -> None:
    """`followed` for one row; noise comes colored."""
    first, first_noise, A, B, h, multipliers, gains, offsets, values, slopes, *more = refs
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

    start = (first[0], first_noise[0]) if noisy else (first[0],)
    lax.fori_loop(0, horizon, stage, start)
