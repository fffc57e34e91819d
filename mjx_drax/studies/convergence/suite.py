"""The suite `convergence`: iterations from one plain guess to a tolerance of 1e-8, beside IPOPT.

    problems  textbook optimal control (`optimal_control`), also with a free duration, parameters, a
              free x_0 or a reference (`open_problems`), smooth tasks, and programs of Hock and
              Schittkowski (`programs`)
    guess     a straight line of states, and controls, parameters and durations in the middle of
              their box; for programs the starting point of the book
    optimum   the published cost of the continuous problem, where it is known; that of the program
              differs by what its knots add, see `Case.error`
    method    the polish; for tasks also the polish after some of the noise-free flow, as in `solve`
    IPOPT     the same program from the same guess, exact derivatives, tol 1e-8, at most 500
              iterations; left out if casadi is not installed

All is computed in float64, in a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import write_json
from mjx_drax.polish.interior_point import Polish
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import Question, begin, iterate, partition
from mjx_drax.search.restarts import Restarts, scale_of
from mjx_drax.search.sizes import scale_and_floor, sizes_of
from mjx_drax.studies.convergence import open_problems, optimal_control
from mjx_drax.studies.convergence.optimal_control import straight
from mjx_drax.studies.convergence.programs import PROGRAMS
from mjx_drax.studies.other_methods import ipopt_jax
from mjx_drax.studies.other_methods.ipopt import has_casadi

Row = dict[str, Any]

CASES = optimal_control.CASES | open_problems.CASES
"""Problems of textbooks, by name; those that leave something open or follow a reference last."""

NAME = "convergence"

TOLERANCE, LONGEST = 1e-8, 500
"""Of both methods: on the residual, and the largest number of iterations."""

DESCENTS = 0, 50, 100
"""Iterations of the flow before the polish, which are counted; `solve` makes 100."""

TASKS: dict[str, Sequence[float] | None] = {
    "pendulum": [0.0, 0.0],
    "pendulum_swingup": [np.pi, 0.0],
    "cartpole_swingup": [0.0, np.pi, 0.0, 0.0],
    "acrobot_swingup": [np.pi, 0.0, 0.0, 0.0],
    "double_pendulum_swingup": [0.0, np.pi, 0.0, 0.0, 0.0, 0.0],
    "quadrotor_planar": [2.5, 1.0, 0.0, 0.0, 0.0, 0.0],
    "quadrotor": [2.5, 0.0, 1.0, 1.0, *[0.0] * 9],
    "arm_reach": None,
    "bug_trap": [1.0, 0.0, 0.0],
    "deep_trap": [1.0, 0.0, 0.0],
}
"""The smooth tasks, and where the straight line of their guess ends; None: the start is held."""

HEADER = (
    "| problem | numbers | optimum | IPOPT iterations | IPOPT cost | IPOPT status | iterations "
    "| cost | residual | status | / IPOPT |\n" + "|---" * 11 + "|"
)


def names() -> tuple[str, ...]:
    """All problems of the suite, in the order of the table."""
    return (*CASES, *TASKS, *PROGRAMS)


def posed(name: str) -> tuple[Problem, Trajectory]:
    """A problem of the suite and its guess, x (K, nx) and u (K, nu)."""
    if name in CASES:
        problem = replace(CASES[name].make(), name=name)
        return problem, CASES[name].guess(problem)
    if name in TASKS:
        problem = tasks.load(name).make()
        return problem, straight(problem, TASKS[name])
    if name in PROGRAMS:
        point = jnp.asarray([PROGRAMS[name].start])
        return PROGRAMS[name].problem(name), Trajectory(jnp.zeros((1, 0)), point)
    raise DraxError(f"the suite convergence has no {name}: it has {', '.join(names())}.")


def ours(problem: Problem, knots: Trajectory, descent: int = 0) -> tuple[int, float, float, str]:
    """Iterations, scaled KKT residual, cost and status of so much of the flow, and the polish."""
    polish, flow = Polish(TOLERANCE, LONGEST), replace(Restarts().first(1.0), iterations=descent)
    start = jax.tree.map(lambda a: jnp.asarray(a, float)[None], knots)
    shared, own = partition(Question(flow, problem, polish=polish), None)
    states = begin(own, shared, start, jax.random.key(0))
    if descent:
        cost, _ = scale_and_floor(jax.tree.map(np.asarray, sizes_of(own, shared, start)), True)
        flow = replace(flow, scale=scale_of(float(cost), 0.0))
        shared, own = partition(Question(flow, problem, polish=polish), None)
    states, info = iterate((states, own), shared, 0, descent + LONGEST)
    done = states.polish
    status = "optimal" if done.optimal[0] else "stalled" if done.stalled[0] else "out of iterations"
    iterations = descent + int(done.iterations[0])
    return iterations, float(info.residual[0]), float(info.cost[0]), status


def measure(name: str) -> list[Row]:
    """Rows of the table, for a task one for each of `DESCENTS`. Needs `jax_enable_x64`."""
    problem, knots = posed(name)
    sizes = (int(leaf.size) for leaf in jax.tree.leaves(knots))
    row: Row = {"problem": name, "numbers": sum(sizes)}
    known = PROGRAMS[name].optimum if name in PROGRAMS else None
    known = CASES[name].optimum if name in CASES else known
    row |= {} if known is None else {"optimum": float(known)}
    if has_casadi():
        answer = ipopt_jax.solve(problem, knots)
        row |= {
            "ipopt_iterations": answer.iterations,
            "ipopt_cost": answer.cost,
            "ipopt_status": answer.status,
        }
    rows = []
    for descent in DESCENTS if name in TASKS else (0,):
        iterations, residual, cost, status = ours(problem, knots, descent)
        found = {"iterations": iterations, "residual": residual, "cost": cost, "status": status}
        if descent:
            found["problem"] = f"{name}, {descent} of the flow"
        if row.get("ipopt_iterations"):
            found["ratio"] = iterations / row["ipopt_iterations"]
        rows.append(row | found)
    return rows


def line(row: Row) -> str:
    """A row of the table, in Markdown."""

    def cell(key: str, form: str = "") -> str:
        return format(row[key], form) if key in row else "-"

    return (
        f"| {row['problem']} | {row['numbers']} | {cell('optimum', '.6g')} "
        f"| {cell('ipopt_iterations')} "
        f"| {cell('ipopt_cost', '.8g')} | {cell('ipopt_status')} | {cell('iterations')} "
        f"| {cell('cost', '.8g')} | {cell('residual', '.0e')} | {cell('status')} "
        f"| {cell('ratio', '.2f')} |"
    )


def run(chosen: Sequence[str], folder: Path, report: Callable[[str], None]) -> list[Row]:
    """Measure problems, all by default, in a process of its own.

    The table is reported line by line; after each, all rows are written to `convergence.json`.
    """
    for name in chosen:
        if name not in names():
            posed(name)
    report(HEADER)
    rows = []
    for row in _rows(chosen or names()):
        rows.append(row)
        report(line(row))
        write_json(folder / "convergence.json", rows)
    return rows


def _rows(chosen: Sequence[str]) -> Iterator[Row]:
    """Rows as a process with float64 prints them."""
    paths = os.pathsep.join(p or os.getcwd() for p in sys.path)
    with subprocess.Popen(
        [sys.executable, "-m", __name__, *chosen],
        env=os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        for text in process.stdout:
            if text.startswith("{"):  # IPOPT may print too
                yield json.loads(text)
    if process.returncode:
        raise DraxError(
            f"the suite convergence ended with status {process.returncode}: see above for the "
            "reason, or give the names of the problems to measure."
        )


if __name__ == "__main__":
    for each in sys.argv[1:]:
        for one in measure(each):
            print(json.dumps(one), flush=True)
        jax.clear_caches()  # a process may map only so many programs into its memory
