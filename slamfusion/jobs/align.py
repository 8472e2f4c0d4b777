"""The rigid motion from one map to another."""

from __future__ import annotations

import logging

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.fusion import align_grids
from slamfusion.fusion.records import Alignment
from slamfusion.geometry import Pose2
from slamfusion.jobs.documents import circumstances
from slamfusion.jobs.inputs import MapInput, Warn, as_grids, device_for
from slamfusion.jobs.records import AlignDocument

__all__ = ["align_document", "align_maps"]

_LOG = logging.getLogger(__name__)


def align_maps(
    reference: MapInput,
    moving: MapInput,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    start: Pose2 | None = None,
    resolution: float | None = None,
    warn: Warn = _LOG.warning,
) -> Alignment:
    """Align a map with another one.

    Args:
        reference: the map that is held still: in memory, a map_server YAML file, or a bare image.
        moving: the map that is moved, likewise.
        config: ``fusion`` and ``map_files`` are used; default: the defaults.
        device: searches; default: the one that the settings name.
        start: of the search; the windows of the settings count from here.
        resolution: metres per cell of bare images.
        warn: told in a sentence what is doubtful about a map.

    Returns:
        The alignment; its ``transform`` maps a point of the frame of ``moving`` into that of
        ``reference``. It may be used only where it is ``accepted``.

    Raises:
        MapFileError: a map cannot be read.
        GridError: a map has no known cell.
        DeviceError: the device cannot be opened.
    """
    config = config or RunConfig()
    still, moved = as_grids((reference, moving), config, resolution=resolution, warn=warn)
    return align_grids(still, moved, config.fusion, device_for(config, device), start)


def align_document(found: Alignment, config: RunConfig, device: str) -> AlignDocument:
    """Return what ``slamfusion align`` prints as JSON.

    Args:
        found: the alignment.
        config: the settings in effect.
        device: what computed it, in words.
    """
    return {**found.to_json(), **circumstances(config, device)}
