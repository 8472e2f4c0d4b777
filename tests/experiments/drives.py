"""A short drive whose truth and relations are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamfusion.evaluation.measured import GroundTruth
from slamfusion.evaluation.relations import Relations
from slamfusion.experiments.tinyslam import Drive
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan, write_carmen, write_tum
from slamfusion.jobs.inputs import LogFiles
from slamfusion.trajectory import Trajectory
from tests.support.producers import room_drive


def room(name: str = "room", *, drift: float = 0.0, relations: bool = True) -> Drive:
    """The square room; its odometry is the truth, but reads by this share too long."""
    items = room_drive(12)
    poses = [item.odometry for item in items if item.odometry is not None]
    stamps = np.array([item.scan.stamp_s for item in items])
    truth = Trajectory(stamps, np.array([(p.x, p.y, p.yaw_rad) for p in poses]), "truth")
    motion = poses[0].inverse().compose(poses[-1])
    known = Relations(
        np.array([[stamps[0], stamps[-1]]]), np.array([[motion.x, motion.y, motion.yaw_rad]])
    )
    items = [
        LogScan(item.scan, Pose2(pose.x * (1.0 + drift), pose.y, pose.yaw_rad), item.line)
        for item, pose in zip(items, poses, strict=True)
    ]
    return Drive(name, tuple(items), GroundTruth(known if relations else None, truth=truth))


def room_files(folder: Path, name: str = "room", *, relations: bool = True) -> LogFiles:
    """Write the room with drifting odometry, its relations and its truth."""
    made = room(name, drift=0.3)
    known, truth = made.ground_truth.relations, made.ground_truth.truth
    files = LogFiles(
        folder / f"{name}.log",
        folder / f"{name}.relations" if relations else None,
        truth=folder / f"{name}.tum",
    )
    write_carmen(files.log, made.scans)
    write_tum(folder / f"{name}.tum", truth)
    ((first, second),), ((x, y, yaw),) = known.stamps_s, known.motions
    line = f"{first} {second} {x} {y} 0 0 0 {yaw}\n"
    (folder / f"{name}.relations").write_text(line, encoding="utf-8")
    return files
