"""The Riccati recursion of `method.riccati` as GPU kernels: a thread for each chain.

As a loop of array operations the recursion costs 20 to 30 us for each stage on a GPU, because every
stage is a handful of kernel launches. Here one launch does all stages of a chain: the value
function stays in registers from stage to stage, and small blocks are unrolled into scalars. In
memory the chains are the last axis, so that neighbouring threads read neighbouring numbers. A row
is a chain, or a segment of one (`riccati_segments`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import prod
from operator import mul
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels.batching import padded, thread_for_each_row
from mjx_drax.kernels.small_matrices import (
    Matrix,
    Vector,
    add,
    cholesky,
    dot,
    matmul,
    matvec,
    solve_lower,
    solve_upper,
    symmetric,
    transpose,
)

THREADS = 32
"""Chains that a block of threads works on: one warp."""

READ_AHEAD = 96
"""Numbers of a stage that a thread reads while it works on the stage before."""

MAX_NDX, MAX_NU = 4, 4
"""The largest blocks: of larger ones the kernel takes most of a minute to compile, and longer than
`riccati_cuda` to run."""


class Given(NamedTuple):
    """Quadratic programs of many chains, or of segments of chains, in rows.

    A (rows, K, ndx, ndx), B (rows, K, ndx, nu) and h (rows, K, ndx); gx (rows, K+1, ndx) and gu
    (rows, K, nu); Hxx (rows, K+1, ndx, ndx), Hux (rows, K, nu, ndx) and Huu (rows, K, nu, nu);
    multipliers (rows, K, ndx); penalty (rows,), or None; standard normal numbers xi_u (rows, K, nu)
    and xi_e (rows, K, ndx), or None for no noise.
    """

    A: Array
    B: Array
    h: Array
    gx: Array
    gu: Array
    Hxx: Array
    Hux: Array
    Huu: Array
    multipliers: Array
    penalty: Array | None = None
    xi_u: Array | None = None
    xi_e: Array | None = None


class Link(NamedTuple):
    """How the value function before some stages follows from the one after them.

    With V(y) = W(y) + 1/2 y'Hxx y + gx'y after them, whose quadratic part is of the last knot,

        V_before(x) = 1/2 x'J x + j'x + min_y [ W(y) + 1/2 |y - Phi x - phi|^2_{C^{-1}} ]

    and C = R R'. J, Phi and R are (..., n, n), of which J is symmetric; j and phi are (..., n).
    """

    J: Array
    j: Array
    Phi: Array
    phi: Array
    R: Array


def factorized(given: Given, interpret: bool = False) -> Array:
    """What `followed` needs of all stages of all rows: `method.riccati.factorize`."""
    shape = (given.h.shape[1], _factors(given).size)
    return _through(backward, given, shape, interpret)


def condensed(given: Given, interpret: bool = False) -> Link:
    """The stages of every row as one; of its last knot the cost is counted."""
    n = given.h.shape[-1]
    found = _link(n)
    packed = _through(condense, given, (1, found.size), interpret)
    link = {name: found.unpack(packed, name)[: len(given.h), 0] for name in found.shapes}
    return Link(**{**link, "J": symmetric_from(link["J"], n)})


def joined(links: Link, interpret: bool = False) -> tuple[Array, Array, Array]:
    """P and p after every segment, and W Phi, (rows, S, ...); see `riccati_segments`."""
    rows, S, n = links.j.shape
    given = _link(n)
    found = Layout(P=tri(n), p=(n,), WPhi=(n, n))
    packed = [given.pack(**links._replace(J=lower_triangle(links.J))._asdict())]
    body = partial(join, given)
    out = thread_for_each_row(body, THREADS, (S, found.size), packed, interpret=interpret)
    P, p, WPhi = (found.unpack(out, name)[:rows] for name in found.shapes)
    return symmetric_from(P, n), p, WPhi


def followed(
    given: Given, factors: Array, start: tuple[Array, Array] | None, interpret: bool = False
) -> dict[str, Array | None]:
    """What `riccati_segments.newton_steps` returns: `method.riccati.solve_and_sample`.

    The step starts at dx_0 = 0, and its noise too, or both at what is given, (rows, ndx).
    """
    rows, K, n, m = given.B.shape
    left = _factors(given)
    zero = jnp.zeros_like(given.h[:, 0])
    dx, nx = start or (zero, zero)
    first = Layout(dx=(n,), nx=(n,), **_soft(given))
    parts = {"dx": dx, "nx": nx, **_softness(given)}
    stages = [(_common(given), _model(given)), (left, factors)]
    noise: dict[str, tuple[int, ...]] = {}
    if given.xi_u is not None:
        white = Layout(xi_u=(m,), xi_e=(n,))
        stages.insert(1, (white, white.pack(xi_u=given.xi_u, xi_e=given.xi_e)))
        noise = {"noise_x": (n,), "noise_u": (m,)}
    out = Layout(dx=(n,), du=(m,), **noise, rate=(n,))
    layouts, arrays = zip(*stages, strict=True)
    program = partial(forward, K, first, layouts)
    given_to = [first.pack(**parts), *arrays]
    steps = thread_for_each_row(program, THREADS, (K, out.size), given_to, interpret=interpret)
    step = {name: out.unpack(steps, name)[:rows] for name in out.shapes}
    gains = left.unpack(factors, "K")[:rows]
    return {"noise_x": None, "noise_u": None, **step, "gains": gains}


def recursion(F: Array, f: Array, interpret: bool = False) -> Array:
    """`recursion.affine_recursion` of many chains, (chains, K, ...)."""
    chains, K, n, m = f.shape
    given, found = Layout(F=(n, n), f=(n, m)), Layout(x=(n, m))

    def body(given_ref: Any, found_ref: Any) -> None:
        def stage(k: Array, here: dict[str, Any], x: Matrix) -> Matrix:
            x = [add(*rows) for rows in zip(matmul(here["F"], x), here["f"], strict=True)]
            write(found_ref, k, *x)
            return x

        zero = jnp.zeros_like(given_ref[0, 0, :])
        over_stages(K, [given], [given_ref], stage, [[zero] * m for _ in range(n)])

    packed = given.pack(F=F, f=f)
    states = thread_for_each_row(body, THREADS, (K, found.size), [packed], interpret=interpret)
    return found.unpack(states, "x")[:chains]


def _through(body: Any, given: Given, shape: tuple[int, ...], interpret: bool) -> Array:
    """A kernel that goes backward through all stages."""
    horizon, n, m = given.B.shape[1:]
    end = Layout(Hxx=tri(n), gx=(n,), **_soft(given))
    costs = Layout(gx=(n,), gu=(m,), Hxx=tri(n), Hux=(m, n), Huu=tri(m))
    Hxx, gx = lower_triangle(given.Hxx), given.gx
    last = end.pack(Hxx=Hxx[:, -1], gx=gx[:, -1], **_softness(given))
    cost = costs.pack(
        gx=gx[:, :-1], gu=given.gu, Hxx=Hxx[:, :-1], Hux=given.Hux, Huu=lower_triangle(given.Huu)
    )
    program = partial(body, horizon, end, (_common(given), costs))
    arrays = [last, _model(given), cost]
    return thread_for_each_row(program, THREADS, shape, arrays, interpret=interpret)


def _common(given: Given) -> Layout:
    n, m = given.B.shape[2:]
    return Layout(A=(n, n), B=(n, m), h=(n,), multiplier=(n,))


def _model(given: Given) -> Array:
    return _common(given).pack(A=given.A, B=given.B, h=given.h, multiplier=given.multipliers)


def _factors(given: Given) -> Layout:
    n, m = given.B.shape[2:]
    Ls = {} if given.penalty is None else {"Ls": tri(n)}
    return Layout(K=(m, n), kff=(m,), Lu=tri(m), **Ls, P=tri(n), p=(n,))


def _link(n: int) -> Layout:
    return Layout(J=tri(n), j=(n,), Phi=(n, n), phi=(n,), R=(n, n))


def _soft(given: Given) -> dict[str, tuple[int, ...]]:
    return {} if given.penalty is None else {"soft": (1,)}


def _softness(given: Given) -> dict[str, Array]:
    return {} if given.penalty is None else {"soft": 1.0 / given.penalty[:, None]}


class Stage(NamedTuple):
    """What a stage leaves: gains, factors of Quu and S / mu, and P, p before it."""

    K: Matrix
    kff: Vector
    Lu: Matrix
    Ls: Matrix
    P: Matrix
    p: Vector


def before(s: dict[str, Any], soft: Array | None, P: Matrix, p: Vector) -> Stage:
    """`method.riccati.factorize` of one stage."""
    Ls: Matrix = []
    P_relaxed, p_relaxed = P, p
    if soft is not None:
        n = range(len(p))
        Ls = factor([[soft * P[r][c] + (1.0 if r == c else 0.0) for c in n] for r in n])
        right = [a + soft * b for a, b in zip(p, matvec(P, s["multiplier"]), strict=True)]
        P_relaxed, p_relaxed = symmetric([solve(Ls, row) for row in P]), solve(Ls, right)
    slope = add(matvec(P_relaxed, s["h"]), p_relaxed)
    A, B = s["A"], s["B"]
    PA, PB = matmul(P_relaxed, A), matmul(P_relaxed, B)
    Qux = [add(a, b) for a, b in zip(s["Hux"], matmul(transpose(B), PA), strict=True)]
    qx = add(s["gx"], matvec(transpose(A), slope))
    qu = add(s["gu"], matvec(transpose(B), slope))
    Lu = factor(symmetric_product(full(s["Huu"]), B, PB))
    K = transpose([[-e for e in solve(Lu, column)] for column in transpose(Qux)])
    kff = [-e for e in solve(Lu, qu)]
    Qxx = symmetric_product(full(s["Hxx"]), A, PA)
    P, p = symmetric_product(Qxx, Qux, K), add(qx, matvec(transpose(Qux), kff))
    return Stage(K, kff, Lu, Ls, P, p)


def backward(
    horizon: int, end: Layout, layouts: Sequence[Layout], end_ref: Any, *refs: Any
) -> None:
    """`method.riccati.factorize` for the rows of a block of threads."""
    *stage_refs, out_ref = refs
    last = end.read(end_ref)
    soft = last["soft"][0] if "soft" in last else None

    def stage(k: Array, s: dict[str, Any], carry: Any) -> Any:
        P, p = full(carry[0]), carry[1]
        found = before(s, soft, P, p)
        write(out_ref, k, *found.K, found.kff, *found.Lu, *found.Ls, *triangle(P), p)
        return halves(found.P), found.p

    over_stages(horizon, layouts, stage_refs, stage, (last["Hxx"], last["gx"]), True)


def condense(
    horizon: int, end: Layout, layouts: Sequence[Layout], end_ref: Any, *refs: Any
) -> None:
    """`Link` of the stages of every row of a block of threads."""
    *stage_refs, out_ref = refs
    last = end.read(end_ref)
    soft = last["soft"][0] if "soft" in last else None
    n = range(len(last["gx"]))
    zero, one = jnp.zeros_like(last["gx"][0]), jnp.ones_like(last["gx"][0])

    def stage(k: Array, s: dict[str, Any], carry: Any) -> Any:
        P, p, Phi, phi, C = full(carry[0]), carry[1], carry[2], carry[3], full(carry[4])
        found = before(s, soft, P, p)
        if soft is not None:
            relaxed = [solve(found.Ls, row) for row in Phi]
            scaled = [[soft * e for e in row] for row in relaxed]
            C = symmetric_product(C, transpose(scaled), transpose(Phi))
            push = [b - a for a, b in zip(p, s["multiplier"], strict=True)]
            phi, Phi = add(phi, matvec(scaled, push)), relaxed
        PhiB = matmul(Phi, s["B"])
        phi = add(phi, add(matvec(Phi, s["h"]), matvec(PhiB, found.kff)))
        roots = transpose([solve_lower(found.Lu, row, mul) for row in PhiB])
        C = symmetric_product(C, roots, roots)
        closed = zip(matmul(Phi, s["A"]), matmul(PhiB, found.K), strict=True)
        return halves(found.P), found.p, [add(*rows) for rows in closed], phi, halves(C)

    identity = [[one if i == j else zero for j in n] for i in n]
    nothing = [zero for i in n for j in range(i + 1)]
    start = (last["Hxx"], last["gx"], identity, [zero for _ in n], nothing)
    J, j, Phi, phi, C = over_stages(horizon, layouts, stage_refs, stage, start, True)
    write(out_ref, 0, J, j, *Phi, phi, *rooted(full(C)))


def join(given: Layout, links_ref: Any, out_ref: Any) -> None:
    """`joined` for the chains of a block of threads."""
    n = given.shapes["j"][0]

    def stage(k: Array, s: dict[str, Any], carry: Any) -> Any:
        P, p, Phi, root = full(carry[0]), carry[1], s["Phi"], transpose(s["R"])
        PR = transpose([matvec(P, column) for column in root])
        M = [[dot(column, row) for row in transpose(PR)] for column in root]
        L = factor([[M[i][j] + (1.0 if i == j else 0.0) for j in range(n)] for i in range(n)])
        Y = [solve_lower(L, row, mul) for row in PR]
        W = full([P[i][j] - dot(Y[i], Y[j]) for i in range(n) for j in range(i + 1)])
        w = solve_lower(L, [dot(column, p) for column in root], mul)
        w = [a - b for a, b in zip(p, matvec(Y, w), strict=True)]
        WPhi = matmul(W, Phi)
        write(out_ref, k, carry[0], p, *WPhi)
        slope = matvec(transpose(Phi), add(matvec(W, s["phi"]), w))
        return halves(symmetric_product(full(s["J"]), Phi, WPhi)), add(s["j"], slope)

    zero = jnp.zeros_like(links_ref[0, 0, :])
    nothing = [zero] * tri(n)[0], [zero] * n
    over_stages(links_ref.shape[0], [given], [links_ref], stage, nothing, True)


def rooted(C: Matrix) -> Matrix:
    """R with R R' = C, lower triangular, for C >= 0 that may be singular."""
    n = range(len(C))
    least = np.finfo(C[0][0].dtype)
    size = [lax.sqrt(lax.max(C[i][i], jnp.full_like(C[i][i], least.tiny))) for i in n]
    scaled = [[C[i][j] / (size[i] * size[j]) for j in n] for i in n]

    def root(square: Array) -> Array:
        positive = square > 4 * least.eps
        return jnp.where(positive, lax.rsqrt(jnp.where(positive, square, 1.0)), 0.0)

    L = cholesky(scaled, root, mul)
    zero = jnp.zeros_like(size[0])
    of_diagonal = [
        jnp.where(L[i][i] > 0.0, 1.0 / jnp.where(L[i][i] > 0.0, L[i][i], 1.0), 0.0) for i in n
    ]
    entries = [[L[i][j] if j < i else of_diagonal[i] if j == i else zero for j in n] for i in n]
    return [[size[i] * e for e in row] for i, row in enumerate(entries)]


def forward(
    horizon: int, first: Layout, layouts: Sequence[Layout], first_ref: Any, *refs: Any
) -> None:
    """`method.riccati.solve_and_sample` for the rows of a block of threads."""
    *stage_refs, out_ref = refs
    start = first.read(first_ref)
    soft = start["soft"][0] if "soft" in start else None

    def stage(k: Array, s: dict[str, Any], carry: Any) -> Any:
        dx, nx = carry
        Lu, Ls = triangular(s["Lu"]), [] if soft is None else triangular(s["Ls"])

        def after(x: Vector, u: Vector) -> Vector:
            return add(matvec(s["A"], x), matvec(s["B"], u))

        du, nu = add(matvec(s["K"], dx), s["kff"]), []
        dx = add(s["h"], after(dx, du))
        if nx:
            nu = add(matvec(s["K"], nx), solve_upper(Lu, s["xi_u"], mul))
            nx = after(nx, nu)
        if soft is not None:
            push = [b - a for a, b in zip(s["p"], s["multiplier"], strict=True)]
            dx = solve(Ls, [a + soft * b for a, b in zip(dx, push, strict=True)])
            if nx:
                kicks, size = solve_upper(Ls, s["xi_e"], mul), jnp.sqrt(soft)
                nx = [a - size * b for a, b in zip(solve(Ls, nx), kicks, strict=True)]
        costate = add(matvec(full(s["P"]), dx), s["p"])
        rate = [a - b for a, b in zip(costate, s["multiplier"], strict=True)]
        write(out_ref, k, dx, du, nx, nu, rate)
        return dx, nx

    noisy = any("xi_u" in layout.shapes for layout in layouts)
    over_stages(horizon, layouts, stage_refs, stage, (start["dx"], start["nx"] if noisy else []))


def factor(A: Matrix) -> Matrix:
    """The Cholesky factor of A, whose diagonal is kept as its inverse."""
    return cholesky(A, lax.rsqrt, mul)


def solve(L: Matrix, b: Vector) -> Vector:
    """(L L')^{-1} b for a `factor` L."""
    return solve_upper(L, solve_lower(L, b, mul), mul)


def symmetric_product(A: Matrix, B: Matrix, C: Matrix) -> Matrix:
    """A + B'C where the result is known to be symmetric, so that half of it is computed."""
    Bt, Ct = transpose(B), transpose(C)
    return full([A[i][j] + dot(Bt[i], Ct[j]) for i in range(len(A)) for j in range(i + 1)])


class Layout:
    """Where the entries of named small matrices lie in a stage's vector of numbers."""

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self.shapes, self.slices, self.size = shapes, {}, 0
        for name, shape in shapes.items():
            self.slices[name] = slice(self.size, self.size + prod(shape))
            self.size += prod(shape)

    def pack(self, **arrays: Any) -> Array:
        """Arrays (chains, ..., *shape) as one (..., size, chains), padded."""
        parts = [
            jnp.reshape(arrays[name], (*arrays[name].shape[: -len(shape)], prod(shape)))
            for name, shape in self.shapes.items()
        ]
        return padded(jnp.moveaxis(jnp.concatenate(parts, axis=-1), 0, -1), THREADS)

    def unpack(self, packed: Array, name: str) -> Array:
        """The array (chains, ..., *shape) called `name`."""
        part = jnp.moveaxis(packed, -1, 0)[..., self.slices[name]]
        return part.reshape(*part.shape[:-1], *self.shapes[name])

    def read(self, ref: Any, *stage: Any) -> dict[str, Any]:
        """The small matrices and vectors of a stage."""
        numbers = [ref[*stage, i, :] for i in range(self.size)]
        out: dict[str, Any] = {}
        for name, shape in self.shapes.items():
            part, width = numbers[self.slices[name]], shape[-1]
            rows = [part[i : i + width] for i in range(0, len(part), width)]
            out[name] = rows if len(shape) == 2 else part
        return out


def over_stages(
    horizon: int,
    layouts: Sequence[Layout],
    refs: Sequence[Any],
    stage: Callable[[Array, dict[str, Any], Any], Any],
    carry: Any,
    backwards: bool = False,
) -> Any:
    """The last carry of stage(k, what the arrays hold there, carry), which returns the next one.

    What the next stage needs is read while this one computes, if registers can hold it: a thread
    that has no neighbours to wait for would wait for the memory at every stage.
    """
    ahead = sum(layout.size for layout in layouts) <= READ_AHEAD

    def place(i: Array) -> Array:
        return horizon - 1 - i if backwards else i

    def step(i: Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        k = place(i)
        if not ahead:
            return (), stage(k, read_all(layouts, refs, k), carry[1])
        following = read_all(layouts, refs, place(jnp.minimum(i + 1, horizon - 1)))
        return following, stage(k, carry[0], carry[1])

    first = read_all(layouts, refs, place(jnp.int32(0))) if ahead else ()
    return lax.fori_loop(0, horizon, step, (first, carry))[1]


def read_all(layouts: Sequence[Layout], refs: Sequence[Any], stage: Any) -> dict[str, Any]:
    """What `Layout.read` gives for several arrays together."""
    out: dict[str, Any] = {}
    for layout, ref in zip(layouts, refs, strict=True):
        out |= layout.read(ref, stage)
    return out


def write(ref: Any, stage: Any, *vectors: Vector) -> None:
    """Write the entries of all vectors, in order, to a stage."""
    for i, number in enumerate(number for vector in vectors for number in vector):
        ref[stage, i, :] = number


def triangle(A: Matrix) -> Matrix:
    """The rows of A, each up to its diagonal."""
    return [row[: i + 1] for i, row in enumerate(A)]


def halves(A: Matrix) -> Vector:
    """The entries of the rows of A up to the diagonal, which is all of a symmetric matrix."""
    return [entry for row in triangle(A) for entry in row]


def triangular(numbers: Vector) -> Matrix:
    """The lower triangle, row by row, of which these are all entries."""
    rows: list[Vector] = []
    while numbers:
        n = len(rows) + 1
        rows.append(numbers[:n])
        numbers = numbers[n:]
    return rows


def full(numbers: Vector) -> Matrix:
    """The symmetric matrix whose lower triangle has these entries."""
    L = triangular(numbers)
    n = range(len(L))
    return [[L[max(i, j)][min(i, j)] for j in n] for i in n]


def tri(n: int) -> tuple[int]:
    """Number of entries in the lower triangle of an (n, n) matrix, as a shape."""
    return (n * (n + 1) // 2,)


def symmetric_from(numbers: Array, n: int) -> Array:
    """The symmetric matrices (..., n, n) that have these lower triangles (..., n (n + 1) / 2)."""
    k = np.arange(n)
    i, j = np.maximum.outer(k, k), np.minimum.outer(k, k)
    return numbers[..., i * (i + 1) // 2 + j]


def lower_triangle(A: Array) -> Array:
    """The lower triangles (..., n (n + 1) / 2) of matrices (..., n, n)."""
    rows, columns = np.tril_indices(A.shape[-1])
    return A[..., rows, columns]
