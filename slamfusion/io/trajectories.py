"""``read_trajectory``: stamped poses from logs, bags, graphs and tables."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamfusion.config import YAW_MOST_RAD, LogConfig
from slamfusion.errors import TrajectoryError, counted
from slamfusion.geometry import F64, quaternion_yaw_rad, wrap_angle
from slamfusion.io.bags import METADATA
from slamfusion.io.carmen import CARMEN_WORDS
from slamfusion.io.files import write_atomic
from slamfusion.io.lines import (
    KINDS,
    MAP_SUFFIXES,
    ROW_BYTES,
    numbers,
    packed_by_name,
    printable,
    strip_gz,
    text_lines,
)
from slamfusion.io.log import odometry_path
from slamfusion.io.logs import BAG_SUFFIXES, bag_at, open_log
from slamfusion.io.tinyslam_dat import FIELDS
from slamfusion.trajectory import Trajectory

_LOGGER = logging.getLogger(__name__)

# Times since 1970 have 10 digits in seconds, 13, 16 or 19 in thousandths of the unit before.
_SECONDS_BELOW = 1e11
# Quaternions of few digits are this far from length 1.
_QUATERNION_SLACK = 0.05
# Columns of ``t x y theta``, of a TUM file, and of the matrices of KITTI.
_PLANAR, _TUM, _KITTI = 4, 8, 12
# Limits of a robot on a floor: tilt; climb in metres and as a share of the travelled extent; way
# to the side in metres if it never turns.
_TILT_MAX_DEG, _CLIMB_MAX_M, _CLIMB_MAX, _ASIDE_MAX_M = 30.0, 0.5, 0.5, 0.5
_WANTED = (
    "a TUM file (8 columns, time x y z qx qy qz qw), rows of 'time x y theta', a heading that "
    "names such columns, a log, or a reference graph"
)

# Units in a heading, in seconds, metres or radians.
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "cm": 1e-2, "mm": 1e-3}
_UNITS |= {"rad": 1.0, "deg": math.pi / 180.0}
# Columns of a pose, each with its unit; None: not known.
Columns = list[tuple[int, float | None]]

Row = tuple[float, float, float, float]


def read_trajectory(
    path: str | Path,
    config: LogConfig = LogConfig(),
    pose_topic: str | None = None,
    warn: Callable[[str], None] = _LOGGER.warning,
) -> Trajectory:
    """Read stamped poses.

    The content decides the format:

    - 8 columns ``t x y z qx qy qz qw``: TUM, in the order of time; z, roll and pitch are dropped.
      A path that does not lie in the plane is refused, with the likely cause: quaternions written
      w first, or camera axes, both of which ``config`` can state.
    - 4 columns ``t x y theta``, sorted by time (equal times keep their order); rows out of order
      are counted in the log. A theta in degrees is refused if it jumps by more than two turns.
    - the same in other columns, separated by blanks or commas, under a heading that names them, as
      in EuRoC, and may end in their units (``t_ns``, ``x [mm]``, ``yaw_deg``). Without one, t is in
      seconds if all are below 1e11, in ms below 1e14, in us below 1e17, else in ns.
    - a reference graph: each ``VERTEX2`` with the stamp of the ``ROBOTLASER1`` after it, sorted
      by time; of equal stamps the first stays, with a warning.
    - any log or bag that ``open_log`` reads: the odometry of its scans.

    Args:
        path: the file, plain or gzip, or a ROS 2 bag's folder.
        pose_topic: of a bag, a topic of poses or ``tf``; default: the odometry of its scans; of
            a bag without scans its only topic of poses, else its transforms.

    Raises:
        TrajectoryError: another kind of file, a damaged line (with its number), no pose, or a path
            that does not lie in the plane.
        LogError: it is a log that cannot be read.
        OSError: the file cannot be opened.
    """
    where = Path(path)
    name = Path(strip_gz(where.name)).stem or where.name
    if where.is_dir() or strip_gz(where.name).endswith((*BAG_SUFFIXES, METADATA)):
        return _bag_path(where, config, name, pose_topic, warn)
    if (suffix := Path(strip_gz(where.name)).suffix) in MAP_SUFFIXES:
        raise TrajectoryError(f"{where}: wanted {_WANTED}, found {KINDS[suffix]}")
    first, columns = _first_fields(where)
    if first and (first[0] in CARMEN_WORDS or len(first) == FIELDS):
        graph = _read_graph(where, name)
        return _log_odometry(where, config, name) if graph is None else graph
    rows = list(_rows(where, first, columns)) if first else []
    if not rows:
        message = f"{where}: wanted {_WANTED}, found no pose at all; give a file with poses"
        raise TrajectoryError(message)
    table = np.array(rows)
    if columns is None or columns[0][1] is None:
        latest = np.abs(table[:, 0]).max()
        digits = (digits for digits in (0, 3, 6) if latest < _SECONDS_BELOW * 10.0**digits)
        table[:, 0] *= 10.0 ** -next(digits, 9)
    if table.shape[1] == _TUM:
        table = _in_plane(where, table, config)
    _check_yaw(where, table[:, 1:], warn)
    backward = int((np.diff(table[:, 0]) < 0.0).sum())
    if backward:
        what = "rows are earlier than the one before; sorted by time"
        _LOGGER.info("%s: %d %s", where, backward, what)
        table = table[np.argsort(table[:, 0], kind="stable")]
    return Trajectory(table[:, 0], table[:, 1:], name)


def _first_fields(where: Path) -> tuple[list[bytes], Columns | None]:
    """Return the fields of the first data line, and a pose's columns if a heading names them."""
    columns: Columns | None = None
    for _, line in text_lines(where, TrajectoryError):
        named = _named_columns(_split(line.strip().lstrip(b"#%")))
        columns = columns if named is None else named
        fields = _fields(line)
        if fields and (_is_number(fields[0]) or named is None):
            is_whole = columns is not None and max(columns)[0] < len(fields)
            return fields, columns if is_whole else None
    return [], None


def _named_columns(names: list[bytes]) -> Columns | None:
    """Return the columns of t x y theta, or t x y z qx qy qz qw, in a heading, with their units.

    A unit follows the name: ``time_ns``, ``p_x [mm]``, ``yaw (deg)``.
    """
    plain = [re.sub(r"[\"'\s]", "", name.decode("ascii", "replace").lower()) for name in names]
    words = [re.sub(rf"[\[(].*|_({'|'.join(_UNITS)})$", "", name) for name in plain]
    ends = [re.search(r"[_\[(]([a-z]+)[\])]?$", name) for name in plain]
    units = [None if end is None else _UNITS.get(end[1]) for end in ends]

    def find(pattern: str) -> int | None:
        return next((i for i, word in enumerate(words) if re.fullmatch(pattern, word)), None)

    time = find("(ipc_?)?(time_?stamp|time|stamp|t|sec|seconds)s?")
    place = [find(rf"((p|t|pos\w*|translation)[._]?(\w+[._])*)?{axis}") for axis in "xyz"]
    turn = [find(rf"(q|quat\w*|rot\w*|orientation)[._]?(\w+[._])*{axis}") for axis in "xyzw"]
    columns = [time, *place, *turn]
    if None in columns:
        columns = [time, *place[:2], find("theta|yaw|heading")]
    return None if None in columns else [(i, units[i]) for i in columns if i is not None]


def _split(line: bytes) -> list[bytes]:
    """Return the fields of a line, separated by semicolons or commas, or else blanks."""
    mark = next((mark for mark in (b";", b",") if mark in line), None)
    if mark is None:
        return line.split()
    return [item.strip() for item in line.rstrip(mark + b" \t\r\n").split(mark)]


def _fields(line: bytes) -> list[bytes]:
    stripped = line.strip()
    return [] if stripped.startswith((b"#", b"%")) else _split(stripped)


# --- tables --------------------------------------------------------------------------------------


def _rows(where: Path, first: list[bytes], columns: Columns | None) -> Iterator[list[float]]:
    """Yield t, x, y and yaw, or the 8 values of a TUM file, of every line."""
    if columns is None:
        if len(first) not in {_PLANAR, _TUM} or not _is_number(first[0]):
            count = counted(len(first), "column")
            causes = dict.fromkeys((_PLANAR, _TUM), ", the first of them no time")
            cause = (causes | {_KITTI: " as in KITTI, without a time"}).get(len(first), "")
            lines = (line.strip() for _, line in text_lines(where, TrajectoryError))
            line = next(line for line in lines if _fields(line) == first)
            if re.search(rb"\d,\d+[\s;]", line):
                cause = ", with decimal commas where points are wanted"
            raise TrajectoryError(
                f"{where}: wanted {_WANTED}, found {count}{cause}: {printable(line)!r} in the "
                "first line; check the file"
            )
        columns = [(i, None) for i in range(len(first))]
    last = -math.inf
    for number, line in text_lines(where, TrajectoryError, kept_bytes=ROW_BYTES):
        fields = _fields(line)
        if not fields or (last == -math.inf and _named_columns(fields) is not None):
            continue
        at = f"{where}: line {number}"
        if len(fields) != len(first):
            raise TrajectoryError(
                f"{at}: wanted {len(first)} columns as in the lines before, found {len(fields)}; "
                "fix or remove the line"
            )
        values = numbers(fields, at, TrajectoryError, (column for column, _ in columns))
        length = math.hypot(*values[4:]) if len(values) == _TUM else 1.0
        if abs(length - 1.0) > _QUATERNION_SLACK:
            raise TrajectoryError(
                f"{at}: the quaternion has length {length:.3g}, wanted 1; check that this is a TUM "
                "file (t x y z qx qy qz qw)"
            )
        if len(values) == _TUM and values[0] < last:
            raise TrajectoryError(
                f"{at}: time goes back from {last:.6f} to {values[0]:.6f}; sort the lines by time"
            )
        last = values[0]
        yield [value * (unit or 1.0) for value, (_, unit) in zip(values, columns, strict=True)]


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


# --- the plane ------------------------------------------------------------------------------------


def _in_plane(where: Path, rows: F64, config: LogConfig) -> F64:
    """Return time, x, y and yaw, (N, 4), of rows ``t x y z qx qy qz qw``, (N, 8)."""
    poses = _robot_poses(rows, config.quaternion, config.axes)
    problem = _out_of_plane(poses)
    # With several files, the options apply to those that need them.
    if problem is not None and _out_of_plane(rows[:, 1:]) is None:
        poses, problem = rows[:, 1:], None
    if problem is not None:
        advice = "wanted the path of a robot on one floor, with z up"
        for quaternion, axes, words in (
            ("wxyz", config.axes, "are its quaternions written w first? use --quaternion wxyz"),
            (config.quaternion, "camera", "are its axes those of a camera? use --axes camera"),
            ("wxyz", "camera", "use --quaternion wxyz and --axes camera"),
        ):
            if _out_of_plane(_robot_poses(rows, quaternion, axes)) is None:
                advice = words
                break
        raise TrajectoryError(f"{where}: the path does not lie in the plane: {problem}; {advice}")
    yaws = [quaternion_yaw_rad(*turn) for turn in poses[:, 3:].tolist()]
    return np.column_stack((rows[:, 0], poses[:, :2], yaws))


def _robot_poses(rows: F64, quaternion: str, axes: str) -> F64:
    """Return places and quaternions x y z w, (N, 7), x ahead and z up, of rows of a TUM file."""
    places, turns = rows[:, 1:4], rows[:, 4:]
    if quaternion == "wxyz":
        turns = turns[:, [1, 2, 3, 0]]
    poses = np.column_stack((places, turns))
    if axes == "robot":
        return poses
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (who reads maps needs none)

    # A camera looks along z, with x right and y down. Either only the camera has such axes ...
    ahead = (Rotation.from_quat(turns) * Rotation.from_quat([0.5, -0.5, 0.5, 0.5])).as_quat()
    upright = np.column_stack((places, ahead))
    if _out_of_plane(upright) is None:
        return np.asarray(upright, dtype=np.float64)
    # ... or also the world, as the frame of the camera's first pose.
    order, signs = [2, 0, 1, 5, 3, 4, 6], (1.0, -1.0, -1.0, 1.0, -1.0, -1.0, 1.0)
    return np.asarray(poses[:, order] * signs, dtype=np.float64)


def _out_of_plane(poses: F64) -> str | None:
    """Return how a path of (N, 7) places and quaternions leaves the plane; None if it does not."""
    turns = poses[:, 3:]
    upward = 1.0 - 2.0 * (turns[:, :2] ** 2).sum(axis=1) / (turns**2).sum(axis=1)
    tilt_deg = float(np.percentile(np.degrees(np.arccos(np.clip(upward, -1.0, 1.0))), 95.0))
    if tilt_deg > _TILT_MAX_DEG:
        return f"the robot tilts by {tilt_deg:.0f} degrees"
    extents = np.ptp(poses[:, :3], axis=0)
    if extents[2] > max(_CLIMB_MAX_M, _CLIMB_MAX * float(extents[:2].max())):
        return f"z varies by {extents[2]:.1f} m, x and y by {extents[0]:.1f} and {extents[1]:.1f} m"
    return None


def _check_yaw(where: Path, poses: F64, warn: Callable[[str], None]) -> None:
    """Refuse yaws, (N, 3) poses, that jump as those in degrees do; warn of one that never turns."""
    # A wrapped yaw jumps by a turn, and by what the robot turns meanwhile.
    jump = np.abs(np.diff(poses[:, 2])).max(initial=0.0)
    if jump > YAW_MOST_RAD:
        raise TrajectoryError(
            f"{where}: theta jumps by {jump:.4g} between two poses, wanted radians; is it in "
            "degrees? convert it"
        )
    places = poses[:, :2] - poses[:, :2].mean(axis=0)
    aside_m = np.ptp(places @ np.linalg.svd(places, full_matrices=False)[2].T, axis=0)[-1]
    if np.ptp(poses[:, 2]) == 0.0 and aside_m > _ASIDE_MAX_M:
        warn(
            f"{where}: all {len(poses)} poses have one yaw, but the path turns: positions alone? "
            "then errors of rotation, and relative ones, mean nothing"
        )


# --- graphs and logs -----------------------------------------------------------------------------


def _read_graph(where: Path, name: str) -> Trajectory | None:
    """Return the vertices of a reference graph by time, or None without vertices."""
    rows: list[Row] = []
    pose: list[float] | None = None
    vertices = 0
    for number, line in text_lines(where, TrajectoryError, kept_bytes=ROW_BYTES):
        if line.startswith(b"VERTEX2"):
            fields = line.split()
            if len(fields) != 5:
                message = f"{where}: line {number}: wanted 'VERTEX2 id x y theta'; fix the line"
                raise TrajectoryError(message)
            pose = numbers(fields, f"{where}: line {number}", TrajectoryError, (2, 3, 4))
            vertices += 1
        elif pose is not None and line.startswith(b"ROBOTLASER1"):
            row = _vertex_row(pose, line.rsplit(None, 11))
            if not all(map(math.isfinite, row)):
                message = f"{where}: line {number}: pose or time not finite; fix the line"
                raise TrajectoryError(message)
            rows.append(row)
            pose = None
        elif vertices == 0 and number > 1 and line.startswith((b"FLASER", b"ROBOTLASER1")):
            return None
    if not vertices:
        return None
    if not rows:
        raise TrajectoryError(
            f"{where}: {vertices} vertices, but no ROBOTLASER1 line that says their time; give a "
            "graph with scans"
        )
    table = np.array(rows)
    stamps, first = np.unique(table[:, 0], return_index=True)
    _warn(where, len(table) - len(stamps), "vertices have the stamp of an earlier one; left out")
    _warn(where, vertices - len(rows), "vertices have no scan and so no time; left out")
    return Trajectory(stamps, table[first, 1:], name)


def _vertex_row(vertex: list[float], tail: list[bytes]) -> Row:
    """Return a vertex with the time of its scan; NaN if the scan's line is damaged."""
    try:
        robot = [float(item) for item in tail[1:4]]
        stamp_s = float(tail[9])
    except (IndexError, ValueError):
        return (math.nan, math.nan, math.nan, math.nan)
    # The first vertex of the published graphs has three digits, 577 for 576.537; its scan has all.
    is_rounded = all(float(f"{scan:.3g}") == own for scan, own in zip(robot, vertex, strict=True))
    x, y, yaw_rad = robot if is_rounded else vertex
    return (stamp_s, x, y, yaw_rad)


def _bag_path(
    where: Path, config: LogConfig, name: str, topic: str | None, warn: Callable[[str], None]
) -> Trajectory:
    notes: list[str] = []
    bag = bag_at(where)
    table = None
    if bag is not None:
        from slamfusion.io.bags.odometry import read_poses  # noqa: PLC0415  (as logs.py does)

        table = read_poses(bag, config, topic, notes)
    for note in notes:
        warn(f"{where}: {note}")
    if table is None:
        return _log_odometry(where, config, name)
    poses = _in_plane(where, table, replace(config, quaternion="xyzw"))
    return Trajectory(poses[:, 0], poses[:, 1:], name)


def _log_odometry(where: Path, config: LogConfig, name: str) -> Trajectory:
    log = open_log(where, config)
    scans = list(log)
    if any(item.odometry is None for item in scans):
        raise TrajectoryError(
            f"{where}: its scans have no odometry, so there is no trajectory in it"
        )
    for sentence in (*log.skips.sentences(), *log.warnings.sentences()):
        _LOGGER.warning("%s: %s", where, sentence)
    if not log.has_stamps:
        _LOGGER.warning("%s: its time stamps cannot be used; times are made from indices", where)
    if not scans:
        reasons = "; ".join(log.skips.sentences())
        raise TrajectoryError(f"{where}: no scan of it can be used: {reasons}")
    return odometry_path(scans, name)


def _warn(where: Path, count: int, what: str) -> None:
    if count:
        _LOGGER.warning("%s: %d %s", where, count, what)


_HEADER = "# timestamp tx ty tz qx qy qz qw\n"


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a TUM file; the same poses give the same bytes.

    Times are seconds with nine decimals, lengths metres; z, roll and pitch are 0. The file is
    compressed if its name ends in ``.gz``.

    Raises:
        MapFileError: the file cannot be written.
    """
    target = Path(path)
    lines = [_HEADER]
    for stamp_s, (x, y, yaw_rad) in zip(
        trajectory.stamps_s.tolist(), trajectory.poses.tolist(), strict=True
    ):
        # Half of a wrapped angle keeps qw >= 0: one spelling for each pose.
        half_rad = 0.5 * wrap_angle(yaw_rad)
        lines.append(
            f"{stamp_s:.9f} {x:.9f} {y:.9f} 0 0 0 "
            f"{math.sin(half_rad):.12f} {math.cos(half_rad):.12f}\n"
        )
    write_atomic(target, packed_by_name(target, "".join(lines).encode()))


def replace_tum(path: Path, trajectory: Trajectory | None) -> None:
    """Write a trajectory as ``write_tum``; without one remove that of an earlier result."""
    if trajectory is None:
        path.unlink(missing_ok=True)
    else:
        write_tum(path, trajectory)
