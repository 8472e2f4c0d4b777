"""How much packed data may unpack to: no log is a thousand times larger than its packed form."""

from __future__ import annotations

from slamfusion.errors import LogError
from slamfusion.io.memory import format_bytes

__all__ = ["BAG_FREE_BYTES", "BAG_RATIO", "TEXT_FREE_BYTES", "TEXT_RATIO", "UnpackBudget"]

# Logs of text pack to between a half and a fiftieth; deflate can do a thousandth.
TEXT_RATIO, TEXT_FREE_BYTES = 200, 2**22
# Bags of a robot that stands pack better, but bzip2 can do a millionth.
BAG_RATIO, BAG_FREE_BYTES = 2000, 2**26
UNPACKED_MAX = 2**34


class UnpackBudget:
    """Counts what is unpacked, and refuses what only a bomb unpacks to.

    Args:
        where: the file, for messages.
        ratio: so many times its packed size a file may unpack to.
        free_bytes: may come of any file.
    """

    def __init__(
        self, where: object, ratio: int = TEXT_RATIO, free_bytes: int = TEXT_FREE_BYTES
    ) -> None:
        self._where = where
        self._ratio = ratio
        self._free_bytes = free_bytes
        self._packed = 0
        self._unpacked = 0

    def allowed(self, packed_bytes: int) -> int:
        """Return how many bytes may come of the next ``packed_bytes``."""
        most = max(self._free_bytes, self._ratio * (self._packed + packed_bytes))
        return max(min(most, UNPACKED_MAX) - self._unpacked, 0)

    def spend(self, packed_bytes: int, unpacked_bytes: int) -> None:
        """Take note of bytes that were unpacked.

        Raises:
            LogError: they are more than were allowed.
        """
        if unpacked_bytes > self.allowed(packed_bytes):
            most = format_bytes(self._free_bytes)
            message = (
                f"{self._where}: unpacks to more than {self._ratio} times its size and {most}, or "
                f"to more than {format_bytes(UNPACKED_MAX)}, as no log does; check the file, or "
                "unpack it and give that"
            )
            raise LogError(message)
        self._packed += packed_bytes
        self._unpacked += unpacked_bytes
