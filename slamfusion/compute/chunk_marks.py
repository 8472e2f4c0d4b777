"""Chunk marks: which parts of a drive hit a cell, which saw it, and what the others hit nearby.

A drive is cut into up to 32 chunks, and a cell keeps one bit for each: a word of ``hits`` has the
chunks whose beams ended in it, a word of ``seen`` those whose beams passed or ended in it. Without
the bits of a chunk the map is that of all others. The map is one page table (PH, PW) int32 and
pools (T, TILE, TILE) uint32; see ``slamfusion.compute.tiles``. Cells of pages without a tile stay
empty.

There is at least one beam and one page.

``kernels/chunk_marks.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import numpy as np

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import BEAM_HALF, BEAM_ONE, BEAM_SHIFT, FACINGS, FACINGS_ALIKE
from slamfusion.compute.tiles import tile_places, walk_cells
from slamfusion.geometry import I32, I64, U32

# Beams that are walked at once: each step of each is a row of some arrays.
BATCH = 4096


def _mark(pool: U32, places: tuple[I32 | I64, ...], bits: U32) -> None:
    has_tile = places[0] != 0
    np.bitwise_or.at(pool, tuple(part[has_tile] for part in places), bits[has_tile])


class ChunkMarkDevice(ArrayDevice):
    """A device that marks beams by chunk.

    On the device stay a map, ``hits`` (T, FACINGS, TILE, TILE) and ``seen`` (T, TILE, TILE) uint32
    behind ``pages`` (PH, PW) int32; the ``beams`` (B, BEAM_INTS) int32, x and y of the hit and of
    the laser in 1/1024 cell; the ``facings`` (B,) int32, 0 to ``FACINGS`` - 1, the directions that
    the hit surfaces face; and a word of bits for each beam, (B,) uint32.
    """

    def mark_chunks(
        self,
        hits: DeviceArray[np.uint32],
        seen: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        facings: DeviceArray[np.int32],
        bits: DeviceArray[np.uint32],
    ) -> None:
        """Mark beams with the bits of their chunks, in place.

        Every cell on the walk from a beam's end to the laser is seen, one cell of the longer axis a
        step; the cell of the end is also hit, on a surface that faces about the beam's direction.
        Cells of pages without a tile, and beyond the window, are left out.
        """
        if self.opencl:
            count, (height, width) = beams.shape[0], pages.shape
            self.opencl.launch(
                "mark_chunks", (count,), hits, seen, pages, width, height, beams, facings, bits,
                count,
            )  # fmt: skip
            return
        hits, seen, pages = host(hits), host(seen), host(pages)[None]
        beams, facings, bits = host(beams), host(facings), host(bits)
        end = beams[:, 1].astype(np.int64) >> BEAM_SHIFT, beams[:, 0].astype(np.int64) >> BEAM_SHIFT
        tile, row, col = tile_places(pages, 0, *end)
        side = FACINGS_ALIKE // 2
        for turn in range(-side, side + 1):
            _mark(hits, (tile, (facings + turn) % FACINGS, row, col), bits)
        for first in range(0, len(beams), BATCH):
            beam, row, col, _ = walk_cells(beams[first : first + BATCH])
            _mark(seen, tile_places(pages, 0, row, col), bits[first : first + BATCH][beam])

    def nearest_marks(
        self,
        hits: DeviceArray[np.uint32],
        seen: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        facings: DeviceArray[np.int32],
        left_out: DeviceArray[np.uint32],
        reach: int,
    ) -> I32:
        """Return the distance from each beam's end to the nearest hit of the counted chunks.

        Args:
            left_out: the bits that do not count for each beam.
            reach: cells around the end's own that are searched, 0 to 16: farther squares flow over.

        Returns:
            (B, 2) int32, on the host: the squared distance from the end to the centre of the
            nearest cell that was hit, in (1/1024 cell)^2, -1 where there is none within reach; and
            1 where the cell of the end was seen, else 0.
        """
        if self.opencl:
            count, (height, width) = beams.shape[0], pages.shape
            return self.opencl.launch_into(
                np.empty((count, 2), np.int32), "nearest_marks", (count,), hits, seen, pages, width,
                height, beams, facings, left_out, count, reach,
            )  # fmt: skip
        hits, seen, pages = host(hits), host(seen), host(pages)[None]
        beams, facings, left_out = host(beams), host(facings), host(left_out)
        x, y = beams[:, 0].astype(np.int64), beams[:, 1].astype(np.int64)
        col, row = x >> BEAM_SHIFT, y >> BEAM_SHIFT
        counted = ~left_out
        # Above any squared distance within reach.
        none = 2 * ((reach + 1) * BEAM_ONE) ** 2
        nearest = np.full(len(beams), none, dtype=np.int64)
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                tile, in_row, in_col = tile_places(pages, 0, row + dy, col + dx)
                is_hit = hits[tile, facings, in_row, in_col] & counted != 0
                gap_x = ((col + dx) << BEAM_SHIFT) + BEAM_HALF - x
                gap_y = ((row + dy) << BEAM_SHIFT) + BEAM_HALF - y
                squared = np.where(is_hit, gap_x * gap_x + gap_y * gap_y, none)
                np.minimum(nearest, squared, out=nearest)
        is_seen = seen[tile_places(pages, 0, row, col)] & counted != 0
        found = np.stack((np.where(nearest == none, -1, nearest), is_seen), axis=1)
        return np.asarray(found, dtype=np.int32)
