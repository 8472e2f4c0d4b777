"""Drives through the live fusion, scan by scan, and what ``run`` makes of the same drives.

A solution of the drive is there when as much time of the drive has passed as it took of the
processor: what is measured is what a robot on this machine would have had.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.table import Table

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation.map_error import MapError
from slamfusion.evidence.beams import judged_scans, scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.evidence.patches import ScanMatch
from slamfusion.evidence.path_frames import fit_frame, moved_onto
from slamfusion.evidence.predictive import score_paths
from slamfusion.experiments.fusions import against_truth
from slamfusion.experiments.tinyslam import ATE, RELATIONS, Drive, read_drive
from slamfusion.fusion.live import LiveFusion
from slamfusion.geometry import Pose2, fit_motion, moved_poses, row_of, with_levers
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.jobs.inputs import LogFiles
from slamfusion.jobs.live_drive import DriveLocator, DriveMemory, DriveSolution, DriveSolver, Pace
from slamfusion.jobs.live_drive.solution import PARTS
from slamfusion.jobs.live_drive.solver import STILL_S, Depth
from slamfusion.sim import named_course, simulate, write_recording
from slamfusion.slam.registry import BUILT_IN, make_producer, with_producers
from slamfusion.trajectory import Trajectory

# Producers tell path and map this often; a bent input is drawn and told this often, seconds.
TOLD_S, DRAWN_S = 2.0, 10.0
# A bent input turns away evenly, to so far from where it should be; its walls differ by more than
# the second, metres.
BENT_M, DIFFERS_M = 2.5, 0.3
# Who is heard, and who of these is bent.
CASES: tuple[tuple[Sequence[str], Sequence[str]], ...] = (
    (BUILT_IN, ()),
    (BUILT_IN, BUILT_IN[1:2]),
    (BUILT_IN, BUILT_IN[1:]),
    (BUILT_IN[:2], BUILT_IN[1:2]),
)
COLUMNS = (
    *("drive", "bent", "final path m", "run", "online m", "far %", "not named %", "matched %"),
    *("named after s", "wrongly named", "[F16] error", "run", "walls F1", "run"),
    *("CPU s", "s of drive"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Told:
    """What the producers tell after a scan: poses, and now and then paths and maps."""

    poses: Mapping[str, Pose2]
    paths: Mapping[str, Trajectory]
    maps: Mapping[str, OccupancyGrid]


@dataclass(frozen=True, eq=False)
class ToldDrive:
    """A drive and what the producers tell while it lasts; ``truth``: None if it is not known."""

    drive: Drive
    truth: OccupancyGrid | None
    told: Sequence[Told]

    @property
    def paths(self) -> Mapping[str, Trajectory]:
        """The paths of the producers at the end."""
        return self.told[-1].paths


def produce(drive: Drive, truth: OccupancyGrid | None, device: ComputeDevice) -> ToldDrive:
    """Run the three producers on a drive, and keep what they tell."""
    config = with_producers(RunConfig())
    producers = {name: make_producer(name, config, device) for name in BUILT_IN}
    told, last_s = [], drive.scans[0].scan.stamp_s
    for number, item in enumerate(drive.scans, 1):
        poses = {
            name: own.feed(item.scan, item.odometry).pose_map_base
            for name, own in producers.items()
        }
        paths, maps = {}, {}
        if item.scan.stamp_s - last_s >= TOLD_S or number == len(drive.scans):
            last_s = item.scan.stamp_s
            paths = {name: own.trajectory() for name, own in producers.items()}
            maps = {name: own.grid().with_name(name) for name, own in producers.items()}
        told.append(Told(poses, paths, maps))
    return ToldDrive(drive, truth, told)


def told_drive(name: str, keep: Path | None, device: ComputeDevice) -> ToldDrive:
    """Return a simulated course, ``COURSE[:SEED]``, or a log with its relations, ``LOG:RELATIONS``.

    Args:
        keep: a folder in which it is kept, and looked for first.
    """
    log, _, other = name.partition(":")
    relations = "" if other.isdigit() else other
    kept = (
        None if keep is None else keep / f"{Path(log).name}{other if not relations else ''}.pickle"
    )
    if kept is not None and kept.exists():
        told: ToldDrive = pickle.loads(kept.read_bytes())  # noqa: S301  (our own)
        return told
    if relations:
        files = LogFiles(Path(log), relations=Path(relations))
        found = produce(read_drive(files, RunConfig()), None, device)
    else:
        made = simulate(named_course(log, int(other or 0)), device)
        with TemporaryDirectory() as folder:  # as `run` has it, with rounded ranges
            log, *_ = write_recording(made, folder)
            files = LogFiles(log, truth=log.with_name("truth.tum"))
            drive = read_drive(files, RunConfig())
        found = produce(drive, made.world.grid, device)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(found))
    return found


def bent(told: ToldDrive, names: Sequence[str], device: ComputeDevice) -> tuple[ToldDrive, float]:
    """Return a drive of which some inputs turn away, and when their walls differ, seconds."""
    scans, truth = told.drive.scans, told.drive.ground_truth.truth
    assert truth is not None  # of a simulated drive
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    right = truth.poses[truth.nearest(stamps_s)]
    steps = np.diff(right[:, :2], axis=0)
    way_m = np.concatenate(([0.0], np.cumsum(np.hypot(*steps.T))))

    def turned(rad_per_m: float) -> tuple[np.ndarray, np.ndarray]:
        yaw = rad_per_m * way_m
        cos, sin = np.cos(yaw[:-1]), np.sin(yaw[:-1])
        own = np.column_stack(
            (cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1])
        )
        poses = right.copy()
        poses[1:, :2] = right[0, :2] + np.cumsum(own, axis=0)
        poses[:, 2] += yaw
        return poses, np.hypot(*(poses - right)[:, :2].T)

    low, high = 0.0, 0.05
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if turned(middle)[1].max() < BENT_M else (low, middle)
    poses, off_m = turned(low)
    away = [Pose2(*a).compose(Pose2(*b).inverse()) for a, b in zip(poses, right, strict=True)]
    first = Pose2(*right[0])
    frames = {name: first.compose(told.told[0].poses[name].inverse()) for name in names}
    rays, drawn_s, out = [*scan_hits(scans)], -np.inf, []
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    for index, (now_s, one) in enumerate(zip(stamps_s, told.told, strict=True)):
        own = {name: away[index].compose(frames[name].compose(one.poses[name])) for name in names}
        for name, pose in own.items():
            rows[name].append((pose.x, pose.y, pose.yaw_rad))
        paths, maps = dict(one.paths), dict(one.maps)
        if paths:
            is_drawn = now_s - drawn_s >= DRAWN_S
            drawn_s = now_s if is_drawn else drawn_s
            for name in names:
                paths[name] = Trajectory(stamps_s[: index + 1], np.array(rows[name]), name)
                grid = maps.pop(name)
                if is_drawn:
                    maps[name] = draw_map(
                        rays[: index + 1],
                        paths[name],
                        device,
                        resolution=grid.resolution,
                        name=name,
                    )
        out.append(Told({**one.poses, **own}, paths, maps))
    return replace(told, told=out), float(stamps_s[np.argmax(off_m > DIFFERS_M)])


class Robot:
    """Drives through the live fusion as the fusion node does.

    Attributes:
        named_s: when each input was named first, a stamp.
        online: the newest pose in the fused frame, at each scan from the first solution on.
        first_path: of the first solution.
        is_undecided: at each of these, whether the node says that the path may be wrong.
        fused: the newest fused map.
        cpu_s: processor time of all solutions and updates, seconds.
    """

    def __init__(self, names: Sequence[str], device: ComputeDevice) -> None:
        self.names = names
        self.memory = DriveMemory()
        self.locator = DriveLocator(self.memory)
        self.solver = DriveSolver(self.memory, self.locator, device)
        self.fusion = LiveFusion(RunConfig(), device)
        self.pace = Pace()
        self.solution: DriveSolution | None = None
        self.named_s: dict[str, float] = {}
        self.online: list[tuple[float, ScanMatch]] = []
        self.first_path = Trajectory(np.empty(0), np.empty((0, 3)), "none")
        self.is_undecided: list[bool] = []
        self.fused: OccupancyGrid | None = None
        self.cpu_s = 0.0
        self._waits: tuple[float, DriveSolution | None] | None = None

    def hear(self, item: LogScan, told: Told, number: int) -> None:
        """Take a scan, and what the producers tell after it."""
        now_s, began_s = item.scan.stamp_s, time.process_time()
        self.memory.add_scan(item)
        for name in self.names:
            self.memory.add_pose(name, now_s, told.poses[name])
            self.fusion.hear(name, now_s, told.poses[name])
            if name in told.paths:
                self.memory.set_path(name, told.paths[name])
            if name in told.maps:
                self.fusion.put(name, told.maps[name], now_s)
        self._fuse(now_s)
        self.cpu_s += time.process_time() - began_s
        self.turn(now_s, number)
        if self.solution is not None and self.solution.supported:
            name = next(iter(self.solution.supported))
            located = self.locator.locate(name, now_s, told.poses[name])
            if located is not None:
                self.online.append((now_s, located))
                self.is_undecided.append("undecided" in self.solution.judgement.conditions)

    def turn(self, now_s: float, number: int) -> None:
        """Take the solution that is ready, and begin one that is due."""
        if self._waits is not None:
            done_s, solution = self._waits
            if now_s < done_s:
                return
            self._waits = None
            self._take(now_s, solution)
        depth = self.pace.due(now_s, number)
        if depth is None:
            return
        spent_s, solution = self._solve(depth)
        self.pace.done(depth, now_s, now_s + spent_s)
        self._waits = now_s + spent_s, solution

    def end(self, now_s: float, number: int) -> None:
        """Let no scan come any more until all is solved."""
        for _ in range(8):
            now_s = max(now_s + STILL_S, 0.0 if self._waits is None else self._waits[0])
            self.turn(now_s, number)

    def _solve(self, depth: Depth) -> tuple[float, DriveSolution | None]:
        placed = {
            record.name: record.transform
            for record in self.fusion.inputs()
            if record.accepted and record.transform is not None
        }
        began_s = time.process_time()
        solution = self.solver.solve(
            depth, lattice=self.fusion.lattice, transforms=placed, resolution=self.fusion.resolution
        )
        spent_s = time.process_time() - began_s
        self.cpu_s += spent_s
        return spent_s, solution

    def _take(self, now_s: float, solution: DriveSolution | None) -> None:
        if solution is None:
            return
        if self.solution is None:
            self.first_path = solution.path
        self.solution = solution
        self.locator.take(solution)
        for name in solution.evidence.doubts:
            self.named_s.setdefault(name, now_s)
        self.fusion.put_evidence(solution.evidence)
        self._fuse(now_s)

    def _fuse(self, now_s: float) -> None:
        while self.fusion.has_new:
            update = self.fusion.update(now_s)
            if update is not None and update.fused is not None:
                self.fused = update.fused


def as_run(
    told: ToldDrive, names: Sequence[str], live: DriveSolution, device: ComputeDevice
) -> tuple[Trajectory, OccupancyGrid]:
    """Return the path and the map that ``run`` makes of some inputs of a drive.

    Both are in the fused frame and on its lattice: the walls F1 of one path depends on how the rows
    lie (0.37 to 0.50 on f16).
    """
    paths = {name: told.paths[name] for name in names}
    evidence = score_paths(judged_scans(told.drive.scans), paths, device)
    path = fuse_weighed_paths(paths, evidence)[0].trajectory
    path, lattice = moved_onto(path, [live.path]), live.evidence.lattice
    rays, size = [*scan_hits(told.drive.scans)], lattice.resolution
    return path, draw_map(rays, path, device, resolution=size, origin=lattice.origin)


def bend_m(path: Trajectory, right: Trajectory) -> float:
    """Return how far a path leaves the right one at most, metres; aligned by any of its parts."""
    still, most_m = right.poses[right.nearest(path.stamps_s)], 0.0
    for part in np.array_split(np.arange(len(path)), PARTS):
        motion = fit_motion(with_levers(path.poses[part]), with_levers(still[part]))
        off = moved_poses(motion, path.poses) - still
        most_m = max(most_m, float(np.hypot(*off[:, :2].T).max()))
    return most_m


def far_shares(robot: Robot, online: Trajectory, right: Trajectory) -> tuple[float, float]:
    """Return the shares of poses that are far off, and of those that are also not named.

    In the frame that the first solution gives. A pose is named if three of its deviations reach as
    far, or the path is named as undecided.
    """
    first = robot.first_path
    frame = fit_frame(first.poses, right.poses[right.nearest(first.stamps_s)])
    off = moved_poses(frame, online.poses) - right.poses[right.nearest(online.stamps_s)]
    off_m = np.hypot(*off[:, :2].T)
    variances = [np.trace(located.covariance[:2, :2]) for _, located in robot.online]
    is_named = (9.0 * np.array(variances) >= off_m**2) | np.array(robot.is_undecided)
    is_far = off_m > DIFFERS_M
    return float(is_far.mean()), float((is_far & ~is_named).mean())


def path_until(told: ToldDrive, name: str, until_s: float) -> Trajectory:
    """Return the path of an input as it is known at a stamp."""
    rows: dict[float, list[float]] = {}
    for item, one in zip(told.drive.scans, told.told, strict=True):
        if item.scan.stamp_s > until_s:
            break
        pose, own = one.poses[name], one.paths.get(name)
        rows[item.scan.stamp_s] = [pose.x, pose.y, pose.yaw_rad]
        if own is not None:
            rows = dict(zip(own.stamps_s.tolist(), own.poses.tolist(), strict=True))
    return Trajectory(np.array([*rows]), np.array([*rows.values()]), name)


def path_error(path: Trajectory, drive: Drive) -> str:
    """Return the error of a path, metres: by the truth, or else by the relations."""
    found = drive.errors(path, RunConfig())
    return f"{found[ATE]:.4f}" if ATE in found else f"{found[RELATIONS]:.4f} rel"


def map_errors(
    grid: OccupancyGrid | None, told: ToldDrive, device: ComputeDevice
) -> MapError | None:
    """Return the errors of a map against the truth; None where it is not known."""
    if told.truth is None or grid is None:
        return None
    return against_truth(grid, told.truth, RunConfig(), device, same_heading=True)


def measured(
    told: ToldDrive, names: Sequence[str], bent_ones: Sequence[str], device: ComputeDevice
) -> list[str]:
    """Return the row of a drive, some of whose inputs are bent."""
    heard, differs_s = told, np.nan
    if bent_ones:
        heard, differs_s = bent(told, bent_ones, device)
    robot, scans = Robot(names, device), told.drive.scans
    for number, (item, one) in enumerate(zip(scans, heard.told, strict=True), 1):
        robot.hear(item, one, number)
    robot.end(scans[-1].scan.stamp_s, len(scans))
    if robot.solution is None or robot.fused is None:
        raise SlamFusionError(f"{told.drive.name}: nothing was fused")
    path, grid = as_run(heard, names, robot.solution, device)
    rows = [row_of(located.pose) for _, located in robot.online]
    online = Trajectory(
        np.array([stamp_s for stamp_s, _ in robot.online]), np.array(rows), "online"
    )
    live_map, run_map = (map_errors(own, told, device) for own in (robot.fused, grid))
    since = {
        name: f"{robot.named_s[name] - differs_s:.0f}"
        for name in bent_ones
        if name in robot.named_s
    }
    right = told.drive.ground_truth.truth or path
    far, unnamed = far_shares(robot, online, right)
    wrong = [
        name
        for name, named_s in robot.named_s.items()
        if name not in bent_ones and bend_m(path_until(heard, name, named_s), right) <= DIFFERS_M
    ]
    return [
        told.drive.name,
        f"{len(bent_ones)} of {len(names)}",
        path_error(robot.solution.path, told.drive),
        path_error(path, told.drive),
        path_error(online, told.drive),
        *(f"{100.0 * share:.1f}" for share in (far, unnamed)),
        f"{100.0 * np.mean([located.fits for _, located in robot.online]):.1f}",
        ", ".join(since.get(name, "never") for name in bent_ones) or "-",
        ", ".join(wrong) or "none",
        *(cell for form in (_f16, _walls) for cell in (form(live_map), form(run_map))),
        f"{robot.cpu_s:.0f}",
        f"{scans[-1].scan.stamp_s - scans[0].scan.stamp_s:.0f}",
    ]


def _f16(error: MapError | None) -> str:
    return "-" if error is None else f"{error.error:.1f}"


def _walls(error: MapError | None) -> str:
    return "-" if error is None else f"{error.faces.f1(0.1) or 0.0:.3f}"


def rows_of(
    name: str, keep: Path | None, cases: Sequence[int], device: ComputeDevice
) -> Iterator[list[str]]:
    """Yield the rows of a drive: as it is, and with bent inputs where the truth is known."""
    told = told_drive(name, keep, device)
    for case in cases:
        names, bent_ones = CASES[case]
        if not bent_ones or told.drive.ground_truth.truth is not None:
            yield measured(told, names, bent_ones, device)


def drive_table(
    drives: Sequence[str], keep: Path | None, cases: Sequence[int], device: ComputeDevice
) -> Table:
    """Return the table of all drives."""
    table = Table(*COLUMNS, title=f"live and as `run`, on {device.name}")
    for name in drives:
        for row in rows_of(name, keep, cases, device):
            table.add_row(*row)
            print(
                "; ".join(f"{column} {cell}" for column, cell in zip(COLUMNS, row, strict=True)),
                flush=True,
            )
    return table
