"""Alignments of pairs by an executor, started ahead of their requests.

The next pair depends on the results so far, but most pairs are predictable: they are started in
advance, a few more than the executor can run. A pair that is never requested costs time and changes
nothing, because an alignment depends on its two maps only.
"""

from __future__ import annotations

import math
import pickle
import zlib
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import lru_cache

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import NormalizedGrid
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.starts import StartPose
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fleet import tasks_ahead

# Largest grid whose fields a worker keeps, cells; each takes some 24 bytes.
KEPT_CELLS = 1 << 20
# A grid in transit, pickled and compressed to about a tenth, and whether its fields are kept.
Packed = tuple[bytes, bool]


@dataclass(frozen=True)
class PairSettings:
    """Common settings of the alignments of one job; see ``align_pair``."""

    config: AlignConfig
    pairs: int
    thorough: bool


class AlignmentTasks:
    """Alignments of pairs of maps by an executor; each pair is aligned once."""

    def __init__(self, executor: Executor, settings: PairSettings, device: ComputeDevice) -> None:
        """Start without tasks."""
        self._executor, self._common = executor, (settings, device)
        self._packed: dict[str, Packed] = {}
        self._tasks: dict[tuple[str, str], Future[Alignment]] = {}

    @property
    def ahead(self) -> int:
        """The number of pairs worth starting in advance, now."""
        return tasks_ahead(self._executor)

    def begin(self, pair: Pair, start: StartPose | None) -> None:
        """Start a pair if it was not started yet."""
        if sum(not task.done() for task in self._tasks.values()) < self.ahead:
            self._task(pair, start)

    def result(self, pair: Pair, start: StartPose | None) -> Alignment:
        """Return the alignment of a pair."""
        return self._task(pair, start).result()

    def _task(self, pair: Pair, start: StartPose | None) -> Future[Alignment]:
        """Return the task of a pair; start it if it was not started yet."""
        key = pair.reference.grid.name, pair.moving.grid.name
        if key not in self._tasks:
            one, other = (self._pack(features.given) for features in pair)
            self._tasks[key] = self._executor.submit(align_packed, one, other, start, *self._common)
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
    settings: PairSettings,
    device: ComputeDevice,
) -> Alignment:
    """Align two packed grids; see ``align_pair``."""
    return align_pair(
        Pair(_features(reference, device), _features(moving, device)), settings.config, start,
        pairs=settings.pairs, thorough=settings.thorough,
    )  # fmt: skip


def _features(packed: Packed, device: ComputeDevice) -> GridFeatures:
    """Return the features of a grid; small ones are kept for their next pairs."""
    data, is_small = packed
    make = _kept if is_small else _kept.__wrapped__
    return make(data, device)


@lru_cache(maxsize=16)
def _kept(data: bytes, device: ComputeDevice) -> GridFeatures:
    grid: NormalizedGrid = pickle.loads(zlib.decompress(data))  # noqa: S301 - our own
    for array in (grid.cells, grid.solid):
        array.flags.writeable = False
    return GridFeatures(grid, device)
