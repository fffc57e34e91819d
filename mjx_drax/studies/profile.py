"""Which GPU kernels an iteration runs, and how long the GPU waits between them.

    python -m mjx_drax.studies.profile TASK[:CHAINS] ... [--of KIND] [--iterations N] [--path DIR]

For the flow and for the polish of each task, or with `--of plan` for plans of model predictive
control: the time of an iteration or a plan, how many kernels it starts, the time in which one of
them runs, the kernels that take longest, and between which the GPU waits longest, because the host
decides something or starts the next. Taken from JAX's profiler, in the last of three solves of N
iterations each, or of three times N plans. The profiler makes waits longer than they are. Robots of
`studies.robots` are tasks, too; DIR is where their packages' files lie.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import tempfile
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_drax.control.mpc import MPC
from mjx_drax.polish.interior_point import Polish
from mjx_drax.problem.problem import Problem
from mjx_drax.search.restarts import Restarts, Rollouts
from mjx_drax.solution.solve import solve
from mjx_drax.studies.measurements import task_and_chains
from mjx_drax.studies.robots import named


def kernels(folder: Path) -> list[dict[str, Any]]:
    """The events of GPU streams in a trace, with name, ts and dur in microseconds."""
    (trace,) = folder.rglob("perfetto_trace.json.gz")
    events = json.loads(gzip.decompress(trace.read_bytes()))["traceEvents"]
    devices = {
        e["pid"]
        for e in events
        if e.get("name") == "process_name" and "GPU" in e["args"].get("name", "")
    }
    streams = {
        (e["pid"], e["tid"])
        for e in events
        if e.get("name") == "thread_name"
        and e["pid"] in devices
        and e["args"].get("name", "").startswith("Stream")
    }
    return [e for e in events if e.get("ph") == "X" and (e["pid"], e["tid"]) in streams]


def busy(events: list[dict[str, Any]]) -> float:
    """Time [us] in which at least one event runs."""
    end, total = 0.0, 0.0
    for start, stop in sorted((e["ts"], e["ts"] + e["dur"]) for e in events):
        total += max(stop - max(start, end), 0.0)
        end = max(end, stop)
    return total


def waits(events: list[dict[str, Any]]) -> dict[str, list[float]]:
    """Times [us] in which nothing runs, by the kernels before and after."""
    found: dict[str, list[float]] = defaultdict(list)
    end, last = math.inf, ""
    for event in sorted(events, key=lambda e: e["ts"]):
        if event["ts"] > end:
            found[f"{last[:40]} to {event['name'][:40]}"].append(event["ts"] - end)
        if event["ts"] + event["dur"] > end or math.isinf(end):
            end, last = event["ts"] + event["dur"], event["name"]
    return found


def measured(run: Callable[[], tuple[int, float]], what: str, rows: int) -> None:
    """Run three times, and print the table of the third run.

    It is the last one: solves after a profile have ended in launch failures.

    Args:
        run: returns how many iterations or plans there were, and their time [s].
        what: which of the two.
        rows: of the table.
    """
    run()
    count, seconds = run()
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, create_perfetto_trace=True):
            run()
        events = kernels(Path(folder))
    print(
        f"{count} {what} of {1e3 * seconds / count:.3f} ms: {len(events) / count:.0f} kernels, "
        f"busy for {busy(events) / count / 1e3:.3f} ms"
    )
    sums: dict[str, list[float]] = defaultdict(list)
    for event in events:
        sums[event["name"]].append(event["dur"])
    for kind, found in (("kernel", sums), ("wait", waits(events))):
        print(f"\n| {kind} | times | ms |\n|---|---|---|")
        for name, times in sorted(found.items(), key=lambda item: -sum(item[1]))[:rows]:
            print(f"| {name[:90]} | {len(times) / count:.1f} | {sum(times) / count / 1e3:.4f} |")
    print(flush=True)


def solving(problem: Problem, chains: int, solver: Restarts) -> tuple[int, float]:
    """Iterations of a solve, and its time [s]."""
    solution = solve(problem, chains=chains, solver=solver, progress=False)
    return max(solution.iterations, 1), solution.solve_time


def planning(policy: MPC, count: int) -> tuple[int, float]:
    """So many plans of a policy whose system stays where the last plan wants it; their time [s]."""
    policy.rewind()
    dt = float(policy.problem.dynamics.dt)
    for k in range(1, count + 1):
        policy.plan(policy.latest.x[1][: policy.problem.dynamics.given_nx], k * dt)
    return count, sum(policy.statistics.latencies)


def main(arguments: Sequence[str] | None = None) -> None:
    """Profile and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("tasks", nargs="+", metavar="TASK[:CHAINS]")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--rows", type=int, default=20)
    parser.add_argument("--path", type=Path, metavar="DIR", help="of the packages of robots")
    parser.add_argument("--of", choices=["flow", "polish", "plan"], help="default flow and polish")
    options = parser.parse_args(arguments)
    n, rows = options.iterations, options.rows
    usual = Restarts(attempts=1, rollouts=Rollouts(first=0, rounds=0))
    flow = replace(usual, descent=n, flow=replace(usual.flow, tail=0), polish=Polish(iterations=0))
    polish = replace(usual, descent=10, polish=Polish(1e-30, n))
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}")
    for word in options.tasks:
        name, count = task_and_chains(word, 64)
        problem = named(name, options.path)
        for what, solver in (("flow", flow), ("polish", polish)):
            if options.of in (None, what):
                print(f"\n## {name}, {count} chains, {what}\n")
                measured(partial(solving, problem, count, solver), "iterations", rows)
        if options.of == "plan":
            print(f"\n## {name}, {count} chains, plan\n")
            policy = MPC(problem, chains=count)
            policy.reset(np.asarray(problem.x_init)[: problem.dynamics.given_nx])
            measured(partial(planning, policy, n), "plans", rows)


if __name__ == "__main__":
    main()
