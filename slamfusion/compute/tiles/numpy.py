"""The NumPy twins of the tile kernels: each function defines the kernel of its name, exactly."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

__all__ = [
    "copy_tiles",
    "extend",
    "take_tiles",
]

I32 = npt.NDArray[np.int32]
Scalar = TypeVar("Scalar", bound=np.generic)


def copy_tiles(pools: tuple[npt.NDArray[Any], ...], pairs: I32) -> None:
    """Copy tiles, in place.

    Args:
        pools: (T, TILE, TILE) each, of any dtype.
        pairs: (M, 2) int32, source and target; source 0 clears the target. Targets differ from
            each other and are no sources.
    """
    for pool in pools:
        pool[pairs[:, 1]] = pool[pairs[:, 0]]


def take_tiles(pool: npt.NDArray[Any], numbers: I32) -> npt.NDArray[Any]:
    """Fetch tiles of a pool.

    Args:
        pool: (T, TILE, TILE) of any dtype.
        numbers: (K,) int32, 0 to T - 1, on the host.

    Returns:
        (K, TILE, TILE), on the host.
    """
    return np.asarray(pool[numbers])


def extend(pool: npt.NDArray[Scalar], count: int, fill: int) -> npt.NDArray[Scalar]:
    """Return a longer copy of a pool.

    Args:
        pool: (T, ...) of any dtype.
        count: tiles of the copy, T or more.
        fill: value of the new tiles' cells.
    """
    grown = np.full((count, *pool.shape[1:]), fill, dtype=pool.dtype)
    grown[: len(pool)] = pool
    return grown
