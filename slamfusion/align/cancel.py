"""Give up a search between two operations of the device, since something else waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
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


_TOKEN: ContextVar[CancelToken | None] = ContextVar("cancel", default=None)


@contextmanager
def watched_by(cancel: CancelToken | None) -> Iterator[None]:
    """Ask a token before each operation of the block; None: ask as around the block."""
    outer = _TOKEN.set(cancel or _TOKEN.get())
    try:
        yield
    finally:
        _TOKEN.reset(outer)


def check_cancelled() -> None:
    """Return where a search may go on, as one that no token watches always may.

    Raises:
        CancelledSearchError: something else waits.
    """
    token = _TOKEN.get()
    if token is not None:
        token.check()
