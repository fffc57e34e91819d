"""Write more files from a result that `mjx-drax solve` or Solution.save wrote into a folder."""

from __future__ import annotations

import argparse

from mjx_drax.base.errors import DraxError
from mjx_drax.cli import exports
from mjx_drax.cli.common import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder, and the files."""
    parser.add_argument("folder", metavar="DIR", help="such as out/cartpole_swingup")
    exports.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Write the files beside the result."""
    wanted = exports.chosen(options)
    if not wanted:
        flags = ", ".join(f"--{name}" for name in exports.exporters())
        raise DraxError(f"nothing to write: give at least one of {flags} or --export.")
    from mjx_drax.solution.save import writable
    from mjx_drax.solution.solution import Solution

    solution = Solution.load(options.folder)
    for each in wanted:
        each.check(solution.problem)
    folder = writable(options.folder)
    written = exports.write(solution, folder, wanted, say)
    say(f"written to {folder}/: {', '.join(written)}")
    return 0
