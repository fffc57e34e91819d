"""One method on one problem, as a row of the benchmark.

A row leaves out what a method has no number for, and methods add their own. Whoever found a
trajectory, it counts when the problem's own replay (MuJoCo's C engine, or float64 for functions)
ends in the goal.

`time_to_certified_s` is the time of solving until an answer could be handed over that a replay
certifies, with that replay; compilation, and building IPOPT's program, are left out. It is None if
there never was one. In detail:

    this solver   The solve is repeated with the same seed and interrupted at some of its reports,
                  from the first one at which any chain is feasible; what an interrupted solve
                  returns is replayed. Counted is the time of the first interrupted solve in which
                  a chain succeeds. Chains run together, so the time is that of all of them.
    IPOPT         Starts run one after the other; counted are all until the first that is certified.
    shooting      Runs go on together; counted is the time until the first report at which the
                  cheapest rollout of a run is certified. A run that once held a certified answer
                  has succeeded, whatever it found later.

Reaching the goal is not everything: a trap's wall is a cost, and ploughing through it reaches the
goal at seventy times the price of the way round. `near_rate` is the share that succeeds at no more
than `NEAR` times the best known cost, `time_to_near_s` the time until the first such answer.

`curve` holds [seconds, share, near] triples: the shares of chains, starts or runs that held a
certified answer after so many seconds, and one near the best known, by the same rules.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax import __version__
from mjx_drax.base.errors import DraxError, shown
from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import Langevin
from mjx_drax.physics.c_engine.stepper import cores
from mjx_drax.problem.problem import Problem
from mjx_drax.search.family import Family
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.restarts import Restarts, as_restarts
from mjx_drax.solution.replay import Replays, judged
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.solution.violations import Tolerances, extents
from mjx_drax.studies.many_starts import solve_each
from mjx_drax.studies.other_methods import shooting
from mjx_drax.studies.other_methods.ipopt import Transcription

Row = dict[str, Any]

OURS = "mjx_drax"
"""What `solver` says for this library with its default settings."""

BEST_KNOWN = {
    "pendulum": 0.031774,
    "bug_trap": 18.1888,
    "deep_trap": 48.3437,
    "pendulum_swingup": 2.15088,
    "cartpole_swingup": 0.22190,
    "acrobot_swingup": 0.22473,
}
"""Lowest costs of certified and optimal answers that were ever found, not only with default
settings. They are local optima: a lower one may exist, and then `cost_ratio` is below 1."""

NEAR = 2.0
"""How many times the best known cost still counts as near it."""

PROBES = 8
"""Largest number of interrupted solves for one row."""

STARTS = 20
"""Largest number of IPOPT's starts for one row."""

TUNING = 10_000
"""Added to a seed for the runs that choose a shooting method's settings."""


def machine() -> Row:
    """What a row was measured on."""
    device = jax.devices()[0]
    return {
        "device": device.device_kind,
        "cpus": cores(),
        "mjx_drax": __version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def task_and_chains(word: str, usual: int) -> tuple[str, int]:
    """The name of a task and a number of chains, of TASK:CHAINS, or the usual one of TASK.

    Raises:
        DraxError: CHAINS is no whole number of at least 1.
    """
    name, _, count = word.partition(":")
    if not count:
        return name, usual
    if not count.isdecimal() or int(count) < 1:
        raise DraxError(f"{shown(word)}: give TASK or TASK:CHAINS, a whole number of at least 1.")
    return name, int(count)


def row(problem: Problem, solver: str, seed: int, chains: int, **found: Any) -> Row:
    """A row, with the cost as a multiple of the best known one."""
    given = {
        "problem": problem.name,
        "horizon": problem.horizon,
        "solver": solver,
        "seed": seed,
        "chains": chains,
        **machine(),
        **found,
    }
    cost, best = given.get("best_cost"), BEST_KNOWN.get(problem.name)
    if cost is not None and best is not None and given.get("certified"):
        given["cost_ratio"] = cost / best
    return given


def near(problem: Problem, cost: np.ndarray) -> np.ndarray:
    """Which costs are at most `NEAR` times the best known; all of them if none is known."""
    return np.asarray(cost) <= NEAR * BEST_KNOWN.get(problem.name, np.inf)


def over_time(seconds: Sequence[float], share: Sequence[float], close: Sequence[float]) -> Row:
    """What a row says about the time at which shares of certified and of near answers were held."""

    def first(shares: Sequence[float]) -> float | None:
        return next((float(t) for t, s in zip(seconds, shares, strict=True) if s > 0), None)

    return {
        "success_rate": float(share[-1]),
        "near_rate": float(close[-1]),
        "time_to_certified_s": first(share),
        "time_to_near_s": first(close),
        "curve": [list(map(float, point)) for point in zip(seconds, share, close, strict=True)],
    }


# This solver


def ours(
    problem: Problem,
    solver: Langevin | Restarts,
    chains: int,
    seed: int,
    name: str = OURS,
    probes: int = PROBES,
    devices: int = 1,
) -> Row:
    """A solve, and when its first answer was there; with probes=0, only when its last one was."""
    solution = solve(problem, chains, seed, solver, devices=devices, progress=False)
    replay = seconds_to_replay(problem, np.asarray(solution.best.u, float))
    answers = [*_interrupted(solution, probes), _judged(solution)]
    seconds, share, close = map(list, zip(*answers, strict=True))
    times = np.maximum.accumulate(seconds) + replay  # solves are timed with some noise
    best, certificate = solution.best_chain, solution.certificate
    return row(
        problem,
        name,
        seed,
        chains,
        iterations=solution.iterations,
        certified=solution.certified,
        optimal=solution.optimal,
        residual=float(solution.residual[best]),
        best_cost=float(solution.replay_cost[best]),
        max_defect=float(solution.max_defect[best]),
        evaluations=evaluations(solver, problem, chains, solution.iterations),
        open_loop_deviation=certificate.open_loop["max_deviation"],
        feedback_deviation=certificate.feedback["max_deviation"],
        median_success_cost=float(np.median(solution.replay_cost[solution.success]))
        if solution.success.any()
        else None,
        compile_time_s=solution.compile_time,
        solve_time_s=solution.solve_time,
        **over_time(times.tolist(), share, close),
    )


def evaluations(solver: Langevin | Restarts, problem: Problem, chains: int, iterations: int) -> int:
    """Evaluations of f that so many iterations cost.

    Per knot, an iteration linearizes, 1 + ndx + nu evaluations (forward mode, or one reverse sweep
    for less), and one of the tail also tries every step size of its ladder.
    """
    dynamics = problem.dynamics
    linearization = 1 + dynamics.ndx + dynamics.nu
    attempts = as_restarts(solver)
    flow, tails = attempts.flow, sum(end < iterations for end in attempts.noise_ends)
    searches = tails * int(flow.tail) * len(flow.preconditioner.ladder)
    return chains * problem.horizon * (iterations * linearization + searches)


def _interrupted(solution: Solution, probes: int) -> list[tuple[float, float, float]]:
    """Seconds, and shares of chains that succeed and that come near, of the solve cut short."""
    history = solution.history
    feasible = (history["max_defect"] < FEASIBLE).any(axis=1)
    stops = history["iteration"][feasible & (history["iteration"] > 0)][:-1]
    if len(stops) == 0 or probes == 0:
        return []
    chosen = stops[np.unique(np.linspace(0, len(stops) - 1, probes).round().astype(int))]
    answers: list[tuple[float, float, float]] = []
    for stop in chosen:

        def interrupt(done: int, total: int, info: Info, stop: int = int(stop)) -> None:
            if done >= stop:
                raise KeyboardInterrupt  # which keeps what there is

        part = solve(
            solution.problem, solution.chains, solution.seed, solution.solver, progress=interrupt
        )
        answers.append(_judged(part))
    return answers


def _judged(solution: Solution) -> tuple[float, float, float]:
    close = solution.success & near(solution.problem, solution.replay_cost)
    return solution.solve_time, solution.success_rate, float(close.mean())


# Peers


def judge(problem: Problem, u: np.ndarray, x_init: np.ndarray | None = None) -> Replays:
    """Open-loop replays of controls (n, K, nu), judged as certificates are.

    Each starts at its x_init (n, nx), by default at the problem's.
    """
    ran = _replayed(problem, u, x_init)
    # As if what happened had been planned
    return judged(Family.of_one(problem), ran[0], extents(problem, *ran), ran, Tolerances())


def _replayed(
    problem: Problem, u: np.ndarray, x_init: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """States and controls of open-loop replays of controls (n, K, nu)."""
    plan = np.zeros((len(u), problem.horizon + 1, problem.dynamics.nx))
    plan[:, 0] = np.asarray(problem.x_init, float) if x_init is None else x_init
    return problem.replay(plan, u, np.zeros((*u.shape, problem.dynamics.ndx)))


def seconds_to_replay(problem: Problem, u: np.ndarray) -> float:
    """Time of a replay of controls (K, nu) [s], once compiled."""
    for _ in range(2):  # the first compiles
        clock = time.perf_counter()
        _replayed(problem, u[None])
    return time.perf_counter() - clock


def ipopt(problem: Problem, starts: int, seed: int, program: Transcription | None = None) -> Row:
    """IPOPT from random knots, one start after the other on one thread; see `Transcription`."""
    clock = time.perf_counter()
    program = program or Transcription(problem)
    building = time.perf_counter() - clock
    found = program.multistart(starts, seed)
    verdicts = judge(problem, np.stack([start.u for start in found]))
    defects, costs = (np.array([getattr(s, k) for s in found]) for k in ("max_defect", "cost"))
    success = verdicts.success & (defects < FEASIBLE)
    times = np.cumsum([start.seconds for start in found])
    eligible = success if success.any() else defects < FEASIBLE
    best = int(np.argmin(np.where(eligible, costs, np.inf)))
    return row(
        problem,
        "ipopt",
        seed,
        starts,
        certified=bool(success.any()),
        best_cost=float(costs[best]),
        max_defect=float(defects[best]),
        median_start_s=float(np.median([start.seconds for start in found])),
        costs=sorted(round(float(cost), 6) for cost in costs),
        compile_time_s=building,
        solve_time_s=float(times[-1]),
        **over_time(
            (times + seconds_to_replay(problem, found[0].u)).tolist(),
            (np.cumsum(success) / starts).tolist(),
            (np.cumsum(success & near(problem, costs)) / starts).tolist(),
        ),
    )


def shoot(
    problem: Problem, method: shooting.Method, runs: int, samples: int, budget: int, seed: int
) -> Row:
    """A shooting method with a budget of evaluations of f, spent on independent runs."""
    result = shooting.optimize(method, problem, runs, samples, budget, seed)
    reports = len(result.seconds)
    u = result.u.reshape(-1, *result.u.shape[2:])
    verdicts, times = judge(problem, u), result.seconds + seconds_to_replay(problem, u[0])
    certified = verdicts.success
    eligible = certified if certified.any() else np.isfinite(verdicts.cost)
    cost = np.where(eligible, verdicts.cost, np.inf).min()
    share, close = (
        np.logical_or.accumulate(held.reshape(reports, runs), axis=0).mean(axis=1)
        for held in (certified, certified & near(problem, verdicts.cost))
    )
    return row(
        problem,
        method.name,
        seed,
        runs,
        iterations=result.iterations,
        samples=samples,
        settings={name: float(value) for name, value in asdict(method).items()},  # type: ignore[call-overload]
        certified=bool(certified.any()),
        best_cost=float(cost),
        max_defect=0.0,
        evaluations=result.evaluations,
        compile_time_s=result.compile_time,
        solve_time_s=float(result.seconds[-1]),
        **over_time(times.tolist(), share.tolist(), close.tolist()),
    )


def tuned(
    problem: Problem,
    methods: Sequence[shooting.Method],
    runs: int,
    samples: int,
    budget: int,
    seed: int,
) -> tuple[shooting.Method, float]:
    """The settings whose answers come near the best known cost most often.

    Next to that counts success, then the lowest cost. Each gets the whole budget, with another seed
    than the one that is reported. The second value is the time that compilation took [s].
    """
    rows = [shoot(problem, m, runs, samples, budget, seed + TUNING) for m in methods]
    order = [(-r["near_rate"], -r["success_rate"], r["best_cost"]) for r in rows]
    best = methods[min(range(len(methods)), key=lambda i: order[i])]
    return best, sum(r["compile_time_s"] for r in rows)


# Many problems at once


def random_states(
    problem: Problem,
    solver: Langevin,
    count: int,
    seed: int,
    sample: int = 50,
    starts: int = 4,
    program: Transcription | None = None,
) -> Row:
    """One chain for each of many initial states, U(-4, 4) in every element.

    Not every one can reach the goal, so the row says what share is feasible to 1e-5, and, on the
    first `sample` states, the cost against the lowest of IPOPT's `starts` (left out without
    `program`). States and random keys are the same however many there are. `best_cost` and
    `max_defect` are medians over the states, `chains` their number.
    """
    states, keys = random_starts(problem.dynamics.nx, count, seed)
    knots, info, compile_time, seconds = solve_each(solver, problem, states, keys)
    defect, cost = np.asarray(info.max_defect), np.asarray(info.cost)
    x_init = np.asarray(states, float)
    success = judge(problem, np.asarray(knots.u), x_init).success & (defect < FEASIBLE)
    total = int(solver.iterations) + int(solver.tail)
    found: Row = {
        "problem": f"{problem.name}, random x_init",
        "iterations": total,
        "share_feasible_1e-5": float((defect < 1e-5).mean()),
        "share_feasible_1e-3": float((defect < FEASIBLE).mean()),
        "sample_x_init": x_init[:sample],
        "sample_cost": cost[:sample],
        "sample_max_defect": defect[:sample],
    }
    if program is not None:
        found |= _against_ipopt(program, x_init[:sample], cost, defect, starts)
    return row(problem, OURS, seed, count) | {
        "success_rate": float(success.mean()),
        "certified": bool(success.any()),
        "best_cost": float(np.median(cost)),
        "max_defect": float(np.median(defect)),
        "evaluations": evaluations(solver, problem, count, total),
        "compile_time_s": compile_time,
        "solve_time_s": seconds,
        **found,
    }


def random_starts(nx: int, count: int, seed: int) -> tuple[Array, Array]:
    """Initial states (count, nx) from U(-4, 4), and a key for each one's chain."""
    keys = jax.random.split(jax.random.key(seed))
    of_states, of_chains = (
        jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(count)) for key in keys
    )
    draw = partial(jax.random.uniform, shape=(nx,), minval=-4.0, maxval=4.0)
    return jax.vmap(draw)(of_states), of_chains


def _against_ipopt(
    program: Transcription, states: np.ndarray, cost: np.ndarray, defect: np.ndarray, starts: int
) -> Row:
    """Costs of the first states against the lowest feasible cost of IPOPT from each."""
    best, seconds = [], 0.0
    for i, x_init in enumerate(states):
        found = program.multistart(starts, i, x_init)
        seconds += sum(start.seconds for start in found)
        best.append(min((s.cost for s in found if s.max_defect < FEASIBLE), default=np.inf))
    reference, own = np.array(best), cost[: len(states)]
    solved = np.isfinite(reference) & (defect[: len(states)] < FEASIBLE)
    ratio = own[solved] / reference[solved]
    return {
        "cost_ratio": float(np.median(ratio)) if len(ratio) else None,
        "sample_ipopt_cost": reference,
        "sample_ipopt_starts": starts,
        "sample_ipopt_time_s": seconds,
        "sample_feasible": int((defect[: len(states)] < FEASIBLE).sum()),
        "sample_within_1_percent": float(np.sum(ratio < 1.01) / len(states)),
        "sample_within_10_percent": float(np.sum(ratio < 1.1) / len(states)),
        "sample_cost_ratio_p90": float(np.quantile(ratio, 0.9)) if len(ratio) else None,
    }
