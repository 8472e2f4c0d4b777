"""``CancelToken``: asked between the operations of a search whether to give it up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class _Finishes(Protocol):
    """A device that may take orders ahead."""

    def finish(self) -> object:
        """Wait until all orders are done."""


class CancelledSearchError(Exception):
    """A search was given up since something else waits; nothing of it was kept but features."""


class CancelToken:
    """Asks whether something else waits.

    An alignment of maps of 16 million cells takes half a second in two hundred operations, so
    what waits for it waits no longer than the longest of these. A device that takes orders ahead
    finishes them before each question, so that a search which goes on has nothing left to wait for.
    """

    def __init__(self, is_wanted: Callable[[], bool], device: _Finishes) -> None:
        """Ask ``is_wanted``; ``device`` does the operations of the search."""
        self._is_wanted = is_wanted
        self._device = device

    def check(self) -> None:
        """Return where the search may go on.

        Raises:
            CancelledSearchError: something else waits.
        """
        self._device.finish()
        if self._is_wanted():
            raise CancelledSearchError


def check_cancelled(cancel: CancelToken | None) -> None:
    """Return where a search may go on, as one without a token always may.

    Raises:
        CancelledSearchError: something else waits.
    """
    if cancel is not None:
        cancel.check()
