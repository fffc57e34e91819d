"""What a task's own function draws on matplotlib axes, as frames; for problems without a model."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_drax.view.frames import Frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Draw = Callable[["Axes", np.ndarray], None]
"""draw(axes, states (k + 1, nx)) draws the motion x_0..x_k."""

_INCHES = 5.0  # height of a frame: sets the size of its letters


class Canvas:
    """A figure of so many pixels, which is drawn without a display.

    Attributes:
        figure: matplotlib's.
        agg: what it is drawn on.
    """

    def __init__(self, height: int, width: int, dpi: float | None = None, **options: Any) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        dpi = height / _INCHES if dpi is None else dpi
        self.figure = Figure(((width + 0.5) / dpi, (height + 0.5) / dpi), dpi, **options)
        self.agg = FigureCanvasAgg(self.figure)

    def pixels(self) -> Frame:
        """A copy of what has been drawn."""
        return np.array(self.agg.buffer_rgba())[..., :3]


def knot_at(times: np.ndarray, time: float) -> int:
    """The last knot that is reached at a time [s], of knots at times (T,)."""
    return int(np.searchsorted(times, time + 1e-9, side="right")) - 1
