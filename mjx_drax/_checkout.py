"""Finds `mjx_drax.tasks` and `mjx_drax.models` in a checkout, where they lie beside the package.

An installed package holds them, and needs nothing of this.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

_ROOT = Path(__file__).resolve().parents[1]
_BESIDE = {f"mjx_drax.{name}": _ROOT / name for name in ("tasks", "models")}


class _Beside(MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        folder = _BESIDE.get(name)
        if folder is None or not (folder / "__init__.py").is_file():
            return None
        return spec_from_file_location(
            name, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )


sys.meta_path.append(_Beside())  # after the usual finders, so that what is installed comes first
