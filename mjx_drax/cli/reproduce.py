"""Make a figure or table of the paper again: writes NAME.png and NAME.json."""

from __future__ import annotations

import argparse

from mjx_drax.cli.common import at_least_1, say
from mjx_drax.studies import reproduce

__doc__ += "\n\n" + "\n".join(f"{name:24} {shows}" for name, shows in reproduce.NAMES.items())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which figure, its size, and where to."""
    add = parser.add_argument
    add("name", metavar="NAME", choices=reproduce.NAMES, help="one of the names above")
    add("--out", metavar="DIR", default="out/reproduce", help="default out/reproduce")
    add(
        "--chains",
        type=at_least_1,
        metavar="N",
        help="number of chains; parallel-table leaves out larger N",
    )
    add(
        "--iterations",
        type=at_least_1,
        metavar="K",
        help="number of iterations, instead of the usual one",
    )
    add(
        "--full",
        action="store_true",
        help="the sizes of the paper, for a GPU, where they are others; without it less than ten "
        "minutes on two CPU cores",
    )


def run(options: argparse.Namespace) -> int:
    """Make the figure, and print its table."""
    from mjx_drax.kernels.compilation import keep_programs

    keep_programs()
    sizes = options.chains, options.iterations, options.full
    numbers = reproduce.run(options.name, options.out, *sizes)
    from mjx_drax.studies.reproduce.output import table

    say(table(numbers))
    say(f"written to {options.out}/: {options.name}.png, {options.name}.json")
    return 0
