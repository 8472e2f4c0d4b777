"""Walls, distances, scores and resampled grids on an OpenCL device."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import (
    DISTANCE2_MAX,
    DISTANCE_LANES,
    DISTANCE_MAX,
    RUN,
    WINDOW_LANES,
)
from slamfusion.compute.opencl_queue import OpenCLArray, OpenCLQueue
from slamfusion.errors import DeviceError

__all__ = ["OpenCLFields"]

Cell = TypeVar("Cell", np.int8, np.uint8)


class OpenCLFields(OpenCLQueue):
    """The operations of ``FieldDevice`` on one OpenCL device."""

    def solid_walls(self, cells: DeviceArray[np.int8]) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.solid_walls``."""
        height, width = cells.shape
        out = self.empty(cells.shape, np.uint8)
        sizes = (np.int32(height), np.int32(width))
        self._launch("solid_walls", (-(-width // RUN), height), cells, *sizes, out)
        return out

    def surface_walls(
        self, cells: DeviceArray[np.int8], solid: DeviceArray[np.uint8]
    ) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.surface_walls``."""
        height, width = cells.shape
        out = self.empty(cells.shape, np.uint8)
        sizes = (np.int32(height), np.int32(width))
        self._launch("surface_walls", (-(-width // RUN), height), cells, solid, *sizes, out)
        return out

    def shrink(
        self, walls: DeviceArray[np.uint8], cells: DeviceArray[np.int8], step: int
    ) -> tuple[DeviceArray[np.uint8], DeviceArray[np.uint8]]:
        """See ``fields.numpy.shrink``."""
        height, width = cells.shape
        shape = (-(-height // step), -(-width // step))
        wall, free = self.empty(shape, np.uint8), self.empty(shape, np.uint8)
        sizes = [np.int32(v) for v in (height, width, step, *shape)]
        size = (-(-shape[1] // max(1, RUN // step)), shape[0])
        self._launch("shrink", size, walls, cells, *sizes, wall, free)
        return wall, free

    def distance_squared(
        self, walls: DeviceArray[np.uint8], reach: int = DISTANCE_MAX
    ) -> DeviceArray[np.uint16]:
        """See ``fields.numpy.distance_squared``."""
        height, width = walls.shape
        padded = -(-width // DISTANCE_LANES) * DISTANCE_LANES
        source = walls if padded == width else self._repitch(walls, padded)
        # Beyond both edges no wall is within reach.
        reached = padded + 2 * DISTANCE_MAX
        columns = self.empty((height, reached), np.uint16)
        squared = self.empty((height, padded), np.uint16)
        sizes = (np.int32(height), np.int32(padded))
        self._launch("distance_columns", (reached // DISTANCE_LANES,), source, *sizes, columns)
        size = (padded // DISTANCE_LANES, height)
        self._launch("distance_rows", size, columns, *sizes, np.int32(reach), squared)
        return squared if padded == width else self._repitch(squared, width)

    def _repitch(self, array: DeviceArray[Any], width: int) -> OpenCLArray[Any]:
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
            self._buffer(array),
            src_origin=(0, 0, 0),
            dst_origin=(0, 0, 0),
            region=(min(old, width) * item, height, 1),
            src_pitches=(old * item,),
            dst_pitches=(width * item,),
        )
        return out

    def score_field(
        self,
        distance2: DeviceArray[np.uint16],
        free_share: DeviceArray[np.uint8],
        hit: npt.NDArray[np.uint16],
        miss: npt.NDArray[np.uint16],
        base: int,
    ) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.score_field``."""
        if hit.shape != (DISTANCE2_MAX + 1,) or miss.shape != hit.shape:
            message = f"score tables must have {DISTANCE2_MAX + 1} entries, found {hit.shape}"
            raise DeviceError(message)
        out = self.empty(distance2.shape, np.uint8)
        cells = distance2.size
        worths = self._table(hit.astype(np.uint32) | miss.astype(np.uint32) << 16)
        scalars = (np.int32(base), np.int32(cells))
        self._launch(
            "score_field", (-(-cells // RUN),), distance2, free_share, worths, *scalars, out
        )
        return out

    def look_up(
        self, values: DeviceArray[np.uint16], table: npt.NDArray[np.uint16]
    ) -> DeviceArray[np.uint16]:
        """See ``fields.numpy.look_up``."""
        out = self.empty(values.shape, np.uint16)
        cells = values.size
        self._launch(
            "look_up", (-(-cells // RUN),), values, self._table(table), np.int32(cells), out
        )
        return out

    def look_up_where(
        self,
        values: DeviceArray[np.uint16],
        mask: DeviceArray[np.uint8],
        table: npt.NDArray[np.uint16],
        otherwise: npt.NDArray[np.uint16],
    ) -> DeviceArray[np.uint16]:
        """See ``fields.numpy.look_up_where``."""
        out = self.empty(values.shape, np.uint16)
        cells = values.size
        tables = (self._table(table), self._table(otherwise))
        size = (-(-cells // RUN),)
        self._launch("look_up_where", size, values, mask, *tables, np.int32(cells), out)
        return out

    def max_window(
        self, field: DeviceArray[np.uint8], window: int, *, along_rows: bool, fill: int
    ) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.max_window``."""
        height, width = field.shape
        reached = 1
        while reached < window:
            shift = min(reached, window - reached)
            out = self.empty(field.shape, np.uint8)
            sizes = [np.int32(v) for v in (height, width, shift, along_rows)]
            self._launch(
                "max_pair", (-(-width // WINDOW_LANES), height), field, *sizes, np.uint8(fill), out
            )
            field = out
            reached += shift
        return field

    def warp(
        self,
        cells: DeviceArray[Cell],
        poses: npt.NDArray[np.int64],
        shape: tuple[int, int],
        fill: int,
    ) -> DeviceArray[Cell]:
        """See ``fields.numpy.warp``."""
        out = self.empty((len(poses), *shape), cells.dtype)
        sizes = [np.int32(v) for v in (len(poses), *shape)]
        own = [np.int32(v) for v in cells.shape]
        size = (-(-shape[1] // RUN), shape[0], len(poses))
        fixed = self.upload(poses)
        self._launch("warp", size, cells, *own, fixed, *sizes, np.int8(fill), out)
        return out
