"""A progress bar with the two numbers that matter: best feasible cost, share feasible."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tqdm import tqdm

    from mjx_drax.method.descent import Info

FORMAT = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"


class Bar:
    """What `solve` calls as progress(done, total, info); closes as a context."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._best = float("inf")

    def __enter__(self) -> Bar:
        return self

    def __call__(self, done: int, total: int, info: Info) -> None:
        """Show how far the solve is."""
        import numpy as np
        from tqdm import tqdm

        from mjx_drax.search.iterate import FEASIBLE

        if self._bar is None:  # only now: before, it would count compilation as progress
            self._bar = tqdm(total=total, initial=done, file=sys.stderr, bar_format=FORMAT)
        feasible = np.asarray(info.max_defect) < FEASIBLE
        self._best = np.asarray(info.cost)[feasible].min(initial=self._best)
        numbers = f"best cost {self._best:.4g}, feasible {feasible.mean():.0%}"
        self._bar.set_postfix_str(numbers, False)
        self._bar.update(done - self._bar.n)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.total = self._bar.n  # fewer iterations than expected were enough
            self._bar.refresh()
            self._bar.close()
