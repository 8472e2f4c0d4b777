"""What is done to the scans of a drive before producers are fed: kidnapping, broken sensors.

Each function takes the scans that the robot recorded and returns those that a producer is fed. No
range is changed; a scan without odometry has none afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from slamfusion.geometry import Pose2
from slamfusion.io import LogScan

# The robot is kidnapped over this part of its drive.
KIDNAPPED_FROM, KIDNAPPED_TO = 0.45, 0.55
# From here on the wheels' encoder reads distances too long and turns too small.
BROKEN_FROM, BROKEN_DISTANCE, BROKEN_TURN = 1.0 / 3.0, 1.4, 0.4
LOST_FROM = 0.5

Scans = Sequence[LogScan]


def kidnap(scans: Scans) -> tuple[LogScan, ...]:
    """Return the scans of a robot that was lifted and set down elsewhere: a kidnapping.

    It is blind on its way, and its wheels stand still: the part of the drive is cut out, and time
    and odometry go on as if nothing had been.
    """
    first, last = int(KIDNAPPED_FROM * len(scans)), int(KIDNAPPED_TO * len(scans))
    if not 0 < first < last < len(scans):
        return tuple(scans)
    before, after = scans[first - 1], scans[last]
    step_s = scans[first].scan.stamp_s - before.scan.stamp_s
    sooner_s = after.scan.stamp_s - before.scan.stamp_s - step_s
    moved = [
        replace(item, scan=replace(item.scan, stamp_s=item.scan.stamp_s - sooner_s))
        for item in scans[last:]
    ]
    if before.odometry is not None and after.odometry is not None:
        back = before.odometry.compose(after.odometry.inverse())
        moved = [_at(item, back.compose) for item in moved]
    return (*scans[:first], *moved)


def break_odometry(scans: Scans) -> tuple[LogScan, ...]:
    """Return the scans with odometry of distances too long and turns too small, from a third on.

    Errors that are in proportion to the motion, much larger than a motion model expects.
    """
    first = int(BROKEN_FROM * len(scans))
    fed, read, before = list(scans[:first]), None, None
    for item in scans[first:]:
        if item.odometry is None or before is None or read is None:
            read = item.odometry
        else:
            step = before.inverse().compose(item.odometry)
            read = read.compose(
                Pose2(
                    BROKEN_DISTANCE * step.x, BROKEN_DISTANCE * step.y, BROKEN_TURN * step.yaw_rad
                )
            )
        before = item.odometry
        fed.append(item if read is None else replace(item, odometry=read))
    return tuple(fed)


def lose(scans: Scans) -> tuple[LogScan, ...]:
    """Return the scans of a producer that is lost for good from half of the drive on.

    Its laser was knocked off its mount and hangs upside down: left and right change places, and
    nothing that it sees fits what it has drawn. A mere jump of odometry is found back from.
    """
    first = int(LOST_FROM * len(scans))
    return (*scans[:first], *(_upside_down(item) for item in scans[first:]))


def _upside_down(item: LogScan) -> LogScan:
    """Return a scan with left and right in each other's place."""
    scan = item.scan
    first, step = -scan.angle_min_rad, -scan.angle_increment_rad
    return replace(item, scan=replace(scan, angle_min_rad=first, angle_increment_rad=step))


def _at(item: LogScan, move: Callable[[Pose2], Pose2]) -> LogScan:
    """Return a scan with its odometry moved."""
    return item if item.odometry is None else replace(item, odometry=move(item.odometry))


FAULTS: dict[str, Callable[[Scans], tuple[LogScan, ...]]] = {
    "kidnap": kidnap,
    "break_odometry": break_odometry,
    "lose": lose,
}
