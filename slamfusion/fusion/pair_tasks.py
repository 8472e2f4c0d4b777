"""Alignments of pairs by an executor, started ahead of their requests.

The next pair depends on the results so far, but most pairs are predictable: they are started in
advance, a few more than the executor can run. A pair that is never requested costs time and changes
nothing, because an alignment depends on its two maps only.
"""

from __future__ import annotations

import math
import pickle
import zlib
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import lru_cache

from slamfusion.align.align import THREADS
from slamfusion.align.features import KEPT_CELLS, GridFeatures
from slamfusion.align.normalize import NormalizedGrid
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.starts import StartPose
from slamfusion.compute import ComputeDevice
from slamfusion.fleet import tasks_ahead

# A grid in transit, pickled and compressed to about a tenth, and whether its fields are kept.
Packed = tuple[bytes, bool]


class AlignmentTasks:
    """Alignments of pairs of maps by an executor, or by threads; each pair is aligned once."""

    def __init__(self, executor: Executor | None, align: Callable[..., Alignment]) -> None:
        """Start without tasks.

        Args:
            executor: None: two threads, on the device of the maps.
            align: called with a pair and its ``start``; ``align_pair`` with its settings.
        """
        self._is_here, self._align = executor is None, align
        self._executor = executor or ThreadPoolExecutor(THREADS)
        self._packed: dict[str, Packed] = {}
        self._tasks: dict[tuple[str, str], Future[Alignment]] = {}

    @property
    def ahead(self) -> int:
        """The number of pairs worth starting in advance, now."""
        return THREADS if self._is_here else tasks_ahead(self._executor)

    def begin(self, pair: Pair, start: StartPose | None) -> None:
        """Start a pair if it was not started yet."""
        if sum(not task.done() for task in self._tasks.values()) < self.ahead:
            self._task(pair, start)

    def result(self, pair: Pair, start: StartPose | None) -> Alignment:
        """Return the alignment of a pair."""
        return self._task(pair, start).result()

    def close(self) -> None:
        """End the own threads, and cancel what no one waits for."""
        if self._is_here:
            self._executor.shutdown(cancel_futures=True)

    def _task(self, pair: Pair, start: StartPose | None) -> Future[Alignment]:
        """Return the task of a pair; start it if it was not started yet."""
        key = pair.reference.grid.name, pair.moving.grid.name
        if key not in self._tasks:
            if self._is_here:
                task = self._executor.submit(self._align, pair, start=start)
            else:
                one, other = (self._pack(features.given) for features in pair)
                task = self._executor.submit(
                    align_packed, one, other, start, self._align, pair.device
                )
            self._tasks[key] = task
        return self._tasks[key]

    def _pack(self, grid: NormalizedGrid) -> Packed:
        if grid.name not in self._packed:
            plain = pickle.dumps(grid, pickle.HIGHEST_PROTOCOL)
            self._packed[grid.name] = zlib.compress(plain, 1), math.prod(grid.shape) <= KEPT_CELLS
        return self._packed[grid.name]


# --- where tasks are done --------------------------------------------------------------------


def align_packed(
    reference: Packed,
    moving: Packed,
    start: StartPose | None,
    align: Callable[..., Alignment],
    device: ComputeDevice,
) -> Alignment:
    """Align two packed grids; the features of small ones are kept for their next pairs."""
    features = []
    for data, is_small in (reference, moving):
        make = _kept if is_small else _kept.__wrapped__
        features.append(make(data, device))
    return align(Pair(*features), start=start)


@lru_cache(maxsize=16)
def _kept(data: bytes, device: ComputeDevice) -> GridFeatures:
    grid: NormalizedGrid = pickle.loads(zlib.decompress(data))  # noqa: S301 - our own
    for array in (grid.cells, grid.solid):
        array.flags.writeable = False
    return GridFeatures(grid, device)
