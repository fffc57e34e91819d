"""Newton steps, noise and feedback from one block-tridiagonal factorization.

Around a trajectory with defects h_k, the flow needs the minimizer d = (dx, du) of

    sum_k [ gx'dx + gu'du + 1/2 (dx'Hxx dx + 2 du'Hux dx + du'Huu du) ]_k + terminal terms
        + sum_k [ lambda_k'e_k + mu/2 |e_k|^2 ],      e_k = h_k + A_k dx_k + B_k du_k - dx_{k+1}

that is d = -M^{-1} grad L_mu with M = H + mu J'J, and samples of N(0, M^{-1}). With the value
function 1/2 x'Px + p'x of the stages after k, minimizing over dx_{k+1} at a fixed
y = h + A dx + B du gives e = S^{-1} (P y + p - lambda), S = mu I + P, and

    P~ = mu S^{-1} P                          (P as mu -> infinity: ordinary LQR)
    p~ = S^{-1} (mu p + P lambda)             computed with S / mu = I + P / mu
    Qxx = Hxx + A'P~A      Quu = Huu + B'P~B      Qux = Hux + B'P~A
    qx = gx + A'(P~h + p~)                    qu = gu + B'(P~h + p~)
    K = -Quu^{-1} Qux      kff = -Quu^{-1} qu     P <- Qxx + Qux'K      p <- qx + Qux'kff

which is the Riccati recursion with dual regularization. Without a penalty, as for mu -> infinity,
P~ = P and p~ = p: the linearized dynamics hold, and there is no S to factorize. Nothing with a
condition number near mu is ever formed, so float32 suffices. The conditional distributions of
N(0, M^{-1}) are du | dx ~ N(K dx, Quu^{-1}) and e | y ~ N(S^{-1}P y, S^{-1}), for which the
Cholesky factors of Quu and S are at hand. Newton step and noise are hence two solutions of one
affine recursion

    dx_{k+1} = F_k dx_k + f_k,     F = mu S^{-1} (A + B K)

that GPUs solve in parallel over time. Shapes: all arrays carry the stage axis K first.

On GPUs kernels do it (`kernels.riccati_gpu`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import Array

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels.linalg import cholesky, product, solve, solve_upper, symmetric
from mjx_drax.kernels.recursion import affine_recursion
from mjx_drax.kernels.riccati_gpu import vmapped_as_kernel
from mjx_drax.method.model import Linearization, QuadraticCost


@register_dataclass
@dataclass(frozen=True)
class Factorization:
    """What the backward recursion leaves at every stage.

    gains K (K, nu, ndx) and kff (K, nu); Lu (K, nu, nu) and Ls (K, ndx, ndx), the lower Cholesky
    factors of Quu and S / mu, the latter None without a penalty; P (K, ndx, ndx) and p (K, ndx),
    the value function after the stage.
    """

    gains: Array
    kff: Array
    Lu: Array
    Ls: Array | None
    P: Array
    p: Array


@register_dataclass
@dataclass(frozen=True)
class White:
    """Standard normal numbers that become noise: for controls (K, nu) and for defects (K, ndx)."""

    u: Array
    e: Array


@register_dataclass
@dataclass(frozen=True)
class Start:
    """What a free x_0 = x_init + E w adds to the quadratic program.

    E (ndx, n0); slope (n0,) and diagonal curvature (n0,) of a barrier on w; white numbers for its
    noise, (n0,), or None.
    """

    E: Array
    slope: Array
    curvature: Array
    white: Array | None = None


@register_dataclass
@dataclass(frozen=True)
class Step:
    """What a chain moves by.

    Newton step dx (K, ndx) at x_1..x_K and du (K, nu); noise_x and noise_u alike, or None; the
    multipliers' step `rate` = mu (h + J d), (K, ndx); feedback gains (K, nu, ndx). Where x_0 is
    free, w and its noise, (n0,), and the step dx_0 that they make, noise beside, (ndx, 1 or 2).
    """

    dx: Array
    du: Array
    noise_x: Array | None
    noise_u: Array | None
    rate: Array
    gains: Array
    start: Array | None = None
    noise_start: Array | None = None
    first: Array | None = None


def factorize(
    model: Linearization, cost: QuadraticCost, multipliers: Array, penalty: Array | None
) -> tuple[tuple[Array, Array], Factorization]:
    """The backward recursion, for multipliers (K, ndx) and penalty mu > 0, or None.

    Returns P and p of x_0, and the factors of every stage.
    """

    def relaxed(P: Array, p: Array, multiplier: Array) -> tuple[Array, Array, Array | None]:
        """P~, p~ and Ls."""
        if penalty is None:
            return P, p, None
        soft = 1.0 / penalty
        Ls = cholesky(jnp.eye(len(p), dtype=p.dtype) + soft * P)
        found = solve(Ls, jnp.column_stack([P, p + soft * product(P, multiplier)]))
        return symmetric(found[:, :-1]), found[:, -1], Ls

    def stage(
        carry: tuple[Array, Array], inputs: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], Factorization]:
        P, p = carry
        A, B, h, gx, gu, Hxx, Hux, Huu, multiplier = inputs
        P_relaxed, p_relaxed, Ls = relaxed(P, p, multiplier)
        slope = product(P_relaxed, h) + p_relaxed
        PA, PB = product(P_relaxed, A), product(P_relaxed, B)
        Qxx, Qux, Quu = Hxx + product(A.T, PA), Hux + product(B.T, PA), Huu + product(B.T, PB)
        qx, qu = gx + product(A.T, slope), gu + product(B.T, slope)
        Lu = cholesky(Quu)
        gains = -solve(Lu, jnp.column_stack([Qux, qu]))
        K, kff = gains[:, :-1], gains[:, -1]
        before = symmetric(Qxx + product(Qux.T, K)), qx + product(Qux.T, kff)
        return before, Factorization(K, kff, Lu, Ls, P, p)

    inputs = (model.A, model.B, model.h, cost.gx[:-1], cost.gu, cost.Hxx[:-1], cost.Hux, cost.Huu)
    end = cost.Hxx[-1], cost.gx[-1]
    return jax.lax.scan(stage, end, (*inputs, multipliers), reverse=True)


def solve_and_sample(
    model: Linearization,
    factors: Factorization,
    multipliers: Array,
    penalty: Array | None,
    white: White | None = None,
    first: Array | None = None,
) -> Step:
    """The Newton step d = -M^{-1} grad L_mu, one draw n ~ N(0, M^{-1}), and the multipliers' step.

    The draw is of the white numbers; without them there is none. The multipliers' step is the
    costate P dx + p of the quadratic program less the present multipliers. `first` is dx_0, with
    its noise beside it, (ndx, 1 or 2).
    """

    def affine(
        model: Linearization, factors: Factorization, multiplier: Array, white: White | None
    ) -> tuple[Array, Array]:
        """F, and the columns f of the step and of the noise."""
        columns = [
            model.A + product(model.B, factors.gains),
            model.h + product(model.B, factors.kff),
        ]
        if white is not None:
            columns.append(product(model.B, solve_upper(factors.Lu, white.u)))
        if penalty is not None:
            assert factors.Ls is not None
            soft = 1.0 / penalty
            columns[1] = columns[1] + soft * (multiplier - factors.p)
            out = solve(factors.Ls, jnp.column_stack(columns))
            columns = [out[:, : len(out)], *out[:, len(out) :].T]
            if white is not None:
                columns[2] = columns[2] - jnp.sqrt(soft) * solve_upper(factors.Ls, white.e)
        return columns[0], jnp.column_stack(columns[1:])

    F, f = jax.vmap(affine)(model, factors, multipliers, white)
    if first is not None:
        f = f.at[0].add(F[0] @ first)
    after = affine_recursion(F, f)  # dx_1..dx_K, of dx_0 = 0 or with f_0 of the other one
    zeroth = jnp.zeros_like(after[:1]) if first is None else first[None]
    before = jnp.concatenate([zeroth, after[:-1]])
    controls = jax.vmap(product)(factors.gains, before)
    dx, du = after[..., 0], controls[..., 0] + factors.kff
    noise_x, noise_u = None, None
    if white is not None:
        noise_x = after[..., 1]
        noise_u = controls[..., 1] + jax.vmap(solve_upper)(factors.Lu, white.u)
    costate = jax.vmap(product)(factors.P, dx) + factors.p
    return Step(dx, du, noise_x, noise_u, costate - multipliers, factors.gains)


@vmapped_as_kernel(result=Step)
def newton(
    model: Linearization,
    cost: QuadraticCost,
    multipliers: Array,
    penalty: Array | None,
    white: White | None = None,
) -> Step:
    """Newton step of one chain for multipliers (K, ndx) and penalty mu; noise of `white`."""
    _, factors = factorize(model, cost, multipliers, penalty)
    return solve_and_sample(model, factors, multipliers, penalty, white)


def newton_with_start(
    model: Linearization,
    cost: QuadraticCost,
    multipliers: Array,
    penalty: Array | None,
    white: White | None,
    start: Start | None,
) -> Step:
    """`newton`; where x_0 is free, its step w minimizes 1/2 (E w)'P E w + p'E w + barrier."""
    if start is None:
        return newton(model, cost, multipliers, penalty, white)
    (P, p), factors = factorize(model, cost, multipliers, penalty)
    L = cholesky(start.E.T @ P @ start.E + jnp.diag(start.curvature))
    columns = [-solve(L, start.E.T @ p + start.slope)]
    if start.white is not None:
        columns.append(solve_upper(L, start.white))
    w = jnp.column_stack(columns)
    first = start.E @ w
    step = solve_and_sample(model, factors, multipliers, penalty, white, first)
    noise = None if start.white is None else w[:, 1]
    return replace(step, start=w[:, 0], noise_start=noise, first=first)
