"""The exporters of the library; importing this module makes them known by their names.

What they write with is imported when it is needed, so that the command line lists them at once.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from mjx_drax.base.files import require
from mjx_drax.solution.export import Exporter

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem
    from mjx_drax.solution.solution import Solution


class _Written(Exporter):
    """An exporter that calls a function (solution, path)."""

    by: ClassVar[str]
    """The function's module in this package, and its name, MODULE:FUNCTION."""

    def write(self, solution: Solution, path: Path) -> None:
        """Write the file; see the function."""
        module, _, function = self.by.partition(":")
        getattr(import_module(f"mjx_drax.{module}"), function)(solution, path)


class Html(_Written):
    """The best chain's replay as one HTML file."""

    name, file, by = "html", "replay.html", "view.browser.page:save_html"
    summary = 'the replay for any browser, one file; pip install "mjx-drax[view]"'

    def check(self, problem: Problem) -> None:
        """Complain about a problem without a model, or if viser is not installed."""
        from mjx_drax.view.browser.scene import require_viewer

        require_viewer(problem)


class Csv(_Written):
    """The best chain's replay as a table."""

    name, file, by = "csv", "replay.csv", "solution.formats:save_csv"
    summary = "times, states and controls of the replay as a table"


class Keyframes(_Written):
    """The best chain's replay as MJCF."""

    name, file, by = "keyframes", "keyframes.xml", "solution.formats:export_keyframes"
    summary = "the model with the replay as keyframes, for MuJoCo's viewers"

    def check(self, problem: Problem) -> None:
        """Complain about a problem without MJCF."""
        from mjx_drax.solution.formats import mjcf_of

        mjcf_of(problem)


class Dataset(_Written):
    """The certified chains as HDF5."""

    name, file, by = "dataset", "dataset.h5", "solution.formats:save_dataset"
    summary = 'all certified chains as HDF5; pip install "mjx-drax[dataset]"'

    def check(self, problem: Problem) -> None:
        """Complain if h5py is not installed."""
        require("h5py", "dataset", "a dataset")
