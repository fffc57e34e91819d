"""The flags that ask for more files, and what writes them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_drax.cli.common import Tell

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem
    from mjx_drax.solution.solution import Solution

EXPORTS = {
    "html": ("replay.html", 'the replay for any browser, one file; pip install "mjx-drax[html]"'),
    "csv": ("replay.csv", "times, states and controls of the replay as a table"),
    "keyframes": ("keyframes.xml", "the model with the replay as keyframes, for MuJoCo's viewers"),
    "dataset": ("dataset.h5", 'all certified chains as HDF5; pip install "mjx-drax[dataset]"'),
}
"""Flags, names of files and what they hold."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A flag for each file."""
    for name, (file, what) in EXPORTS.items():
        parser.add_argument(f"--{name}", action="store_true", help=f"write {file}: {what}")


def chosen(options: argparse.Namespace) -> list[str]:
    """Names of the files that are asked for."""
    return [name for name in EXPORTS if getattr(options, name)]


def require(problem: Problem, names: list[str]) -> None:
    """Refuse now what could not be written later."""
    from mjx_drax.base import files
    from mjx_drax.solution import export
    from mjx_drax.view import browser

    checks: dict[str, Callable[[], None]] = {
        "html": lambda: browser.require_viewer(problem),
        "keyframes": lambda: export.require_mjcf(problem),
        "dataset": lambda: files.require("h5py", "dataset", "a dataset"),
    }
    for name in names:
        checks.get(name, lambda: None)()


def write(solution: Solution, folder: Path, names: list[str], tell: Tell) -> list[str]:
    """Write the files that are asked for; returns their names."""
    from mjx_drax.solution import export
    from mjx_drax.view import browser

    writers: dict[str, Callable[[Solution, Path], Path]] = {
        "html": browser.save_html,
        "csv": export.save_csv,
        "keyframes": export.export_keyframes,
        "dataset": export.save_dataset,
    }
    written = []
    for name in names:
        if name == "dataset" and not solution.certified_chains.any():
            tell("no chain is certified: dataset.h5 is left out")
            continue
        writers[name](solution, folder / EXPORTS[name][0])
        written.append(EXPORTS[name][0])
    return written
