"""``Interrupt``: waits of a node's own thread that the end of the node interrupts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Interrupt:
    """One condition for everything that a thread waits for, the end of the node among it.

    Attributes:
        is_set: whether the node ends; waits end at once from then on.
    """

    def __init__(self) -> None:
        self.is_set = False
        self._changed = threading.Condition()

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Hold the lock in a ``with`` block, and wake whoever waits after it."""
        with self._changed:
            yield
            self._changed.notify_all()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock in a ``with`` block, to read what ``changing`` guards."""
        with self._changed:
            yield

    def set(self) -> None:
        """End all waits."""
        with self.changing():
            self.is_set = True

    def wait_for(self, is_true: Callable[[], bool], duration_s: float) -> bool:
        """Wait until something is true or the node ends; return whether either is so.

        Args:
            is_true: asked under the lock, again after each change.
            duration_s: wait no longer.
        """
        with self._changed:
            return self._changed.wait_for(lambda: self.is_set or is_true(), duration_s)

    def pause(self, duration_s: float) -> None:
        """Wait, but not beyond the end of the node."""
        self.wait_for(lambda: False, duration_s)
