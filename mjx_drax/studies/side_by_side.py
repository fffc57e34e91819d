"""Two checkouts of this project side by side on one machine: compile and solve times of tasks.

    python -m mjx_drax.studies.side_by_side OLD NEW [TASK[:CHAINS[xPROBLEMS]] ...] [--repeats N]

With PROBLEMS so many initial states near the task's are solved by one `solve_batch`.

OLD and NEW are folders of checkouts. Each is run in processes of its own, in turn (old, new, old,
new, ...), without a cache of compiled programs. Of each task the first solve of a process gives the
compile time; the solve time is the median over further seeds. Only what both versions have is
called: `mjx_drax.tasks.load`, `mjx_drax.solve` and `mjx_drax.solve_batch`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_drax.base.files import write_json

TASKS = (
    "pendulum:16384",
    "pendulum:4x4096",
    "cartpole_swingup:1024",
    "acrobot_swingup:256",
    "bug_trap:1024",
)

CHILD = """
import json, sys
from dataclasses import replace
import numpy as np
import mjx_drax, mjx_drax.tasks

def solved(problem, chains, count, seed):
    if not count:
        found = mjx_drax.solve(problem, chains=chains, seed=seed)
        return found, found.success_rate, found.cost[found.best_chain]
    off = np.random.default_rng(seed).uniform(-0.1, 0.1, (count, problem.dynamics.nx))
    starts = np.asarray(problem.x_init) + off
    found = mjx_drax.solve_batch(lambda x: replace(problem, x_init=x), starts, chains, seed)
    return found, found.certified.mean(), np.median(found.cost)

for word in sys.argv[2:]:
    name, _, numbers = word.partition(":")
    chains, _, count = numbers.partition("x")
    problem, rows = mjx_drax.tasks.load(name).make(), []
    for seed in range(int(sys.argv[1])):
        found, share, cost = solved(problem, int(chains or 64), int(count or 0), seed)
        rows.append([found.compile_time, found.solve_time, float(share), float(cost)])
    compile, solves, success, costs = map(list, zip(*rows))
    print(json.dumps({"task": word, "compile": compile[0], "solves": solves,
                      "success": success, "cost": costs}), flush=True)
"""


def run(folder: Path, tasks: Sequence[str], seeds: int) -> list[dict[str, Any]]:
    """Rows of every task from one process in that checkout."""
    kept = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    anew = {"JAX_ENABLE_COMPILATION_CACHE": "0"}
    path = os.pathsep.join([str(folder), kept.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", CHILD, str(seeds), *tasks]
    out = subprocess.run(
        command,
        cwd=folder,
        env={**kept, **anew, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        check=True,
    )
    return [json.loads(line) for line in out.stdout.decode().splitlines() if line[:1] == "{"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print a table and write all numbers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--repeats", type=int, default=2, metavar="N", help="processes of each")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="solves in a process")
    parser.add_argument("--out", default="side_by_side.json", metavar="FILE")
    options = parser.parse_args(arguments)
    found: dict[str, list[dict[str, Any]]] = {"old": [], "new": []}
    for turn in range(options.repeats):
        for which in ("old", "new"):
            for row in run(getattr(options, which).resolve(), options.tasks, options.seeds):
                found[which].append(row)
                solve = np.median(row["solves"][1:] or row["solves"])
                print(
                    f"{turn} {which} {row['task']:24} compile {row['compile']:6.1f} s  solve "
                    f"{solve:8.4f} s  success {np.mean(row['success']):.3f}",
                    flush=True,
                )
    for task in options.tasks:
        old, new = ([r for r in found[w] if r["task"] == task] for w in ("old", "new"))

        def median(rows: list[dict[str, Any]], name: str) -> float:
            values = [r[name] if name == "compile" else r[name][1:] or r[name] for r in rows]
            return float(np.median([np.median(value) for value in values]))

        ratios = {n: median(new, n) / median(old, n) for n in ("compile", "solves")}
        print(f"{task:26} new / old: compile {ratios['compile']:.3f}, solve {ratios['solves']:.3f}")
    print(f"written: {write_json(options.out, found)}")


if __name__ == "__main__":
    main()
