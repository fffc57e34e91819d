"""What several commands share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem

Tell = Callable[[str], None]

TASK = "a name from `mjx-drax list`, or the beginning of one, such as cartpole"


def at_least_1(text: str) -> int:
    """The type of an argument that counts something."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number of at least 1")
    return int(text)


def say(line: str) -> None:
    """Print one line, at once."""
    print(line, flush=True)


def say_aside(line: str) -> None:
    """Print one line that is no result, at once."""
    print(line, file=sys.stderr, flush=True)


def say_nothing(line: str) -> None:
    """Take the place of `say` where the user wants no lines."""


def make(task: ModuleType, horizon: float | None) -> Problem:
    """A task's problem, over its own horizon or one of so many seconds."""
    problem: Problem = task.make() if horizon is None else task.make(horizon=horizon)
    return problem
