"""A plan of `MPC` as one compiled function: shift the chains, iterate, and choose the best.

All is traced: the state that was measured, by how many knots the last plan is moved, the number of
iterations. Only the best chain's plan comes to the host, packed into one array.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.pytrees import packed, register_dataclass, unpacked
from mjx_drax.control.open_quantities import at_present, step_of
from mjx_drax.control.shift import shifted
from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import Langevin, State
from mjx_drax.polish.interior_point import Polish, Progress, begin_inside
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.search.chains import Chains
from mjx_drax.search.identity import identity
from mjx_drax.search.iterate import (
    FEASIBLE,
    Question,
    chain_keys,
    evaluate,
    loop,
    partition,
)
from mjx_drax.search.warm import resumed

CHEAPER = 0.9
"""Another chain is applied if its cost is below that of the one applied by this factor: the cost
itself, or from its floor, where that is smaller."""

HEATED, CYCLE = 30, 50
"""Iterations of an explorer with noise, and of all, before it starts again."""


@register_dataclass
@dataclass(frozen=True)
class Plan:
    """The best chain's plan.

    Attributes:
        x: states x_0..x_K, (K + 1, nx), with the further ones that the problem has.
        u: controls, (K, nu).
        gains: feedback K_k, (K, nu, ndx).
        cost, max_defect: of the plan, scalars.
        finite: whether it may be used.
        switched: whether another chain than the last plan's was the best.
        dt: time between its knots [s].
        time: of x_0 [s]; set on the host.
    """

    x: Any
    u: Any
    gains: Any
    cost: Any
    max_defect: Any
    finite: Any
    switched: Any
    dt: Any
    time: float = 0.0

    def __repr__(self) -> str:
        return f"<Plan of {len(self.u)} controls from {self.time:.6g} s: cost {self.cost}>"


@register_dataclass
@dataclass(frozen=True)
class Carried:
    """What stays on the device between plans.

    Attributes:
        state: of all chains; the explorers are the last ones.
        best: which chain is applied, always a keeper.
        lost: whether its plan broke the dynamics.
        spare: the worst keeper, which may be given other knots.
        age: iterations since an explorer last started, (chains,); 0 for keepers.
        key: for the explorers' noise.
    """

    state: State
    best: Array
    lost: Array
    spare: Array
    age: Array
    key: Array


class Now(NamedTuple):
    """What is new when a plan is made.

    Attributes:
        x: the state that was measured, (nx,) with the further ones.
        t: its time [s].
        by: knots by which the last plan is moved forward.
        iterations: of every chain.
        noise: unit of the explorers' noise, the root of the last plan's cost.
        floor: the least that costs may be, about; see `search.sizes`.
        passed: time since the policy began [s].
        before: the control that was applied last (nu,), and whether there is one; None without
            rates.
    """

    x: Any
    t: Any
    by: Any
    iterations: Any
    noise: Any
    floor: Any
    passed: Any
    before: Any


def first_carried(found: Chains, explorers: int, seed: int, polish: Polish | None) -> Carried:
    """The chains of a solve, the best ones as keepers; the explorers at all ages.

    The polish of explorers begins when they become keepers.
    """
    chains = len(found.cost)
    count = chains - explorers
    age = np.zeros(chains, np.int32)
    age[count:] = np.arange(explorers) * CYCLE // max(explorers, 1)
    state = _rows(found.state, found.order()[0])
    if polish is None:
        state = replace(state, polish=())
    return Carried(
        _begun_anew(state, jnp.arange(chains) >= count),
        jnp.int32(0),
        jnp.array(False),
        jnp.int32(count - 1),
        jnp.asarray(age),
        jax.random.key(seed),
    )


def _rows(state: State, which: ArrayLike) -> State:
    """Some of the chains."""
    which = jnp.asarray(which)
    return jax.tree.map(lambda a: a[which], state)


@lru_cache
def planner_of(structure: Any, explorers: int) -> compiled:
    """The program that plans with settings of this structure (flow, heated flow, polish, problem).

    A call gives their leaves, so that no plan waits while settings and problem are flattened and
    their structure is compared; what is `Now` in one vector; and the problem's data of the knots
    from now on. The plan comes back in one vector, too. What is `Carried` is overwritten: a CUDA
    graph is told anew where each of its arrays lies, if they lie elsewhere than in the last plan.
    """

    def plan(
        leaves: list[Any], carried: Carried, packet: Array, data: Any
    ) -> tuple[Carried, Array]:
        flow, heated, polish, problem = jax.tree.unflatten(structure, leaves)
        now: Now = unpacked(packet, now_like(problem))
        heated = replace(heated, scale=replace(heated.scale, noise=now.noise))
        present = at_present(problem, now.passed, now.before)
        present = replace(present, x_init=now.x, t_init=now.t, data=data)
        after, plan = _plan(flow, heated, polish, present, carried, now, explorers)
        return after, packed(plan, packet.dtype)

    def key(leaves: list[Any], carried: Carried, packet: Array, data: Any) -> str | None:
        shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype) for leaf in leaves]
        settings = jax.tree.unflatten(structure, shapes)
        known = identity((settings, carried, packet, data), settings[-1])
        return known and f"{explorers} explore; {known}"

    return compiled(full_precision(plan), graph=True, key=key, donate_argnames=("carried",))


def now_like(problem: Problem) -> Now:
    """Zeros of the shapes and types of what a plan of that problem starts from."""
    dynamics, number = problem.dynamics, np.zeros((), problem.x_init.dtype)
    rates = isinstance(dynamics, Extended) and dynamics.order
    return Now(
        x=np.zeros(dynamics.nx, number.dtype),
        t=number,
        by=number,
        iterations=np.zeros((), np.int32),
        noise=number,
        floor=number,
        passed=number,
        before=(np.zeros(dynamics.nu, number.dtype), np.zeros((), bool)) if rates else None,
    )


def plan_like(state: State) -> Plan:
    """Zeros of the shapes and types of a plan, for chains in that state."""
    knots, (K, nu, ndx) = state.trajectory, state.gains.shape[1:]
    number = np.zeros((), knots.u.dtype)
    no = np.zeros((), bool)
    return Plan(
        x=np.zeros((K + 1, knots.x.shape[-1]), number.dtype),
        u=np.zeros((K, nu), number.dtype),
        gains=np.zeros((K, nu, ndx), number.dtype),
        cost=number,
        max_defect=number,
        finite=no,
        switched=no,
        dt=number,
        time=0.0,
    )


def _plan(
    flow: Langevin,
    heated: Langevin,
    polish: Polish | None,
    problem: Problem,
    carried: Carried,
    now: Now,
    explorers: int,
) -> tuple[Carried, Plan]:
    """Shift the chains, iterate from x_init, and choose: one plan, all on the device."""
    by, iterations = now.by, now.iterations
    chains, best, age, key = len(carried.age), carried.best, carried.age, carried.key
    exploring = jnp.arange(chains) >= chains - explorers
    state = jax.vmap(partial(shifted, flow, problem, by))(carried.state)
    if explorers:
        key, fresh = jax.random.split(key)
        state = _restarted(heated, problem, state, best, exploring & (age == 0), fresh)
    state = _led_back(flow, problem, state, carried, alone=chains - explorers == 1)
    state = _iterated(flow, heated, polish, problem, state, age, iterations, explorers)
    age = jnp.where(exploring & (age + iterations < CYCLE), age + iterations, 0)
    info = evaluate(problem, state.trajectory)
    alive = state.alive & jnp.isfinite(info.cost) & jnp.isfinite(info.max_defect)
    cost = jnp.where(alive & (info.max_defect < FEASIBLE), info.cost, jnp.inf)
    chosen = _chosen(info, cost, alive, best, now.floor)
    states = problem.with_start(state.trajectory)[chosen]
    plan = Plan(
        x=states,
        u=state.trajectory.u[chosen],
        gains=state.gains[chosen],
        cost=info.cost[chosen],
        max_defect=info.max_defect[chosen],
        finite=alive[chosen],
        switched=chosen != best,
        dt=step_of(problem, states),
    )
    # An explorer that is applied becomes a keeper, and so does whatever replaces the dead
    worst = jnp.argmax(jnp.where(exploring, -jnp.inf, cost))
    places, found = jnp.arange(chains), exploring[chosen]
    source = jnp.where(alive | exploring, places, chosen)
    source = jnp.where(found & (places == worst), chosen, source)
    best = jnp.where(found, worst, chosen)
    mine = (places == best) | exploring
    spare = jnp.argmax(jnp.where(mine, -jnp.inf, jnp.where(alive, cost, jnp.inf)))
    lost = ~(info.max_defect[chosen] < FEASIBLE)
    return Carried(_rows(state, source), best, lost, spare, age, key), plan


def _chosen(info: Info, cost: Array, alive: Array, best: Array, floor: Array) -> Array:
    """The chain to apply: of the feasible ones the cheapest, else the one with least max|h|.

    The one that was applied last has an advantage, so that plans do not alternate.
    """
    mine = jnp.arange(len(cost)) == best
    size = jnp.minimum(jnp.abs(info.cost), jnp.abs(info.cost - floor))
    cost = jnp.where(mine, cost - (1.0 - CHEAPER) * size, cost)
    defect = jnp.where(mine, CHEAPER, 1.0) * jnp.where(alive, info.max_defect, jnp.inf)
    return jnp.argmin(jnp.where(jnp.isfinite(cost).any(), cost, defect))


def _led_back(
    flow: Langevin, problem: Problem, state: State, carried: Carried, alone: bool
) -> State:
    """The spare keeper's knots replaced by a rollout of the applied plan, if that was lost.

    A keeper that is alone is its own spare one.

    After a push the knots are far from any motion, and few iterations do not bring them back. The
    controls with their feedback, followed from x, give a motion to start from. It takes as many
    steps as there are knots, one after the other: several times as long as an iteration.
    """
    best, spare = carried.best, carried.spare

    def rolled() -> State:
        knots, gains = jax.tree.map(lambda a: a[best], (state.trajectory, state.gains))
        several = jax.tree.map(lambda a: a[None], (knots, gains))  # kernels are for batches
        x, u = jax.tree.map(lambda a: a[0], jax.vmap(problem.rolled_out)(*several))
        x, u = jnp.where(jnp.isfinite(x), x, knots.x), jnp.where(jnp.isfinite(u), u, 0.0)
        inside = flow.inside(problem, replace(knots, x=x, u=u))
        new = jax.tree.map(lambda a, b: a.at[spare].set(b), state.trajectory, inside)
        which = jnp.arange(len(state.alive)) == spare
        damping = jnp.where(which, 1.0, state.damping)
        return _begun_anew(replace(state, trajectory=new, damping=damping), which)

    led: State = jax.lax.cond(carried.lost & (alone | (spare != best)), rolled, lambda: state)
    return led


def _restarted(
    heated: Langevin, problem: Problem, state: State, best: Array, which: Array, key: Array
) -> State:
    """The chains (chains,) that are to start again do so from the best one's knots."""
    knots = jax.tree.map(lambda a: jnp.broadcast_to(a[best], a.shape), state.trajectory)
    keys = chain_keys(key, len(which))
    started = jax.vmap(partial(heated.init, problem))(replace(knots, slack=None), keys)
    return _where(which, replace(started, polish=state.polish), state)


def _where(which: Array, new: State, old: State) -> State:
    """The new state for some chains (chains,), the old one for the others."""

    def chosen(a: Array, b: Array) -> Array:
        return jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(chosen, new, old)


def _begun_anew(state: State, which: Array) -> State:
    """Some chains (chains,) have other knots than their polish has known."""
    if not isinstance(state.polish, Progress):
        return state
    return replace(state, polish=replace(state.polish, stalled=state.polish.stalled | which))


def _iterated(
    flow: Langevin,
    heated: Langevin,
    polish: Polish | None,
    problem: Problem,
    state: State,
    age: Array,
    iterations: Array,
    explorers: int,
) -> State:
    """So many iterations of every chain: of the polish, else of the tail; of an explorer's flow.

    Explorers are the last chains, and go on from their `age` (chains,).
    """
    keepers = len(age) - explorers
    if polish is None:  # one loop for all: where f has contacts, each takes long to compile
        return _flow_iterated(flow, heated, problem, state, age, iterations, explorers)
    kept, others = (
        jax.tree.map(lambda a, part=part: a[part], state)
        for part in (slice(keepers), slice(keepers, None))
    )
    kept = jax.vmap(partial(_resumed, flow, problem))(kept)
    question = Question(replace(flow, iterations=0), problem, np.int32(0), polish)
    shared, own = partition(question, None)
    kept = loop((kept, own), shared, 0, iterations, diagnose=False)[0]
    if not explorers:
        return kept
    others = _flow_iterated(flow, heated, problem, others, age[keepers:], iterations, explorers)
    whole: State = jax.tree.map(lambda *parts: jnp.concatenate(parts), kept, others)
    return whole


def _flow_iterated(
    flow: Langevin,
    heated: Langevin,
    problem: Problem,
    state: State,
    age: Array,
    iterations: Array,
    explorers: int,
) -> State:
    """So many iterations of keepers in the tail, and of explorers in their own schedules."""
    exploring = jnp.arange(len(age)) >= len(age) - explorers

    def own(old: Array, new: Array) -> Array:
        which = exploring.reshape(-1, *[1] * jnp.ndim(old))
        return jnp.where(which, jnp.asarray(new), jnp.asarray(old))

    start = jnp.where(exploring, age, jnp.int32(flow.iterations + flow.tail) - iterations)
    question = Question(jax.tree.map(own, flow, heated), problem, start)
    sizes = [len(jax.tree.leaves(part)) for part in question]
    differs = (True,) * sizes[0] + (False,) * sizes[1] + (True,)
    shared, rows = partition(question, differs)
    both = explorers > 0
    return loop((state, rows), shared, 0, iterations, noise=both, diagnose=False, mixed=both)[0]


def _resumed(flow: Langevin, problem: Problem, state: State) -> State:
    """A chain as a warm start of the polish; one that was blocked is led off its bounds.

    Steps of an interior point method are short where knots are at their bounds and have to leave
    them.
    """
    old, rho = state.polish, flow.weights(1.0).barrier
    inside = replace(state, trajectory=flow.inside(problem, state.trajectory))
    fresh = begin_inside(problem, inside, rho)
    fresh = replace(fresh, polish=replace(fresh.polish, stiffness=old.stiffness))
    warm = resumed(problem, state)
    return jax.tree.map(lambda a, b: jnp.where(old.blocked, a, b), fresh, warm)
