"""Odometry in a CSV file next to a log, one row for each laser line.

For a corrected log, whose own poses are the result of a SLAM.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamfusion.errors import LogError
from slamfusion.geometry import F64, Pose2, wrap_angle
from slamfusion.io.lines import ROW_BYTES, text_lines

PoseRow = tuple[float, float, float]

INDEX = "index"
POSE = ("odom_x", "odom_y", "odom_theta")
# Optional: the poses in the log that the file belongs to.
LOGGED = ("corrected_x", "corrected_y", "corrected_theta")
# Rounding of a log of six digits (metres or radians, and share of a coordinate).
ROUNDING, ROUNDING_SHARE = 2e-5, 1e-5


@dataclass(frozen=True, eq=False)
class ScanOdometry:
    """Odometry of every laser line of a log.

    Attributes:
        poses: (N, 3) float64, x and y in metres, yaw in radians, of the robot at laser line 0 to
            N - 1 of the log, in the odometry frame.
        logged: (N, 3) float64, the poses in the log's own lines, to check that the file belongs to
            the log; None if the file has none.
    """

    path: Path
    poses: F64
    logged: F64 | None = None

    def for_lines(self, log: Path, logged: Sequence[PoseRow | None]) -> list[Pose2]:
        """Return the odometry of each laser line of a log.

        Args:
            logged: the poses in the lines, metres and radians; None if unreadable.

        Raises:
            LogError: the number of rows differs from the number of lines, or a pose differs.
        """
        if len(self.poses) != len(logged):
            raise LogError(
                f"{self.path}: wanted a row for each of the {len(logged)} laser lines of {log}, "
                f"found {len(self.poses)}; give the odometry of this log"
            )
        rows = () if self.logged is None else self.logged
        for index, (own, line) in enumerate(zip(rows, logged, strict=False)):
            if line is None:
                continue
            away = np.abs(own - np.array(line))
            away[2] = abs(wrap_angle(float(away[2])))
            if (away > ROUNDING + ROUNDING_SHARE * np.abs(own)).any():
                raise LogError(
                    f"{self.path}: row {index} belongs to a scan at {_text(own)}, but that laser "
                    f"line of {log} is at {_text(line)}; give the odometry of this log"
                )
        return [Pose2(*row) for row in self.poses.tolist()]


def read_scan_odometry(path: str | Path) -> ScanOdometry:
    """Read the odometry of a log's scans.

    Args:
        path: CSV, plain or gzip. The first line names the columns: ``index`` (of the laser line in
            the log, from 0, without a gap), ``odom_x``, ``odom_y`` (metres), ``odom_theta``
            (radians), and optionally ``corrected_x``, ``corrected_y``, ``corrected_theta``, the
            pose in the log's line; others are ignored.
    """
    where = Path(path)
    columns: list[str] = []
    rows: list[list[float]] = []
    for number, line in text_lines(where, LogError, kept_bytes=ROW_BYTES):
        fields = line.decode("ascii", "replace").strip().split(",")
        if not columns:
            columns = [name.strip() for name in fields]
            missing = [name for name in (INDEX, *POSE) if name not in columns]
            if missing:
                raise LogError(
                    f"{where}: wanted the columns {', '.join((INDEX, *POSE))} in the first line, "
                    f"found no {', '.join(missing)}; give a CSV file with these"
                )
        elif fields != [""]:
            rows.append(_row(fields, columns, len(rows), f"{where}: line {number}"))
    if not rows:
        raise LogError(f"{where}: wanted a row for each scan, found none; check the file")
    table = np.array(rows)
    has_logged = all(name in columns for name in LOGGED)
    return ScanOdometry(
        where,
        table[:, [columns.index(name) for name in POSE]],
        table[:, [columns.index(name) for name in LOGGED]] if has_logged else None,
    )


def _row(fields: list[str], columns: list[str], index: int, where: str) -> list[float]:
    """Return the numbers of one line; index and pose must be finite."""
    try:
        values = [float(field) for field in fields]
    except ValueError:
        values = []
    has_all = len(values) == len(columns)
    if not has_all or not all(math.isfinite(values[columns.index(n)]) for n in (INDEX, *POSE)):
        raise LogError(
            f"{where}: wanted {len(columns)} finite numbers, found {','.join(fields)[:60]!r}; "
            "fix the line"
        )
    found = values[columns.index(INDEX)]
    if found != index:
        raise LogError(
            f"{where}: wanted the row of index {index}, found {found:g}: a row is missing or out "
            "of order; fix the file"
        )
    return values


def _text(pose: npt.ArrayLike) -> str:
    x, y, yaw_rad = np.asarray(pose, dtype=np.float64).tolist()
    return f"({x:.4f}, {y:.4f}) m, {yaw_rad:.4f} rad"
