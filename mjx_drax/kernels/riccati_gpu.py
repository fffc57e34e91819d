"""The Riccati recursion of `method.riccati` as one GPU kernel: a thread for each chain.

As a loop of array operations the recursion costs 20 to 30 us for each stage on a GPU, because every
stage is a handful of kernel launches. Here one launch does all stages of a chain: the value
function stays in registers from stage to stage, and small blocks are unrolled into scalars. In
memory the chains are the last axis, so that neighbouring threads read neighbouring numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, update_wrapper
from math import prod
from operator import mul
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels import riccati_blocks
from mjx_drax.kernels.batching import (
    merged_vmaps,
    of_one_precision,
    on_gpu,
    padded,
    repeated,
    thread_for_each_row,
)
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

MAX_NDX, MAX_NU = 6, 4
"""Largest blocks that the kernel unrolls; compiling it takes longer than it saves beyond."""


def vmapped_as_kernel(result: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of the Newton step of one chain, whose vmap is one kernel where that pays.

    That is on GPUs, in one precision, for blocks of at most MAX_NDX and MAX_NU, and larger ones of
    float32 as far as `riccati_blocks` goes. The arrays of the
    step's arguments are, in their order, those of `newton_steps`; it returns
    result(dx=, du=, noise_x=, noise_u=, rate=, gains=).
    """

    def decorate(newton: Callable[..., Any]) -> Callable[..., Any]:
        plain = jax.vmap(newton)

        def all_chains(has_rows: tuple[bool, ...], *arguments: Any) -> Any:
            arguments = repeated(has_rows, arguments)
            steps = kernel_for(*arrays_of(arguments)) if on_gpu() else None
            if steps is None:
                return plain(*arguments)

            def kernel(*arguments: Any) -> Any:
                return result(**steps(*arrays_of(arguments)))

            return lax.platform_dependent(*arguments, cuda=kernel, default=plain)

        return update_wrapper(merged_vmaps(newton, all_chains), newton)

    return decorate


def arrays_of(arguments: Any) -> list[Any]:
    """The arrays of a step's arguments, with None for the penalty where there is none."""
    return jax.tree.leaves(arguments, is_leaf=lambda leaf: leaf is None)


def kernel_for(A: Array, B: Array, *rest: Array | None) -> Callable[..., Any] | None:
    """The kernel that is made for such blocks, if there is one."""
    ndx, nu = B.shape[-2:]
    there = [array for array in (A, B, *rest) if array is not None]
    if min(ndx, nu) == 0 or not of_one_precision(there):
        return None
    if ndx <= MAX_NDX and nu <= MAX_NU:
        return newton_steps
    blocks = ndx <= riccati_blocks.MAX_NDX and nu <= riccati_blocks.MAX_NU
    return riccati_blocks.newton_steps if blocks and A.dtype == np.float32 else None


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
    """Newton step, noise and feedback of many chains (in plain JAX: `method.riccati.newton`).

    Args:
        A: (chains, K, ndx, ndx); B (chains, K, ndx, nu) and h (chains, K, ndx) likewise.
        gx: (chains, K+1, ndx); gu (chains, K, nu).
        Hxx: (chains, K+1, ndx, ndx); Hux (chains, K, nu, ndx) and Huu (chains, K, nu, nu).
        multipliers: (chains, K, ndx); penalty (chains,), or None.
        xi_u: standard normal numbers (chains, K, nu), and xi_e (chains, K, ndx); None: no noise.
        interpret: run it without a GPU.

    Returns:
        dx, rate and noise_x (chains, K, ndx), du and noise_u (chains, K, nu), and gains
        (chains, K, nu, ndx); noise_x and noise_u are None without noise.
    """
    chains, horizon, n, m = B.shape
    noisy, soft = xi_u is not None, penalty is not None
    end = Layout(Hxx=tri(n), gx=(n,), **({"soft": (1,)} if soft else {}))
    common = Layout(A=(n, n), B=(n, m), h=(n,), multiplier=(n,))
    costs = Layout(gx=(n,), gu=(m,), Hxx=tri(n), Hux=(m, n), Huu=tri(m))
    Ls = {"Ls": tri(n)} if soft else {}
    left = Layout(K=(m, n), kff=(m,), Lu=tri(m), **Ls, P=tri(n), p=(n,))
    white = Layout(xi_u=(m,), xi_e=(n,))
    noise = {"noise_x": (n,), "noise_u": (m,)} if noisy else {}
    out = Layout(dx=(n,), du=(m,), **noise, rate=(n,))

    def launch(
        body: Callable[..., None], layouts: Sequence[Layout], result: Layout, *stages: Array
    ) -> Array:
        program = partial(body, horizon, end, layouts)
        shape = (horizon, result.size)
        return thread_for_each_row(program, THREADS, shape, [last, *stages], interpret=interpret)

    softness = {} if penalty is None else {"soft": 1.0 / penalty[:, None]}
    last = end.pack(Hxx=lower_triangle(Hxx[:, -1]), gx=gx[:, -1], **softness)
    model = common.pack(A=A, B=B, h=h, multiplier=multipliers)
    cost = costs.pack(
        gx=gx[:, :-1],
        gu=gu,
        Hxx=lower_triangle(Hxx[:, :-1]),
        Hux=Hux,
        Huu=lower_triangle(Huu),
    )
    factors = launch(backward, (common, costs), left, model, cost)
    if noisy:
        numbers = white.pack(xi_u=xi_u, xi_e=xi_e)
        steps = launch(forward, (common, white, left), out, model, numbers, factors)
    else:
        steps = launch(forward, (common, left), out, model, factors)
    step = {name: out.unpack(steps, name)[:chains] for name in out.shapes}
    gains = left.unpack(factors, "K")[:chains]
    return {"noise_x": None, "noise_u": None, **step, "gains": gains}


def backward(
    horizon: int, end: Layout, layouts: Sequence[Layout], end_ref: Any, *refs: Any
) -> None:
    """`method.riccati.factorize` for the chains of a block of threads."""
    *stage_refs, out_ref = refs
    last = end.read(end_ref)

    def relaxed(P: Matrix, p: Vector, multiplier: Vector) -> tuple[Matrix, Vector, Matrix]:
        """P~, p~ and Ls."""
        if "soft" not in last:
            return P, p, []
        (soft,), n = last["soft"], range(len(p))
        Ls = factor([[soft * P[r][c] + (1.0 if r == c else 0.0) for c in n] for r in n])
        right = [a + soft * b for a, b in zip(p, matvec(P, multiplier), strict=True)]
        return symmetric([solve(Ls, row) for row in P]), solve(Ls, right), Ls

    def stage(k: Array, s: dict[str, Any], carry: Any) -> Any:
        P, p = carry
        P_relaxed, p_relaxed, Ls = relaxed(P, p, s["multiplier"])
        slope = add(matvec(P_relaxed, s["h"]), p_relaxed)
        A, B = s["A"], s["B"]
        PA, PB = matmul(P_relaxed, A), matmul(P_relaxed, B)
        Qux = [add(a, b) for a, b in zip(s["Hux"], matmul(transpose(B), PA), strict=True)]
        qx = add(s["gx"], matvec(transpose(A), slope))
        qu = add(s["gu"], matvec(transpose(B), slope))
        Lu = factor(symmetric_product(full(s["Huu"]), B, PB))
        K = transpose([[-e for e in solve(Lu, column)] for column in transpose(Qux)])
        kff = [-e for e in solve(Lu, qu)]
        write(out_ref, k, *K, kff, *Lu, *Ls, *triangle(P), p)
        Qxx = symmetric_product(full(s["Hxx"]), A, PA)
        return symmetric_product(Qxx, Qux, K), add(qx, matvec(transpose(Qux), kff))

    over_stages(horizon, layouts, stage_refs, stage, (full(last["Hxx"]), last["gx"]), True)


def forward(horizon: int, end: Layout, layouts: Sequence[Layout], end_ref: Any, *refs: Any) -> None:
    """`method.riccati.solve_and_sample` for the chains of a block of threads."""
    *stage_refs, out_ref = refs
    last = end.read(end_ref)
    soft = last["soft"][0] if "soft" in last else None

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
    zero = [jnp.zeros_like(last["gx"][0])] * len(last["gx"])
    over_stages(horizon, layouts, stage_refs, stage, (zero, zero if noisy else []))


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
) -> None:
    """stage(k, what the arrays hold there, carry), which returns the next carry, for all k.

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
    lax.fori_loop(0, horizon, step, (first, carry))


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


def lower_triangle(A: Array) -> Array:
    """The lower triangles (..., n (n + 1) / 2) of matrices (..., n, n)."""
    rows, columns = np.tril_indices(A.shape[-1])
    return A[..., rows, columns]
