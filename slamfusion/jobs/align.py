"""The rigid motion from one map to another."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from slamfusion.align.records import Alignment
from slamfusion.align.scale import wrong_resolution
from slamfusion.align.starts import StartPose, place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.fusion import align_grids
from slamfusion.geometry import Pose2
from slamfusion.jobs.inputs import MapInput, Warn, device_for, load_maps, log_warning
from slamfusion.jobs.records import Circumstances
from slamfusion.json_values import FLAT

# Of a start without tolerances: x, y, yaw.
POSE_NUMBERS = 3


@dataclass(frozen=True, eq=False)
class AlignDocument:
    """``slamfusion align``; exit code 1 where the alignment is not accepted."""

    alignment: Alignment = field(metadata=FLAT)
    circumstances: Circumstances = field(metadata=FLAT)
    resolution: float
    """Metres per cell of the moving map; with --scale as it was found."""
    scale: float | None = None
    """By which that is larger than the map says; null: without --scale."""


def align_maps(
    reference: MapInput,
    moving: MapInput,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    start: Pose2 | StartPose | None = None,
    resolution: float | None = None,
    warn: Warn = log_warning,
) -> Alignment:
    """Align a map with another one.

    Args:
        reference: the fixed map: in memory, a map_server YAML file, or a bare image.
        moving: the map that is moved, likewise.
        start: expected pose of the frame of ``moving`` in that of ``reference``. Only its
            tolerances are searched; a bare pose shifts the windows of the settings. Default: from
            ``config.start`` by the names of the two maps. A single start there is in the other
            map's frame; without tolerances it gets windows from the settings.
        resolution: metres per cell of bare images.
        warn: receives a sentence for each doubtful property of a map.

    Returns:
        The alignment; its ``transform`` maps points from the frame of ``moving`` to that of
        ``reference``. Use it only if it is ``accepted``.

    Raises:
        MapFileError: a map cannot be read.
        GridError: a map has no known cell.
        StartError: ``config.start`` names another map.
    """
    config = config or RunConfig()
    still, moved = load_maps((reference, moving), config, resolution=resolution, warn=warn)
    if start is None:
        start = _expected(config, still.name, moved.name)
    device = device_for(config, device)
    found = align_grids(still, moved, config.fusion, device, start)
    if not found.accepted and found.evidence is not None and found.decision != "mirrored":
        words = wrong_resolution(still, moved, config.fusion, device)
        if words is not None:
            return replace(found, reason=words, decision="other scale")
    return found


def _expected(config: RunConfig, reference: str, moving: str) -> Pose2 | StartPose | None:
    """Return what the settings say of where the moving map is expected in the reference's frame."""
    starts = place_starts(config.start, (reference, moving))
    found, align = starts.between(reference, moving), config.fusion.align
    has_window = align.window_m is not None or align.window_yaw_rad < math.pi
    has_tolerances = any(len(values) > POSE_NUMBERS for values in config.start.values())
    if found is not None and has_window and not has_tolerances:
        return found.pose
    return found
