"""``read_trajectory``: stamped poses from any of the files that hold them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import TrajectoryError
from slamfusion.io.carmen import CARMEN_WORDS
from slamfusion.io.lines import ROW_BYTES, TextLines, read_head, strip_gz
from slamfusion.io.logs import open_log
from slamfusion.io.tinyslam_dat import FIELDS
from slamfusion.io.tum import quaternion_yaw_rad
from slamfusion.trajectory import Trajectory

_DEFAULT_CONFIG = LogConfig()

_LOGGER = logging.getLogger(__name__)

# Seconds since 1970 have 10 digits, nanoseconds 19: in between no file of poses has its times.
_NANOSECONDS_FROM = 1e14
# Quaternions of few digits are this far from length 1.
_QUATERNION_SLACK = 0.05
_BAG_SUFFIXES = (".bag", ".db3", ".mcap")
_CSV_HEADER = ("ipc_timestamp", "x", "y", "theta")
_WANTED = (
    "a TUM file (8 columns, time x y z qx qy qz qw), rows of 'time x y theta', a CSV file with "
    "ipc_timestamp,x,y,theta, a log, or a reference graph"
)

Row = tuple[float, float, float, float]


def read_trajectory(path: str | Path, config: LogConfig = _DEFAULT_CONFIG) -> Trajectory:
    """Read stamped poses.

    The content decides what the file is:

    - 8 columns ``t x y z qx qy qz qw``: TUM, in the order of time; z, roll and pitch are dropped.
    - 4 columns ``t x y theta``, or CSV with the heading ``ipc_timestamp,x,y,theta``; t in
      nanoseconds where it is 1e14 or more, else in seconds. Recorded odometry need not be in
      order: it is sorted by time (equal times keep their order), and a warning is logged.
    - a reference graph: each ``VERTEX2`` with the stamp of the ``ROBOTLASER1`` after it, sorted
      by time; of equal stamps the first stays, and a warning is logged.
    - any log or bag that ``open_log`` reads: the odometry of its scans.

    Args:
        path: the file, plain or gzip, or a ROS 2 bag's folder.
        config: how logs and bags are read.

    Returns:
        The poses in the order of time, named after the file.

    Raises:
        TrajectoryError: not such a file, a damaged line (its number is given), or no pose in it.
        LogError: it is a log that cannot be read.
        OSError: the file cannot be opened.
    """
    where = Path(path)
    name = Path(strip_gz(where.name)).stem or where.name
    if where.is_dir() or strip_gz(where.name).endswith(_BAG_SUFFIXES):
        return _log_odometry(where, config, name)
    first = _first_fields(where)
    if first and (first[0] in CARMEN_WORDS or len(first) == FIELDS):
        graph = _read_graph(where, name)
        return _log_odometry(where, config, name) if graph is None else graph
    rows = list(_rows(where, first)) if first else []
    if not rows:
        message = f"{where}: wanted {_WANTED}, found no pose at all; give a file with poses"
        raise TrajectoryError(message)
    table = np.array(rows)
    backward = int((np.diff(table[:, 0]) < 0.0).sum())
    if backward:
        _warn(where, backward, "rows are earlier than the one before; sorted by time")
        table = table[np.argsort(table[:, 0], kind="stable")]
    return Trajectory(table[:, 0], table[:, 1:], name)


def _first_fields(where: Path) -> list[bytes]:
    """Return the fields of the first line that says something."""
    for line in read_head(where).splitlines():
        fields = _fields(line)
        if fields:
            return fields
    return []


def _fields(line: bytes) -> list[bytes]:
    """Return the fields of a line between blanks or commas; none for a comment."""
    stripped = line.strip()
    if not stripped or stripped.startswith((b"#", b"%")):
        return []
    return [item.strip() for item in stripped.split(b",")] if b"," in line else stripped.split()


# --- tables --------------------------------------------------------------------------------------


def _rows(where: Path, first: list[bytes]) -> Iterator[Row]:
    """Yield time in seconds, x, y and yaw of every line.

    Args:
        where: the file.
        first: its first line's fields, which decide the columns.
    """
    header = tuple(item.decode("ascii", "replace") for item in first)
    has_header = header == _CSV_HEADER
    to_row = _COLUMNS.get(len(first))
    if to_row is None or not (has_header or _is_number(first[0])):
        shown = " ".join(header)[:60]
        columns = f"{len(first)} column{'s' if len(first) > 1 else ''}"
        cause = "" if to_row is None else ", the first of them no time"
        message = (
            f"{where}: wanted {_WANTED}, found {columns}{cause}: {_printable(shown)!r} in the "
            "first line; check the file"
        )
        raise TrajectoryError(message)
    last_s = -math.inf
    lines = TextLines(where, kept_bytes=ROW_BYTES, if_cut_off=TrajectoryError)
    for number, line in lines:
        fields = _fields(line)
        if not fields or (has_header and number == 1):
            continue
        if len(fields) != len(first):
            message = (
                f"{where}: line {number}: wanted {len(first)} columns as in the lines before, "
                f"found {len(fields)}; mend or remove the line"
            )
            raise TrajectoryError(message)
        values = _floats(fields, where, number)
        row = to_row(values)
        if not all(map(math.isfinite, row)):
            wrong = [i for i, value in enumerate(values, 1) if not math.isfinite(value)]
            which = f"column {wrong[0]}" if wrong else "the quaternion of columns 5 to 8"
            message = (
                f"{where}: line {number}, {which} of {len(fields)}: not a finite pose; mend or "
                "remove the line"
            )
            raise TrajectoryError(message)
        if to_row is _tum_row:
            _check_tum(where, number, values, last_s)
        last_s = row[0]
        yield row


def _check_tum(where: Path, number: int, values: list[float], last_s: float) -> None:
    """Refuse rows of 8 numbers that are something else, such as relations."""
    length = math.hypot(*values[4:])
    if abs(length - 1.0) > _QUATERNION_SLACK:
        message = (
            f"{where}: line {number}: the quaternion has length {length:.3g}, wanted 1; check that "
            "this is a TUM file (t x y z qx qy qz qw)"
        )
        raise TrajectoryError(message)
    if values[0] < last_s:
        message = (
            f"{where}: line {number}: time goes back from {last_s:.6f} s to {values[0]:.6f} s; "
            "sort the lines by time"
        )
        raise TrajectoryError(message)


def _floats(fields: list[bytes], where: Path, number: int) -> list[float]:
    try:
        return [float(item) for item in fields]
    except ValueError:
        wrong = next(index for index, item in enumerate(fields) if not _is_number(item))
        shown = _printable(fields[wrong][:60].decode("ascii", "replace"))
        message = (
            f"{where}: line {number}, column {wrong + 1} of {len(fields)}: wanted a number, found "
            f"{shown!r}; mend or remove the line"
        )
        raise TrajectoryError(message) from None


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _printable(text: str) -> str:
    return "".join(item if item.isprintable() else "?" for item in text)


def _planar_row(values: list[float]) -> Row:
    """Return a row of ``t x y theta``."""
    time, x, y, yaw_rad = values
    return (time * 1e-9 if abs(time) >= _NANOSECONDS_FROM else time, x, y, yaw_rad)


def _tum_row(values: list[float]) -> Row:
    """Return a row of ``t x y z qx qy qz qw``; NaN for a quaternion that is no rotation."""
    time_s, x, y, _, *quaternion = values
    return (time_s, x, y, quaternion_yaw_rad(*quaternion))


_COLUMNS: dict[int, Callable[[list[float]], Row]] = {4: _planar_row, 8: _tum_row}


# --- graphs and logs -----------------------------------------------------------------------------


def _read_graph(where: Path, name: str) -> Trajectory | None:
    """Return the vertices of a reference graph by time, or None when the file has none."""
    rows: list[Row] = []
    pose: list[float] | None = None
    vertices = 0
    for number, line in TextLines(where, kept_bytes=ROW_BYTES):
        if line.startswith(b"VERTEX2"):
            fields = line.split()
            if len(fields) != 5:
                message = f"{where}: line {number}: wanted 'VERTEX2 id x y theta'; mend the line"
                raise TrajectoryError(message)
            pose = _floats(fields[2:], where, number)
            vertices += 1
        elif pose is not None and line.startswith(b"ROBOTLASER1"):
            row = _vertex_row(pose, line.rsplit(None, 11))
            if not all(map(math.isfinite, row)):
                message = f"{where}: line {number}: pose or time not finite; mend the line"
                raise TrajectoryError(message)
            rows.append(row)
            pose = None
        elif vertices == 0 and number > 1 and line.startswith((b"FLASER", b"ROBOTLASER1")):
            return None
    if not vertices:
        return None
    if not rows:
        message = (
            f"{where}: {vertices} vertices, but no ROBOTLASER1 line that says their time; give a "
            "graph with scans"
        )
        raise TrajectoryError(message)
    table = np.array(rows)
    stamps, first = np.unique(table[:, 0], return_index=True)
    _warn(where, len(table) - len(stamps), "vertices have the stamp of an earlier one; left out")
    _warn(where, vertices - len(rows), "vertices have no scan and so no time; left out")
    return Trajectory(stamps, table[first, 1:], name)


def _vertex_row(vertex: list[float], tail: list[bytes]) -> Row:
    """Return a vertex with the time of its scan; NaN where the scan's line does not end well.

    Args:
        vertex: x, y, yaw as its own line says them.
        tail: the scan's line before its last 11 fields, and these: the robot's pose, 5 settings
            and speeds, time, host, logger's time.
    """
    try:
        robot = [float(item) for item in tail[1:4]]
        stamp_s = float(tail[9])
    except (IndexError, ValueError):
        return (math.nan, math.nan, math.nan, math.nan)
    # The first vertex of the published graphs has three digits, 577 for 576.537; its scan has all.
    is_rounded = all(float(f"{scan:.3g}") == own for scan, own in zip(robot, vertex, strict=True))
    x, y, yaw_rad = robot if is_rounded else vertex
    return (stamp_s, x, y, yaw_rad)


def _log_odometry(where: Path, config: LogConfig, name: str) -> Trajectory:
    """Return the odometry of a log's scans."""
    log = open_log(where, config)
    rows = []
    for scan in log:
        if scan.odometry is None:
            message = f"{where}: its scans have no odometry, so there is no trajectory in it"
            raise TrajectoryError(message)
        pose = scan.odometry
        rows.append((scan.scan.stamp_s, pose.x, pose.y, pose.yaw_rad))
    for sentence in (*log.skips.sentences(), *log.warnings.sentences()):
        _LOGGER.warning("%s: %s", where, sentence)
    if not log.has_stamps:
        _LOGGER.warning("%s: its time stamps cannot be used; times are made from indices", where)
    if not rows:
        reasons = "; ".join(log.skips.sentences())
        message = f"{where}: no scan of it can be used: {reasons}"
        raise TrajectoryError(message)
    table = np.array(rows)
    return Trajectory(table[:, 0], table[:, 1:], name)


def _warn(where: Path, count: int, what: str) -> None:
    if count:
        _LOGGER.warning("%s: %d %s", where, count, what)
