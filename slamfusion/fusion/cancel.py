"""``Pausable``: a device whose work is given up, between two operations, when something waits."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from slamfusion.compute import ComputeDevice

__all__ = ["Pausable", "PausedError"]


class PausedError(Exception):
    """Work was given up since something else waits; nothing of it was kept but features."""


class Pausable:
    """A device that asks, inside of ``until``, before each operation whether to give up.

    An alignment of maps of 16 million cells takes half a second in two hundred operations, so
    what waits for it waits no longer than the longest of these: a device that takes orders ahead
    finishes each before the next is given.
    """

    def __init__(self, device: ComputeDevice) -> None:
        """Start without asking; ``device`` does the operations."""
        self._device = device
        self._is_wanted: Callable[[], bool] | None = None
        self._finish: Callable[[], None] | None = getattr(device, "finish", None)

    @contextlib.contextmanager
    def until(self, is_wanted: Callable[[], bool] | None) -> Iterator[None]:
        """Raise ``PausedError`` from the next operation once ``is_wanted`` answers True."""
        before, self._is_wanted = self._is_wanted, is_wanted
        try:
            yield
        finally:
            self._is_wanted = before

    def __getattr__(self, name: str) -> Any:
        """Return an operation of the device."""
        if self._is_wanted is not None:
            if self._finish is not None:
                self._finish()
            if self._is_wanted():
                raise PausedError
        return getattr(self._device, name)
