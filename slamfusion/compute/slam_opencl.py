"""The SLAMs' operations on an OpenCL device; ``slam_reference`` defines each of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray, DeviceArrays
from slamfusion.compute.slam_reference import CLIMBERS, BeamRule, SmearRule

__all__ = ["SlamOperations"]


class SlamOperations(DeviceArrays):
    """Scoring of poses on tiled maps, pools that grow, and tinySLAM's map update."""

    def extend(self, pool: DeviceArray, count: int, fill: int) -> DeviceArray:
        """See ``Backend.extend``."""
        grown = self.empty((count, *pool.shape[1:]), pool.dtype)
        used = pool.size * pool.dtype.itemsize
        total = grown.size * pool.dtype.itemsize
        cl.enqueue_copy(self.queue, grown.buffer, pool.buffer, byte_count=used)
        value = np.array([fill], dtype=pool.dtype)
        cl.enqueue_fill_buffer(self.queue, grown.buffer, value, used, total - used)
        return grown

    def score_poses(
        self,
        field: DeviceArray,
        pages: DeviceArray,
        points: DeviceArray,
        poses: npt.NDArray[np.float32],
        *,
        reach: int = 0,
    ) -> npt.NDArray[np.int64]:
        """See ``slam_reference.score_poses``."""
        n = len(poses)
        sums = np.empty(n, dtype=np.int32)
        out = self.lend(sums, writable=True)
        height, width = pages.shape
        arguments: list[Any] = [
            field, pages, np.int32(width), np.int32(height), points, np.int32(points.shape[0]),
            self.lend(poses), np.int32(n),
        ]  # fmt: skip
        if reach:
            self._launch("score_wide", (n,), *arguments, np.int32(reach), out)
        else:
            self._launch("score_smooth", (n,), *arguments, out)
        self.collect(out, sums)
        return sums.astype(np.int64)

    def climb(
        self,
        field: DeviceArray,
        pages: DeviceArray,
        points: DeviceArray,
        guesses: npt.NDArray[np.float32],
        starts: npt.NDArray[np.float32],
        steps: npt.NDArray[np.float32],
        *,
        scale: float,
    ) -> npt.NDArray[np.float32]:
        """See ``slam_reference.climb``."""
        found = np.empty((len(starts), 6), dtype=np.float32)
        out = self.lend(found, writable=True)
        height, width = pages.shape
        self._launch(
            "climb",
            (len(starts) * CLIMBERS,),
            field,
            pages,
            np.int32(width),
            np.int32(height),
            points,
            np.int32(points.shape[0]),
            self.lend(guesses),
            np.int32(len(guesses)),
            self.lend(starts),
            self.lend(steps),
            np.int32(len(steps)),
            np.float32(scale),
            out,
        )
        self.collect(out, found)
        return found

    def climb_maps(
        self,
        field: DeviceArray,
        pages: DeviceArray,
        points: DeviceArray,
        guesses: npt.NDArray[np.float32],
        starts: npt.NDArray[np.float32],
        sizes: npt.NDArray[np.float32],
        *,
        tries: int,
        scale: float,
    ) -> npt.NDArray[np.float32]:
        """See ``slam_reference.climb_maps``."""
        found = np.empty((len(starts), 6), dtype=np.float32)
        out = self.lend(found, writable=True)
        _, height, width = pages.shape
        self._launch(
            "climb_maps",
            (len(starts) * CLIMBERS,),
            field,
            pages,
            np.int32(width),
            np.int32(height),
            points,
            np.int32(points.shape[0]),
            self.lend(guesses),
            self.lend(starts),
            self.lend(sizes),
            np.int32(len(sizes)),
            np.int32(tries),
            np.float32(scale),
            out,
        )
        self.collect(out, found)
        return found

    def score_maps(
        self,
        field: DeviceArray,
        pages: DeviceArray,
        points: DeviceArray,
        poses: npt.NDArray[np.float32],
        table: npt.NDArray[np.int32],
    ) -> npt.NDArray[np.int64]:
        """See ``slam_reference.score_maps``."""
        maps, each = poses.shape[:2]
        sums = np.empty((maps, each), dtype=np.int32)
        out = self.lend(sums, writable=True)
        _, height, width = pages.shape
        self._launch(
            "score_maps",
            (maps * each,),
            field,
            pages,
            np.int32(width),
            np.int32(height),
            points,
            np.int32(points.shape[0]),
            self.lend(poses),
            np.int32(maps),
            np.int32(each),
            self.lend(table),
            out,
        )
        self.collect(out, sums)
        return sums.astype(np.int64)

    def tiny_mark(
        self,
        observed: DeviceArray,
        pages: DeviceArray,
        beams: DeviceArray,
        rule: BeamRule,
        wanted: DeviceArray,
    ) -> bool:
        """See ``slam_reference.tiny_mark``."""
        height, width = pages.shape
        count = beams.shape[0]
        numbers = (rule.half_blur, rule.behind, rule.free)
        self._launch(
            "tiny_mark",
            (count,),
            observed,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            *(np.int32(number) for number in numbers),
            wanted,
        )
        missing = np.empty(1, dtype=np.int32)
        cl.enqueue_copy(self.queue, missing, wanted.buffer)
        return bool(missing[0])

    def tiny_fold(
        self,
        observed: DeviceArray,
        valley: DeviceArray,
        published: DeviceArray,
        field: DeviceArray,
        pages: DeviceArray,
        beams: DeviceArray,
        rule: BeamRule,
    ) -> None:
        """See ``slam_reference.tiny_fold``."""
        height, width = pages.shape
        count = beams.shape[0]
        numbers = (
            rule.half_blur,
            rule.map_free,
            rule.quality,
            rule.is_mean,
            rule.wall_floor,
            rule.wall_gain,
        )
        self._launch(
            "tiny_fold",
            (count,),
            observed,
            valley,
            published,
            field,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            *(np.int32(number) for number in numbers),
        )

    def smear_mark(
        self,
        observed: DeviceArray,
        pages: DeviceArray,
        beams: DeviceArray,
        rule: SmearRule,
        wanted: DeviceArray,
    ) -> bool:
        """See ``slam_reference.smear_mark``."""
        height, width = pages.shape
        count = beams.shape[0]
        self._launch(
            "smear_mark",
            (count,),
            observed,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            self._table(rule.table),
            np.int32(rule.shift),
            np.int32(rule.reach),
            wanted,
        )
        missing = np.empty(1, dtype=np.int32)
        cl.enqueue_copy(self.queue, missing, wanted.buffer)
        return bool(missing[0])

    def smear_fold(
        self,
        observed: DeviceArray,
        states: DeviceArray,
        field: DeviceArray,
        pages: DeviceArray,
        beams: DeviceArray,
        rule: SmearRule,
    ) -> None:
        """See ``slam_reference.smear_fold``."""
        height, width = pages.shape
        count = beams.shape[0]
        self._launch(
            "smear_fold",
            (count,),
            observed,
            states,
            field,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            np.int32(rule.reach),
            np.int32(rule.most),
        )
