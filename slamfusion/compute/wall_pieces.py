"""Pieces of wall: what each piece of one map meets on another under a rigid motion.

``kernels/wall_pieces.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.lattice import cells_at, fixed_cells
from slamfusion.compute.layout import FACING_PARTS, FIELD_ONE, FREE, OPPOSED_PARTS, PIECE_LANES, RUN
from slamfusion.geometry import B8, F64, I32, I64, U8, U16


def is_another(own: U8 | I64, other: U8 | I64, turn: int) -> B8:
    """Return (N,) whether two walls were seen from opposite sides; 0 is an unknown facing.

    The own ones are turned by ``turn``, in parts of a turn.
    """
    apart = (own.astype(np.int64) + turn - other) & (FACING_PARTS - 1)
    is_far = (apart >= OPPOSED_PARTS) & (apart <= FACING_PARTS - OPPOSED_PARTS)
    return np.asarray((own != 0) & (other != 0) & is_far)


class PointPieces(NamedTuple):
    """Points of a map on the device, piece by piece.

    Attributes:
        points: (3, N + ``PIECE_LANES``) int32: x and y in half cells, and what each point faces
            (see ``layout.FACES``); the last ones are read and do not count.
        starts: (B + 1,) int32 the first point of each piece, and N.
    """

    points: DeviceArray[np.int32]
    starts: DeviceArray[np.int32]


def piece_points(points: I32, facing: U8, starts: I32, device: ArrayDevice) -> PointPieces:
    """Bring points (N, 2) and what they face (N,), piece by piece, to the device."""
    planes = np.zeros((3, len(points) + PIECE_LANES), np.int32)
    planes[:2, : len(points)], planes[2, : len(points)] = points.T, facing
    return PointPieces(device.upload(planes), device.upload(starts))


class PieceSide(NamedTuple):
    """Pieces of one map on the other.

    Attributes:
        pieces: of the one.
        motions: (4, P) as of ``search.ScoredSide``, points to cells; they enlarge less than twice.
        words: (H, W) uint32 of the other, see ``piece_words``.
        base: worth of a cell that says nothing.
    """

    pieces: PointPieces
    motions: F64
    words: DeviceArray[np.uint32]
    base: int

    def poses(self) -> tuple[I64, I32]:
        """Return (P, 4) int64 fixed poses, and (P,) how far they turn, in parts of a turn."""
        turns = np.arctan2(self.motions[1], self.motions[0]) * (FACING_PARTS / (2.0 * math.pi))
        return self.motions.T.astype(np.int64), np.rint(turns).astype(np.int32)


class WallPieceDevice(ArrayDevice):
    """A device that looks up pieces of wall."""

    def piece_words(
        self,
        distance2: DeviceArray[np.uint16],
        cells: DeviceArray[np.int8],
        facing: DeviceArray[np.uint8],
        worths: U16,
        *,
        base: int,
        span: int,
        near2: int,
    ) -> DeviceArray[np.uint32]:
        """Return (H, W) uint32 all that a piece looks up in a cell.

        Args:
            distance2: (H, W) uint16. cells: (H, W) int8; seen are known cells, and cells within
                ``near2`` of a wall.
            facing: (H, W) uint8 what each cell faces.
            worths: of a wall, as of ``score_field``.
            base, span: worth of a cell that says nothing, and the most above it of a known one.

        Returns:
            The worth of a wall, above 8 bits 1 where seen, above 16 the most that it could be,
            above 24 the facing.
        """
        if self.opencl:
            return self.opencl.launch_new(
                cells.shape, np.uint32, "piece_words", (-(-cells.size // RUN),), distance2, cells,
                facing, self.upload(worths), base, span, near2, cells.size,
            )  # fmt: skip
        distance2, cells = host(distance2), host(cells)
        worth = worths[distance2].astype(np.int32)
        worth = base + (worth & 255) - (cells == FREE) * (worth >> 8)
        field, known = np.clip(worth, 0, FIELD_ONE).astype(np.uint32), cells >= 0
        seen = known | (distance2 <= near2)
        could = np.where(known, np.uint32(span), field - np.uint32(base)) & np.uint32(255)
        facing = host(facing).astype(np.uint32)
        return np.asarray(field | seen << np.uint32(8) | could << 16 | facing << 24, np.uint32)

    def start_piece_sums(self, *sides: PieceSide, sided: bool) -> Callable[[], list[I32]]:
        """Start to sum what the points of each piece meet under each motion, of each side.

        A wall that the field has, but that was seen from another side, meets nothing if ``sided``;
        nor does a point off the field.

        Returns:
            A function that waits for the sums, and returns (3, P, B) int32 of each side: the field
            less ``base``, the most that it could be, and points in seen cells.
        """
        if not self.opencl:
            return lambda: [_piece_sums(side, sided=sided) for side in sides]
        started = []
        for side in sides:
            (points, starts), _, words, base = side
            poses, turns = side.poses()
            pieces, n = starts.shape[0] - 1, len(poses)
            sums = self.opencl.start_into(
                np.empty((3, n, pieces), np.int32), "piece_sums", (n, pieces), points,
                points.shape[1], starts, pieces, int(sided), self.upload(poses),
                self.upload(turns), n, words, *words.shape, base,
            )  # fmt: skip
            started.append(sums)
        return lambda: [sums() for sums in started]


def _piece_sums(side: PieceSide, *, sided: bool) -> I32:
    """Return what one side gives; see ``WallPieceDevice.start_piece_sums``."""
    starts, words = host(side.pieces.starts), host(side.words).astype(np.int64)
    (poses, turns), count = side.poses(), len(starts) - 1
    piece = np.repeat(np.arange(count), np.diff(starts))
    out = np.zeros((3, len(poses), count), dtype=np.int32)
    x2, y2, sides = host(side.pieces.points)[:, : starts[-1]].astype(np.int64)
    for p, (pose, turn) in enumerate(zip(poses, turns, strict=True)):
        word = cells_at(words, *fixed_cells(pose, x2, y2), side.base)
        value = (word & 255) - side.base
        tells = ~((value > 0) & sided & is_another(sides, word >> 24, int(turn)))
        # Whole numbers below 2^53 are exact in the float64 that bincount adds.
        for sums, part in zip(out, (value, word >> 16 & 255, word >> 8 & 1), strict=True):
            sums[p] = np.bincount(piece, part * tells, count)
    return out
