"""List the tasks.

The beginning of a name is enough, if no other name begins so: `mjx-drax solve cartpole`. Tasks
"from MJCF" have a model, which MuJoCo's C engine replays; the others have dynamics in Python.
"""

from __future__ import annotations

import argparse

from mjx_drax import tasks


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """There are none."""


def run(options: argparse.Namespace) -> int:
    """Print every task with the first line of its docstring."""
    width = max(map(len, tasks.names()))
    for name in tasks.names():
        print(f"{name:{width}}  {tasks.summary(name)}")
    print("\nThe beginning of a name is enough: mjx-drax solve cartpole")
    return 0
