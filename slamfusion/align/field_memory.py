"""Which of many maps hold what alignment looks at: those that were looked at last."""

from __future__ import annotations

from typing import Protocol

from slamfusion.io.memory import available_memory, return_freed_memory

# Maps that keep their fields however little memory is left: those of a usual job.
LEAST_KEPT = 3
# What the fields of a cell take, in bytes, and the share of the free memory that all may take; and
# how much at most where little memory is wanted, bytes.
FIELD_BYTES, FREE_SHARE = 40, 0.5
SPARING_BYTES = 2**28


class Fields(Protocol):
    """What can be computed again."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the map."""

    def release(self) -> None:
        """Let go of it."""


class FieldMemory:
    """Releases the fields of those maps of a job that were not looked at for longest."""

    def __init__(self, cells: int | None = None, *, is_sparing: bool = False) -> None:
        """Begin with none.

        Args:
            cells: of maps that may hold fields; None: as many as the memory that is free now lets.
            is_sparing: not more than some hundred megabytes, though more be free.
        """
        if cells is None:
            room = int(FREE_SHARE * available_memory())
            cells = (min(room, SPARING_BYTES) if is_sparing else room) // FIELD_BYTES
        self._most = cells
        self._used: dict[int, Fields] = {}

    def use(self, fields: Fields, *, is_more: bool) -> None:
        """Note that a map is looked at, and make room if it will hold more."""
        self._used.pop(id(fields), None)
        self._used[id(fields)] = fields
        if is_more:
            self._shrink()

    def forget(self, fields: Fields) -> None:
        """Note that a map holds nothing any more."""
        self._used.pop(id(fields), None)

    def _shrink(self) -> None:
        before = len(self._used)
        held = sum(_cells(fields) for fields in self._used.values())
        while held > self._most and len(self._used) > LEAST_KEPT:
            oldest = self._used.pop(next(iter(self._used)))
            held -= _cells(oldest)
            oldest.release()
        if len(self._used) < before:
            return_freed_memory()

    def clear(self) -> None:
        """Release everything."""
        while self._used:
            self._used.popitem()[1].release()


def _cells(fields: Fields) -> int:
    return fields.shape[0] * fields.shape[1]
