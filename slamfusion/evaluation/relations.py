"""The relations metric [K09]: errors of known motions between pairs of times.

Source: Kuemmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27(4),
2009. No common frame is needed, and an error at one place counts once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from slamfusion.errors import TrajectoryError
from slamfusion.evaluation.statistics import ErrorStatistics, mean_interval
from slamfusion.geometry import B8, F64, compose_poses, invert_poses, wrap_angles
from slamfusion.io.lines import KINDS, ROW_BYTES, numbers, strip_gz, text_lines
from slamfusion.trajectory import Trajectory

# A relation over a longer time joins two visits of one place.
REVISIT_S = 30.0
# A time this near to that of a scan is the same; rounding of both files.
AT_SCAN_S = 2e-5

_COLUMNS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")
_X, _Y, _YAW = (_COLUMNS.index(name) for name in ("x", "y", "yaw"))


@dataclass(frozen=True, eq=False)
class Relations:
    """Known motions between pairs of times.

    Attributes:
        stamps_s: (N, 2) float64, first and second time, seconds; in any order.
        motions: (N, 3) float64, pose of the robot at the second time in its frame at the first; x
            and y in metres, yaw in radians.

    Raises:
        TrajectoryError: shapes that do not fit, or values that are not finite.
    """

    stamps_s: F64
    motions: F64
    name: str = "relations"

    def __post_init__(self) -> None:
        stamps = np.array(self.stamps_s, dtype=np.float64).reshape(-1, 2)
        motions = np.array(self.motions, dtype=np.float64).reshape(-1, 3)
        if len(stamps) != len(motions):
            message = f"{self.name}: {len(stamps)} pairs of times for {len(motions)} motions"
            raise TrajectoryError(message)
        if not (np.isfinite(stamps).all() and np.isfinite(motions).all()):
            raise TrajectoryError(f"{self.name}: times and motions must be finite")
        stamps.flags.writeable = False
        motions.flags.writeable = False
        vars(self).update(stamps_s=stamps, motions=motions)

    def __len__(self) -> int:
        return len(self.stamps_s)

    def span_s(self) -> tuple[float, float]:
        """Return the first and the last time; NaN for no relations."""
        if len(self) == 0:
            return math.nan, math.nan
        return float(self.stamps_s.min()), float(self.stamps_s.max())


@dataclass(frozen=True, eq=False, kw_only=True)
class RelationErrors:
    """Errors of a trajectory on known relations [K09].

    What is left of each relation after the trajectory's own motion is taken off.
    """

    translation: ErrorStatistics = field(init=False)
    """Remaining translations on the known relations, metres."""
    rotation_deg: ErrorStatistics = field(init=False)
    """Remaining rotations on the known relations, degrees."""
    relations_used: int = field(init=False)
    """Relations whose two times met a pose."""
    relations_total: int
    """All relations of the file."""
    tolerance_s: float
    """Poses further apart in time than this do not meet, seconds."""
    poses: int
    """Poses of the path."""
    name: str = field(repr=False)
    """The trajectory."""
    relations: str = field(repr=False)
    """Name of the relations."""
    stamps_s: F64 = field(repr=False)
    """(M, 2), the times of the relations used."""
    translation_m: F64 = field(repr=False)
    """(M,), length of the remaining translation."""
    rotation_rad: F64 = field(repr=False)
    """(M,), size of the remaining rotation, 0 to pi."""

    def __post_init__(self) -> None:
        vars(self).update(
            translation=ErrorStatistics.of(self.translation_m),
            rotation_deg=ErrorStatistics.of(np.rad2deg(self.rotation_rad)),
            relations_used=len(self.translation_m),
        )

    def is_revisit(self) -> B8:
        """Return which relations join two visits of one place, (M,): over ``REVISIT_S`` apart."""
        return np.asarray(np.abs(self.stamps_s[:, 1] - self.stamps_s[:, 0]) > REVISIT_S)


@dataclass(frozen=True, eq=False, kw_only=True)
class RelationErrorsAtScans(RelationErrors):
    """Errors on the relations whose both ends are poses of the trajectory itself."""

    translation_mean_95: tuple[float, float] = field(init=False)
    """Low and high end of the 95 % interval of the mean translation, metres."""
    rotation_deg_mean_95: tuple[float, float] = field(init=False)
    """Low and high end of the 95 % interval of the mean rotation, degrees."""

    def __post_init__(self) -> None:
        super().__post_init__()
        vars(self).update(
            translation_mean_95=mean_interval(self.translation_m),
            rotation_deg_mean_95=mean_interval(np.rad2deg(self.rotation_rad)),
        )


def read_relations(path: str | Path) -> Relations:
    """Read a relations file: ``t1 t2 x y z roll pitch yaw`` a line, blank-separated.

    Lines that start with ``#`` are skipped; z, roll and pitch are dropped.

    Raises:
        TrajectoryError: a line is not a relation (its number is given), or there is none.
        OSError: the file cannot be opened.
    """
    where = Path(path)
    if strip_gz(where.name).endswith(".tum"):  # which has as many columns
        raise TrajectoryError(f"{where}: wanted relations, found {KINDS['.tum']}")
    rows, wanted = [], f"'{' '.join(_COLUMNS)}'"
    for number, line in text_lines(where, TrajectoryError, kept_bytes=ROW_BYTES):
        fields, at = line.split(), f"{where}: line {number}"
        if not fields or fields[0].startswith(b"#"):
            continue
        if len(fields) != len(_COLUMNS):
            message = f"{at}: wanted {wanted}, found {len(fields)} columns; fix or remove the line"
            raise TrajectoryError(message)
        rows.append(numbers(fields, at, TrajectoryError))
    if not rows:
        raise TrajectoryError(f"{where}: wanted lines {wanted}, found none; check the file")
    table = np.array(rows)
    name = Path(strip_gz(where.name)).stem or where.name
    return Relations(table[:, :2], table[:, (_X, _Y, _YAW)], name)


def relation_errors(
    trajectory: Trajectory, relations: Relations, tolerance_s: float
) -> RelationErrors:
    """Measure a trajectory, in any frame, by known motions.

    Poses are the nearest in time, without interpolation; both must be within the tolerance.

    Raises:
        TrajectoryError: no relation could be used.
    """
    nearest, is_matched = trajectory.matches(relations.stamps_s, tolerance_s)
    used = is_matched.all(axis=1)
    if not used.any():
        raise TrajectoryError(_no_relation(trajectory, relations, tolerance_s))
    first, second = trajectory.poses[nearest[used, 0]], trajectory.poses[nearest[used, 1]]
    made = compose_poses(invert_poses(first), second)
    left = compose_poses(invert_poses(relations.motions[used]), made)
    return RelationErrors(
        name=trajectory.name,
        relations=relations.name,
        stamps_s=relations.stamps_s[used],
        translation_m=np.hypot(left[:, 0], left[:, 1]),
        rotation_rad=np.abs(wrap_angles(left[:, 2])),
        relations_total=len(relations),
        tolerance_s=tolerance_s,
        poses=len(trajectory),
    )


def errors_at_scans(scans: Trajectory, relations: Relations) -> RelationErrorsAtScans | None:
    """Measure only by relations between scans, without odometry in between; None without any."""
    try:
        found = relation_errors(scans, relations, AT_SCAN_S)
    except TrajectoryError:
        return None
    given = {item.name: getattr(found, item.name) for item in fields(found) if item.init}
    return RelationErrorsAtScans(**given)


def _no_relation(trajectory: Trajectory, relations: Relations, tolerance_s: float) -> str:
    low_s, high_s = relations.span_s()
    return (
        f"{trajectory.name}: none of the {len(relations)} relations of {relations.name} has a "
        f"pose within {tolerance_s:g} s of both its times; the poses are from "
        f"{trajectory.stamps_s[0]:.3f} to {trajectory.stamps_s[-1]:.3f} s, the relations from "
        f"{low_s:.3f} to {high_s:.3f} s; give the trajectory of the same run, or a larger "
        "--tolerance-s"
    )
