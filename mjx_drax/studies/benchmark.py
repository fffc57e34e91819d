"""The benchmark: suites of methods and problems, a table, `benchmark.json` and a figure.

    cpu      every task with its own settings and number of chains; then one pendulum on one CPU
             thread, 1 to 16 chains against IPOPT in the same process
    gpu      as many chains as suit a GPU, and ablations with the first seed; then 16,384 pendulums
             with initial states of their own
    devices  the same solve on 1, 2, 4, ... devices of this machine, with chains enough for all
    peers    this solver, its ablations, IPOPT and shooting methods; an equal number of evaluations
             of f for shooting as for this solver

How each number comes about is in `measurements`. IPOPT needs casadi
(`pip install "mjx-drax[peers]"`); without it the suites `cpu` and `gpu` leave IPOPT out, and
`peers` refuses to start.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import write_json
from mjx_drax.kernels.compilation import keep_none
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.metrics import Diagonal
from mjx_drax.method.schedules import Geometric
from mjx_drax.problem.problem import Problem
from mjx_drax.search.restarts import Restarts
from mjx_drax.search.sizes import scale_at
from mjx_drax.studies import one_thread
from mjx_drax.studies.convergence.suite import NAME as CONVERGENCE
from mjx_drax.studies.measurements import (
    OURS,
    STARTS,
    Row,
    ipopt,
    ours,
    random_states,
    shoot,
    tuned,
)
from mjx_drax.studies.other_methods.cem import CEM
from mjx_drax.studies.other_methods.ipopt import (
    FUNCTIONS,
    Transcription,
    has_casadi,
    require_casadi,
)
from mjx_drax.studies.other_methods.mbd import MBD
from mjx_drax.studies.other_methods.mppi import MPPI
from mjx_drax.studies.other_methods.shooting import Method
from mjx_drax.studies.reproduce.settings import PENDULUM_FLOW, TRAP_FLOW

GPU_CHAINS = {
    "pendulum": 16_384,
    "cartpole_swingup": 1_024,
    "acrobot_swingup": 256,
    "bug_trap": 1_024,
    "deep_trap": 1_024,
}
"""Tasks of the suite `gpu`, and their chains."""

GPU_PROBES = 1
"""Interrupted solves for one row of the suite `gpu`: its replays take longer than its solves."""

DEVICE_CHAINS = {"pendulum": 262_144, "acrobot_swingup": 65_536}
"""Tasks of the suite `devices`, and their chains: so many that each device has much to do."""

PEER_TASKS = ("pendulum", "bug_trap", "deep_trap", "cartpole_swingup", "acrobot_swingup")
"""Tasks of the suite `peers`; IPOPT and the ablations on those that are functions."""

SHOOTING: dict[str, Sequence[Method]] = {
    "mppi": [MPPI(t, s, r) for t in (0.001, 0.01) for s in (0.3, 1.0) for r in (0.9, 0.97)],
    "cem": [
        CEM(rate=a, floor=f, correlation=r, elite=n)
        for a, f in ((0.7, 0.05), (0.9, 0.02))
        for r in (0.9, 0.97)
        for n in (3, 5)
    ],
    "mbd": [MBD(t, r) for t in (0.0003, 0.001, 0.01) for r in (0.9, 0.97)],
}
"""Settings that are tried for every problem; the best ones are reported. Higher temperatures (0.1,
0.5), white noise, narrower first spreads and larger elites were tried on the pendulum and on the
traps, and were worse."""

SAMPLES, CHAINS_PER_RUN = 256, 16
"""Rollouts of one iteration of a shooting run; for so many of our chains there is one run."""

ONE_THREAD_CHAINS = (1, 2, 4, 8, 16)
"""Numbers of chains that are compared with IPOPT on one thread."""


def run(
    names: Sequence[str] = (),
    seeds: Sequence[int] = (0, 1, 2),
    chains: int | None = None,
    suite: str | None = None,
    report: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Measure; one row for every solve. What cannot be measured is refused, see `check`.

    Args:
        names: tasks, by default all that the suite has.
        seeds: of the random numbers.
        chains: for all tasks, instead of their own or the suite's number.
        suite: one of `SUITES`; by default tasks with their own settings.
        report: called with every row as it is ready.
    """
    names = [tasks.full_name(name) for name in names]
    check(names, suite)
    keep_none()
    measured, known = SUITES[suite] if suite else (_tasks, tasks.names)
    rows = []
    for found in measured(tuple(names or known()), seeds, chains):
        rows.append(found)
        report(found)
    return rows


def check(names: Sequence[str], suite: str | None) -> None:
    """Complain about what `run` could not measure.

    Raises:
        DraxError: there is no such suite or task, the suite does not have a task, or it needs
            casadi, which is not installed.
    """
    if suite is not None and suite not in SUITES:
        raise DraxError(
            f"there is no suite {suite!r}: choose one of {', '.join([*SUITES, CONVERGENCE])}."
        )
    known = SUITES[suite][1]() if suite else tasks.names()
    for name in names:
        tasks.load(name)
        if name not in known:
            raise DraxError(f"the suite {suite} has no {name}: it has {', '.join(known)}.")
    if suite == "peers":
        require_casadi()


# Suites


def _tasks(names: Sequence[str], seeds: Sequence[int], chains: int | None) -> Iterator[Row]:
    """Tasks with their own settings."""
    for name in names:
        problem, solver, number = _task(name)
        for seed in seeds:
            yield ours(problem, solver, chains or number, seed)


def _cpu(names: Sequence[str], seeds: Sequence[int], chains: int | None) -> Iterator[Row]:
    yield from _tasks(names, seeds, chains)
    if "pendulum" in names:
        for seed in seeds:
            yield from one_thread.run(seed, [n for n in ONE_THREAD_CHAINS if n <= (chains or n)])


def _gpu(names: Sequence[str], seeds: Sequence[int], chains: int | None) -> Iterator[Row]:
    for name in names:
        problem, solver, _ = _task(name)
        for seed in seeds:
            yield ours(problem, solver, chains or GPU_CHAINS[name], seed, probes=GPU_PROBES)
        if name in FUNCTIONS:
            for label, changed in ablations(problem, solver).items():
                number = chains or GPU_CHAINS[name]
                yield ours(problem, changed, number, seeds[0], label, probes=0)
    if "pendulum" in names:
        yield from _random_pendulums(chains or GPU_CHAINS["pendulum"], seeds)


def _devices(names: Sequence[str], seeds: Sequence[int], chains: int | None) -> Iterator[Row]:
    for name in names:
        problem, solver, _ = _task(name)
        number = chains or DEVICE_CHAINS[name]
        count = 1
        while count <= jax.local_device_count():
            label = f"{OURS}, {count} device{'s' if count > 1 else ''}"
            for seed in seeds:
                yield ours(problem, solver, number, seed, label, probes=0, devices=count)
            count *= 2


def _peers(names: Sequence[str], seeds: Sequence[int], chains: int | None) -> Iterator[Row]:
    for name in names:
        problem, solver, number = _task(name)
        number = chains or number
        solvers: dict[str, Langevin | Restarts] = {OURS: solver}
        if name in FUNCTIONS:
            solvers |= ablations(problem, solver)
        for label, own in solvers.items():
            for seed in seeds:
                found = ours(problem, own, number, seed, label)
                if label == OURS:
                    budget = found["evaluations"]
                yield found
        if name in FUNCTIONS:
            program = Transcription(problem)
            for seed in seeds:
                yield ipopt(problem, min(number, STARTS), seed, program)
        runs = max(number // CHAINS_PER_RUN, 1)
        for methods in SHOOTING.values():
            best, compilation = tuned(problem, methods, runs, SAMPLES, budget, seeds[0])
            for seed in seeds:
                found = shoot(problem, best, runs, SAMPLES, budget, seed)
                found["compile_time_s"] += compilation
                yield found | {"settings_tried": len(methods)}
                compilation = 0.0
    if "pendulum" in names:
        yield from _random_pendulums(min(chains or 50, 50), seeds)


SUITES: dict[str, tuple[Callable[..., Iterator[Row]], Callable[[], Sequence[str]]]] = {
    "cpu": (_cpu, tasks.names),
    "gpu": (_gpu, lambda: tuple(GPU_CHAINS)),
    "devices": (_devices, lambda: tuple(DEVICE_CHAINS)),
    "peers": (_peers, lambda: PEER_TASKS),
}
"""What measures a suite, and the tasks that it has."""


def ablations(problem: Problem, solver: Restarts) -> dict[str, Langevin | Restarts]:
    """The solver with one part taken out.

    `no restarts` makes the first, noise-free attempt only; `no noise`, `diagonal` and `no tail`
    keep everything else, and the number of iterations.
    `identity` is the paper's flow, with its own settings and 20,000 iterations: the identity metric
    is unstable at the step size of the others.
    """
    flow = solver.flow

    def with_flow(**settings: Any) -> Restarts:
        return replace(solver, flow=replace(flow, **settings))

    return {
        "no restarts": replace(solver, attempts=1),
        "no noise": with_flow(noise=Geometric(0.0, 0.0)),
        "diagonal": with_flow(preconditioner=Diagonal()),
        "identity": PENDULUM_FLOW if problem.name == "pendulum" else TRAP_FLOW,
        "no tail": with_flow(iterations=flow.iterations + flow.tail, tail=0),
    }


def _random_pendulums(count: int, seeds: Sequence[int]) -> Iterator[Row]:
    problem, solver, _ = _task("pendulum")
    knots = jax.vmap(problem.draw)(jax.random.split(jax.random.key(0), 1024))
    first = solver.first(scale_at(problem, solver.flow, knots))
    program = Transcription(problem) if has_casadi() else None
    for seed in seeds:
        yield random_states(problem, first, count, seed, program=program)


def _task(name: str) -> tuple[Problem, Restarts, int]:
    """Problem, settings (the default for all) and number of chains of a task."""
    task = tasks.load(name)
    return task.make(), Restarts(), getattr(task, "CHAINS", 64)


# Results


HEADER = (
    "| problem | K | solver | seed | chains | success | near best | best cost | / best known "
    "| max\\|h\\| | f evaluations | first certified [s] | first near [s] | solve [s] "
    "| compile [s] |\n" + "|---" * 15 + "|"
)


def line(row: Row) -> str:
    """A row of the table, in Markdown."""

    def cell(key: str, form: str) -> str:
        return "-" if row.get(key) is None else format(row[key], form)

    return (
        f"| {row['problem']} | {row['horizon']} | {row['solver']} | {row['seed']} "
        f"| {row['chains']} | {cell('success_rate', '.2%')} | {cell('near_rate', '.1%')} "
        f"| {cell('best_cost', '.6g')} "
        f"| {cell('cost_ratio', '.4f')} | {cell('max_defect', '.0e')} "
        f"| {cell('evaluations', '.2g')} | {cell('time_to_certified_s', '.3g')} "
        f"| {cell('time_to_near_s', '.3g')} "
        f"| {cell('solve_time_s', '.3g')} | {cell('compile_time_s', '.1f')} |"
    )


def certified(rows: Sequence[Row]) -> bool:
    """Whether this library's own rows, without ablations and peers, are all certified."""
    return all(row["certified"] for row in rows if row["solver"].startswith(OURS))


def save(rows: Sequence[Row], folder: str | os.PathLike[str]) -> list[Path]:
    """Write `benchmark.json`, the list of rows, and `benchmark.png`, success against time."""
    from mjx_drax.studies.benchmark_plot import plot

    target = Path(folder)
    return [write_json(target / "benchmark.json", rows), plot(rows, target / "benchmark.png")]
