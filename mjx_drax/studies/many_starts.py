"""One chain for each of many initial states of a problem, all in one compiled program."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial

import jax
from jax import Array

from mjx_drax.method.langevin import Info, Langevin, State, evaluate
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory


@dataclass(frozen=True)
class Answers:
    """Where N chains ended, and how long they took.

    Attributes:
        trajectory: knots, (N, K, nx) and (N, K, nu).
        info: diagnostics, (N,) each.
        compile_time: [s], with a first run, which loads and allocates.
        solve_time: of a second run [s], from drawing the initial knots to the final ones.
    """

    trajectory: Trajectory
    info: Info
    compile_time: float
    solve_time: float


def solve_each(solver: Langevin, problem: Problem, starts: Array, keys: Array) -> Answers:
    """One chain from each x_init in `starts` (N, nx), with its own random key (N,)."""
    total, tail = int(solver.iterations) + int(solver.tail), int(solver.tail) > 0
    clock = time.perf_counter()
    compiled = _solve_each.lower(solver, problem, starts, keys, total, tail).compile()
    jax.block_until_ready(compiled(solver, problem, starts, keys))
    compile_time = time.perf_counter() - clock
    clock = time.perf_counter()
    trajectory, info = jax.block_until_ready(compiled(solver, problem, starts, keys))
    return Answers(trajectory, info, compile_time, time.perf_counter() - clock)


@partial(jax.jit, static_argnames=("total", "tail"))
def _solve_each(
    solver: Langevin, problem: Problem, starts: Array, keys: Array, total: int, tail: bool
) -> tuple[Trajectory, Info]:
    """Knots and diagnostics at the end, without the axis of chains, which has one entry.

    The number of iterations is static: a GPU then need not ask after each whether it was the last.
    """

    def one(x_init: Array, key: Array) -> tuple[Trajectory, Info]:
        own = replace(problem, x_init=x_init)
        key_knots, key_noise = jax.random.split(key)
        state = solver.init(own, jax.tree.map(lambda a: a[None], own.draw(key_knots)), key_noise)

        def step(i: Array, state: State) -> State:
            return solver.step(own, state, i, tail)

        knots = jax.lax.fori_loop(0, total, step, state).trajectory
        return jax.tree.map(lambda a: a[0], (knots, evaluate(own, knots)))

    return jax.vmap(one)(starts, keys)
