"""What a command is about: a task, or a model and a cost file of the user's."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, NamedTuple

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.cli import cost_file
from mjx_drax.cli.common import TASK, make

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem
    from mjx_drax.search.restarts import Restarts


class Asked(NamedTuple):
    """A problem, how to solve it, and by how many chains; `draw` draws what has no model."""

    problem: Problem
    solver: Restarts
    chains: int
    draw: Any


def add_problem(parser: argparse.ArgumentParser) -> None:
    """The task, or --model and --cost."""
    parser.add_argument("task", nargs="?", help=TASK)
    parser.add_argument("--model", metavar="XML", help="MJCF file of your own, with --cost")
    parser.add_argument("--cost", metavar="PY", help="Python file with the cost (see above)")


def require_known(options: argparse.Namespace) -> None:
    """Answer a wrong task's name at once, before heavy imports."""
    if options.task is not None:
        if options.task.endswith((".xml", ".urdf")):
            raise DraxError(
                f"{options.task!r} stands where a task's name does: give a model of your own as "
                f"--model {options.task}, with --cost PY."
            )
        tasks.full_name(options.task)


def asked(options: argparse.Namespace) -> Asked:
    """The named task, or the user's own problem, over its own horizon or that of the options."""
    from mjx_drax.search.restarts import Restarts

    if options.task is not None:
        if options.model or options.cost:
            raise DraxError(
                f"both the task {options.task!r} and --model or --cost are given: choose one."
            )
        task = tasks.load(options.task)
        chains, draw = getattr(task, "CHAINS", 64), getattr(task, "draw", None)
        return Asked(make(task, options.horizon), Restarts(), chains, draw)
    if options.model and options.cost:
        problem, solver = cost_file.load(options.model, options.cost, options.horizon)
        return Asked(problem, solver, 64, None)
    raise DraxError("give a task (see `mjx-drax list`), or both --model XML and --cost PY.")
