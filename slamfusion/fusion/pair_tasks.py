"""Alignments of pairs as tasks of a scheduler: those that will be asked for begin ahead.

Who aligns many maps asks for one pair after the other, and what comes next depends on what was
found. Most of what comes next is known beforehand all the same: pairs that are told in advance are
handed over, as many as the scheduler can do and some more, and wait to be asked for. A pair that is
never asked for has cost its time and changes nothing: an alignment depends on its two maps alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fleet import Scheduler, Task
from slamfusion.fleet.packed import Kept, Packed, pack
from slamfusion.fleet.worker import worker_device
from slamfusion.fusion.align import align_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import NormalizedGrid
from slamfusion.fusion.records import Alignment
from slamfusion.fusion.start import StartPose

__all__ = ["AlignmentTasks", "PairSettings", "align_packed"]

# Tasks for each of the scheduler's slots: none of them waits for the next one to be handed over.
AHEAD = 2
# Cells of maps whose fields a worker keeps, of which each takes some 24 bytes; two maps always.
KEPT_CELLS = 1 << 24


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
        self._packed: dict[str, Packed[NormalizedGrid]] = {}
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
        packed = [self._pack(item.given) for item in (reference, moving)]
        self._tasks[key] = self._scheduler.submit(
            align_packed, *packed, self._settings, start, self._scheduler.device
        )

    def _pack(self, grid: NormalizedGrid) -> Packed[NormalizedGrid]:
        if grid.name not in self._packed:
            self._packed[grid.name] = pack(grid)
        return self._packed[grid.name]


# --- where tasks are done --------------------------------------------------------------------


def align_packed(
    reference: Packed[NormalizedGrid],
    moving: Packed[NormalizedGrid],
    settings: PairSettings,
    start: StartPose | None,
    device: str,
) -> Alignment:
    """Align two grids that came from elsewhere; see ``align_features``."""
    opened = worker_device(device)
    features = [
        _KEPT.get((packed.key, opened.name), partial(_unpacked_features, packed, opened))
        for packed in (reference, moving)
    ]
    _KEPT.shrink()
    return align_features(
        features[0], features[1], settings.config, opened, start,
        pairs=settings.pairs, thorough=settings.thorough,
    )  # fmt: skip


def _unpacked_features(packed: Packed[NormalizedGrid], device: ComputeDevice) -> GridFeatures:
    grid = packed.unpack()
    for array in (grid.cells, grid.solid):
        array.flags.writeable = False
    return GridFeatures(grid, device)


def _cells(features: GridFeatures) -> int:
    return features.shape[0] * features.shape[1]


# The fields of the grids that were looked at last: a grid is in several pairs.
_KEPT: Kept[GridFeatures] = Kept(_cells, KEPT_CELLS, least=2)
