"""One pendulum on one CPU thread: this solver with several numbers of chains, beside IPOPT.

All in one process, which binds itself to one core before jax starts its threads: `_main` comes
before any import of it. Rows go to standard output, as one line of JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from mjx_drax.base.errors import DraxError


def run(seed: int, chains: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of IPOPT's starts and of each number of chains, from a process of its own.

    `solver` gets the suffix ", 1 thread"; rows of this solver also say how long IPOPT's median
    start took, `peer_median_s`.
    """
    result = subprocess.run(
        [sys.executable, "-m", __name__, str(seed), *map(str, chains)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)},
        stdout=subprocess.PIPE,
        check=False,
    )
    if result.returncode:
        raise DraxError(
            f"the comparison on one thread failed with status {result.returncode}: see above."
        )
    rows: list[dict[str, Any]] = json.loads(result.stdout.splitlines()[-1])
    return rows


def _main() -> None:
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
    from mjx_drax.studies.measurements import STARTS, ipopt, ours
    from mjx_drax.studies.other_methods.ipopt import has_casadi

    problem, rows, median = tasks.load("pendulum").make(), [], None
    if has_casadi():
        rows.append(ipopt(problem, STARTS, seed))
        median = rows[0]["median_start_s"]
    for number in chains:
        rows.append(ours(problem, Restarts(), number, seed) | {"peer_median_s": median})
    print(json.dumps([row | {"solver": f"{row['solver']}, 1 thread"} for row in rows]))


if __name__ == "__main__":
    _main()
