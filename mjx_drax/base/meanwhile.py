"""Settings of the whole process that are others for a while."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Generic, TypeVar

Before = TypeVar("Before")


class Meanwhile(Generic[Before]):
    """A change of the process that lasts while at least one thread is inside.

    The first one that comes makes it, and the last one that goes takes it back. A call is a
    context, and a decorator.

    Args:
        change: makes the change, and returns what was before.
        restore: takes what was before.
    """

    def __init__(self, change: Callable[[], Before], restore: Callable[[Before], object]) -> None:
        self._change, self._restore = change, restore
        self._lock, self._inside = Lock(), 0
        self._before: list[Before] = []  # empty, or of one

    @property
    def lasts(self) -> bool:
        """Whether anyone is inside."""
        return self._inside > 0

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Be inside."""
        with self._lock:
            if not self._inside:
                self._before = [self._change()]
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    self._restore(self._before.pop())
