"""Live progress of a solve, on standard error.

In a terminal or a notebook it is a line while it compiles, then a bar with the numbers that matter.
Elsewhere, as in the log of a cluster's job, it is a line a minute.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from mjx_drax.method.descent import Info
from mjx_drax.problem.tracing import require_functions
from mjx_drax.search.iterate import FEASIBLE

COMPILING = "{desc}: compiling, first iterations [{elapsed}]"
EVERY = 60.0
"""Seconds between two lines of a log; a solve that takes less writes none."""
FORMAT = "{l_bar}{bar}| {n_fmt}%s{total_fmt} [{elapsed}<{remaining}{postfix}]"


def reporting(
    progress: Callable[..., None] | bool | None, name: str
) -> AbstractContextManager[Callable[..., None] | None]:
    """A context that gives what is called with reports, or None if nothing is to be told.

    Args:
        progress: a function of the user's; True or False: with a `Bar` or without; None: with one
            where somebody watches, and else with `Lines`.
        name: what they call the problem.
    """
    if progress is None and sys.stderr is not None:
        return Bar(name) if watched() else Lines(name)
    if progress is True:
        return Bar(name)
    if progress is None or progress is False:
        return nullcontext()
    require_functions(progress=progress)
    return nullcontext(progress)


def watched() -> bool:
    """Whether standard error is a terminal or a notebook."""
    return sys.stderr is not None and (sys.stderr.isatty() or _in_notebook())


def _in_notebook() -> bool:
    """Whether this is the kernel of a notebook; nothing is imported to find out."""
    ipython: Any = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class _Progress:
    """Called as progress(done, total, info), or (done, total) for a batch's problems; a context."""

    def __init__(self, name: str) -> None:
        self._name, self._best = name, float("inf")

    def _numbers(self, info: Info) -> str:
        """The best cost so far, and how many chains are feasible."""
        feasible = np.asarray(info.max_defect) < FEASIBLE
        self._best = np.asarray(info.cost)[feasible].min(initial=self._best)
        if not np.isfinite(self._best):
            return "no feasible chain yet"
        return f"best cost {self._best:.4g}, feasible {feasible.mean():.0%}"


class Lines(_Progress):
    """A line a minute, written by a thread: how far the solve is, or that it compiles."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._now, self._ended = "compiling, first iterations", threading.Event()

    def __enter__(self) -> Lines:
        self._begun = time.monotonic()
        self._clock = threading.Thread(target=self._tick, daemon=True)
        self._clock.start()
        return self

    def _tick(self) -> None:
        while not self._ended.wait(EVERY):
            minutes, seconds = divmod(int(time.monotonic() - self._begun), 60)
            print(
                f"{self._name}: {self._now} [{minutes}:{seconds:02}]", file=sys.stderr, flush=True
            )

    def __call__(self, done: int, total: int, info: Info | None = None) -> None:
        """Keep how far the solve is, for the next line."""
        if info is None:
            self._now = f"{done}/{total}"
        else:
            self._now = f"iteration {done} of at most {total}, {self._numbers(info)}"

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._clock.join()


class Bar(_Progress):
    """A line while it compiles, then a bar.

    The time that compiling takes is shown once a second by a thread, if somebody watches.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._compiled = threading.Event()

    def __enter__(self) -> Bar:
        from tqdm import tqdm

        self._bar = tqdm(desc=self._name, file=sys.stderr, bar_format=COMPILING)
        self._clock = threading.Thread(target=self._tick, daemon=True)
        if watched():
            self._clock.start()
        return self

    def _tick(self) -> None:
        while not self._compiled.wait(1.0):
            self._bar.refresh()

    def _stop_clock(self) -> None:
        self._compiled.set()
        if self._clock.is_alive():
            self._clock.join()

    def __call__(self, done: int, total: int, info: Info | None = None) -> None:
        """Show how far the solve is."""
        bar = self._bar
        if not self._compiled.is_set():
            self._stop_clock()
            bar.bar_format = FORMAT % ("/" if info is None else " of at most ")
            bar.reset(total)
            bar.initial = done
        if info is not None:
            bar.set_postfix_str(self._numbers(info), False)
        bar.total = total  # grows with each further attempt
        bar.update(done - bar.n)

    def __exit__(self, *_: object) -> None:
        bar = self._bar
        self._stop_clock()
        # Nothing remains, whether fewer iterations were enough or Ctrl-C ended them.
        bar.bar_format = str(bar.bar_format).replace("<{remaining}", "")
        bar.refresh()
        bar.close()
