"""The compiled loops over iterations: many chains at once, of one problem or of many.

Chains are rows. What all rows share (settings, functions, most numbers of a problem) is there once;
what differs from row to row has a leading axis. `Question` holds both, and `partition` parts them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.kernels.pruning import pruned
from mjx_drax.method.bounds import Projection
from mjx_drax.method.descent import Info, diagnosed
from mjx_drax.method.gauss_newton import GaussNewton
from mjx_drax.method.langevin import Langevin, State, keep_finite
from mjx_drax.method.model import Multipliers, expand
from mjx_drax.polish import interior_point
from mjx_drax.polish.interior_point import Polish
from mjx_drax.polish.residual import residual_of
from mjx_drax.problem.problem import PARTS, Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.identity import identity
from mjx_drax.search.scaled import without_units

FEASIBLE = 1e-3
"""Largest max|h| of a feasible chain: of defects in `Problem.defect_unit`, and of constraints."""

BOUND = 5e-3
"""Share of the box of states by which a rollout may leave it and be polished back."""

Tree = TypeVar("Tree")


class Question(NamedTuple):
    """What a row works on: a flow, a problem, a number added to its iterations, and the polish.

    Without a polish the flow's tail is what follows the noise.
    """

    flow: Langevin
    problem: Problem
    offset: ArrayLike = np.int32(0)
    polish: Polish | None = None


def partition(question: Question, differs: tuple[bool, ...] | None) -> tuple[Question, Question]:
    """The leaves that all rows share and those that have an axis of rows, None for the others.

    Args:
        question: the leaves that differ have a leading axis.
        differs: which do, in the order of `jax.tree.leaves`; None: none.
    """
    leaves, tree = jax.tree.flatten(question)
    differs = differs or (False,) * len(leaves)
    parts = (
        [leaf if d is own else None for leaf, d in zip(leaves, differs, strict=True)]
        for own in (False, True)
    )
    shared, own = (jax.tree.unflatten(tree, part) for part in parts)
    return shared, own


def joined(shared: Tree, own: Tree) -> Tree:
    """What `partition` parted, whole again."""
    whole: Tree = jax.tree.map(
        lambda a, b: b if a is None else a, shared, own, is_leaf=lambda leaf: leaf is None
    )
    return whole


def by_row(shared: Question, own: Question, function: Callable[..., Any], *rows: Any) -> Any:
    """function(question, *row) of every row."""
    return jax.vmap(lambda own, *row: function(joined(shared, own), *row))(own, *rows)


def identity_of_rows(own: Any, shared: Any, **others: Any) -> str | None:
    """`identity` of a program of questions, or problems, that `partition` parted."""
    one: Any = jax.tree.map(lambda a: jax.eval_shape(lambda rows: rows[0], a), own)
    whole = joined(shared, one)
    return identity((own, shared, others), getattr(whole, "problem", whole))


@jax.jit
@full_precision
def begin(own: Question, shared: Question, knots: Trajectory, keys: Array) -> State:
    """The first state of chains that start at the given knots (rows, K, ...).

    Keys are one for each row, (rows,), or one for all, of which row i folds in i: results do not
    depend on how chains are split over calls.
    """
    if keys.ndim == 0:
        keys = chain_keys(keys, len(knots.u))

    def first(q: Question, knots: Trajectory, key: Array) -> State:
        state = q.flow.init(q.problem, knots, key)
        return state if q.polish is None else interior_point.begin(q.problem, state)

    started: State = by_row(shared, own, first, knots, keys)
    return started


def chain_keys(key: Array, chains: int) -> Array:
    """The key of each chain, (chains,)."""
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(chains))


@jax.jit
@full_precision
def restart_at(own: Question, shared: Question, states: State, knots: Trajectory) -> State:
    """The chains with other knots (rows, K, ...), slacks that go with them, and a new polish.

    A polish brings knots inside their bounds as it begins; until then they may lie on them, as
    controls of a rollout do. Without one they are brought inside here.
    """

    def moved(q: Question, state: State, knots: Trajectory) -> State:
        flow = q.flow if q.polish is None else replace(q.flow, bounds=Projection())
        state = replace(state, trajectory=flow.inside(q.problem, knots))
        return state if q.polish is None else interior_point.begin(q.problem, state)

    restarted: State = by_row(shared, own, moved, states, knots)
    return restarted


@jax.jit
@full_precision
def between(
    own: Question, shared: Question, here: Trajectory, there: Trajectory, share: ArrayLike
) -> Trajectory:
    """Knots a share of the way from here to there, (rows, K, ...), without slacks."""

    def of_row(q: Question, a: Trajectory, b: Trajectory) -> Trajectory:
        a, b = (replace(knots, slack=None) for knots in (a, b))
        way = jax.tree.map(jnp.subtract, b, a)
        way = replace(way, x=jax.vmap(q.problem.dynamics.difference)(b.x, a.x))
        return q.problem.displaced(a, jax.tree.map(lambda d: share * d, way))

    knots: Trajectory = by_row(shared, own, of_row, here, there)
    return knots


@jax.jit
@full_precision
def worst_and_unit(own: Question, shared: Question, knots: Trajectory) -> tuple[Array, Array]:
    """What rows are judged by whose defects the replaying engine gives.

    Returns:
        The largest violation of each row's constraints (rows,), and its `defect_unit` (rows, ndx).
    """

    def of_row(q: Question, knots: Trajectory) -> tuple[Array, Array]:
        problem = q.problem
        worst = problem.worst_constraint(problem.constraints(knots))
        return worst, problem.defect_unit(knots.x)

    both: tuple[Array, Array] = by_row(shared, own, of_row, knots)
    return both


@jax.jit
@full_precision
def box_of_controls(own: Question, shared: Question, knots: Trajectory) -> tuple[Array, Array]:
    """The ends of the box that each row's initial controls are drawn from, each (rows, K, nu)."""

    def of_row(q: Question, knots: Trajectory) -> tuple[Array, Array]:
        box = q.problem.scatter
        shape = knots.u.shape
        return jnp.broadcast_to(box.u_lower, shape), jnp.broadcast_to(box.u_upper, shape)

    ends: tuple[Array, Array] = by_row(shared, own, of_row, knots)
    return ends


@jax.jit
@full_precision
def judged(own: Question, shared: Question, knots: Trajectory) -> tuple[Array, Array]:
    """Cost of rollouts (samples, rows, K, ...), and by how much they break what must hold.

    That is the largest violation of a constraint, or of a bound of states in `BOUND` of their box.
    """

    def of_row(q: Question, knots: Trajectory) -> tuple[Array, Array]:
        problem = q.problem
        inside = replace(q.flow, bounds=Projection()).inside(problem, knots)
        off = jax.vmap(problem.dynamics.difference)(knots.x, inside.x) / problem.defect_scale
        worst = problem.worst_constraint(problem.constraints(knots))
        outside = FEASIBLE / (PARTS * BOUND) * jnp.abs(off).max(initial=0.0)
        return problem.cost(knots), jnp.maximum(worst, outside)

    found: tuple[Array, Array] = jax.lax.map(partial(by_row, shared, own, of_row), knots)
    return found


def loop(
    rows: tuple[State, Question],
    shared: Question,
    start: ArrayLike,
    stop: ArrayLike,
    tail: bool = True,
    noise: bool = True,
    diagnose: bool = True,
    mixed: bool = False,
) -> tuple[State, Any]:
    """Iterations start..stop-1 of every chain, and diagnostics of where they end.

    Both ends are traced: any number of iterations runs the same compiled loop, and none at all
    (start = stop) just diagnoses. Where f has kinks, as in models with contacts, the loop takes one
    round more, which diagnoses by the f that the loop holds: such programs compile for as long as
    they are, and most of their length is f.

    Args:
        rows: the chains, and what differs from row to row.
        shared: what does not.
        start, stop: iterations.
        tail, noise, mixed: as in `Langevin.step` (static).
        diagnose: whether diagnostics are asked for (static); None takes their place.
    """
    states, own = rows

    def flow_step(i: Array, moves: Array | None, q: Question, state: State) -> tuple[State, Info]:
        problem = q.problem.prepared()
        return q.flow.step(problem, state, i + q.offset, tail, noise, moves, mixed)

    if shared.polish is not None:

        @pruned
        def refine(carry: tuple[Array, State]) -> tuple[Array, State]:
            i, states = carry
            return i + 1, by_row(shared, own, partial(iteration, i), states)

        def unfinished(carry: tuple[Array, State]) -> Array:
            i, states = carry
            return (i < stop) & (states.polish.active & states.alive).any()

        states = jax.lax.while_loop(unfinished, refine, (jnp.asarray(start, int), states))[1]
        return states, by_row(shared, own, _diagnosis, states) if diagnose else None

    if diagnose and tail and shared.problem.dynamics.kinked:

        @pruned  # jit does it to all but the bodies of loops
        def step_or_diagnose(i: Array, carry: tuple[State, Info]) -> tuple[State, Info]:
            moved: Any = by_row(shared, own, partial(flow_step, i, i < stop), carry[0])
            return moved

        zeros = jnp.zeros(states.alive.shape)
        none = Info.of(zeros)
        return jax.lax.fori_loop(start, jnp.asarray(stop) + 1, step_or_diagnose, (states, none))

    @pruned
    def step(i: Array, states: State) -> State:
        moved: State = by_row(shared, own, partial(flow_step, i, None), states)[0]
        return moved

    states = jax.lax.fori_loop(start, stop, step, states)
    if not diagnose:
        return states, None

    return states, by_row(shared, own, _diagnosis, states)


def _diagnosis(q: Question, state: State) -> Info:
    """Where a chain is."""
    knots = state.trajectory
    info = diagnosed(q.problem, knots, q.problem.values(knots))
    if q.polish is None:
        return info
    return replace(info, residual=state.polish.residual, size=state.polish.cost)


def iteration(i: Array, q: Question, state: State) -> State:
    """Iteration i of a chain: a step of the flow while there is noise, then one of the polish.

    The penalty goes half its way; see `Restarts`. Between the two the chain is projected.
    """
    flow, problem, polish, i = q.flow, q.problem.prepared(), q.polish, i + q.offset
    assert polish is not None  # for the type checker
    noisy, key = i < flow.iterations, jax.random.fold_in(state.key, i)
    guided = jnp.asarray(flow.iterations > 0)
    state = jax.lax.cond(
        guided & (i == flow.iterations),
        lambda: interior_point.projected(problem, state),
        lambda: state,
    )
    t = jnp.minimum(flow.progress(i, True), 1.0)
    weights = replace(flow.weights(t), penalty=flow.weights(0.5 * t).penalty)
    model = flow.model(problem, state, weights, key, tail=False)
    last = i + 1 == flow.iterations + polish.iterations

    def diffused() -> State:
        own = without_units(flow, problem)
        to = own.preconditioner.direction(problem, model, key, state.memory)
        return own.diffuse(problem, state, model, to, key, True)

    new = jax.lax.cond(
        noisy,
        diffused,
        lambda: interior_point.step(problem, state, model, polish, last, guided),
    )
    return keep_finite(state, new, i, None)


iterate = compiled(
    full_precision(loop),
    key=lambda rows, shared, **others: identity_of_rows(rows[1], shared, state=rows[0]),
    static_argnames=("tail", "noise", "diagnose"),
)
"""`loop` as a program of its own."""


@jax.jit
@full_precision
def evaluate(problem: Problem, trajectory: Trajectory) -> Info:
    """Cost, max|h| and bound violation of a batch of trajectories of one problem."""
    return jax.vmap(lambda z: diagnosed(problem, z, problem.values(z)))(trajectory)


@partial(compiled, key=identity_of_rows)
@full_precision
def feedback_gains(own: Question, shared: Question, states: State) -> Array:
    """Time-varying LQR gains (rows, K, nu, ndx) for a flow whose metric brings none."""

    def gains(q: Question, state: State) -> Array:
        metric, flow = GaussNewton(), q.flow
        knots, weights = state.trajectory, flow.weights(2.0)
        key = jax.random.split(state.key)[0]
        present = state.multipliers, weights, metric.derivatives
        model = expand(q.problem, flow.bounds, knots, *present, key)
        return metric.direction(q.problem, model, None, ()).gains

    found: Array = by_row(shared, own, gains, states)
    return found


@partial(compiled, key=identity_of_rows)
@full_precision
def residuals(
    own: Question, shared: Question, knots: Trajectory, multipliers: Multipliers
) -> Array:
    """The residual (rows,) of knots with multipliers, those of bounds included."""

    def of_row(q: Question, knots: Trajectory, multipliers: Multipliers) -> Array:
        flow, problem = q.flow, q.problem.prepared()
        present = replace(multipliers, bounds=None), flow.weights(2.0)
        by, key = flow.preconditioner.derivatives, jax.random.key(0)
        model = expand(problem, flow.bounds, knots, *present, by, key)
        assert multipliers.bounds is not None  # for the type checker
        return residual_of(problem, model, multipliers.bounds)[0].total

    found: Array = by_row(shared, own, of_row, knots, multipliers)
    return found


_weights = jax.jit(Langevin.weights)


def noise_at(flow: Langevin, iteration: int) -> float:
    """The noise sigma that an iteration, from 0, adds; 0 in the tail."""
    if iteration >= flow.iterations:
        return 0.0
    return float(_weights(flow, iteration / max(flow.iterations - 1, 1)).noise)


def start(flow: Langevin, problem: Problem, knots: Trajectory, key: Array) -> State:
    """Chains of one problem at knots (chains, K, ...); chain c has the key fold_in(key, c)."""
    shared, own = partition(Question(flow, problem), None)
    return begin(own, shared, knots, key)


def advance(
    flow: Langevin,
    problem: Problem,
    states: State,
    start: ArrayLike,
    stop: ArrayLike,
    tail: bool = True,
) -> tuple[State, Info]:
    """`iterate` for chains of one problem and one flow."""
    shared, own = partition(Question(flow, problem), None)
    return iterate((states, own), shared, start, stop, tail)


def ranking(cost: ArrayLike, max_defect: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Sort keys of chains (...,), best first: infeasible, then cost, or max|h| if infeasible."""
    defect = np.nan_to_num(np.asarray(max_defect), nan=np.inf)
    defect = np.where(np.isfinite(cost), defect, np.inf)
    infeasible = defect >= FEASIBLE
    return infeasible, np.where(infeasible, defect, np.asarray(cost))
