"""What the fusion node says of itself and of its inputs on ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from slamfusion.fusion.live import LiveInput
from slamfusion.fusion.live.outbox import Sent
from slamfusion.fusion.live.session import Snapshot
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.ros.base import Level, Status
from slamfusion.ros.map_source import MapSource

FUSION, PREFIX = "fusion", "input "
# Of an input's figures: what it is called in ``inputs``.
ENTRY = "entry"


def fusion_status(
    lines: Sequence[Status],
    worst_else: tuple[Level, str],
    nothing: str,
    worst: Level,
    values: Mapping[str, object],
) -> Status:
    """Return the line of the fusion.

    Args:
        lines: those of its inputs.
        worst_else: the worst level of what else is wrong, and all of it in words.
        nothing: why nothing is fused, where no input votes.
        worst: the level of that.
        values: its figures.
    """
    level, message = worst_else
    out = [line.name.removeprefix(PREFIX) for line in lines if line.level != Level.OK]
    voters = len(lines) - len(out)
    if not voters:
        words = nothing
        level = max(level, worst)
    elif out:
        words = f"{voters} of {len(lines)} inputs vote; not: {', '.join(out)}"
        level = max(level, Level.WARN)
    else:
        words = f"all {voters} inputs vote"
    said = "; ".join(filter(None, (words, message)))
    return Status(FUSION, level, said, {"inputs": len(lines), "voters": voters, **values})


def fusion_figures(
    snapshot: Snapshot,
    sent: Sent,
    published: tuple[object, OccupancyGrid] | None,
    leader: str,
    device: str,
) -> dict[str, object]:
    """Return the figures of the fusion's line.

    Args:
        snapshot: of the session.
        sent: what went out so far.
        published: the last published map as message and as grid; None before the first.
        leader: name of the input whose pose is taken; empty without.
        device: that computes.
    """
    update = snapshot.update
    grid = None if published is None else published[1]
    values: dict[str, object] = {
        "reference": update.reference if update is not None else None,
        "pose from": leader or None,
        "maps published": sent.maps,
        "updates": snapshot.updates,
        "full searches": snapshot.searches,
        "resets": snapshot.resets,
        "phantom cells": update.phantom_cells if update is not None else None,
        "map [cells]": "-" if grid is None else f"{grid.width} x {grid.height}",
        "latency median [ms]": sent.median_ms,
        "latency p95 [ms]": sent.high_ms,
        "device": device,
    }
    if update is not None:
        values |= {f"{step} [ms]": 1e3 * spent for step, spent in update.time_s.items()}
    return values


def input_status(
    name: str,
    entry: str,
    source: MapSource | None,
    topic: str,
    frame: str,
    record: LiveInput | None,
    since_s: float,
) -> Status:
    """Return the line of one input.

    Args:
        name: of the input.
        entry: of it in ``inputs``.
        source: of its maps; None for a saved map.
        topic: its name in full.
        frame: that its transform is sent to.
        record: as the last update left it; None before its first map.
        since_s: how long ago that update was.
    """
    if record is None:
        who = "nobody publishes it"
        if source is None or source.silent_since_s is None:
            who = "a node could publish it"
        said = f"no map on {topic!r} yet; {who}"
        return Status(PREFIX + name, Level.STALE, said, {ENTRY: entry})
    transform = record.transform or Pose2()
    is_silent = record.reason.startswith(("lost", "no map for"))
    level = Level.OK if record.accepted else Level.STALE if is_silent else Level.WARN
    values: dict[str, object] = {
        ENTRY: entry,
        "accepted": record.accepted,
        "score": record.score,
        "overlap": record.overlap,
        "tracked": record.is_tracked,
        "age [s]": record.age_s + since_s,
        "rate [Hz]": record.rate_hz,
        "maps": record.maps,
        "maps refused": record.rejected,
        "x [m]": transform.x if record.transform is not None else None,
        "y [m]": transform.y if record.transform is not None else None,
        "yaw [rad]": transform.yaw_rad if record.transform is not None else None,
        "frame": frame,
    }
    return Status(PREFIX + name, level, record.reason, values)
