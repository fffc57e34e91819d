"""Measure success and time, alone or beside other methods.

Tasks are solved for several seeds. A table is printed; benchmark.json (a list of rows) and
benchmark.png (success against time) are written. The suites:

  cpu          every task, and one pendulum on one thread beside IPOPT
  gpu          more chains, and 16,384 random pendulums
  devices      one solve on 1, 2, 4, ... devices
  peers        ablations, IPOPT, MPPI, CEM and model-based diffusion
  convergence  iterations from one guess to a tolerance of 1e-8, in float64 beside IPOPT; textbook
               problems and programs besides tasks; writes convergence.json

IPOPT needs pip install "mjx-drax[peers]". The exit status is 0 if all rows of this solver are
certified; of the suite convergence it is 0.
"""

from __future__ import annotations

import argparse

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.cli.common import at_least_1, say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which tasks, how often, and where to."""
    add = parser.add_argument
    add("tasks", nargs="*", metavar="TASK", help="default: all of them")
    add("--suite", metavar="SUITE", help="default: each task as it is, alone")
    add("--seeds", type=int, nargs="+", metavar="S", help="default 0 1 2")
    add("--chains", type=at_least_1, metavar="N", help="default: each task's, or the suite's")
    add("--out", metavar="DIR", default="out/benchmark", help="default out/benchmark")


def run(options: argparse.Namespace) -> int:
    """Print each row as it is ready, and save them all."""
    names = options.tasks
    if options.suite is None:
        names = [tasks.full_name(name) for name in names]  # answers at once, before heavy imports
    from mjx_drax.solution.files.save import writable
    from mjx_drax.studies import benchmark
    from mjx_drax.studies.convergence import suite

    if options.suite == suite.NAME:
        if options.seeds or options.chains:
            raise DraxError(
                f"the suite {suite.NAME} solves from one guess, by one chain, without noise: leave "
                "--seeds and --chains."
            )
        suite.run(names, writable(options.out, file="convergence.json"), say)
        return 0
    benchmark.check(names, options.suite)
    folder = writable(options.out, file="benchmark.json")
    say(benchmark.HEADER)
    rows = benchmark.run(
        names,
        options.seeds or [0, 1, 2],
        options.chains,
        options.suite,
        report=lambda row: say(benchmark.line(row)),
    )
    if options.suite in ("cpu", "gpu") and not benchmark.has_casadi():
        say('IPOPT is left out: it needs pip install "mjx-drax[peers]".')
    say(f"written to {', '.join(map(str, benchmark.save(rows, folder)))}")
    return 0 if benchmark.certified(rows) else 1
