"""Times of the parts of an iteration: f, its Jacobians, the Riccati recursion, and the whole.

    python -m mjx_drax.studies.iteration TASK[:CHAINS] ... [--horizon S] [--repeats N] [--path DIR]

A row for each task and number of chains, in milliseconds: f at all knots, Jacobians of f at all
knots, one recursion with noise and gains, an iteration with noise, one of the noise-free tail, and
one of the polish. Line searches evaluate f at each knot: that of the tail 5 times, that of the
polish 14 times on GPUs, and on CPUs as often as it needs. Plans last as long as the task's, or S
seconds. Robots of `studies.robots` are tasks, too; DIR is where their packages' files lie. Times
are medians of calls in one process; the last column is the time that all of these took to compile,
in seconds. To compare two versions, run this file with PYTHONPATH set to either checkout.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

from mjx_drax import Autodiff
from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.model import linearize
from mjx_drax.method.riccati import newton
from mjx_drax.polish.interior_point import Polish, begin_inside
from mjx_drax.problem.problem import Problem
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.iterate import Question, iteration, start
from mjx_drax.studies.measurements import task_and_chains
from mjx_drax.studies.recursion import batch, median_seconds
from mjx_drax.studies.robots import named

TASKS = ("quadruped_step:32", "humanoid_stand:32", "quadruped_step:1", "humanoid_stand:1")


def times(problem: Problem, chains: int, repeats: int) -> tuple[list[float], float]:
    """Seconds of each part, in the order of the table, and seconds to compile them all."""
    flow = Langevin()
    K, key = problem.horizon, jax.random.key(0)
    knots = initial_knots(problem, chains, None, key)
    states = start(flow, problem, knots, key)
    polished = Question(replace(flow, iterations=0), problem, polish=Polish())
    # a polish that has begun: its first iteration takes no step
    begun = jax.vmap(lambda state: begin_inside(problem, state, jnp.ones(())))(states)
    recursion = batch(chains, K, problem.dynamics.ndx, problem.dynamics.nu)
    keys = jax.random.split(key, (chains, K))
    parts = [
        (lambda z: problem.defects(z), (knots,)),
        (lambda z, keys: linearize(problem, z, Autodiff(), keys), (knots, keys)),
        (newton, recursion),
        (lambda s: flow.step(problem, s, 0, tail=False)[0], (states,)),
        (lambda s: flow.step(problem, s, flow.iterations, noise=False)[0], (states,)),
        (partial(iteration, jnp.zeros((), int), polished), (begun,)),
    ]
    seconds, compiling = [], 0.0
    for part, arguments in parts:
        clock = time.perf_counter()
        program = compiled(full_precision(jax.vmap(part))).lower(*arguments).compile()
        compiling += time.perf_counter() - clock
        seconds.append(median_seconds(program, arguments, repeats)[0])
    return seconds, compiling


def main(arguments: Sequence[str] | None = None) -> None:
    """Time and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("tasks", nargs="*", default=TASKS, metavar="TASK[:CHAINS]")
    parser.add_argument("--horizon", type=float, metavar="S", help="duration of the plans [s]")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--path", type=Path, metavar="DIR", help="of the packages of robots")
    options = parser.parse_args(arguments)
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, milliseconds\n")
    print("| task | K | chains | f | Jacobians | recursion | noise | tail | polish | compile [s] |")
    print("|---" * 10 + "|")
    own = {} if options.horizon is None else {"horizon": options.horizon}
    for word in options.tasks:
        name, chains = task_and_chains(word, 32)
        problem = named(name, options.path, **own)
        seconds, compiling = times(problem, chains, options.repeats)
        row = " | ".join(f"{1e3 * part:.2f}" for part in seconds)
        print(f"| {name} | {problem.horizon} | {chains} | {row} | {compiling:.0f} |", flush=True)


if __name__ == "__main__":
    main()
