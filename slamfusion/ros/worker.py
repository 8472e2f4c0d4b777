"""``Worker``: one thread that does the work of a node, so that its callbacks stay short."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Worker(Generic[T]):
    """A thread that takes items one by one, in order, from a queue that never grows.

    When the queue is full the oldest waiting item is dropped and counted: a robot's newest scan
    says most of where it is. What is being worked on is never dropped. An item that fails is
    reported and the next one is taken.

    Args:
        work: called in the thread with each item.
        capacity: items that may wait, at least 1; with 1 only the newest waits.
        on_error: called in the thread with the item and what its work raised.
        name: of the thread.

    Attributes:
        dropped: items dropped so far.
        done: items worked on so far, failed ones too.
        failed: items whose work raised.
    """

    def __init__(
        self,
        work: Callable[[T], None],
        capacity: int,
        on_error: Callable[[T, Exception], None],
        name: str = "worker",
    ) -> None:
        if capacity < 1:
            message = f"a worker's queue needs room for at least one item, found {capacity}"
            raise ValueError(message)
        self.dropped = 0
        self.done = 0
        self.failed = 0
        self._work = work
        self._on_error = on_error
        self._capacity = capacity
        self._waiting: deque[T] = deque()
        self._is_busy = False
        self._is_closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> list[T]:
        """Let an item wait for its turn; returns at once.

        Returns:
            What was dropped to make room: nothing, the oldest, or, after ``close``, the item.
        """
        with self._changed:
            if self._is_closed:
                return [item]
            lost = []
            while len(self._waiting) >= self._capacity:
                lost.append(self._waiting.popleft())
            self.dropped += len(lost)
            self._waiting.append(item)
            self._changed.notify_all()
            return lost

    def clear(self) -> list[T]:
        """Take away everything that waits (not counted as dropped), and return it."""
        with self._changed:
            taken = list(self._waiting)
            self._waiting.clear()
            self._changed.notify_all()
            return taken

    def resize(self, capacity: int) -> None:
        """Change how many items may wait; what is over is dropped with the next ``put``."""
        with self._changed:
            self._capacity = max(1, capacity)

    @property
    def waiting(self) -> int:
        """Items that wait now."""
        with self._changed:
            return len(self._waiting)

    @property
    def is_idle(self) -> bool:
        """Whether nothing waits and nothing is being worked on."""
        with self._changed:
            return not self._waiting and not self._is_busy

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until nothing waits and nothing is worked on; return whether that came."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._waiting and not self._is_busy, timeout_s
            )

    def close(self, timeout_s: float = 5.0) -> bool:
        """Drop what waits, let the current item end, and return whether the thread has ended."""
        with self._changed:
            self._is_closed = True
            self._waiting.clear()
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                item = self._waiting.popleft()
                self._is_busy = True
            try:
                self._work(item)
            except Exception as error:  # noqa: BLE001  (a node goes on; the error is named)
                self.failed += 1
                self._on_error(item, error)
            self.done += 1
