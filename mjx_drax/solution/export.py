"""What writes a solution into a file of one format: a subclass of `Exporter`.

Those of the library are in `view.exporters`. Nothing heavy is imported here or there, so that the
help of the command line lists them at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mjx_drax.base.errors import DraxError, reason, shown
from mjx_drax.base.imports import imported

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem
    from mjx_drax.solution.solution import Solution


class NothingToExport(DraxError):
    """A solution holds nothing that this exporter could write; others may still write theirs."""


class Exporter:
    """Writes a solution into a file of one format; a subclass defines what is below.

    Attributes:
        name: by which the exporter is called; the last class that is defined with a name has it.
        file: name of the file, unless another one is asked for.
        summary: what the file holds, in a few words.
    """

    name: str = ""
    file: str = ""
    summary: str = ""

    def check(self, problem: Problem) -> None:
        """Complain before a solve about a problem whose solutions cannot be written.

        Raises:
            DraxError: naming what is missing, such as a package or the problem's model.
        """

    def write(self, solution: Solution, path: Path) -> None:
        """Write a solution; `base.files.complete` gives a file that appears once it is complete.

        Raises:
            NothingToExport: the solution holds nothing of what this file is for.
            DraxError: the file cannot be written.
        """
        raise NotImplementedError


def exporters() -> dict[str, Exporter]:
    """One exporter of each named subclass of `Exporter` in the modules imported so far, by name."""
    classes = Exporter.__subclasses__()
    for each in classes:  # the list grows: subclasses of subclasses too
        classes += each.__subclasses__()
    return {each.name: _made(each) for each in classes if each.name}


def exporter(text: str) -> Exporter:
    """The exporter of a name in `exporters`, or of a class given as MODULE:CLASS.

    Raises:
        DraxError: there is no such exporter, or its module or class cannot be used.
    """
    found = exporters()
    if text in found:
        return found[text]
    module, colon, name = text.partition(":")
    if not (module and colon and name):
        raise DraxError(
            f"there is no exporter {shown(text)}: give one of {', '.join(found)}, or a class of "
            "your own as MODULE:CLASS."
        )
    each = imported(text)
    if not (isinstance(each, type) and issubclass(each, Exporter)):
        raise DraxError(
            f"the exporter {shown(text)} is {shown(each)}: give a subclass of mjx_drax.Exporter."
        )
    return _made(each)


def _made(each: type[Exporter]) -> Exporter:
    """An exporter of a class, if the class defines all that it must."""
    missing = "file" if not each.file else "write(solution, path)"
    if not each.file or each.write is Exporter.write:
        raise DraxError(
            f"the exporter {each.__name__} has no {missing}: define it, as mjx_drax.Exporter says."
        )
    try:
        return each()
    except TypeError as failure:
        raise DraxError(
            f"the exporter {each.__name__} cannot be made: {reason(failure)}. Let its class take "
            "no arguments."
        ) from failure
