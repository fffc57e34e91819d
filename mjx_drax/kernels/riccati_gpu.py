"""The recursion of `riccati` as one GPU kernel: a thread for each chain, all stages in one launch.

As a loop of array operations the recursion costs 20 to 30 us for each stage on a GPU, because every
stage is a handful of kernel launches. Here a chain is a thread: the value function stays in
registers from stage to stage, and small blocks are unrolled into scalars. Chains are the fastest
axis in memory, so that neighbouring threads read neighbouring numbers.

A small matrix is a list of rows here, each entry the values (threads,) of one element.
"""

from __future__ import annotations

from functools import partial
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import pallas as pl
from jax.experimental.pallas.triton import CompilerParams

from mjx_drax.method.linearize import Linearization
from mjx_drax.method.riccati import QuadraticCost, Step, White

THREADS = 32
"""Chains a program works on: one warp."""

Vector = list[Array]
Matrix = list[Vector]


def dot(a: Vector, b: Vector) -> Array:
    """a'b."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def transposed(A: Matrix) -> Matrix:
    """A'."""
    return [list(column) for column in zip(*A, strict=True)]


def apply(A: Matrix, x: Vector) -> Vector:
    """A x."""
    return [dot(row, x) for row in A]


def multiply(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    columns = transposed(B)
    return [[dot(row, column) for column in columns] for row in A]


def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


def sum_of(A: Matrix, B: Matrix) -> Matrix:
    """A + B."""
    return [add(a, b) for a, b in zip(A, B, strict=True)]


def symmetric(A: Matrix) -> Matrix:
    """1/2 (A + A')."""
    n = range(len(A))
    return [[A[i][i] if i == j else 0.5 * (A[i][j] + A[j][i]) for j in n] for i in n]


def cholesky(A: Matrix) -> Matrix:
    """L with L L' = A, whose diagonal is kept as its inverse."""
    L: Matrix = []
    for i in range(len(A)):
        row: Vector = []
        for j in range(i + 1):
            total = A[i][j]
            for k in range(j):
                total = total - row[k] * (row[k] if i == j else L[j][k])
            row.append(jax.lax.rsqrt(total) if i == j else total * L[j][j])
        L.append(row)
    return L


def solve_lower(L: Matrix, b: Vector) -> Vector:
    """L^{-1} b."""
    x: Vector = []
    for i, row in enumerate(L):
        total = b[i]
        for k in range(i):
            total = total - row[k] * x[k]
        x.append(total * row[i])
    return x


def solve_upper(L: Matrix, b: Vector) -> Vector:
    """L'^{-1} b."""
    n = len(L)
    x: Vector = [b[0]] * n
    for i in reversed(range(n)):
        total = b[i]
        for k in range(i + 1, n):
            total = total - L[k][i] * x[k]
        x[i] = total * L[i][i]
    return x


def solve(L: Matrix, b: Vector) -> Vector:
    """(L L')^{-1} b."""
    return solve_upper(L, solve_lower(L, b))


class Layout:
    """Where the elements of named small matrices lie in a stage's vector of numbers."""

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self.shapes = shapes
        self.starts, self.size = {}, 0
        for name, shape in shapes.items():
            self.starts[name] = self.size
            self.size += prod(shape)

    def pack(self, **arrays: Array) -> Array:
        """Arrays (chains, ..., *shape) as one (..., size, chains)."""
        parts = [
            jnp.reshape(arrays[name], (*arrays[name].shape[: -len(shape)], prod(shape)))
            for name, shape in self.shapes.items()
        ]
        return jnp.moveaxis(jnp.concatenate(parts, axis=-1), 0, -1)

    def unpack(self, packed: Array, name: str) -> Array:
        """The array (chains, ..., *shape) called `name`."""
        shape, start = self.shapes[name], self.starts[name]
        part = jnp.moveaxis(packed, -1, 0)[..., start : start + prod(shape)]
        return part.reshape(*part.shape[:-1], *shape)

    def named(self, numbers: list[Array]) -> dict[str, Any]:
        """The small matrices and vectors in a list of all their elements."""
        out: dict[str, Any] = {}
        for name, shape in self.shapes.items():
            part = numbers[self.starts[name] : self.starts[name] + prod(shape)]
            width = shape[-1]
            rows = [part[i : i + width] for i in range(0, len(part), width)]
            out[name] = rows if len(shape) == 2 else part
        return out


def flat(*parts: Vector | Matrix) -> Vector:
    """All elements in order."""
    out: Vector = []
    for part in parts:
        for entry in part:
            out.extend(entry if isinstance(entry, list) else [entry])
    return out


def triangle(L: Matrix) -> Vector:
    """The lower triangle, row by row."""
    return [entry for i, row in enumerate(L) for entry in row[: i + 1]]


def triangular(numbers: Vector) -> Matrix:
    """The matrix whose `triangle` this is."""
    rows: Matrix = []
    while numbers:
        n = len(rows) + 1
        rows.append(numbers[:n])
        numbers = numbers[n:]
    return rows


def tri(n: int) -> tuple[int]:
    """Shape of the lower triangle of an (n, n) matrix."""
    return (n * (n + 1) // 2,)


def lower_triangle(A: Array) -> Array:
    """The lower triangles (..., n (n + 1) / 2) of matrices (..., n, n)."""
    rows, columns = np.tril_indices(A.shape[-1])
    return A[..., rows, columns]


def full(numbers: Vector) -> Matrix:
    """The symmetric matrix with this lower triangle."""
    L = triangular(numbers)
    n = range(len(L))
    return [[L[max(i, j)][min(i, j)] for j in n] for i in n]


def symmetric_product(A: Matrix, B: Matrix, C: Matrix) -> Matrix:
    """A + B'C where the result is known to be symmetric, so that half of it is computed."""
    Bt, Ct = transposed(B), transposed(C)
    return full([A[i][j] + dot(Bt[i], Ct[j]) for i in range(len(A)) for j in range(i + 1)])


def read(ref: Any, layout: Layout, *where: Any) -> dict[str, Any]:
    """All small matrices of a stage."""
    return layout.named([ref[*where, i, :] for i in range(layout.size)])


def write(ref: Any, k: Array, numbers: Vector) -> None:
    """All numbers of a stage."""
    for i, number in enumerate(numbers):
        ref[k, i, :] = number


def backward(
    horizon: int,
    end: Layout,
    common: Layout,
    cost: Layout,
    end_ref: Any,
    common_ref: Any,
    cost_ref: Any,
    out_ref: Any,
) -> None:
    """`riccati.factorize` for THREADS chains."""
    last = read(end_ref, end)
    mu = last["penalty"][0]

    def stage(i: Array, carry: Any) -> Any:
        P, p = carry
        k = horizon - 1 - i
        s = {**read(common_ref, common, k), **read(cost_ref, cost, k)}
        n = range(len(p))
        Ls = cholesky([[P[r][c] + mu if r == c else P[r][c] for c in n] for r in n])
        right = [mu * a + b for a, b in zip(p, apply(P, s["multiplier"]), strict=True)]
        p_relaxed = solve(Ls, right)
        P_relaxed = symmetric([solve(Ls, [mu * a for a in row]) for row in P])
        slope = add(apply(P_relaxed, s["h"]), p_relaxed)
        A, B = s["A"], s["B"]
        PA, PB = multiply(P_relaxed, A), multiply(P_relaxed, B)
        Qux = sum_of(s["Hux"], multiply(transposed(B), PA))
        qx = add(s["gx"], apply(transposed(A), slope))
        qu = add(s["gu"], apply(transposed(B), slope))
        Lu = cholesky(symmetric_product(full(s["Huu"]), B, PB))
        K = transposed([[-e for e in solve(Lu, column)] for column in transposed(Qux)])
        kff = [-e for e in solve(Lu, qu)]
        write(out_ref, k, flat(K, kff, triangle(Lu), triangle(Ls), triangle(P), p))
        Qxx = symmetric_product(full(s["Hxx"]), A, PA)
        return symmetric_product(Qxx, Qux, K), add(qx, apply(transposed(Qux), kff))

    jax.lax.fori_loop(0, horizon, stage, (full(last["Hxx"]), last["gx"]))


def forward(
    horizon: int,
    end: Layout,
    common: Layout,
    white: Layout,
    left: Layout,
    end_ref: Any,
    common_ref: Any,
    white_ref: Any,
    left_ref: Any,
    out_ref: Any,
) -> None:
    """`riccati.solve_and_sample` for THREADS chains."""
    last = read(end_ref, end)
    mu = last["penalty"][0]

    def stage(k: Array, carry: Any) -> Any:
        dx, nx = carry
        s = {**read(common_ref, common, k), **read(white_ref, white, k), **read(left_ref, left, k)}
        Lu, Ls = triangular(s["Lu"]), triangular(s["Ls"])
        du = add(apply(s["K"], dx), s["kff"])
        nu = add(apply(s["K"], nx), solve_upper(Lu, s["xi_u"]))

        def after(x: Vector, u: Vector) -> Vector:
            return add(apply(s["A"], x), apply(s["B"], u))

        y = add(s["h"], after(dx, du))
        right = [mu * a - b + c for a, b, c in zip(y, s["p"], s["multiplier"], strict=True)]
        dx = solve(Ls, right)
        noise = solve(Ls, [mu * a for a in after(nx, nu)])
        nx = [a - b for a, b in zip(noise, solve_upper(Ls, s["xi_e"]), strict=True)]
        costate = add(apply(full(s["P"]), dx), s["p"])
        rate = [a - b for a, b in zip(costate, s["multiplier"], strict=True)]
        write(out_ref, k, flat(dx, du, nx, nu, rate))
        return dx, nx

    zero = [jnp.zeros_like(mu)] * len(last["gx"])
    jax.lax.fori_loop(0, horizon, stage, (zero, zero))


def newton_batch(
    model: Linearization,
    cost: QuadraticCost,
    multipliers: Array,
    penalty: Array,
    white: White,
    interpret: bool = False,
) -> Step:
    """`riccati.newton` of many chains; every array leads with the chain axis."""
    chains, horizon, n = multipliers.shape
    m = cost.gu.shape[-1]
    common = Layout(A=(n, n), B=(n, m), h=(n,), multiplier=(n,))
    costs = Layout(gx=(n,), gu=(m,), Hxx=tri(n), Hux=(m, n), Huu=tri(m))
    whites = Layout(xi_u=(m,), xi_e=(n,))
    end = Layout(Hxx=tri(n), gx=(n,), penalty=(1,))
    left = Layout(K=(m, n), kff=(m,), Lu=tri(m), Ls=tri(n), P=tri(n), p=(n,))
    out = Layout(dx=(n,), du=(m,), nx=(n,), nu=(m,), rate=(n,))
    missing = -chains % THREADS

    def pack(layout: Layout, **arrays: Array) -> Array:
        packed = layout.pack(**arrays)
        return jnp.pad(packed, [(0, 0)] * (packed.ndim - 1) + [(0, missing)])

    def call(
        body: Any, layouts: tuple[Layout, ...], result: Layout, last: Array, *stages: Array
    ) -> Array:
        specs = [_block(horizon, layout.size) for layout in (*layouts, result)]
        return pl.pallas_call(
            partial(body, horizon, end, *layouts),
            grid=((chains + missing) // THREADS,),
            in_specs=[_block(end.size), *specs[:-1]],
            out_specs=specs[-1],
            out_shape=jax.ShapeDtypeStruct((horizon, result.size, chains + missing), last.dtype),
            compiler_params=CompilerParams(num_warps=1, num_stages=1),
            interpret=interpret,
        )(last, *stages)

    last = pack(
        end,
        Hxx=lower_triangle(cost.Hxx[:, -1]),
        gx=cost.gx[:, -1],
        penalty=penalty[:, None],
    )
    shared = pack(common, A=model.A, B=model.B, h=model.h, multiplier=multipliers)
    model_of_cost = pack(
        costs,
        gx=cost.gx[:, :-1],
        gu=cost.gu,
        Hxx=lower_triangle(cost.Hxx[:, :-1]),
        Hux=cost.Hux,
        Huu=lower_triangle(cost.Huu),
    )
    factors = call(backward, (common, costs), left, last, shared, model_of_cost)
    noise = pack(whites, xi_u=white.u, xi_e=white.e)
    steps = call(forward, (common, whites, left), out, last, shared, noise, factors)
    parts = {name: out.unpack(steps, name)[:chains] for name in out.shapes}
    return Step(**parts, K=left.unpack(factors, "K")[:chains])


def _block(*shape: int) -> pl.BlockSpec:
    """All of an array (*shape, chains) that belongs to one program's chains."""
    return pl.BlockSpec((*shape, THREADS), lambda i: (*[0] * len(shape), i))
