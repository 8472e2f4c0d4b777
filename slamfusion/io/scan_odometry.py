"""Odometry in a CSV file next to a log, one row for each laser line.

For a corrected log, whose own poses are the result of a SLAM.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slamfusion.errors import LogError
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.io.lines import ROW_BYTES, numbers, text_lines

PoseRow = tuple[float, float, float]

INDEX = "index"
POSE = ("odom_x", "odom_y", "odom_theta")
# Optional: the poses in the log that the file belongs to.
LOGGED = ("corrected_x", "corrected_y", "corrected_theta")
# Rounding of a log of six digits (metres or radians, and share of a coordinate).
ROUNDING, ROUNDING_SHARE = 2e-5, 1e-5


def read_scan_odometry(
    path: str | Path, log: Path, logged: Sequence[PoseRow | None]
) -> list[Pose2]:
    """Read the odometry of each laser line of a log.

    Args:
        path: CSV, plain or gzip. The first line names the columns: ``index`` (of the laser line in
            the log, from 0, without a gap), ``odom_x``, ``odom_y`` (metres), ``odom_theta``
            (radians), and optionally ``corrected_x``, ``corrected_y``, ``corrected_theta``, the
            pose in the log's line, which shows that the file belongs to the log; others are
            ignored.
        logged: the poses in the log's laser lines, metres and radians; None if unreadable.

    Raises:
        LogError: a damaged row, another number of rows than of lines, or a pose differs.
    """
    where = Path(path)
    columns: list[str] = []
    rows: list[dict[str, float]] = []
    for number, line in text_lines(where, LogError, kept_bytes=ROW_BYTES):
        fields = line.strip().split(b",")
        if not columns:
            columns = [name.decode("ascii", "replace").strip() for name in fields]
            missing = [name for name in (INDEX, *POSE) if name not in columns]
            if missing:
                raise LogError(
                    f"{where}: wanted the columns {', '.join((INDEX, *POSE))} in the first line, "
                    f"found no {', '.join(missing)}; give a CSV file with these"
                )
        elif fields != [b""]:
            rows.append(_row(fields, columns, len(rows), f"{where}: line {number}"))
    if not rows:
        raise LogError(f"{where}: wanted a row for each scan, found none; check the file")
    if len(rows) != len(logged):
        raise LogError(
            f"{where}: wanted a row for each of the {len(logged)} laser lines of {log}, found "
            f"{len(rows)}; give the odometry of this log"
        )
    if set(LOGGED) <= set(columns):
        for index, (row, line_pose) in enumerate(zip(rows, logged, strict=True)):
            own = [row[name] for name in LOGGED]
            if line_pose is not None and not _is_same(own, line_pose):
                raise LogError(
                    f"{where}: row {index} belongs to a scan at {_text(own)}, but that laser line "
                    f"of {log} is at {_text(line_pose)}; give the odometry of this log"
                )
    return [Pose2(*(row[name] for name in POSE)) for row in rows]


def _row(fields: list[bytes], columns: list[str], index: int, where: str) -> dict[str, float]:
    """Return the numbers of one line by column."""
    if len(fields) != len(columns):
        message = f"{where}: wanted {len(columns)} columns, found {len(fields)}; fix the line"
        raise LogError(message)
    used = [name for name in (INDEX, *POSE, *LOGGED) if name in columns]
    row = dict(zip(used, numbers(fields, where, LogError, map(columns.index, used)), strict=True))
    if row[INDEX] != index:
        raise LogError(
            f"{where}: wanted the row of index {index}, found {row[INDEX]:g}: a row is missing or "
            "out of order; fix the file"
        )
    return row


def _is_same(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two poses differ by no more than the rounding of a log."""
    away = [abs(a - b) for a, b in zip(one, other, strict=True)]
    away[2] = abs(wrap_angle(away[2]))
    return not any(d > ROUNDING + ROUNDING_SHARE * abs(a) for d, a in zip(away, one, strict=True))


def _text(pose: Sequence[float]) -> str:
    x, y, yaw_rad = pose
    return f"({x:.4f}, {y:.4f}) m, {yaw_rad:.4f} rad"
