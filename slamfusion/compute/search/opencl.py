"""Scoring of motions on an OpenCL device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.lattice import narrow_motions
from slamfusion.compute.layout import (
    COUNT_TERMS,
    REFINE_TERMS,
    SHIFT_LANES,
    SHIFT_POINTS,
    SHIFT_ROWS,
    SHIFT_TILE,
)
from slamfusion.compute.opencl_queue import OpenCLQueue
from slamfusion.compute.search import FitSide, ScoredSide
from slamfusion.errors import DeviceError

__all__ = ["OpenCLSearch"]

# Points, cells and rows that one work item sums, one after the other; the host adds the sums.
CHUNK_POINTS = 64
CHUNK_SCORED = 512
CHUNK_CELLS = 4096
CHUNK_ROWS = 16
# Points that `pose_scores` moves at once; its rows of points start at multiples of it.
POINT_LANES = 8


class OpenCLSearch(OpenCLQueue):
    """The operations of ``SearchDevice`` on one OpenCL device."""

    def confusion(self, a: DeviceArray[np.int8], b: DeviceArray[np.int8]) -> npt.NDArray[np.int64]:
        """See ``search.numpy.confusion``."""
        chunks = -(-a.size // CHUNK_CELLS)
        partial = self.empty((chunks, 9), np.int32)
        sizes = (np.int32(a.size), np.int32(CHUNK_CELLS))
        self._launch("confusion", (chunks,), a, b, *sizes, partial)
        return np.asarray(self.download(partial).sum(axis=0, dtype=np.int64)).reshape(3, 3)

    def squared_error(
        self,
        a: DeviceArray[np.int8],
        b: DeviceArray[np.int8],
        poses: npt.NDArray[np.int64],
        stride: int,
    ) -> npt.NDArray[np.int64]:
        """See ``search.numpy.squared_error``."""
        chunks = -(-a.shape[0] // (stride * CHUNK_ROWS))
        partial = self.empty((len(poses), chunks), np.int32)
        own = [np.int32(v) for v in a.shape]
        other = [np.int32(v) for v in b.shape]
        sizes = [np.int32(v) for v in (len(poses), stride, CHUNK_ROWS, chunks)]
        fixed = self.upload(poses)
        self._launch(
            "squared_error", (chunks, len(poses)), a, *own, b, *other, fixed, *sizes, partial
        )
        return np.asarray(self.download(partial).sum(axis=1, dtype=np.int64))

    def correlate(
        self,
        fields: DeviceArray[np.uint8],
        offsets: npt.NDArray[np.int32],
        shift_shape: tuple[int, int],
        spans: npt.NDArray[np.int32] | None = None,
        base: int = 0,
    ) -> DeviceArray[np.int32]:
        """See ``search.numpy.correlate``."""
        planes, field_height, field_width = fields.shape
        count = max(planes, len(offsets))
        height, width = shift_shape
        if width % SHIFT_LANES:
            message = f"shifts along a row must come in multiples of {SHIFT_LANES}, found {width}"
            raise DeviceError(message)
        scores = self.empty((count, height, width), np.int32)
        points = offsets.shape[1]
        field_stride = np.int32(field_height * field_width if planes > 1 else 0)
        offset_stride = np.int32(points if len(offsets) > 1 else 0)
        if spans is None:
            everywhere = (0, height - 1, 0, width - 1)
            spans = np.full((count, -(-points // SHIFT_POINTS), 4), everywhere, dtype=np.int32)
        self._launch(
            "correlate",
            (width // SHIFT_LANES, -(-height // SHIFT_ROWS), count),
            fields,
            field_stride,
            np.int32(field_width),
            self.upload(offsets),
            offset_stride,
            np.int32(points),
            self.upload(spans),
            np.int32(base),
            np.int32(height),
            np.int32(width),
            np.int32(count),
            scores,
        )
        return scores

    def polyphase(
        self,
        field: DeviceArray[np.uint8],
        corner: tuple[int, int],
        step: int,
        shape: tuple[int, int],
        fill: int,
    ) -> DeviceArray[np.uint8]:
        """See ``search.numpy.polyphase``."""
        out = self.empty((step, step, *shape), np.uint8)
        sizes = [np.int32(v) for v in (*field.shape, *corner, step, *shape)]
        size = (shape[0], step * step)
        self._launch("polyphase", size, field, *sizes, np.uint8(fill), out)
        return out

    def bound_blocks(
        self,
        blocks: npt.NDArray[np.int32],
        starts: DeviceArray[np.int32],
        classes: npt.NDArray[np.uint8],
        fields: DeviceArray[np.uint8],
        fill: int,
        *,
        least: int = -1,
    ) -> npt.NDArray[np.int32]:
        """See ``search.numpy.bound_blocks``."""
        bounds = np.empty(len(blocks), dtype=np.int32)
        out = self.wrap_host(bounds, writable=True)
        _, height, width = fields.shape
        self._launch(
            "bound_blocks",
            (len(blocks),),
            self.wrap_host(blocks),
            np.int32(len(blocks)),
            starts,
            self.wrap_host(classes),
            np.int32(len(classes)),
            fields,
            np.int32(height),
            np.int32(width),
            np.uint8(fill),
            np.int32(least),
            out,
        )
        self.map_host(out, bounds)
        return bounds

    def tile_peaks(
        self, forward: DeviceArray[np.int32], backward: DeviceArray[np.int32], width: int
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """See ``search.numpy.tile_peaks``."""
        count, height, stride = forward.shape
        tiles_y, tiles_x = -(-height // SHIFT_TILE), -(-width // SHIFT_TILE)
        values = self.empty((count, tiles_y, tiles_x), np.int32)
        places = self.empty((count, tiles_y, tiles_x), np.int32)
        sizes = [np.int32(v) for v in (height, width, stride, count, tiles_y, tiles_x)]
        size = (-(-width // (2 * SHIFT_TILE)), tiles_y, count)
        self._launch("tile_peaks", size, forward, backward, *sizes, values, places)
        return self.download(values), self.download(places)

    def pose_counts(
        self,
        points: npt.NDArray[np.int32],
        poses: npt.NDArray[np.int64],
        field: DeviceArray[np.uint8],
        distance2: DeviceArray[np.uint16],
        free_cell: DeviceArray[np.uint8],
        *,
        base: int,
        near2: int,
        far2: int,
    ) -> npt.NDArray[np.int64]:
        """See ``search.numpy.pose_counts``."""
        count, n = len(points), len(poses)
        chunks = -(-count // CHUNK_POINTS)
        partial = self.empty((n, chunks, COUNT_TERMS), np.int32)
        height, width = field.shape
        sizes = [np.int32(v) for v in (height, width, base, near2, far2, CHUNK_POINTS, chunks)]
        self._launch(
            "pose_counts",
            (chunks, n),
            self.upload(points),
            np.int32(count),
            self.upload(poses),
            np.int32(n),
            field,
            distance2,
            free_cell,
            *sizes,
            partial,
        )
        return np.asarray(self.download(partial).sum(axis=1, dtype=np.int64))

    def pose_scores(self, *sides: ScoredSide) -> list[npt.NDArray[np.int64]]:
        """See ``search.numpy.pose_scores``."""
        # All are started before the first is waited for.
        started = [self._start_scores(side) for side in sides]
        return [np.asarray(self.download(sums).sum(axis=0, dtype=np.int64)) for sums in started]

    def _start_scores(self, side: ScoredSide) -> DeviceArray[np.int32]:
        """Start to score one side; return (chunks, P) sums, one row for each chunk of points."""
        count, n = len(side.points), len(side.poses)
        chunks = -(-count // CHUNK_SCORED)
        stride = -(-count // POINT_LANES) * POINT_LANES
        planes = np.zeros((2, stride), np.int32)
        near, narrow, shift = narrow_motions(side.points, side.poses)
        planes[:, :count] = near.T
        partial = self.empty((chunks, n), np.int32)
        before = [np.int32(v) for v in (count, stride)]
        sizes = [np.int32(v) for v in (*side.field.shape, side.base, CHUNK_SCORED, chunks)]
        self._launch(
            "pose_scores",
            (chunks * n,),
            self.upload(planes),
            *before,
            self.upload(narrow),
            np.int32(n),
            np.int32(shift),
            side.field,
            *sizes,
            partial,
        )
        return partial

    def refine_terms(
        self,
        forward: FitSide,
        backward: FitSide,
        *,
        scales: npt.NDArray[np.float32],
        centre: tuple[float, float],
    ) -> npt.NDArray[np.float64]:
        """See ``search.numpy.refine_terms``."""
        n = len(forward.poses)
        sides, chunks = [], []
        for side in (forward, backward):
            count = side.points.shape[0]
            sizes = [np.int32(v) for v in side.distance.shape]
            poses = self.upload(side.poses)
            sides += [side.points, np.int32(count), poses, side.distance, *sizes]
            chunks.append(-(-count // CHUNK_POINTS))
        partial = self.empty((sum(chunks), n, REFINE_TERMS), np.float32)
        middle = [np.float32(v) for v in centre]
        counts = [np.int32(v) for v in (CHUNK_POINTS, chunks[0], sum(chunks))]
        self._launch(
            "refine_terms",
            (sum(chunks), n),
            *sides,
            np.int32(n),
            self.upload(scales),
            *middle,
            *counts,
            partial,
        )
        parts = self.download(partial)
        ahead, back = parts[: chunks[0]], parts[chunks[0] :]
        return np.asarray(ahead.sum(axis=0, dtype=np.float64) + back.sum(axis=0, dtype=np.float64))
