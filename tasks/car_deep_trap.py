"""Car gets out of a deeper trap, from MJCF: two metres of walls on both sides."""

from __future__ import annotations

from mjx_drax import Problem
from mjx_drax.tasks import car_bug_trap, deep_trap

CHAINS = 96


def make(horizon: float = 14.0) -> Problem:
    """From inside the trap to rest at the goal behind it."""
    return car_bug_trap.make(horizon, "car_deep_trap", deep_trap.WALL)
