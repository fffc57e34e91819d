"""Write more files from a result that `mjx-drax solve` or Solution.save wrote into a folder."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_drax.base.errors import DraxError
from mjx_drax.cli.common import Tell, say
from mjx_drax.solution.export import Exporter, NothingToExport, exporter, exporters
from mjx_drax.view import exporters as _more  # noqa: F401  # to import it makes its exporter known

if TYPE_CHECKING:
    from mjx_drax.solution.solution import Solution


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder, and the files."""
    parser.add_argument("folder", metavar="DIR", help="such as out/cartpole_swingup")
    add_flags(parser)


def run(options: argparse.Namespace) -> int:
    """Write the files beside the result; the status is 1 if some of them cannot be."""
    wanted = chosen(options)
    if not wanted:
        flags = ", ".join(f"--{name}" for name in exporters())
        raise DraxError(f"nothing to write: give at least one of {flags} or --export.")
    from mjx_drax.solution.files.save import writable
    from mjx_drax.solution.solution import Solution

    solution = Solution.load(options.folder)
    possible, refused = [], []
    for each in wanted:
        try:
            each.check(solution.problem)
        except DraxError as error:
            refused.append(f"{each.file}: {error}")
        else:
            possible.append(each)
    if not possible:
        raise DraxError(" ".join(refused))
    folder = writable(options.folder)
    for words in refused:
        say(f"left out: {words}")
    say(f"written to {folder}/: {', '.join(write(solution, folder, possible, say))}")
    return 1 if refused else 0


def add_flags(parser: argparse.ArgumentParser) -> None:
    """A flag for every exporter, and one for the user's own; `solve` has them too."""
    for name, each in exporters().items():
        parser.add_argument(
            f"--{name}",
            dest="exports",
            action="append_const",
            const=name,
            help=f"write {each.file}: {each.summary}",
        )
    parser.add_argument(
        "--export",
        dest="exports",
        action="append",
        metavar="MODULE:CLASS",
        help="write with an exporter of your own, a subclass of mjx_drax.Exporter; may be repeated",
    )
    parser.set_defaults(exports=[])


def chosen(options: argparse.Namespace) -> list[Exporter]:
    """The exporters that are asked for, each once."""
    return [exporter(text) for text in dict.fromkeys(options.exports)]


def write(solution: Solution, folder: Path, wanted: Sequence[Exporter], tell: Tell) -> list[str]:
    """Write the files that are asked for; returns their names."""
    written = []
    for each in wanted:
        try:
            each.write(solution, folder / each.file)
        except NothingToExport as reason:
            tell(f"{each.file} is left out: {reason}")
        else:
            written.append(each.file)
    return written
