"""The command `mjx-drax`: a table of commands, a file each.

A command is a module: its docstring is the help, `add_arguments(parser)` adds its arguments, and
`run(options)` returns the exit status. Modules import what is heavy where they need it, so that
--help is instant.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from mjx_drax.base.errors import DraxError
from mjx_drax.base.version import __version__
from mjx_drax.cli import benchmark, check, export, list_tasks, mpc, reproduce, solve, view

COMMANDS = {
    "list": list_tasks,
    "check": check,
    "solve": solve,
    "mpc": mpc,
    "view": view,
    "export": export,
    "benchmark": benchmark,
    "reproduce": reproduce,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status is 0 if it did what was asked for, 1 or 2 if not."""
    parser = _parser()
    try:
        options = parser.parse_args(arguments)
        if options.run is None:  # no command
            parser.print_help()
            return 0
        status: int = options.run(options)
        sys.stdout.flush()
        return status
    except DraxError as error:
        print(f"mjx-drax: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mjx-drax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # who reads, such as head, has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mjx-drax",
        description="Finds motions for MuJoCo models: give a model and a cost, get a trajectory "
        "that MuJoCo can replay, and a video of it.",
        epilog="First try: mjx-drax solve cartpole. Help on a command: mjx-drax COMMAND --help.",
    )
    parser.add_argument("--version", action="version", version=f"mjx-drax {__version__}")
    parser.set_defaults(run=None)
    commands = parser.add_subparsers(metavar="COMMAND")
    for name, command in COMMANDS.items():
        words = command.__doc__ or ""
        child = commands.add_parser(
            name,
            help=words.split("\n")[0],
            description=words,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(child)
        child.set_defaults(run=command.run)
    return parser
