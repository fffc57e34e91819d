"""Classes of users, by MODULE:CLASS."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from operator import attrgetter
from typing import Any

from mjx_drax.base.errors import DraxError, reason, shown


def imported(text: str) -> Any:
    """What MODULE:CLASS names, of a module that is installed or lies in the current folder."""
    module, _, name = text.partition(":")
    here = os.getcwd()
    own = here not in sys.path
    if own:
        sys.path.append(here)
    try:
        return attrgetter(name)(import_module(module))
    except Exception as failure:  # the user's module may raise anything
        raise DraxError(
            f"{shown(text)} cannot be imported: {reason(failure)}. Give MODULE:CLASS, of a module "
            "that is installed or lies in the current folder."
        ) from failure
    finally:
        if own:
            sys.path.remove(here)
