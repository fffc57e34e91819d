"""A primal-dual interior point method with its linear algebra by the Riccati recursion.

Each iteration solves for a step d and new multipliers, of the KKT system of

    min  c(z) - rho sum log(slacks)    s.t.   h(z) = 0

with Hessian H + V / S + delta D: Gauss-Newton's H with what stages have learned (`secant`), the
bounds' multipliers over slacks V / S, and damping relative to the model's own diagonal D. Nothing
is in units of a user's: D, the penalties of constraints and the barrier's weight are all measured.

    damping     raised until the factorization exists and a step is found, lowered after each; where
                curvature is learned, short steps say that some is missing, and raise it too
    step        the largest of a ladder, up to the boundary, that lowers the merit function
                c - rho sum log(slacks) + sum eta |h|,  eta >= |lambda|   (Armijo; Han 1977), or
                its first two terms, while h stays within a funnel that narrows (`line_search`)
    penalties   of constraints grow where steps leave too much of them, and fall where their
                slacks leave only short steps (SOFTER)
    barrier     rho falls when its problem is nearly solved (`_barrier`), and rises where the
                boundary leaves only short steps
    end         the `residual`, and what the model promises to gain, or the last one did, relative
                to the cost, are below the tolerance, and the chain stands still; or no step is
                found however large the damping, and it has stalled

After J. Nocedal and S. Wright, Numerical Optimization, 2006, chapter 19, and A. Waechter and L.
Biegler, On the implementation of an interior-point filter line-search algorithm, 2006.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels.first_success import first_success
from mjx_drax.method.bounds import Sides
from mjx_drax.method.gauss_newton import slack_step, stage_steps, start_of, with_constraints
from mjx_drax.method.langevin import State
from mjx_drax.method.model import Model, Multipliers, QuadraticCost
from mjx_drax.method.riccati import newton_with_start
from mjx_drax.polish.curvature import measured_hessian, with_exact_hessian
from mjx_drax.polish.line_search import Ray, line_search, worst
from mjx_drax.polish.residual import (
    STILL,
    Residual,
    Scales,
    is_flat,
    moves_of_start,
    products,
    residual_of,
    row_scales,
    slacks_of,
)
from mjx_drax.polish.secant import Secant, blocks, with_curvature
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory

FUNNEL, NARROWER = 0.05, 0.7
"""The first funnel, and the factor when it is used; see `line_search`."""

DAMPED = 1e-2
"""First damping after a flow. Without it the first steps leave the basin that the flow found."""

STATE_DAMPING = 1e-2
"""Damping of states beside that of controls: D is the largest along the motion, and often that of
the end."""

LESS_DAMPING, MORE_DAMPING = 1 / 3, 8.0
"""Factors on the damping after a good step, and after a poor one."""

LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e8
"""Damping is raised from 0 to the first, becomes 0 eight good steps below it, and beyond the second
the chain stalls."""

KEEPS_DAMPING, RAISES_DAMPING = 0.5, 0.25
"""Where curvature is learned: the longest steps that keep the damping, and that raise it."""

TRIES = 3
"""Factorizations in one iteration: without learned curvature, then with more damping each time."""

NEAR = 0.02
"""Residual below which the curvature that stages have learned is used."""

PATIENCE, MEASURED = 3.0, 1.5
"""Where f is smooth: a chain polished for PATIENCE n iterations is slow, n = ndx + nu: so many
rank-one updates could have taught its stages all. Then curvature is measured, once in MEASURED n
iterations, and used wherever the chain is."""

BLOCKED, RAISE = 0.1, 3.0
"""Steps to the boundary shorter than BLOCKED raise the barrier's weight by a factor RAISE."""

LOOSE, STIFFER, SOFTER = 0.1, 10.0, 1000.0
"""Where a step leaves more than LOOSE of the constraints, their penalties grow by STIFFER. Where
slacks of constraints that do not hold leave only steps below BLOCKED, they fall by SOFTER, to at
least 1: the linearized constraints then have no solution with positive slacks, and steps towards
one only use the slacks up (Waechter and Biegler, 2000)."""

KEPT, RAISED = 0.1, 1e3
"""Where with eta = |lambda| a step would raise the merit function, eta grows, by at most RAISED,
until the share KEPT of what the step takes from sum eta |h| is left. Exact and learned Hessians
need it: they are positive definite only along the constraints (Nocedal and Wright, (18.36))."""

MARGIN = 1e-2
"""Where the polish begins, knots keep this share of their range from its ends."""

FIRST = 0.1
"""First weight of the barrier, relative to the largest term of the slope as a cost."""

SMALLEST = 1e-4
"""Smallest entry of D, as a share of the largest, both times the squared extent of a coordinate."""


@register_dataclass
@dataclass(frozen=True)
class Polish:
    """How far to go.

    Attributes:
        tolerance: on the residual; 1e-4 is what float32 can reach, 1e-8 what float64 can.
        iterations: at most so many in an attempt; 0: no polish.
        patience: of a single problem, after the last attempt, so many times as many, while no
            chain at the best cost has settled.
    """

    tolerance: ArrayLike = 1e-4
    iterations: int = 200
    patience: int = 5


@register_dataclass
@dataclass(frozen=True)
class Progress:
    """What a chain carries while it is polished.

    Attributes:
        barrier: rho; 0 before the first iteration.
        damping: delta.
        stiffness: kappa, of which the penalties of constraints are multiples.
        penalties: eta, shaped like lambda.
        secant: what stages have learned; () where Hessians are exact.
        residual: of the knots where derivatives were taken last, or the last promise if larger.
        cost: the size of the cost there, free of constants; see `Scales`.
        size: of the last step.
        promise: what the last model promised to gain, relative to the cost.
        funnel: up to where h, relative to the scales of its rows, may grow while the cost falls.
        iterations: how many steps were looked for.
        optimal: the residual is below the tolerance, and the chain stands still.
        stalled: no step is found, and the chain stands still.
    """

    barrier: Array
    damping: Array
    stiffness: Array
    penalties: Multipliers
    secant: Any
    residual: Array
    cost: Array
    size: Array
    promise: Array
    funnel: Array
    iterations: Array
    optimal: Array
    stalled: Array

    @property
    def active(self) -> Array:
        """Whether the chain still moves."""
        return ~(self.optimal | self.stalled)

    @property
    def blocked(self) -> Array:
        """Whether its steps are almost 0 although it has not converged."""
        return self.stalled | ((self.size < BLOCKED) & ~self.optimal)

    def again(self, barrier: Array) -> Progress:
        """The same for a chain that is to move on, with another weight of the barrier."""
        zero, no = jnp.zeros_like(self.size), jnp.zeros_like(self.optimal)
        return replace(
            self,
            barrier=barrier,
            residual=jnp.full_like(self.residual, jnp.inf),
            size=zero,
            promise=jnp.ones_like(self.promise),
            optimal=no,
            stalled=no,
        )


def begin(problem: Problem, state: State) -> State:
    """The chain with what the polish carries."""
    zero, no = jnp.zeros(()), jnp.zeros((), bool)
    nothing = jax.tree.map(jnp.zeros_like, replace(state.multipliers, bounds=None))
    progress = Progress(
        barrier=zero,
        damping=zero,
        stiffness=0.1 / jnp.sqrt(jnp.finfo(zero.dtype).eps) + zero,
        penalties=nothing,
        secant=() if problem.dynamics.twice else Secant.none(problem),
        residual=jnp.full((), jnp.inf, zero.dtype),
        cost=jnp.full((), jnp.nan, zero.dtype),
        size=zero,
        promise=1.0 + zero,
        funnel=FUNNEL + zero,
        iterations=jnp.zeros((), int),
        optimal=no,
        stalled=no,
    )
    return replace(state, polish=progress)


def begin_inside(problem: Problem, state: State, rho: Array) -> State:
    """`begin` for knots that are inside the bounds: rho is the barrier's weight from the start."""
    v = _central(problem, state.trajectory, rho)
    state = begin(problem, replace(state, multipliers=replace(state.multipliers, bounds=v)))
    return replace(state, polish=replace(state.polish, barrier=rho))


def projected(problem: Problem, state: State) -> State:
    """The chain's controls with their feedback, and the states that follow: no defects are left.

    Chains that soft dynamics have left between two motions, where bounds block all steps, take
    one of them. A chain whose states do not stay finite keeps its knots.
    """
    knots = state.trajectory
    x, u = problem.rolled_out(knots, state.gains)
    finite = jnp.isfinite(x).all()
    x, u = jnp.where(finite, x, knots.x), jnp.where(finite, u, knots.u)
    return replace(state, trajectory=replace(knots, x=x, u=u))


def step(
    problem: Problem, state: State, model: Model, polish: Polish, last: Array, guided: Array
) -> State:
    """One iteration of a chain, from the model at its knots.

    The first brings the knots inside the bounds and takes no step. The `last` takes no step either:
    it measures the residual of where the chain ends. Where a flow has `guided` the chain, its
    barrier's weight goes on from that of the flow.
    """
    before, v, derivatives = state.polish, state.multipliers.bounds, model.derivatives
    assert v is not None  # for the type checker
    assert derivatives is not None
    residual, scales = residual_of(problem, model, v)
    learned = before.secant
    if isinstance(learned, Secant):
        at = problem, state.trajectory, derivatives, state.multipliers
        moves = jnp.concatenate([scales.x, scales.u])
        learned = learned.updated(*at, moves, learns=before.size > 0.0)
        if not problem.dynamics.kinked:
            learned = _measured(problem, state, learned, derivatives.cost, scales)
    total = jnp.maximum(residual.total, before.promise)
    optimal = before.optimal | (total < polish.tolerance)
    now = replace(before, secant=learned, residual=total, cost=scales.cost, optimal=optimal)
    stays = ~before.active | optimal | last
    entered = _entered(problem, state, model, now, scales, guided)
    first = before.barrier == 0.0
    moved = _moved(problem, state, model, now, residual, scales, polish, ~stays & ~first)
    new = jax.tree.map(lambda a, b: jnp.where(first, a, b), entered, moved)
    kept = replace(
        state, polish=jax.tree.map(lambda a, b: jnp.where(before.active, a, b), now, before)
    )
    return jax.tree.map(lambda a, b: jnp.where(stays & ~first, a, b), kept, new)


def _measured(
    problem: Problem,
    state: State,
    learned: Secant,
    cost: QuadraticCost,
    scales: Scales,
) -> Secant:
    """What stages have learned; measured now and then where a chain is slow (PATIENCE)."""
    polish, n = state.polish, len(scales.x) + len(scales.u)
    learned = replace(learned, age=learned.age + 1)
    turn = polish.iterations % math.ceil(MEASURED * n) == 0
    due = polish.active & turn & _slow(learned)

    def measure(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        at = state.trajectory, state.multipliers
        once = jnp.where(carry[1], 0.0, 1.0)  # else XLA would take all of it out of the loop
        H = measured_hessian(problem, *at, once * scales.x, once * scales.u)
        return H - blocks(cost), jnp.ones((), bool)

    # a loop of one round, which a batch skips where no row needs it
    kept = learned.B, jnp.zeros((), bool)
    B, _ = jax.lax.while_loop(lambda carry: due & ~carry[1], measure, kept)
    return replace(learned, B=B)


def _slow(learned: Secant) -> Array:
    """Whether a chain has been polished for longer than it should take to learn."""
    return learned.age > PATIENCE * learned.B.shape[-1]


def _entered(
    problem: Problem, state: State, model: Model, now: Progress, scales: Scales, guided: Array
) -> State:
    """The chain inside its bounds, with central multipliers for the flow's barrier."""
    knots = _inside(problem, model, scales)
    assert model.derivatives is not None
    _, largest = _diagonal(model.derivatives.cost, scales)
    most = FIRST * jnp.maximum(scales.terms, STILL * largest)
    rho = jnp.where(guided, jnp.clip(model.weights.barrier, 1e-6 * scales.cost, most), most)
    v = _central(problem, knots, rho)
    damping = jnp.where(guided, DAMPED * state.damping, jnp.zeros(()))
    no = jnp.zeros((), bool)
    now = replace(now, barrier=rho, damping=damping, size=jnp.zeros(()), optimal=no)
    multipliers = replace(state.multipliers, bounds=v)
    return replace(state, trajectory=knots, multipliers=multipliers, polish=now)


def _inside(problem: Problem, model: Model, scales: Scales) -> Trajectory:
    """The knots, a share MARGIN of their range or of their motion away from the ends."""
    knots, g = model.trajectory, problem.inequalities(model.trajectory)
    assert model.derivatives is not None
    stage, end = row_scales(model.derivatives, scales, model.trajectory)
    slack = None
    if g is not None:
        rows = Stagewise(
            stage[problem.constraint.equalities :], end[problem.terminal_constraint.equalities :]
        )
        slack = jax.tree.map(lambda g, scale: jnp.maximum(-g, MARGIN * scale), g, rows)
    lower, upper = problem.plan_bounds.with_room().sides(replace(knots, slack=None))

    def inside(z: Array, a: Array, b: Array, moves: Array) -> Array:
        gap = MARGIN * jnp.where(jnp.isfinite(b - a), b - a, moves)
        return jnp.clip(z, a + gap, b - gap)

    extent = scales.x if problem.dynamics.ndx == problem.dynamics.nx else jnp.ones(())
    start = knots.start
    if model.start is not None:
        z, a, b = (jnp.asarray(side.start) for side in (knots, lower, upper))
        start = inside(z, a, b, moves_of_start(model.start, scales.x))
    return Trajectory(
        inside(knots.x, lower.x, upper.x, extent),
        inside(knots.u, lower.u, upper.u, scales.u),
        slack,
        start,
    )


def _moved(
    problem: Problem,
    state: State,
    model: Model,
    now: Progress,
    residual: Residual,
    scales: Scales,
    polish: Polish,
    needed: Array,
) -> State:
    """The chain after a step, where one is `needed`."""
    knots, v, derivatives = state.trajectory, state.multipliers.bounds, model.derivatives
    assert v is not None  # for the type checker
    assert derivatives is not None
    ends = slacks_of(problem, knots)
    # Before the first step multipliers are 0, and defects would seem to cost nothing
    known = (now.iterations > 0) | (state.multipliers.dynamics != 0.0).any()
    rho = _barrier(problem, knots, v, now.barrier, residual, polish, scales)
    rho = jnp.where(known, rho, now.barrier)

    central = _central(problem, knots, rho)
    model = replace(model, barrier=_barrier_model(problem, central, v, ends))
    cost, learned = derivatives.cost, None
    if isinstance(now.secant, Secant):
        used = _slow(now.secant) | (residual.total < NEAR)
        learned = jnp.where(used, now.secant.B, 0.0)
    else:
        cost = with_exact_hessian(problem, knots, state.multipliers, cost, Autodiff())
    diagonal, _ = _diagonal(cost, scales)
    ok, d, rates, left, gains, damping = _direction(
        model, cost, learned, diagonal, now.damping, now.stiffness, needed
    )

    # bounds: v slack = rho, linearized
    moves = _displacement(problem, knots, d)
    dv = (
        jax.tree.map(lambda c, v, s, m: c - v - v * m / s, central[0], v[0], ends[0], moves),
        jax.tree.map(lambda c, v, s, m: c - v + v * m / s, central[1], v[1], ends[1], moves),
    )
    share = jnp.clip(1.0 - rho / scales.terms, 0.99, 1.0 - jnp.finfo(rho.dtype).eps ** 0.5)
    reach = jnp.minimum(
        _largest(ends[0], moves, share), _largest(ends[1], jax.tree.map(jnp.negative, moves), share)
    )
    reach_v = jnp.minimum(_largest(v[0], dv[0], share), _largest(v[1], dv[1], share))

    before = replace(state.multipliers, bounds=None)
    eta = jax.tree.map(
        lambda e, m, r: jnp.maximum(jnp.abs(m + r), 0.5 * (e + jnp.abs(m + r))),
        now.penalties,
        before,
        rates,
    )
    of_cost, of_defects = _promised(model, d, left, eta)
    of_cost = of_cost - rho * _logs(ends, moves, reach)
    rises = (of_defects < 0.0) & (of_cost + of_defects >= 0.0)
    enough = of_cost / jnp.where(rises, (KEPT - 1.0) * of_defects, 1.0)
    more = jnp.where(rises, jnp.minimum(enough, RAISED), 1.0)
    eta = jax.tree.map(lambda e: more * e, eta)
    promised = of_cost, more * of_defects
    rows = Multipliers(scales.x, Stagewise(*row_scales(derivatives, scales, model.trajectory)))
    A, B = derivatives.dynamics.A, derivatives.dynamics.B
    ray = Ray(
        problem=problem,
        knots=knots,
        h=model.h,
        d=d,
        reach=reach,
        closed=A + B @ gains,
        gains=gains,
        eta=eta,
        rho=rho,
        promised=promised,
        rows=rows,
        funnel=now.funnel,
    )
    gain = jnp.where(is_flat(derivatives), 0.0, jnp.abs(promised[0]) / scales.cost)
    done = ok & (jnp.maximum(residual.total, gain) < polish.tolerance)
    alpha, X, parts = line_search(ray, ok & needed & ~done)
    found = ok & (alpha > 0.0)
    alpha = jnp.where(found, alpha, 0.0)
    X = jax.tree.map(lambda a, b: jnp.where(found, a, b), X, knots)
    lambda_ = jax.tree.map(lambda m, r: m + jnp.where(found, alpha * r, 0.0), before, rates)
    size_v = jnp.where(found, reach_v, 0.0)
    v = jax.tree.map(lambda v, dv: v + jnp.where(found, size_v * dv, 0.0), v, dv)
    v = _held(problem, X, v, rho)
    lower = LESS_DAMPING * damping
    lower = jnp.where(lower < LEAST_DAMPING * LESS_DAMPING**8, 0.0, lower)
    higher = jnp.maximum(MORE_DAMPING * damping, LEAST_DAMPING)
    if learned is not None:
        kept = jnp.where(alpha > RAISES_DAMPING * reach, damping, higher)
        lower = jnp.where(alpha > KEEPS_DAMPING * reach, lower, kept)
    after = jnp.where(found, lower, higher)
    shortfall, present = worst(left, rows), worst(model.h, rows)
    loose = (shortfall > LOOSE * present) & (jnp.maximum(present, shortfall) > polish.tolerance)
    most = 1.0 / (SMALLEST * jnp.finfo(alpha.dtype).eps)  # D may be floored
    stiffness = jnp.where(loose, jnp.minimum(STIFFER * now.stiffness, most), now.stiffness)
    if knots.slack is not None:
        unmet = worst(Multipliers(left.dynamics, model.h.constraints), rows) > polish.tolerance
        jammed = unmet & (_largest(ends[0].slack, moves.slack, share) < BLOCKED)
        stiffness = jnp.where(jammed, jnp.maximum(now.stiffness / SOFTER, 1.0), stiffness)
    blocked = jnp.minimum(RAISE * rho, 0.1 * scales.terms)
    arrived = replace(now, optimal=done, residual=jnp.maximum(residual.total, gain))
    moved = replace(
        now,
        barrier=jnp.where(reach < BLOCKED, jnp.maximum(rho, blocked), rho),
        damping=after,
        stiffness=stiffness,
        penalties=jax.tree.map(lambda a, b: jnp.where(ok, a, b), eta, now.penalties),
        size=alpha,
        promise=jnp.where(ok, gain, now.promise),
        funnel=jnp.where(parts, NARROWER * now.funnel, now.funnel),
        iterations=now.iterations + 1,
        stalled=after > MOST_DAMPING,
    )
    new = replace(
        state,
        trajectory=X,
        multipliers=replace(lambda_, bounds=v),
        gains=jnp.where(ok, gains, state.gains),
        polish=moved,
    )
    here = replace(state, polish=arrived)
    chosen: State = jax.tree.map(lambda a, b: jnp.where(done, a, b), here, new)
    return chosen


def _barrier(
    problem: Problem,
    knots: Trajectory,
    v: Sides,
    rho: Array,
    residual: Residual,
    polish: Polish,
    scales: Scales,
) -> Array:
    """rho, lower where the barrier's problem is nearly solved; at most two steps down.

    It is if slopes, defects and gaps are below ten times rho, as costs; or if the residual's other
    parts are small, and below what the bounds' part is at this rho.
    """
    gaps = jax.tree.leaves(products(problem, knots, v))
    count = jnp.maximum(sum((jnp.sum(p > 0.0) for p in gaps), start=jnp.zeros((), int)), 1)
    floor = 0.1 * polish.tolerance * scales.cost / count
    others = residual.others
    for _ in range(2):
        off = [jnp.abs(jnp.where(p > 0.0, p - rho, 0.0)).max(initial=0.0) for p in gaps]
        centred = jnp.max(jnp.stack(off)) < 10.0 * rho
        small = (others < NEAR) & (others < count * rho / scales.cost)
        lower = jnp.minimum(0.2 * rho, scales.terms * (rho / scales.terms) ** 1.5)
        falls = centred & ((residual.error < 10.0 * rho) | small)
        rho = jnp.where(falls, jnp.maximum(lower, floor), rho)
    return jnp.maximum(rho, floor)


def _barrier_model(
    problem: Problem, central: Sides, v: Sides, ends: Sides
) -> tuple[Trajectory, Trajectory]:
    """Slope of the barrier, and its primal-dual curvature v / slack, in tangent space."""
    tangent = problem.dynamics.tangent
    slope = jax.tree.map(lambda a, b: b - a, *central)
    curvature = jax.tree.map(lambda va, vb, a, b: va / a + vb / b, *v, *ends)
    return replace(slope, x=tangent(slope.x)), replace(curvature, x=tangent(curvature.x))


def _diagonal(cost: QuadraticCost, scales: Scales) -> tuple[tuple[Array, Array], Array]:
    """D of states (ndx,) and of controls (nu,): sum |H_ij| |z_j| / |z_i|, floored.

    The largest along the motion, z being how far coordinates move. Also the largest of D |z|^2.
    """
    x, u = scales.x, scales.u
    Hxx, Hux, Huu = (jnp.abs(H).max(axis=0) for H in (cost.Hxx, cost.Hux, cost.Huu))
    of_x, of_u = x * (Hxx @ x + Hux.T @ u), u * (Hux @ x + Huu @ u)
    largest = jnp.maximum(of_x.max(initial=0.0), of_u.max(initial=0.0))
    largest = jnp.where(largest > 0.0, largest, 1.0)
    floored = [jnp.maximum(D, SMALLEST * largest) for D in (of_x, of_u)]
    return (floored[0] / jnp.square(x), floored[1] / jnp.square(u)), largest


def _direction(
    model: Model,
    cost: QuadraticCost,
    learned: Array | None,
    diagonal: tuple[Array, Array],
    damping: Array,
    stiffness: Array,
    needed: Array,
) -> tuple[Array, Trajectory, Multipliers, Multipliers, Array, Array]:
    """Whether there is one, the step d, the multipliers' step, h + J d, gains, and the damping.

    Curvature that stages have `learned` (K, n, n) is left out where it makes the model indefinite:
    Gauss-Newton's alone never is, and needs no more damping. Where none is needed, none is
    looked for.
    """
    derivatives, multipliers = model.derivatives, model.multipliers
    assert derivatives is not None
    of_x, of_u = diagonal
    slope, curvature = model.barrier
    penalties = _penalties(derivatives.stage, derivatives.terminal, diagonal, stiffness)
    whole, stages, end = with_constraints(cost, derivatives, model, penalties, jnp.zeros(()))
    gx, gu = whole.gx.at[1:].add(slope.x), whole.gu + slope.u
    Hxx = whole.Hxx.at[1:].add(jax.vmap(jnp.diag)(curvature.x))
    Huu = whole.Huu + jax.vmap(jnp.diag)(curvature.u)

    def solved(damping: Array, share: Array) -> tuple[Array, Any]:
        damped = QuadraticCost(
            gx,
            gu,
            Hxx + STATE_DAMPING * damping * jnp.diag(of_x),
            whole.Hux,
            Huu + damping * jnp.diag(of_u),
        )
        if learned is not None:
            damped = with_curvature(damped, share * learned)
        present = derivatives.dynamics, damped, multipliers.dynamics
        # No penalty for dynamics, whose rows are regular
        step = newton_with_start(*present, None, None, start_of(model))
        first = None if step.first is None else step.first[:, 0]
        ds, rate = jax.vmap(lambda block, dz: slack_step(block, dz, penalties.stage))(
            stages, stage_steps(step.dx, step.du, first)
        )
        ds_end, rate_end = slack_step(end, step.dx[-1], penalties.terminal)
        has_slack = model.trajectory.slack is not None
        slack = Stagewise(ds, ds_end) if has_slack else None
        d = Trajectory(step.dx, step.du, slack, step.start)
        rates = Multipliers(step.rate, Stagewise(rate, rate_end))
        finite = jnp.isfinite(sum(jnp.sum(a) for a in jax.tree.leaves((d, rates))))
        return finite, (d, rates, step.gains)

    more = [damping]
    for _ in range(TRIES - 1):
        more.append(jnp.maximum(MORE_DAMPING * more[-1], LEAST_DAMPING))
    if learned is not None:  # the second is without what was learned, no more damping
        more = [damping, *more[:-1]]
    dampings, shares = jnp.stack(more), jnp.arange(TRIES) == 0
    ok, (d, rates, gains), which = first_success(solved, (dampings, shares), needed)
    damping = dampings[which]
    rows = rates.constraints
    of_rows = Stagewise(rows.stage / penalties.stage, rows.terminal / penalties.terminal)
    left = Multipliers(jnp.zeros_like(rates.dynamics), of_rows)
    return ok, d, rates, left, gains, damping


def _penalties(
    stage: Array, terminal: Array, diagonal: tuple[Array, Array], kappa: Array
) -> Stagewise:
    """Penalties of the rows, (m,) and (m_end,): kappa over J D^-1 J'."""
    floor = jnp.sqrt(jnp.finfo(stage.dtype).tiny)
    weights = 1.0 / jnp.concatenate(diagonal)
    of_stage = (jnp.square(stage) @ weights).max(axis=0, initial=0.0)
    of_end = jnp.square(terminal) @ (1.0 / diagonal[0])
    return Stagewise(kappa / jnp.maximum(of_stage, floor), kappa / jnp.maximum(of_end, floor))


def _displacement(problem: Problem, knots: Trajectory, d: Trajectory) -> Trajectory:
    """By how much entries of the knots change with a step d of their tangents."""
    if problem.dynamics.ndx == problem.dynamics.nx:
        return d
    return replace(d, x=problem.displaced(knots, d).x - knots.x)


def _largest(slacks: Any, moves: Any, share: Array) -> Array:
    """The largest step, at most 1, that uses up no more than that share of any slack."""

    def largest(slack: Array, move: Array) -> Array:
        shrinks = (move < 0.0) & jnp.isfinite(slack)
        reach = -share * slack / jnp.where(shrinks, move, -1.0)
        return jnp.where(shrinks, reach, 1.0).min(initial=1.0)

    return jnp.min(jnp.stack(jax.tree.leaves(jax.tree.map(largest, slacks, moves))))


def _central(problem: Problem, knots: Trajectory, rho: Array) -> Sides:
    """rho / slack, and 0 where there is no bound."""
    lower, upper = slacks_of(problem, knots)
    return jax.tree.map(lambda s: rho / s, lower), jax.tree.map(lambda s: rho / s, upper)


def _held(problem: Problem, knots: Trajectory, v: Sides, rho: Array) -> Sides:
    """v within ten orders of magnitude of the central path."""
    central = _central(problem, knots, rho)
    held: Sides = jax.tree.map(lambda v, c: jnp.clip(v, 1e-10 * c, 1e10 * c), v, central)
    return held


def _promised(
    model: Model, d: Trajectory, left: Multipliers, eta: Multipliers
) -> tuple[Array, Array]:
    """The changes of c and of sum eta |h| along d, to first order; `left` is h + J d."""
    assert model.derivatives is not None
    gradient = model.derivatives.cost
    of_cost = jnp.sum(gradient.gx[1:] * d.x) + jnp.sum(gradient.gu * d.u)
    if model.start is not None:
        of_cost = of_cost + jnp.dot(gradient.gx[0], model.start @ jnp.asarray(d.start))
    changes = [
        jnp.sum(e * (jnp.abs(after) - jnp.abs(before)))
        for e, after, before in zip(*map(jax.tree.leaves, (eta, left, model.h)), strict=True)
    ]
    return of_cost, sum(changes, jnp.zeros(()))


def _logs(ends: Sides, moves: Trajectory, reach: Array) -> Array:
    """How much sum log(slacks) grows up to the boundary, for each unit of step.

    Its slope would promise too much where a slack is far too small.
    """

    def growth(slack: Array, move: Array) -> Array:
        return jnp.sum(jnp.where(jnp.isinf(slack), 0.0, jnp.log1p(reach * move / slack)))

    back = jax.tree.map(jnp.negative, moves)
    sides = (jax.tree.map(growth, ends[0], moves), jax.tree.map(growth, ends[1], back))
    return sum(jax.tree.leaves(sides)) / reach
