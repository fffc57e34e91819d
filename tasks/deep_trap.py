"""Unicycle in a deeper trap: two metres of walls on both sides, so the way out costs far more.

IPOPT stays inside or ploughs through the wall (docs/compared.md); K = 119 leaves time to get out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mjx_drax import Problem
from mjx_drax.tasks import bug_trap

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WALL = np.array(
    [[x, y] for x in (-2.0, -1.5, -1.0, -0.5, 0.0) for y in (1.0, -1.0)]
    + [[0.0, 0.5], [0.0, 0.0], [0.0, -0.5]]
)
CHAINS = bug_trap.CHAINS


def make(horizon: float = 11.9) -> Problem:
    """From (-1, 0), inside the trap, to (1, 0); x = [x, y, heading], u = [speed, turn rate]."""
    return bug_trap.make(horizon, WALL, "deep_trap")


def draw(axes: Axes, states: np.ndarray) -> None:
    """Obstacles shaded, the goal as a star, and the motion (K + 1, 3) so far."""
    bug_trap.draw(axes, states, WALL)
