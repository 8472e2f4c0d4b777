"""Chunk marks: which parts of a drive hit a cell, which saw it, and what the others hit nearby.

A drive is cut into up to 32 chunks, and a cell keeps one bit for each: a word of ``hits`` says
which chunks' beams ended in it, a word of ``seen`` which passed or ended. One map then is, for each
chunk, the map of all others: leave its bits out. The map is one page table (PH, PW) int32 and pools
(T, TILE, TILE) uint32; see ``slamfusion.compute.tiles``. Cells of pages without a tile stay empty.

There is at least one beam and one page.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/chunk_marks.cl`` do it on a device.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray
from slamfusion.compute.layout import MARK_REACH_MAX
from slamfusion.errors import DeviceError

__all__ = ["ChunkMarkDevice", "check_mark_reach"]


def check_mark_reach(reach: int) -> None:
    """Refuse a reach that no kernel looks as far as.

    Raises:
        DeviceError: it is not within 0 to ``MARK_REACH_MAX`` cells.
    """
    if not 0 <= reach <= MARK_REACH_MAX:
        message = f"marks are looked for within 0 to {MARK_REACH_MAX} cells, asked for {reach}"
        raise DeviceError(message)


class ChunkMarkDevice(ArrayDevice, Protocol):
    """A device that marks beams by chunk; ``chunk_marks.numpy`` says what each operation does."""

    def mark_chunks(
        self,
        hits: DeviceArray[np.uint32],
        seen: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        facings: DeviceArray[np.int32],
        bits: DeviceArray[np.uint32],
    ) -> None:
        """See ``chunk_marks.numpy.mark_chunks``; works in place."""

    def nearest_marks(
        self,
        hits: DeviceArray[np.uint32],
        seen: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        facings: DeviceArray[np.int32],
        left_out: DeviceArray[np.uint32],
        reach: int,
    ) -> npt.NDArray[np.int32]:
        """See ``chunk_marks.numpy.nearest_marks``."""
