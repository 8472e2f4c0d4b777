"""A drive in the plane by geometry alone: walls are segments, and a scan sees them exactly."""

from __future__ import annotations

import numpy as np

from slamfusion.evidence.path_frames import fit_frame
from slamfusion.geometry import F64, Pose2, compose_poses, invert_poses
from slamfusion.io import LogScan
from slamfusion.scan import LaserScan
from slamfusion.trajectory import Trajectory

BEAMS = 90
FAR_M = 12.0


def box(x: float, y: float, width: float, height: float) -> list[tuple[float, ...]]:
    """Return the four walls of a box as segments."""
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    return [(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]


# A room of 9 x 6 m with a block in it, that a robot drives around.
ROOM = np.array(box(0.0, 0.0, 9.0, 6.0) + box(3.5, 2.3, 2.0, 1.4) + box(7.9, 0.0, 1.1, 0.7))


def ranges_at(pose: F64, walls: F64 = ROOM) -> F64:
    """Return what each beam reads at a pose, (BEAMS,) metres; infinite where it meets nothing."""
    angles = pose[2] + np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    towards = np.stack((np.cos(angles), np.sin(angles)), axis=1)[:, None]
    start, along = walls[None, :, :2] - pose[:2], (walls[:, 2:] - walls[:, :2])[None]
    cross = towards[..., 0] * along[..., 1] - towards[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]) / cross
        share = (start[..., 0] * towards[..., 1] - start[..., 1] * towards[..., 0]) / cross
        met = (far > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.asarray(np.where(met, far, np.inf).min(axis=1))


def circuit(count: int = 144, rounds: float = 2.0) -> Trajectory:
    """Return a drive around the block, (count,) poses 0.25 s apart."""
    turn = np.linspace(0.0, 2.0 * np.pi * rounds, count, endpoint=False)
    poses = np.stack((4.5 + 2.6 * np.cos(turn), 3.0 + 1.9 * np.sin(turn), turn + np.pi / 2), axis=1)
    return Trajectory(0.25 * np.arange(count), poses, "truth")


def recorded(
    path: Trajectory,
    *,
    noise_m: float = 0.01,
    seed: int = 0,
    odometry: bool = True,
    walls: F64 = ROOM,
) -> list[LogScan]:
    """Return the scans of a drive, with odometry that drifts by a little."""
    rng = np.random.default_rng(seed)
    scans = []
    for number, (stamp_s, pose) in enumerate(zip(path.stamps_s, path.poses, strict=True), 1):
        ranges = ranges_at(pose, walls) + noise_m * rng.standard_normal(BEAMS)
        scan = LaserScan(
            *(float(stamp_s), ranges.astype(np.float32), -np.pi, 2.0 * np.pi / BEAMS, 0.05, FAR_M)
        )
        wheels = Pose2(1.001 * pose[0], pose[1], pose[2] + 1e-4 * number)
        scans.append(LogScan(scan, wheels if odometry else None, number))
    return scans


def moved(path: Trajectory, motion: tuple[float, float, float], first: int = 0) -> Trajectory:
    """Return a path whose poses from one on are moved by a motion of its frame."""
    poses = path.poses.copy()
    poses[first:] = compose_poses(motion, poses[first:])
    return Trajectory(path.stamps_s, poses, "moved")


def bent(path: Trajectory, turn_rad: float, at: int) -> Trajectory:
    """Return a path that turns by an angle too much at one pose, and goes on from there."""
    steps = compose_poses(invert_poses(path.poses[:-1]), path.poses[1:])
    steps[at, 2] += turn_rad
    return Trajectory(path.stamps_s, compose_poses(path.poses[0], by_steps(steps)), "bent")


def by_steps(steps: F64) -> F64:
    """Return the poses of motions that follow each other, (N + 1, 3), from zero on."""
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose_poses(poses[-1], step))
    return np.array(poses)


def off_m(path: Trajectory, truth: Trajectory) -> float:
    """Return the largest distance from the truth after laying the path on it."""
    motion = fit_frame(path.poses, truth.poses)
    laid = compose_poses((motion.x, motion.y, motion.yaw_rad), path.poses)
    return float(np.hypot(*(laid - truth.poses)[:, :2].T).max())
