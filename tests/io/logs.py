"""Lines and files of logs as tests need them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

Pose = tuple[float, float, float]

ORIGIN: Pose = (0.0, 0.0, 0.0)


def numbers(values: Sequence[float]) -> str:
    return " ".join(map(str, values))


def flaser(
    stamp: object,
    ranges: Sequence[float] = (1.0, 2.0, 3.0),
    robot: Pose = ORIGIN,
    laser: Pose | None = None,
) -> str:
    """One FLASER line; the laser sits on the robot's origin unless it says otherwise."""
    pose = robot if laser is None else laser
    return f"FLASER {len(ranges)} {numbers(ranges)} {numbers(pose)} {numbers(robot)} {stamp} host 0"


def robotlaser(
    stamp: object,
    ranges: Sequence[float] = (1.0, 2.0, 3.0),
    robot: Pose = ORIGIN,
    laser: Pose | None = None,
    angles: tuple[float, float, float] = (-0.5, 1.0, 0.5),
    range_max: float = 8.0,
    remissions: Sequence[float] = (),
) -> str:
    """One ROBOTLASER1 line; ``angles`` are the first, the field of view and the step."""
    pose = robot if laser is None else laser
    return (
        f"ROBOTLASER1 0 {numbers(angles)} {range_max} 0.1 0 {len(ranges)} {numbers(ranges)} "
        f"{len(remissions)} {numbers(remissions)} {numbers(pose)} {numbers(robot)} "
        f"0 0 0 0 0 {stamp} host 0"
    )


def write_lines(path: Path, *lines: str) -> Path:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
    return path
