"""Rooms, the folders of this package, whose modules load when they are named."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from typing import Any

import lazy_loader


def by_name(room: str, folders: Iterable[str]) -> Any:
    """`__getattr__`, `__dir__` and `__all__` of a room, given its `__name__` and `__path__`."""
    modules = [module.name for module in pkgutil.iter_modules(folders)]
    return lazy_loader.attach(room, submodules=modules)
