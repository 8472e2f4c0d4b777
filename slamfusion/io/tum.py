"""TUM trajectory files: ``timestamp tx ty tz qx qy qz qw`` a line, which evo and others read.

Source: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
"""

from __future__ import annotations

import math
from pathlib import Path

from slamfusion.geometry import wrap_angle
from slamfusion.io.files import AtomicFiles, write_atomic
from slamfusion.io.lines import packed_by_name
from slamfusion.trajectory import Trajectory

_HEADER = "# timestamp tx ty tz qx qy qz qw\n"


def write_tum(
    path: str | Path, trajectory: Trajectory, *, files: AtomicFiles | None = None
) -> None:
    """Write a trajectory as a TUM file; the same poses give the same bytes.

    Times are seconds with nine decimals, lengths metres; z, roll and pitch are 0.

    Args:
        path: the file; packed when its name ends in ``.gz``.
        trajectory: what to write; without a pose the file has only its heading.
        files: stage the file here, to appear together with others; default: write it now.

    Raises:
        MapFileError: the file cannot be written.
    """
    target = Path(path)
    lines = [_HEADER]
    for stamp_s, (x, y, yaw_rad) in zip(
        trajectory.stamps_s.tolist(), trajectory.poses.tolist(), strict=True
    ):
        # Half of a wrapped angle keeps qw at or above 0, so each pose has one spelling.
        half_rad = 0.5 * wrap_angle(yaw_rad)
        lines.append(
            f"{stamp_s:.9f} {x:.9f} {y:.9f} 0 0 0 "
            f"{math.sin(half_rad):.12f} {math.cos(half_rad):.12f}\n"
        )
    write_atomic(target, packed_by_name(target, "".join(lines).encode()), files=files)


def quaternion_yaw_rad(x: float, y: float, z: float, w: float) -> float:
    """Return where the x axis of a quaternion points, in plan.

    The quaternion may have any length; 0, which is no rotation, gives NaN.
    """
    if x == y == z == w == 0.0:
        return math.nan
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
