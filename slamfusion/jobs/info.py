"""What a log, a bag, a map or a run holds, before anything is done with it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.cores import usable_cores
from slamfusion.errors import LogError, MapFileError
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.grid import OCCUPIED, UNKNOWN
from slamfusion.io.bags import METADATA
from slamfusion.io.lines import MAP_SUFFIXES, strip_gz
from slamfusion.io.log import AHEAD_S, BACK, EQUAL, STRAY
from slamfusion.io.logs import bag_at, is_bag_folder, log_at, open_log
from slamfusion.jobs.inputs import MOST_NAMED, Progress, load_maps, map_file
from slamfusion.jobs.outputs import RUN_RECORD
from slamfusion.slam.registry import BUILT_IN, producer

# A pause between two scans that is this many times as long as usual is a gap.
GAP_PERIODS = 5.0
# Recorded on mit-csail (1988 scans, 361 beams, two cores of an AMD EPYC): time of tinySLAM for a
# scan, of alignment, vote and report together, and memory of all processes.
SCAN_S, OTHER_STAGES_S, RUN_MB = 0.0022, 8.0, 1400.0


@dataclass(frozen=True)
class LogInfo:
    """A log or bag, read once."""

    scans: int
    """Scans that can be used."""
    duration_s: float
    """From the first to the last, seconds."""
    rate_hz: float | None
    """Scans per second, by the median time between two; null for one scan or unusable stamps."""
    gaps: int
    """Pauses of more than five times that."""
    longest_gap_s: float
    """The longest time between two scans, seconds; scans that odometry does not reach are left
    out."""
    beams: str
    """Beams of a scan; several numbers if they change."""
    field_of_view_deg: float
    """From the first to the last beam, degrees."""
    range_max_m: float
    """Longest range of the laser, metres."""
    returns_percent: float
    """Share of the beams that hit something, percent."""
    odometry_m: float | None
    """Length of the path by odometry, metres; null: the log has none."""
    out_of_order: int | None
    """Scans that are left out: their stamp is not later than the one before, or far ahead; null:
    the stamps cannot be used."""
    deskewed: int
    """Scans whose beams are moved to the stamp of the scan."""
    topics: Sequence[str]
    """Of a bag, each topic with its type and number of messages."""
    frames: Sequence[str]
    """Of a bag, the frame of each laser, and each transform as ``parent > child``."""
    run_time_s: float
    """What `slamfusion run` takes, roughly, with this machine's cores, seconds."""
    run_memory_mb: float
    """Memory of that run, roughly, all processes together, MB."""


@dataclass(frozen=True)
class MapInfo:
    """A saved map."""

    width: int
    """Cells in x."""
    height: int
    """Cells in y."""
    resolution_m: float
    """Size of a cell, metres."""
    origin_x_m: float
    """Lower left corner in the map frame, metres."""
    origin_y_m: float
    """Its y, metres."""
    origin_yaw_deg: float
    """Its direction, degrees."""
    known_m2: float
    """Area of known cells, square metres."""
    walls_m2: float
    """Area of occupied cells, square metres."""


@dataclass(frozen=True)
class RunInfo:
    """The result of ``slamfusion run``."""

    log: str
    """The log."""
    slams: Sequence[str]
    """Each SLAM with its scans, or why it made no map."""
    maps_fused: int
    """Maps that voted."""
    fused_mode: str | None
    """How the fused map was made; null: there is none."""
    recommendation: str | None
    """Which map and path to use, in a sentence; null if no map was made."""
    time_s: float
    """Time of the run, seconds."""
    report: str
    """The page of the report."""


@dataclass(frozen=True)
class InfoDocument:
    """``slamfusion info``; one of ``log``, ``map`` and ``run`` is there."""

    file: Path
    """What is described."""
    log: LogInfo | None = None
    """A log or bag; null if it is none, or has no single laser."""
    map: MapInfo | None = None
    """A map."""
    run: RunInfo | None = None
    """A run."""
    remarks: Sequence[str] = ()
    """What is odd and what to do, a sentence each."""


def describe(
    path: str | Path,
    config: RunConfig | None = None,
    progress: Progress | None = None,
    *,
    resolution: float | None = None,
) -> InfoDocument:
    """Describe a log, a bag, a map (of an image alone: with its resolution, metres) or a run."""
    path, config = Path(path), config or RunConfig()
    path = path.parent if path.name == RUN_RECORD else path
    if (path / RUN_RECORD).exists() and (run := _run_info(path)) is not None:
        return run
    log = log_at(path)
    is_map = strip_gz(path.name).endswith(MAP_SUFFIXES) and path.name != METADATA
    if is_map or (log.is_dir() and not is_bag_folder(log) and any(log.glob("*.yaml"))):
        return _map_info(map_file(path), config, resolution)
    found = _log_info(log, config, progress or (lambda *_: None))
    others = [item.name for item in sorted(path.glob("*")) if path != log != item]
    also = f"also in {path}: {', '.join(others[:MOST_NAMED])}"
    return replace(found, remarks=[*found.remarks, also]) if others else found


def _log_info(path: Path, config: RunConfig, progress: Progress) -> InfoDocument:
    remarks: list[str] = []
    topics, frames = list[str](), list[str]()
    bag_path = bag_at(path)
    if bag_path is not None:
        from slamfusion.io.bags.reader import open_bag  # noqa: PLC0415  (an extra)

        with open_bag(bag_path, remarks) as bag:
            topics, frames = bag.described_topics(), bag.described_frames()
    try:
        log = open_log(path, config.log)
    except LogError as error:
        if not topics:
            raise
        raise LogError(f"{path}: topics {', '.join(topics)}; {error}") from error
    rows = []
    for item in log:
        scan, pose = item.scan, item.odometry
        place = (math.nan, math.nan) if pose is None else (pose.x, pose.y)
        rows.append((scan.stamp_s, len(scan.ranges), np.isfinite(scan.ranges).sum(), *place))
        progress("reading", log.fraction_read, 1)
    if not rows:
        raise LogError(f"{path}: no scan in it can be used; {'; '.join(log.skips.sentences())}")
    stamps_s, beams, hits, *odometry = np.array(rows).T
    has_pose = np.isfinite(odometry[0])
    steps_s, moves_m = np.diff(stamps_s), np.diff([axis[has_pose] for axis in odometry])
    period_s = float(np.median(steps_s)) if len(steps_s) else math.nan
    left_out = sum(log.skips.counts.get(reason, 0) for reason in (BACK, EQUAL, STRAY))
    # Each of our own SLAMs has a process, the longest first.
    free_s = [0.0] * min(usable_cores(), len(BUILT_IN))
    for cost in sorted((producer(name).cost for name in BUILT_IN), reverse=True):
        free_s[free_s.index(min(free_s))] += cost * len(rows) * SCAN_S
    found = LogInfo(
        scans=len(rows),
        duration_s=float(stamps_s[-1] - stamps_s[0]),
        rate_hz=1.0 / period_s if period_s > 0.0 and log.has_stamps else None,
        gaps=int((steps_s > GAP_PERIODS * period_s).sum()),
        longest_gap_s=float(steps_s.max(initial=0.0)),
        beams=", ".join(str(int(count)) for count in np.unique(beams)),
        field_of_view_deg=math.degrees(abs(scan.angle_increment_rad) * (len(scan.ranges) - 1)),
        range_max_m=scan.range_max_m,
        returns_percent=100.0 * float(hits.sum() / beams.sum()),
        odometry_m=float(np.hypot(*moves_m).sum()) if has_pose.any() else None,
        out_of_order=left_out if log.has_stamps else None,
        deskewed=log.deskewing.scans,
        topics=topics,
        frames=frames,
        run_time_s=OTHER_STAGES_S + max(free_s),
        run_memory_mb=RUN_MB,
    )
    if not hits.any():
        remarks.append("no beam of it hits anything: no SLAM can map it")
    if period_s > AHEAD_S:
        remarks.append(f"the scans are {period_s:.4g} s apart: are their stamps in seconds?")
    remarks += [f"left out: {text}" for text in log.skips.sentences()]
    remarks += [f"odd: {text}" for text in log.warnings.sentences()]
    remarks += [*log.deskewing.sentences(), *log.notes]
    return InfoDocument(path, log=found, remarks=list(dict.fromkeys(remarks)))


def _map_info(path: Path, config: RunConfig, resolution: float | None) -> InfoDocument:
    remarks: list[str] = []
    (grid,) = load_maps([path], config, resolution=resolution, warn=remarks.append)
    walls_m2 = float((grid.cells == OCCUPIED).sum() * grid.resolution**2)
    known_m2 = float((grid.cells != UNKNOWN).sum() * grid.resolution**2)
    remarks += ["cells of over a metre: is its resolution in metres?"] * (grid.resolution > 1.0)
    if not walls_m2:
        remarks.append("no wall in it: it aligns with no other map")
    elif 2.0 * walls_m2 > known_m2:
        share = f"{walls_m2 / known_m2:.0%} of what is known"
        remarks.append(f"{share} is wall: check 'negate' and 'mode' in its YAML")
    found = MapInfo(
        width=grid.width,
        height=grid.height,
        resolution_m=grid.resolution,
        origin_x_m=grid.origin.x,
        origin_y_m=grid.origin.y,
        origin_yaw_deg=math.degrees(grid.origin.yaw_rad),
        known_m2=known_m2,
        walls_m2=walls_m2,
    )
    return InfoDocument(path, map=found, remarks=remarks)


def _run_info(folder: Path) -> InfoDocument | None:
    """Return what a run's record says; None for that of ``slamfusion fuse -o DIR/fused``."""
    path = folder / RUN_RECORD
    try:
        record: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if "groups" in record:
            return None
        answer = record["recommendation"]
        found = RunInfo(
            log=record["log"],
            slams=[
                f"{item['name']}: {item['failed'] or str(item['scans_used']) + ' scans'}"
                for item in record["producers"]
            ],
            maps_fused=record["fused_count"],
            fused_mode=record["fused_mode"],
            recommendation=None if answer is None else Recommendation.from_json(answer).headline,
            time_s=record["time_s"],
            report=record["report"],
        )
        remarks = [*record["not_measured"], *filter(None, [record["why_voted"]])]
    except (ValueError, KeyError, TypeError) as error:
        message = f"{path}: wanted the record of a run, found a damaged one ({error!r}); run again"
        raise MapFileError(message) from error
    return InfoDocument(folder, run=found, remarks=remarks)
