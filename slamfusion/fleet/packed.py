"""Values as they travel to tasks, and what a process keeps of those that came."""

from __future__ import annotations

import hashlib
import pickle
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar, cast

__all__ = ["Kept", "Packed", "pack"]

Value = TypeVar("Value")


@dataclass(frozen=True)
class Packed(Generic[Value]):
    """A value as it travels: maps shrink to some percent.

    Attributes:
        key: the same for the same value alone.
        data: the value, pickled and compressed.
    """

    key: str
    data: bytes

    def unpack(self) -> Value:
        """Return the value."""
        return cast("Value", pickle.loads(zlib.decompress(self.data)))  # noqa: S301 - our own


def pack(value: Value) -> Packed[Value]:
    """Return a value as it travels; arrays are contiguous."""
    plain = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    return Packed(hashlib.sha256(plain).hexdigest(), zlib.compress(plain, 1))


class Kept(Generic[Value]):
    """What was asked for last of what takes time to make."""

    def __init__(self, size_of: Callable[[Value], int], most: int, least: int = 0) -> None:
        """Take how much is kept.

        Args:
            size_of: tells the size of a value.
            most: the sizes of all together.
            least: values that are kept however large they are.
        """
        self._size_of, self._most, self._least = size_of, most, least
        self._values: OrderedDict[Hashable, Value] = OrderedDict()

    def __len__(self) -> int:
        """Return how many values are kept."""
        return len(self._values)

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return a value, made where it is not kept."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        return self._values[key]

    def shrink(self) -> None:
        """Let go of those not asked for longest, until the others are small enough."""
        kept = sum(map(self._size_of, self._values.values()))
        while kept > self._most and len(self._values) > self._least:
            _, gone = self._values.popitem(last=False)
            kept -= self._size_of(gone)
