"""List the tasks."""

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
    return 0
