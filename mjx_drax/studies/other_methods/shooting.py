"""The loop that sampling-based shooting methods share.

A method plans the controls of the whole horizon in units of their box, v in [-1, 1]^(K x nu), and
keeps a mean m and a spread s, (K, nu) each. An iteration draws N sequences

    v_n = clip(m + s e_n, -1, 1),    e_n Gaussian with E[e_k e_j] = r^|k - j|,    e_0 = 0,

rolls them out from x_init, and lets the method move m and s by what they cost. The correlation r
between neighbouring knots makes smooth controls (r = 0: white noise); e_0 = 0 tries the mean
itself. The cheapest rollout seen is the answer: a rollout has no defects. Leaving the bounds on
states is penalized (`WALL`), because without that a way out of the world is the cheapest.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.errors import DraxError
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Knot, Trajectory

REPORTS = 25
"""Times at which the cheapest rollouts are looked at."""

WALL, MARGIN = 300.0, 0.005
"""Weight of the squared distance to the box of states, which is drawn in by this share of its width
on every side: a penalty always gives way a little."""


@register_dataclass
@dataclass(frozen=True)
class Plan:
    """What a run carries.

    Attributes:
        mean, spread: of the sequences to draw, in units of the box, (K, nu).
        u: controls of the cheapest rollout so far, (K, nu).
        cost: of that rollout, with what leaving the bounds adds, scalar.
    """

    mean: Array
    spread: Array
    u: Array
    cost: Array


class Method(Protocol):
    """A frozen dataclass of numbers, registered as a pytree."""

    name: ClassVar[str]

    @property
    def correlation(self) -> ArrayLike:
        """r, in [0, 1)."""

    @property
    def spread(self) -> ArrayLike:
        """s of the first iteration, scalar."""

    def update(self, plan: Plan, v: Array, cost: Array, t: Array) -> tuple[Array, Array]:
        """Mean and spread after sequences v (N, K, nu) turned out to cost (N,).

        t in (0, 1] is the progress once this iteration is done.
        """


@dataclass(frozen=True)
class Runs:
    """What independent runs of a method had found at every report.

    Attributes:
        seconds: since the start, (reports,) [s], compilation excluded.
        u: controls of the cheapest rollouts so far, (reports, runs, K, nu).
        iterations: of every run.
        evaluations: of f, all runs together.
        compile_time: [s].
    """

    seconds: np.ndarray
    u: np.ndarray
    iterations: int
    evaluations: int
    compile_time: float


def optimize(
    method: Method, problem: Problem, runs: int, samples: int, evaluations: int, seed: int
) -> Runs:
    """Spend a number of evaluations of f on independent runs of a method.

    Args:
        method: with its settings.
        problem: its controls must be bounded.
        runs: in parallel; they never exchange anything.
        samples: N, rollouts of one iteration of one run.
        evaluations: of f; iterations = evaluations / (runs samples K), at least one.
        seed: of all random numbers.
    """
    _box(problem)
    K, nu = problem.horizon, problem.dynamics.nu
    total = max(round(evaluations / (runs * samples * K)), 1)
    keys = jax.random.split(jax.random.key(seed), runs)
    zeros = jnp.zeros((runs, K, nu))
    spread = jnp.full_like(zeros, method.spread)
    plans = Plan(zeros, spread, zeros, jnp.full(runs, jnp.inf))

    clock = time.perf_counter()
    jax.block_until_ready(advance(method, problem, plans, keys, 0, 0, total, samples))
    compile_time = time.perf_counter() - clock

    clock, seconds, controls = time.perf_counter(), [], []
    stops = np.unique(np.linspace(0, total, REPORTS + 1).round().astype(int)).tolist()
    for start, stop in pairwise(stops):
        plans = advance(method, problem, plans, keys, start, stop, total, samples)
        controls.append(jax.block_until_ready(plans.u))
        seconds.append(time.perf_counter() - clock)
    return Runs(
        seconds=np.array(seconds),
        u=np.stack([np.asarray(u) for u in controls]),
        iterations=total,
        evaluations=total * runs * samples * K,
        compile_time=compile_time,
    )


@partial(jax.jit, static_argnames="samples")
def advance(
    method: Method,
    problem: Problem,
    plans: Plan,
    keys: Array,
    start: ArrayLike,
    stop: ArrayLike,
    total: ArrayLike,
    samples: int,
) -> Plan:
    """Iterations start..stop-1, of `total`, of every run (plans and keys lead with that axis)."""
    centre, half = _box(problem)
    K, nu = problem.horizon, problem.dynamics.nu
    smooth = smoother(method.correlation, K)

    def one(plan: Plan, key: Array, i: Array) -> Plan:
        e = jax.random.normal(jax.random.fold_in(key, i), (samples, K, nu)).at[0].set(0.0)
        e = jnp.einsum("kj,njm->nkm", smooth, e)
        v = jnp.clip(plan.mean + plan.spread * e, -1.0, 1.0)
        u = centre + half * v
        cost = jax.vmap(lambda u: _penalized(problem, rollout(problem, u)))(u)
        best = jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))
        better = cost[best] < plan.cost
        plan = replace(
            plan,
            u=jnp.where(better, u[best], plan.u),
            cost=jnp.where(better, cost[best], plan.cost),
        )
        finite = jnp.isfinite(cost)
        cost = jnp.where(finite, cost, jnp.max(jnp.where(finite, cost, 0.0)))  # the largest
        mean, spread = method.update(plan, v, cost, (i + 1) / total)
        return replace(plan, mean=mean, spread=spread)

    def step(i: Array, plans: Plan) -> Plan:
        return jax.vmap(one, in_axes=(0, 0, None))(plans, keys, i)

    return jax.lax.fori_loop(start, stop, step, plans)


def rollout(problem: Problem, u: Array) -> Trajectory:
    """The knots that controls u (K, nu) lead to from x_init."""

    def step(x: Array, stage: tuple[Array, Knot]) -> tuple[Array, Array]:
        u, knot = stage
        x = problem.dynamics.at(knot).step(x, u)
        return x, x

    knots = problem.knots.at(slice(-1))
    return Trajectory(jax.lax.scan(step, problem.x_init, (u, knots))[1], u)


def average(v: Array, cost: Array, temperature: ArrayLike) -> Array:
    """sum_n w_n v_n with w_n ~ exp(-cost_n / (temperature std(cost))), (K, nu).

    Measured in standard deviations of the costs at hand, a temperature means the same for every
    problem and at every stage of the search.
    """
    scale = jnp.maximum(temperature * jnp.std(cost), jnp.finfo(cost.dtype).tiny)
    return jnp.tensordot(jax.nn.softmax(-(cost - cost.min()) / scale), v, axes=1)


def _penalized(problem: Problem, knots: Trajectory) -> Array:
    """Cost, and what leaving the box of states adds."""
    lower, upper = problem.bounds.x_lower, problem.bounds.x_upper
    margin = jnp.where(jnp.isfinite(upper - lower), MARGIN * (upper - lower), 0.0)
    out = jnp.maximum(lower + margin - knots.x, 0.0) + jnp.maximum(knots.x - upper + margin, 0.0)
    return problem.cost(knots) + WALL * jnp.sum(jnp.square(out))


def smoother(r: ArrayLike, K: int) -> Array:
    """Lower triangular L (K, K) with L L' = r^|k - j|."""
    k = jnp.arange(K)
    powers = jnp.tril(jnp.asarray(r, float) ** jnp.maximum(k[:, None] - k, 0))
    return powers * jnp.where(k == 0, 1.0, jnp.sqrt(1.0 - jnp.square(r)))


def _box(problem: Problem) -> tuple[Array, Array]:
    """Centre and half width of the box of controls."""
    lower, upper = problem.bounds.u_lower, problem.bounds.u_upper
    if not isinstance(lower, jax.core.Tracer) and not np.isfinite([lower, upper]).all():
        raise DraxError(
            f"a control of {problem.name} has no bounds: shooting methods search in a box, so "
            "give u_bounds."
        )
    return (lower + upper) / 2, (upper - lower) / 2
