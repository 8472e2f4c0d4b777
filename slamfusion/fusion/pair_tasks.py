"""Alignments of pairs as tasks of a scheduler: those that will be asked for begin ahead.

Who aligns many maps asks for one pair after the other, and what comes next depends on what was
found. Most of what comes next is known beforehand all the same: pairs that are told in advance are
handed over, as many as the scheduler can do and some more, and wait to be asked for. A pair that is
never asked for has cost its time and changes nothing: an alignment depends on its two maps alone.
"""

from __future__ import annotations

import hashlib
import pickle
import zlib
from collections import OrderedDict
from dataclasses import dataclass

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fleet import Scheduler, Task
from slamfusion.fleet.worker import worker_device
from slamfusion.fusion.align import align_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import NormalizedGrid
from slamfusion.fusion.records import Alignment
from slamfusion.fusion.start import StartPose

__all__ = ["AlignmentTasks", "PackedGrid", "PairSettings", "align_packed", "pack_grid"]

# Tasks for each of the scheduler's slots: none of them waits for the next one to be handed over.
AHEAD = 2
# Cells of maps whose fields a worker keeps, of which each takes some 24 bytes; two maps always.
KEPT_CELLS = 1 << 24


@dataclass(frozen=True)
class PackedGrid:
    """A normalised grid as it travels: maps shrink to some percent.

    Attributes:
        key: the same for the same grid alone.
        data: the grid, pickled and compressed.
    """

    key: str
    data: bytes

    def unpack(self) -> NormalizedGrid:
        """Return the grid."""
        grid: NormalizedGrid = pickle.loads(zlib.decompress(self.data))  # noqa: S301 - our own
        for array in (grid.cells, grid.solid):
            array.flags.writeable = False
        return grid


def pack_grid(grid: NormalizedGrid) -> PackedGrid:
    """Return a grid as it travels."""
    plain = pickle.dumps(grid, pickle.HIGHEST_PROTOCOL)
    return PackedGrid(hashlib.sha256(plain).hexdigest(), zlib.compress(plain, 1))


@dataclass(frozen=True)
class PairSettings:
    """What alignments of one job have in common; see ``align_features``."""

    config: AlignConfig
    pairs: int
    thorough: bool


class AlignmentTasks:
    """Alignments of pairs of maps on a scheduler; each pair is aligned once."""

    def __init__(self, scheduler: Scheduler, settings: PairSettings) -> None:
        """Take who does them, and what they have in common."""
        self._scheduler, self._settings = scheduler, settings
        self._packed: dict[str, PackedGrid] = {}
        self._tasks: dict[tuple[str, str], Task[Alignment]] = {}

    @property
    def ahead(self) -> int:
        """Pairs that are worth being told in advance, now."""
        return AHEAD * self._scheduler.slots

    def begin(self, reference: GridFeatures, moving: GridFeatures, start: StartPose | None) -> None:
        """Hand over a pair, if it was not yet, and as many run as may."""
        key = reference.grid.name, moving.grid.name
        running = sum(not task.done() for task in self._tasks.values())
        if key not in self._tasks and running < self.ahead:
            self._submit(key, reference, moving, start)

    def result(
        self, reference: GridFeatures, moving: GridFeatures, start: StartPose | None
    ) -> Alignment:
        """Return the alignment of a pair.

        Raises:
            FleetError: those that do the tasks are gone.
        """
        key = reference.grid.name, moving.grid.name
        if key not in self._tasks:
            self._submit(key, reference, moving, start)
        return self._tasks[key].result()

    def _submit(
        self,
        key: tuple[str, str],
        reference: GridFeatures,
        moving: GridFeatures,
        start: StartPose | None,
    ) -> None:
        packed = [self._pack(item.grid) for item in (reference, moving)]
        self._tasks[key] = self._scheduler.submit(
            align_packed, *packed, self._settings, start, self._scheduler.device
        )

    def _pack(self, grid: NormalizedGrid) -> PackedGrid:
        if grid.name not in self._packed:
            self._packed[grid.name] = pack_grid(grid)
        return self._packed[grid.name]


# --- where tasks are done --------------------------------------------------------------------


def align_packed(
    reference: PackedGrid,
    moving: PackedGrid,
    settings: PairSettings,
    start: StartPose | None,
    device: str,
) -> Alignment:
    """Align two grids that came from elsewhere; see ``align_features``."""
    opened = worker_device(device)
    features = [_KEPT.get(packed, opened) for packed in (reference, moving)]
    _KEPT.shrink()
    return align_features(
        features[0], features[1], settings.config, opened, start,
        pairs=settings.pairs, thorough=settings.thorough,
    )  # fmt: skip


class _KeptFeatures:
    """The fields of the grids that were looked at last: a grid is in several pairs."""

    def __init__(self) -> None:
        self._features: OrderedDict[tuple[str, str], GridFeatures] = OrderedDict()

    def get(self, packed: PackedGrid, device: ComputeDevice) -> GridFeatures:
        """Return the features of a grid, made where they are not kept."""
        key = packed.key, device.name
        if key not in self._features:
            self._features[key] = GridFeatures(packed.unpack(), device)
        self._features.move_to_end(key)
        return self._features[key]

    def shrink(self) -> None:
        """Let go of those not looked at for longest, but for the last two."""
        cells = sum(map(_cells, self._features.values()))
        while cells > KEPT_CELLS and len(self._features) > 2:
            _, gone = self._features.popitem(last=False)
            cells -= _cells(gone)


_KEPT = _KeptFeatures()


def _cells(features: GridFeatures) -> int:
    return features.shape[0] * features.shape[1]
