"""One pendulum on one CPU thread; `benchmark.one_thread` starts this in a process of its own.

The process binds itself to one core before jax starts its threads: `main` comes before any import
of it. Rows go to standard output, as one line of JSON.
"""

from __future__ import annotations

import json
import os
import sys


def main() -> None:
    """Arguments: the seed, then the numbers of chains."""
    seed, *chains = map(int, sys.argv[1:])
    if hasattr(os, "sched_setaffinity"):  # elsewhere than on Linux, only the settings below
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ |= {
        "JAX_PLATFORMS": "cpu",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false",
    }
    from mjx_drax import tasks
    from mjx_drax.search.restarts import Restarts
    from mjx_drax.studies.benchmark import has_casadi
    from mjx_drax.studies.measurements import STARTS, ipopt, ours

    problem, rows, median = tasks.load("pendulum").make(), [], None
    if has_casadi():
        rows.append(ipopt(problem, STARTS, seed))
        median = rows[0]["median_start_s"]
    for number in chains:
        rows.append(ours(problem, Restarts(), number, seed) | {"peer_median_s": median})
    print(json.dumps([row | {"solver": f"{row['solver']}, 1 thread"} for row in rows]))
