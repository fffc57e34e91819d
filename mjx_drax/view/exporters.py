"""The exporters of the library; importing this module makes them known by their names.

What they write with is imported when it is needed, so that the command line lists them at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mjx_drax.base.files import require
from mjx_drax.solution.export import Exporter

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem
    from mjx_drax.solution.solution import Solution


class Html(Exporter):
    """The best chain's replay as one HTML file."""

    name, file = "html", "replay.html"
    summary = 'the replay for any browser, one file; pip install "mjx-drax[view]"'

    def check(self, problem: Problem) -> None:
        """Complain about a problem without a model, or if viser is not installed."""
        from mjx_drax.view.browser.scene import require_viewer

        require_viewer(problem)

    def write(self, solution: Solution, path: Path) -> None:
        """Write the page; see `browser.page.save_html`."""
        from mjx_drax.view.browser.page import save_html

        save_html(solution, path)


class Csv(Exporter):
    """The best chain's replay as a table."""

    name, file = "csv", "replay.csv"
    summary = "times, states and controls of the replay as a table"

    def write(self, solution: Solution, path: Path) -> None:
        """Write the table; see `formats.save_csv`."""
        from mjx_drax.solution.formats import save_csv

        save_csv(solution, path)


class Keyframes(Exporter):
    """The best chain's replay as MJCF."""

    name, file = "keyframes", "keyframes.xml"
    summary = "the model with the replay as keyframes, for MuJoCo's viewers"

    def check(self, problem: Problem) -> None:
        """Complain about a problem without MJCF."""
        from mjx_drax.solution.formats import mjcf_of

        mjcf_of(problem)

    def write(self, solution: Solution, path: Path) -> None:
        """Write the model; see `formats.export_keyframes`."""
        from mjx_drax.solution.formats import export_keyframes

        export_keyframes(solution, path)


class Dataset(Exporter):
    """The certified chains as HDF5."""

    name, file = "dataset", "dataset.h5"
    summary = 'all certified chains as HDF5; pip install "mjx-drax[dataset]"'

    def check(self, problem: Problem) -> None:
        """Complain if h5py is not installed."""
        require("h5py", "dataset", "a dataset")

    def write(self, solution: Solution, path: Path) -> None:
        """Write the chains; see `formats.save_dataset`."""
        from mjx_drax.solution.formats import save_dataset

        save_dataset(solution, path)
