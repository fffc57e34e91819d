"""The Gauss-Newton metric, M = H + mu J'J + delta D, by one block-tridiagonal factorization.

H is the semidefinite model of the cost's Hessian plus the barrier's diagonal. Ordered by stage
(u_k, x_{k+1}), M is block-tridiagonal, and `riccati` factorizes it. Before, the constraints of each
stage join its cost, their slack variables eliminated:

At one knot let r = [equality; inequality + s] with Jacobian J = [E; G] in the knot's displacement
dz, multipliers y, and a barrier on s with slope b and curvature c (damping included). The model

    y'(r + J dz + [0; ds]) + mu/2 |r + J dz + [0; ds]|^2 + b'ds + 1/2 ds'diag(c) ds

is minimized over ds by ds = -(b + y_g + mu r_g + mu G dz) / D with D = mu + c, elementwise. What
is left for dz has gradient J'(y + mu r) - G'(mu / D) t, where t = b + y_g + mu r_g, and Hessian
J'W J, W = mu for equalities and mu c / D for inequalities: an inequality matters more as
its slack goes to zero. Given dz, ds has variance 1/D under N(0, M^{-1}).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels.linalg import transposed_product
from mjx_drax.method.metrics import Direction, Metric
from mjx_drax.method.model import Derivatives, Model, Multipliers, QuadraticCost
from mjx_drax.method.riccati import Start, White, newton_with_start
from mjx_drax.problem.differentiators import Autodiff, Differentiator
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory


@register_dataclass
@dataclass(frozen=True)
class GaussNewton(Metric):
    """M = H + mu J'J + delta D. The multipliers follow the predicted, noise-free residual.

    r = mu (h + J d), with d = -M^{-1} grad L_mu.

    The ladder is short, because damping adapts: with ten sizes no more chains succeed, and the tail
    takes longer.

    Attributes:
        derivatives: of everything at a knot.
        state_damping: D of states, where that of controls is 1; None: as the dynamics say, 1 for
            smooth ones and 0.001 where contacts, limits or dry friction act.
    """

    ladder: ClassVar = (1.0, 1 / 2, 1 / 4, 1 / 16, 0.0)
    has_gains: ClassVar = True
    scaled_by_box: ClassVar = True
    polished: ClassVar = True
    derivatives: Differentiator = field(default_factory=Autodiff)
    state_damping: ArrayLike | None = None

    def direction(
        self, problem: Problem, model: Model, key: Array | None, memory: Any
    ) -> Direction:
        """Drift, multiplier rate and noise, from one factorization; with feedback gains."""
        derivatives, mu, multipliers = model.derivatives, model.weights.penalty, model.multipliers
        assert derivatives is not None  # for the type checker
        given = self.state_damping
        of_states = problem.dynamics.state_damping if given is None else given
        cost = _with_barrier(derivatives.cost, *model.barrier, model.weights.damping, of_states)
        rows = model.h.constraints
        penalties = Stagewise(*(mu * jnp.ones(r.shape[-1]) for r in (rows.stage, rows.terminal)))
        damping = model.weights.damping
        cost, stages, end = with_constraints(cost, derivatives, model, penalties, damping)
        white, xi = (None, None) if key is None else _white(problem, stages, end, key)
        start = start_of(model, key)
        step = newton_with_start(derivatives.dynamics, cost, multipliers.dynamics, mu, white, start)
        slack, first = model.gradient.slack, step.first
        ds, rate = jax.vmap(partial(slack_step, penalty=penalties.stage))(
            stages, stage_steps(step.dx, step.du, None if first is None else first[:, 0])
        )
        ds_end, rate_end = slack_step(end, step.dx[-1], penalties.terminal)
        drift = Trajectory(step.dx, step.du, Stagewise(ds, ds_end) if slack else None, step.start)
        rates = Multipliers(step.rate, Stagewise(rate, rate_end))
        if xi is None:
            return Direction(drift, None, rates, step.gains, memory)
        nx, nu, nx_0 = step.noise_x, step.noise_u, None if first is None else first[:, 1]
        assert nx is not None  # for the type checker
        assert nu is not None
        of_stage = partial(slack_noise, penalty=penalties.stage)
        ns = jax.vmap(of_stage)(stages, stage_steps(nx, nu, nx_0), xi.stage)
        ns_end = slack_noise(end, nx[-1], xi.terminal, penalties.terminal)
        noise = Trajectory(nx, nu, Stagewise(ns, ns_end) if slack else None, step.noise_start)
        return Direction(drift, noise, rates, step.gains, memory)


@register_dataclass
@dataclass(frozen=True)
class Eliminated:
    """What slacks are recovered from, at one knot: J (m, n), r (m,), t (mg,) and D (mg,)."""

    J: Array
    r: Array
    t: Array
    D: Array


def eliminate(
    J: Array, r: Array, multipliers: Array, slope: Array, curvature: Array, penalty: Array
) -> tuple[Array, Array, Eliminated]:
    """Gradient (n,) and Hessian (n, n) of one knot's constraints, slacks (mg,) eliminated.

    The penalty is one for each row, (m,).
    """
    equalities = r.shape[0] - slope.shape[0]
    force = multipliers + penalty * r
    of_slack = penalty[equalities:]
    D = of_slack + curvature
    t = slope + force[equalities:]
    G = J[equalities:]
    weights = jnp.concatenate([penalty[:equalities], of_slack * curvature / D])
    gradient = transposed_product(J, force) - transposed_product(G, of_slack * t / D)
    return gradient, transposed_product(J, weights[:, None] * J), Eliminated(J, r, t, D)


def slack_step(block: Eliminated, dz: Array, penalty: Array) -> tuple[Array, Array]:
    """Slack step ds (mg,) and mu (r + J d) (m,), given dz (n,)."""
    equalities = block.r.shape[0] - block.t.shape[0]
    ds = -(block.t + penalty[equalities:] * (block.J[equalities:] @ dz)) / block.D
    return ds, penalty * (block.r + block.J @ dz).at[equalities:].add(ds)


def slack_noise(block: Eliminated, nz: Array, white: Array, penalty: Array) -> Array:
    """Slack noise (mg,), given nz (n,) and standard normal numbers (mg,)."""
    equalities = block.r.shape[0] - block.t.shape[0]
    pull = penalty[equalities:] * (block.J[equalities:] @ nz)
    return -pull / block.D + white / jnp.sqrt(block.D)


def _with_barrier(
    cost: QuadraticCost,
    slope: Trajectory,
    curvature: Trajectory,
    damping: Array,
    of_states: ArrayLike,
) -> QuadraticCost:
    """The model of c + rho b + delta/2 (|du|^2 + of_states |dx|^2); x_0 has no barrier here."""
    diagonal_x = jnp.full_like(cost.gx, of_states * damping).at[1:].add(curvature.x)
    diagonal_u = damping + curvature.u
    return QuadraticCost(
        cost.gx.at[1:].add(slope.x),
        cost.gu + slope.u,
        cost.Hxx + jax.vmap(jnp.diag)(diagonal_x),
        cost.Hux,
        cost.Huu + jax.vmap(jnp.diag)(diagonal_u),
    )


def with_constraints(
    cost: QuadraticCost,
    derivatives: Derivatives,
    model: Model,
    penalties: Stagewise,
    damping: Array,
) -> tuple[QuadraticCost, Eliminated, Eliminated]:
    """The cost with the constraints of every stage, and what their slacks are recovered from.

    Penalties are one for each row, (m,) and (m_end,); damping is added to the slacks' curvature.
    """
    K, ndx = derivatives.dynamics.h.shape
    none = Stagewise(jnp.zeros((K, 0)), jnp.zeros(0))
    slope, curvature = (of_barrier.slack or none for of_barrier in model.barrier)
    r, y = model.h.constraints, model.multipliers.constraints

    def reduce(penalty: Array, J: Array, r: Array, y: Array, b: Array, c: Array) -> Any:
        return eliminate(J, r, y, b, c + damping, penalty)

    g, H, stages = jax.vmap(partial(reduce, penalties.stage))(
        derivatives.stage, r.stage, y.stage, slope.stage, curvature.stage
    )
    g_end, H_end, end = reduce(
        penalties.terminal,
        derivatives.terminal,
        r.terminal,
        y.terminal,
        slope.terminal,
        curvature.terminal,
    )
    whole = QuadraticCost(
        cost.gx + jnp.concatenate([g[:, :ndx], g_end[None]]),
        cost.gu + g[:, ndx:],
        cost.Hxx + jnp.concatenate([H[:, :ndx, :ndx], H_end[None]]),
        cost.Hux + H[:, ndx:, :ndx],
        cost.Huu + H[:, ndx:, ndx:],
    )
    return whole, stages, end


def _white(
    problem: Problem, stages: Eliminated, end: Eliminated, key: Array
) -> tuple[White, Stagewise]:
    """Standard normal numbers for controls and defects, and for slacks."""
    K, dynamics = problem.horizon, problem.dynamics
    _, key_noise, key_slack = jax.random.split(key, 3)
    key_u, key_e = jax.random.split(key_noise)
    return White(
        jax.random.normal(key_u, (K, dynamics.nu)),
        jax.random.normal(key_e, (K, dynamics.ndx)),
    ), Stagewise(
        jax.random.normal(key_slack, stages.D.shape),
        jax.random.normal(jax.random.fold_in(key_slack, 1), end.D.shape),
    )


def start_of(model: Model, key: Array | None = None) -> Start | None:
    """The part of a free x_0, with noise if there is a key to draw it with."""
    if model.start is None:
        return None
    slope, curvature = (jnp.asarray(of_barrier.start) for of_barrier in model.barrier)
    white = None if key is None else jax.random.normal(jax.random.fold_in(key, 4), slope.shape)
    return Start(model.start, slope, curvature, white)


def stage_steps(dx: Array, du: Array, first: Array | None = None) -> Array:
    """(dx_k, du_k) for k = 0..K-1, (K, ndx + nu), from steps of x_1..x_K and of x_0, if any."""
    zeroth = jnp.zeros_like(dx[:1]) if first is None else first[None]
    before = jnp.concatenate([zeroth, dx[:-1]])
    return jnp.concatenate([before, du], axis=1)
