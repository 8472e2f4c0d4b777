"""The OpenCL backend: each operation is one kernel launch, or two, on one in-order queue."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import EACH_LANE, DeviceArray
from slamfusion.compute.backend import SHIFT_LANES
from slamfusion.compute.hit_map_opencl import HitMapOperations
from slamfusion.compute.reference import (
    DISTANCE2_MAX,
    DISTANCE_MAX,
    MOST_INPUTS,
    Votes,
    ray_table,
)
from slamfusion.compute.slam_opencl import SlamOperations
from slamfusion.errors import DeviceError

__all__ = ["DeviceArray", "OpenCLBackend"]

LANES = 16
CHUNK_POINTS = 64
CHUNK_CELLS = 4096
CHUNK_ROWS = 16
RUN = 64
BLOCK_CELLS = 32


class OpenCLBackend(SlamOperations, HitMapOperations):
    """The operations of ``Backend`` on one OpenCL device.

    Raises:
        DeviceError: no such device, or the kernels do not build on it.
    """

    is_opencl = True

    # -- walls and fields ----------------------------------------------------------------------

    def solid_walls(self, cells: DeviceArray) -> DeviceArray:
        """See ``reference.solid_walls``."""
        height, width = cells.shape
        out = self.empty(cells.shape, np.uint8)
        sizes = (np.int32(height), np.int32(width))
        self._launch("solid_walls", (-(-width // RUN), height), cells, *sizes, out)
        return out

    def surface_walls(self, cells: DeviceArray, solid: DeviceArray) -> DeviceArray:
        """See ``reference.surface_walls``."""
        height, width = cells.shape
        out = self.empty(cells.shape, np.uint8)
        sizes = (np.int32(height), np.int32(width))
        self._launch("surface_walls", (-(-width // RUN), height), cells, solid, *sizes, out)
        return out

    def shrink(
        self, walls: DeviceArray, cells: DeviceArray, step: int
    ) -> tuple[DeviceArray, DeviceArray]:
        """See ``reference.shrink``."""
        height, width = cells.shape
        shape = (-(-height // step), -(-width // step))
        wall, free = self.empty(shape, np.uint8), self.empty(shape, np.uint8)
        sizes = [np.int32(v) for v in (height, width, step, *shape)]
        self._launch("shrink", shape[::-1], walls, cells, *sizes, wall, free)
        return wall, free

    def distance_squared(self, walls: DeviceArray, reach: int = DISTANCE_MAX) -> DeviceArray:
        """See ``reference.distance_squared``."""
        height, width = walls.shape
        padded = -(-width // LANES) * LANES
        source = walls if padded == width else self._repitch(walls, padded)
        columns = self.empty((height, padded), np.uint16)
        squared = self.empty((height, padded), np.uint16)
        sizes = (np.int32(height), np.int32(padded))
        self._launch("distance_columns", (padded // LANES,), source, *sizes, columns)
        size = (padded // LANES, height)
        self._launch("distance_rows", size, columns, *sizes, np.int32(reach), squared)
        return squared if padded == width else self._repitch(squared, width)

    def _repitch(self, array: DeviceArray, width: int) -> DeviceArray:
        """Return the array with rows of another width: cut, or filled with zeros."""
        height, old = array.shape
        item = array.dtype.itemsize
        out = self.empty((height, width), array.dtype)
        if width > old:
            cl.enqueue_fill_buffer(
                self.queue, out.buffer, np.zeros(1, np.uint8), 0, height * width * item
            )
        cl.enqueue_copy(
            self.queue,
            out.buffer,
            array.buffer,
            src_origin=(0, 0, 0),
            dst_origin=(0, 0, 0),
            region=(min(old, width) * item, height, 1),
            src_pitches=(old * item,),
            dst_pitches=(width * item,),
        )
        return out

    def score_field(
        self,
        distance2: DeviceArray,
        free_share: DeviceArray,
        hit: npt.NDArray[np.uint16],
        miss: npt.NDArray[np.uint16],
        base: int,
    ) -> DeviceArray:
        """See ``reference.score_field``."""
        if hit.shape != (DISTANCE2_MAX + 1,) or miss.shape != hit.shape:
            message = f"score tables must have {DISTANCE2_MAX + 1} entries, found {hit.shape}"
            raise DeviceError(message)
        out = self.empty(distance2.shape, np.uint8)
        cells = distance2.size
        tables = (self._table(hit), self._table(miss))
        scalars = (np.int32(base), np.int32(cells))
        self._launch(
            "score_field", (-(-cells // RUN),), distance2, free_share, *tables, *scalars, out
        )
        return out

    def look_up(self, values: DeviceArray, table: npt.NDArray[np.uint16]) -> DeviceArray:
        """See ``reference.look_up``."""
        out = self.empty(values.shape, np.uint16)
        cells = values.size
        self._launch(
            "look_up", (-(-cells // RUN),), values, self._table(table), np.int32(cells), out
        )
        return out

    def max_window(
        self, field: DeviceArray, window: int, *, along_rows: bool, fill: int
    ) -> DeviceArray:
        """See ``reference.max_window``."""
        height, width = field.shape
        reached = 1
        while reached < window:
            shift = min(reached, window - reached)
            out = self.empty(field.shape, np.uint8)
            sizes = [np.int32(v) for v in (height, width, shift, along_rows)]
            self._launch("max_pair", (-(-width // 32), height), field, *sizes, np.uint8(fill), out)
            field = out
            reached += shift
        return field

    # -- warping and counting ------------------------------------------------------------------

    def warp(
        self,
        cells: DeviceArray,
        poses: npt.NDArray[np.int64],
        shape: tuple[int, int],
        fill: int,
    ) -> DeviceArray:
        """See ``reference.warp``."""
        out = self.empty((len(poses), *shape), cells.dtype)
        sizes = [np.int32(v) for v in (len(poses), *shape)]
        own = [np.int32(v) for v in cells.shape]
        size = (-(-shape[1] // RUN), shape[0], len(poses))
        fixed = self.upload(poses)
        self._launch("warp", size, cells, *own, fixed, *sizes, np.int8(fill), out)
        return out

    def confusion(self, a: DeviceArray, b: DeviceArray) -> npt.NDArray[np.int64]:
        """See ``reference.confusion``."""
        chunks = -(-a.size // CHUNK_CELLS)
        partial = self.empty((chunks, 9), np.int32)
        sizes = (np.int32(a.size), np.int32(CHUNK_CELLS))
        self._launch("confusion", (chunks,), a, b, *sizes, partial)
        return np.asarray(self.download(partial).sum(axis=0, dtype=np.int64)).reshape(3, 3)

    def squared_error(
        self, a: DeviceArray, b: DeviceArray, poses: npt.NDArray[np.int64], stride: int
    ) -> npt.NDArray[np.int64]:
        """See ``reference.squared_error``."""
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

    # -- scoring motions -----------------------------------------------------------------------

    def correlate(
        self,
        fields: DeviceArray,
        offsets: npt.NDArray[np.int32],
        shift_shape: tuple[int, int],
    ) -> DeviceArray:
        """See ``reference.correlate``."""
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
        self._launch(
            "correlate",
            (width // SHIFT_LANES, (height + 1) // 2, count),
            fields,
            field_stride,
            np.int32(field_width),
            self.upload(offsets),
            offset_stride,
            np.int32(points),
            np.int32(height),
            np.int32(width),
            np.int32(count),
            scores,
        )
        return scores

    def polyphase(
        self,
        field: DeviceArray,
        corner: tuple[int, int],
        step: int,
        shape: tuple[int, int],
        fill: int,
    ) -> DeviceArray:
        """See ``reference.polyphase``."""
        out = self.empty((step, step, *shape), np.uint8)
        sizes = [np.int32(v) for v in (*field.shape, *corner, step, *shape)]
        size = (shape[0], step * step)
        self._launch("polyphase", size, field, *sizes, np.uint8(fill), out)
        return out

    def bound_blocks(
        self,
        blocks: npt.NDArray[np.int32],
        starts: DeviceArray,
        classes: npt.NDArray[np.uint8],
        fields: DeviceArray,
        fill: int,
        *,
        least: int = -1,
    ) -> npt.NDArray[np.int32]:
        """See ``reference.bound_blocks``."""
        bounds = np.empty(len(blocks), dtype=np.int32)
        out = self.lend(bounds, writable=True)
        _, height, width = fields.shape
        self._launch(
            "bound_blocks",
            (len(blocks),),
            self.lend(blocks),
            np.int32(len(blocks)),
            starts,
            self.lend(classes),
            np.int32(len(classes)),
            fields,
            np.int32(height),
            np.int32(width),
            np.uint8(fill),
            np.int32(least),
            out,
        )
        self.collect(out, bounds)
        return bounds

    def tile_peaks(
        self, forward: DeviceArray, backward: DeviceArray, width: int, tile: int
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """See ``reference.tile_peaks``."""
        count, height, stride = forward.shape
        tiles_y, tiles_x = -(-height // tile), -(-width // tile)
        values = self.empty((count, tiles_y, tiles_x), np.int32)
        places = self.empty((count, tiles_y, tiles_x), np.int32)
        sizes = [np.int32(v) for v in (height, width, stride, count, tile, tiles_y, tiles_x)]
        size = (tiles_x, tiles_y, count)
        self._launch("tile_peaks", size, forward, backward, *sizes, values, places)
        return self.download(values), self.download(places)

    def pose_counts(
        self,
        points: npt.NDArray[np.int32],
        poses: npt.NDArray[np.int64],
        field: DeviceArray,
        distance2: DeviceArray,
        free_cell: DeviceArray,
        *,
        base: int,
        near2: int,
        far2: int,
    ) -> npt.NDArray[np.int64]:
        """See ``reference.pose_counts``."""
        count, n = len(points), len(poses)
        chunks = -(-count // CHUNK_POINTS)
        partial = self.empty((n, chunks, 4), np.int32)
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

    def refine_terms(
        self,
        points: DeviceArray,
        poses: npt.NDArray[np.float32],
        distance: DeviceArray,
        *,
        scale: float,
        centre: tuple[float, float],
        backward: bool,
    ) -> npt.NDArray[np.float64]:
        """See ``reference.refine_terms``."""
        count, n = points.shape[0], len(poses)
        chunks = -(-count // CHUNK_POINTS)
        partial = self.empty((n, chunks, 10), np.float32)
        height, width = distance.shape
        self._launch(
            "refine_terms",
            (chunks, n),
            points,
            np.int32(count),
            self.upload(poses),
            np.int32(n),
            distance,
            np.int32(height),
            np.int32(width),
            np.float32(scale),
            np.float32(centre[0]),
            np.float32(centre[1]),
            np.int32(backward),
            np.int32(CHUNK_POINTS),
            np.int32(chunks),
            partial,
        )
        return np.asarray(self.download(partial).sum(axis=1, dtype=np.float64))

    # -- voting --------------------------------------------------------------------------------

    def vote_majority(self, grids: Sequence[npt.NDArray[np.int8]], *, unknown_votes: bool) -> Votes:
        """See ``reference.vote_majority``."""
        shares = _majority_shares(len(grids), unknown_votes=unknown_votes)
        arguments = (np.int32(unknown_votes), self._table(shares), np.int32(len(shares)))
        return self._vote("vote_majority", grids, arguments)

    def vote_weighted(
        self,
        grids: Sequence[npt.NDArray[np.int8]],
        weights: npt.NDArray[np.int32],
        *,
        unknown_votes: bool,
    ) -> Votes:
        """See ``reference.vote_weighted``."""
        return self._vote("vote_weighted", grids, (self.upload(weights), np.int32(unknown_votes)))

    def vote_log_odds(
        self,
        grids: Sequence[npt.NDArray[np.int8]],
        odds: npt.NDArray[np.int32],
        *,
        occupied_percent: int,
        free_percent: int,
    ) -> Votes:
        """See ``reference.vote_log_odds``."""
        thresholds = (np.int32(occupied_percent), np.int32(free_percent))
        return self._vote("vote_log_odds", grids, (self._table(odds), *thresholds))

    def _vote(
        self, name: str, grids: Sequence[npt.NDArray[np.int8]], arguments: tuple[Any, ...]
    ) -> Votes:
        """Run a kernel of the vote family; its own arguments follow the grids and their sizes."""
        shape, count = grids[0].shape, len(grids)
        cells = math.prod(shape)
        pitch = -(-cells // BLOCK_CELLS) * BLOCK_CELLS
        planes = -(-count // 8)
        fused, agreement = np.empty(shape, dtype=np.int8), np.empty(shape, dtype=np.int8)
        dissent = np.empty((planes, pitch), dtype=np.uint8)
        results = (fused, agreement, dissent)
        lent = [self.lend(grid) for grid in grids]
        outs = [self.lend(result, writable=True) for result in results]
        chunks = -(-cells // CHUNK_CELLS)
        phantom = self.empty((chunks,), np.int32)
        self._launch(
            name,
            (chunks,),
            *lent,
            *[lent[0]] * (MOST_INPUTS - count),
            np.int32(count),
            np.int32(cells),
            *arguments,
            np.int32(CHUNK_CELLS),
            *outs,
            phantom,
        )
        phantom_cells = int(self.download(phantom).sum(dtype=np.int64))
        for out, result in zip(outs, results, strict=True):
            self.collect(out, result)
        return Votes(fused, agreement, dissent[:, :cells].reshape(planes, *shape), phantom_cells)

    # -- rays ----------------------------------------------------------------------------------

    def cast_rays(
        self, cells: DeviceArray, rays: npt.NDArray[np.float32], reach_cells: float
    ) -> npt.NDArray[np.float32]:
        """See ``reference.cast_rays``."""
        count = len(rays)
        if not count:
            return np.empty((0, 4), dtype=np.float32)
        hits = self.empty((count, 4), np.float32)
        sizes = [np.int32(v) for v in cells.shape]
        table, reach = self.upload(ray_table(rays)), np.float32(reach_cells)
        self._launch("cast_rays", (count,), cells, *sizes, table, np.int32(count), reach, hits)
        return self.download(hits)


@cache
def _majority_shares(count: int, *, unknown_votes: bool) -> npt.NDArray[np.uint64]:
    """Return the share of the winner in percent for every split of up to ``count`` votes.

    Returns:
        (S, 3) uint64: votes for the winner, votes for others (at least 1), percent rounded half
        up, each in all eight lanes of the word.
    """
    splits = [
        (cast - others, others, (200 * (cast - others) + cast) // (2 * cast))
        for cast in ((count,) if unknown_votes else range(2, count + 1))
        for others in range(1, cast + 1)
        if unknown_votes or others <= cast - others
    ]
    return np.array(splits or [(count, 0, 100)], dtype=np.uint64) * EACH_LANE
