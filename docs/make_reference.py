"""Writes the reference with pdoc: python docs/make_reference.py FOLDER, or ./drax docs.

The page of `mjx_drax` holds all public names; every module of every room has a page of its own.
"""

import sys
from pathlib import Path
from pkgutil import iter_modules

import pdoc

import mjx_drax


def write(folder: Path) -> Path:
    """The reference as HTML; gives its first page."""
    # Public names are imported when they are first used: pdoc sees only what is there.
    vars(mjx_drax).update({name: getattr(mjx_drax, name) for name in mjx_drax.__all__})
    rooms = [f"mjx_drax.{room.name}" for room in iter_modules(mjx_drax.__path__) if room.ispkg]
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc("mjx_drax", *rooms, output_directory=folder)
    return folder / "mjx_drax.html"


if __name__ == "__main__":
    print(write(Path(sys.argv[1])))
