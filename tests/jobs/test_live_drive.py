"""A drive that is solved while it lasts: who is contradicted, the path, the map drawn along it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.evidence.beams import judged_scans
from slamfusion.evidence.predictive import score_paths
from slamfusion.fusion.live import LiveFusion
from slamfusion.geometry import Pose2, fit_motion, moved_poses, with_levers
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.jobs.live_drive import DriveSolution, Pace, locating, memory, solver
from slamfusion.jobs.live_drive.solution import DRIFT
from slamfusion.jobs.live_drive.solver import Depth
from slamfusion.trajectory import Trajectory
from slamfusion.vote.lattice import Lattice
from tests.evidence.rooms import circuit, recorded
from tests.slam.drives import drive

SCANS = 160
# Where the map of each input lies, seen from the world.
FRAMES = {"a": Pose2(), "b": Pose2(3.0, -1.0, 0.8), "c": Pose2(-2.0, 5.0, -2.0)}


def bent(pose: Pose2, step: int) -> Pose2:
    """Return a pose of a path that turns away slowly from scan 50 on: 1.2 m at the end."""
    turn = Pose2(0.0, 0.0, 0.004 * max(0, step - 50))
    return turn.compose(pose)


def slowly_bent(pose: Pose2, step: int) -> Pose2:
    """Return a pose of a path that turns away all the time: 0.5 m at the end.

    Laid where most of its poses agree, it is nowhere 0.3 m off.
    """
    return Pose2(0.0, 0.0, 0.0005 * step).compose(pose)


class Robot:
    """Drives, and sends scans and poses of inputs, each in its own frame."""

    def __init__(self, device: ComputeDevice, *, bent_ones: str = "", names: str = "abc") -> None:
        self.memory = memory.DriveMemory()
        self.locator = locating.DriveLocator(self.memory)
        self.solver = solver.DriveSolver(self.memory, self.locator, device)
        self.scans, self.truth = drive(SCANS, turn_bias=0.002)
        self.names = names
        self.step = 0
        self.bends = dict.fromkeys(bent_ones, bent)
        self.noise = np.random.default_rng(7)

    def pose_of(self, name: str) -> Pose2:
        pose = self.truth[self.step]
        if name in self.bends:
            pose = self.bends[name](pose, self.step)
        noise = self.noise.normal(0.0, (0.01, 0.01, 0.003))
        return FRAMES[name].compose(pose).compose(Pose2(*noise.tolist()))

    def drive_to(self, step: int, names: str | None = None) -> None:
        while self.step < step:
            item = self.scans[self.step]
            for name in self.names if names is None else names:
                self.memory.add_pose(name, item.scan.stamp_s, self.pose_of(name))
            self.memory.add_scan(item)
            self.step += 1

    def error_m(self, path: Trajectory) -> float:
        """Return the root mean square error of a path in the frame of a."""
        rows = np.array([(pose.x, pose.y) for pose in self.truth])
        near = np.rint(path.stamps_s * 10.0).astype(int)
        return float(np.sqrt(((path.poses[:, :2] - rows[near]) ** 2).sum(axis=1).mean()))


def solved(robot: Robot, depth: Depth = "whole", **given: object) -> DriveSolution:
    solution = robot.solver.solve(depth, **given)  # type: ignore[arg-type]
    assert solution is not None
    robot.locator.take(solution)
    return solution


def in_frame_of_a(names: str = "abc") -> Mapping[str, Pose2]:
    return {name: FRAMES[name].inverse() for name in names}


LATTICE = Lattice(0.05, Pose2(-0.02, 0.01, 0.0))


def test_the_path_is_better_than_each_input_and_lies_in_the_fused_frame(
    device: ComputeDevice,
) -> None:
    robot = Robot(device)
    robot.drive_to(SCANS)
    found = solved(robot, lattice=LATTICE, transforms=in_frame_of_a(), resolution=0.05)
    assert not found.evidence.doubts
    assert not found.judgement.conditions
    assert robot.error_m(found.path) < 0.01
    for name, motion in found.evidence.transforms.items():
        apart = motion.compose(FRAMES[name])
        assert math.hypot(apart.x, apart.y) < 0.05, name
    assert found.evidence.lattice == LATTICE
    assert LATTICE.cell_of(found.evidence.drawn) is not None
    assert found.evidence.drawn.height * 0.05 == pytest.approx(6.0, abs=0.3)


def test_bent_inputs_are_contradicted_and_the_path_is_right(device: ComputeDevice) -> None:
    robot = Robot(device, bent_ones="bc")
    robot.drive_to(SCANS)
    found = solved(robot, lattice=LATTICE, transforms=in_frame_of_a("a"))
    assert set(found.evidence.doubts) == {"b", "c"}
    assert set(found.supported) == {"a"}
    assert all(5.0 < float(why.split()[-2]) < 16.0 for why in found.evidence.doubts.values())
    assert robot.error_m(found.path) < 0.02
    assert all("since stamp" in why for why in found.evidence.doubts.values())


def test_an_input_that_bends_slowly_stays_contradicted_in_the_next_window(
    device: ComputeDevice,
) -> None:
    robot = Robot(device, names="ab")
    robot.bends = {"b": slowly_bent}
    robot.drive_to(60)
    assert not solved(robot).evidence.doubts
    robot.drive_to(SCANS)
    assert set(solved(robot, "whole").evidence.doubts) == {"b"}
    assert set(solved(robot, "window").evidence.doubts) == {"b"}


def test_of_inputs_that_all_leave_the_fused_path_the_best_and_its_equals_vote(
    device: ComputeDevice,
) -> None:
    for of_b, doubted in ((slowly_bent, set()), (bent, {"b"})):
        robot = Robot(device, names="ab")
        robot.bends = {"a": slowly_bent, "b": of_b}
        robot.drive_to(SCANS)
        assert set(solved(robot).evidence.doubts) == doubted


def test_the_window_reaches_back_to_what_was_solved(device: ComputeDevice) -> None:
    """A solution of the whole drive may take longer than the window is."""
    robot = Robot(device)
    robot.drive_to(40)
    solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "WINDOW_S", 3.0)
        patch.setattr(solver, "LEAST_SCANS", 30)
        robot.drive_to(SCANS)
        found = solved(robot, "window", lattice=LATTICE, transforms=in_frame_of_a())
    assert len(found.path) == SCANS
    assert robot.error_m(found.path) < 0.02


def test_when_no_scan_comes_the_answer_is_that_of_run(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all hits, and with poses at scans without any, by the method of ``run``."""
    monkeypatch.setattr(solver, "MOST_HITS", 5000)
    robot = Robot(device)
    for index in (50, 51, 90):
        scan = robot.scans[index].scan
        nothing = replace(scan, ranges=np.full_like(scan.ranges, np.inf))
        robot.scans[index] = replace(robot.scans[index], scan=nothing)
    robot.noise = np.random.default_rng(7)
    robot.drive_to(SCANS)
    final = solved(robot, "final").path
    robot.noise = np.random.default_rng(7)
    paths: dict[str, list[tuple[float, float, float]]] = {name: [] for name in "abc"}
    for robot.step in range(SCANS):
        for name in "abc":
            pose = robot.pose_of(name)
            paths[name].append((pose.x, pose.y, pose.yaw_rad))
    stamps_s = np.array([item.scan.stamp_s for item in robot.scans])
    given = {name: Trajectory(stamps_s, np.array(rows), name) for name, rows in paths.items()}
    evidence = score_paths(judged_scans(robot.scans), given, device)
    wanted = fuse_weighed_paths(given, evidence)[0].trajectory
    motion = fit_motion(with_levers(final.poses), with_levers(wanted.poses))
    assert np.abs(moved_poses(motion, final.poses) - wanted.poses).max() < 1e-9


def test_the_last_seconds_are_solved_between_solutions_of_the_whole_drive() -> None:
    """And all of it with all hits once scans cease; a drive that is known is not solved again."""
    pace, seen = Pace(), []
    busy_s = 0.0
    for step in range(1000):
        now_s, scans = 0.1 * step, min(step, 600)
        if now_s >= busy_s and (depth := pace.due(now_s, scans)) is not None:
            busy_s = now_s + {"judged": 0.1, "window": 0.5, "whole": 3.0, "final": 9.0}[depth]
            pace.done(depth, now_s, busy_s)
            seen.append((now_s, depth))
    depths = [depth for _, depth in seen]
    assert depths[0] == "whole"
    assert depths.count("final") == 1
    last_s, last = seen[-1]
    assert last == "final"
    assert 61.0 < last_s < 66.0
    waits_s = np.diff([now_s for now_s, _ in seen])
    assert waits_s.max() < 7.0
    # Three seconds of 120 for the whole drive, half a second of 12.5 for the window, a tenth of 3
    # to judge the inputs, and one second ahead of each.
    assert depths.count("whole") == pytest.approx(60.0 / 120.0 + 1.0 / 3.0, abs=1.0)
    assert depths.count("window") == pytest.approx(54.0 / 12.5 + 1.0 / 0.5, abs=3.0)
    assert depths.count("judged") == pytest.approx(60.0 / 3.0 + 1.0 / 0.1, abs=6.0)


def test_the_window_continues_the_path_of_the_whole_drive(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solver, "WINDOW_S", 5.0)
    monkeypatch.setattr(solver, "LEAST_SCANS", 30)
    robot = Robot(device)
    robot.drive_to(100)
    first = solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    robot.drive_to(120)
    found = solved(robot, "window", lattice=LATTICE, transforms=in_frame_of_a())
    assert len(found.path) == 120
    # What the whole drive said of the past stays.
    assert np.array_equal(found.path.poses[:95], first.path.poses[:95])
    assert robot.error_m(found.path) < 0.015


def test_errors_of_windows_do_not_add_up(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two inputs turn away alike, on a second and a third round along walls that are solved."""
    monkeypatch.setattr(solver, "WINDOW_S", 5.0)
    monkeypatch.setattr(solver, "LEAST_SCANS", 30)
    robot, truth = Robot(device, names="ab"), circuit(200, 2.8)
    robot.scans, robot.truth = recorded(truth), [Pose2(*row) for row in truth.poses]
    robot.bends = dict.fromkeys("ab", slowly_bent)
    robot.drive_to(80)
    found = solved(robot)
    for step in range(95, 201, 15):
        robot.drive_to(step)
        found = solved(robot, "window")
    motion = fit_motion(with_levers(found.path.poses[:80]), with_levers(truth.poses[:80]))
    off = moved_poses(motion, found.path.poses) - truth.poses
    assert np.hypot(*off[-10:, :2].T).max() < 0.015


def test_a_corrected_path_takes_the_place_of_poses(device: ComputeDevice) -> None:
    """And the frame stays, though the voter has moved since the first solution."""
    robot = Robot(device, bent_ones="b", names="ab")
    robot.drive_to(SCANS)
    assert set(solved(robot, lattice=LATTICE, transforms=in_frame_of_a("a")).evidence.doubts) == {
        "b"
    }
    rows = [(pose.x, pose.y, pose.yaw_rad) for pose in robot.truth]
    stamps_s = np.array([item.scan.stamp_s for item in robot.scans])
    robot.memory.set_path("b", Trajectory(stamps_s[::3], np.array(rows)[::3], "b"))
    found = solved(robot, lattice=LATTICE, transforms={"a": Pose2(0.4, 0.0, 0.0)})
    assert not found.evidence.doubts
    assert robot.error_m(found.path) < 0.015


def test_frozen_odometry_is_named(device: ComputeDevice) -> None:
    robot = Robot(device)
    robot.scans[90:] = [
        replace(item, odometry=robot.scans[90].odometry) for item in robot.scans[90:]
    ]
    robot.drive_to(SCANS)
    found = solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    assert found.judgement.conditions.keys() == {"odometry"}
    assert "stands still from 9 s to 16 s" in found.judgement.conditions["odometry"]


def test_poses_of_another_robot_and_of_a_silent_input_are_not_scored(device: ComputeDevice) -> None:
    robot = Robot(device)
    robot.drive_to(60)
    for step in range(SCANS):
        robot.memory.add_pose("other", 0.1 * step + 0.033, Pose2(float(step), 0.0, 0.0))
    robot.drive_to(SCANS, names="ab")
    assert set(solved(robot).evidence.transforms) == {"a", "b"}


def test_a_long_drive_keeps_some_scans_and_its_inputs_poses_at_them(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "MOST_SCANS", 60)
    monkeypatch.setattr(memory, "WINDOW_S", 2.5)
    robot = Robot(device)
    robot.bends = dict.fromkeys("abc", slowly_bent)
    robot.scans = [
        replace(item, odometry=pose.compose(Pose2(*robot.noise.normal(0.0, 0.2, 3).tolist())))
        for item, pose in zip(robot.scans, robot.truth, strict=True)
    ]
    robot.drive_to(SCANS)
    # Loops are closed: a node's path is right, but has few of the poses, and of other scans.
    for name, frame in FRAMES.items():
        own = [frame.compose(pose) for pose in robot.truth]
        rows = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in own])
        stamps_s = np.array([item.scan.stamp_s for item in robot.scans])
        robot.memory.set_path(name, Trajectory(stamps_s[::3], rows[::3], name))
    found = solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    assert len(found.path) <= 60
    assert np.diff(found.path.stamps_s)[-10:].max() < 0.11
    assert found.path.stamps_s[0] < 1.0
    assert robot.error_m(found.path) < 0.01


def test_time_that_goes_back_starts_a_new_drive(device: ComputeDevice) -> None:
    robot = Robot(device)
    robot.drive_to(60)
    assert len(solved(robot).path) == 60
    robot.step = 0
    robot.drive_to(40)
    assert len(solved(robot).path) == 40


def test_scans_without_odometry_are_left_out_where_others_have_it(device: ComputeDevice) -> None:
    first = []
    for without in ((), (0, 1, 10)):
        robot = Robot(device)
        for index in without:
            robot.scans[index] = replace(robot.scans[index], odometry=None)
        while robot.solver.solve("whole") is None:
            robot.drive_to(robot.step + 1)
        first.append(robot.step)
    assert first[1] == first[0] + 3


def test_a_live_fusion_draws_its_first_map_where_the_poses_say(device: ComputeDevice) -> None:
    """Only one input sends a map, so no two can agree; the scans confirm it."""
    live = LiveFusion(RunConfig(live=LiveConfig(search_pause_s=0.0)), device)
    robot = Robot(device)
    robot.drive_to(100)
    found = solved(robot, resolution=0.05)
    own = found.evidence.transforms["b"].inverse()
    grid = replace(found.evidence.drawn, origin=own.compose(found.evidence.drawn.origin)).with_name(
        "b"
    )
    live.put("b", grid, 0.0)
    live.update(0.0)
    assert live.lattice is None
    live.put_evidence(found.evidence)
    update = live.update(1.0)
    assert np.count_nonzero(update.fused.cells == 100) == np.count_nonzero(
        found.evidence.drawn.cells == 100
    )
    (record,) = update.inputs
    assert record.accepted, record.reason


def test_new_poses_are_located_on_the_solved_walls(device: ComputeDevice) -> None:
    """Inputs drift after the solution: their scans show where the robot is."""
    robot = Robot(device)
    robot.drive_to(100)
    assert robot.locator.locate("a", 9.9, Pose2()) is None
    solution = solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    off_m = []
    for step in range(100, SCANS):
        truth = robot.truth[step]
        drifted = Pose2(0.003 * (step - 100), 0.0, 0.0).compose(robot.pose_of("a"))
        robot.drive_to(step + 1, "")
        found = robot.locator.locate("a", robot.scans[step].scan.stamp_s, drifted)
        off_m.append(math.dist((found.pose.x, found.pose.y), (truth.x, truth.y)))
    assert max(off_m) < 0.03
    # Without a scan of its stamp a pose is carried on, and is less sure.
    later = robot.locator.locate("a", 1e3, drifted)
    assert not later.fits
    assert np.all(np.diag(later.covariance) > np.diag(found.covariance))
    # Walls that are less sure make the pose less sure.
    unsure_walls = replace(solution.walls, covariance=np.diag((0.09, 0.04, 0.01)))
    robot.locator.take(replace(solution, walls=unsure_walls))
    unsure = robot.locator.locate("a", 1e3, drifted)
    assert np.all(np.diag(unsure.covariance) > (0.09, 0.04, 0.01))
    # Where no scan sees a wall, a new path moves the poses as well.
    robot.locator.take(replace(solution, walls=None))
    before = robot.locator.locate("a", 1e3, drifted)
    transforms = dict.fromkeys("abc", Pose2(5.0, 0.0, 0.0))
    path = replace(solution.path, poses=np.add(solution.path.poses, (5.0, 0.0, 0.0)))
    robot.locator.take(replace(solution, walls=None, path=path, transforms=transforms))
    after = robot.locator.locate("a", 1e3, drifted)
    assert after.pose == Pose2(5.0, 0.0, 0.0).compose(drifted) != before.pose
    robot.memory.forget()
    assert robot.locator.locate("a", 1e3, drifted) is None
    # One that was computed meanwhile is in the frame of the old drive.
    assert not robot.locator.take(solution)
    assert robot.locator.locate("a", 1e3, drifted) is None


def test_a_bent_input_is_contradicted_between_solutions_by_the_located_poses(
    device: ComputeDevice,
) -> None:
    robot = Robot(device, bent_ones="b")
    robot.drive_to(60)
    assert robot.solver.solve("judged") is None
    solution = solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    assert {*solution.supported} == {*solved(robot, "judged").supported} == {*"abc"}
    while robot.step < 140:
        stamp_s, pose = robot.scans[robot.step].scan.stamp_s, robot.pose_of("a")
        robot.drive_to(robot.step + 1)
        assert robot.locator.locate("a", stamp_s, pose) is not None
    later = solved(robot, "judged")
    assert {*later.supported} == {*"ac"}
    assert "contradict its path since" in later.evidence.doubts["b"]
    assert later.path is solution.path
    assert robot.locator.locate("b", stamp_s, Pose2()) is None
    assert robot.locator.locate("a", stamp_s, pose) is not None


def test_poses_that_come_before_their_scans_are_located_by_the_scan_before(
    device: ComputeDevice,
) -> None:
    robot = Robot(device)
    robot.drive_to(100)
    solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    for step in range(100, SCANS):
        robot.step, item, truth = step, robot.scans[step], robot.truth[step]
        drifted = Pose2(0.003 * (step - 100), 0.0, 0.0).compose(robot.pose_of("a"))
        robot.memory.add_pose("a", item.scan.stamp_s, drifted)
        found = robot.locator.locate("a", item.scan.stamp_s, drifted)
        assert found.fits == (step > 100)
        assert math.dist((found.pose.x, found.pose.y), (truth.x, truth.y)) < 0.06
        robot.memory.add_scan(item)
    # The laser is silent now.
    later = robot.locator.locate("a", item.scan.stamp_s + 1.0, drifted)
    assert later.fits
    later = robot.locator.locate("a", item.scan.stamp_s + 2.0, drifted)
    assert not later.fits


def test_where_scans_see_too_little_the_pose_is_less_sure(device: ComputeDevice) -> None:
    robot = Robot(device)
    for at, item in enumerate(robot.scans[60:90], 60):
        ranges = np.full_like(item.scan.ranges, np.inf)
        robot.scans[at] = replace(item, scan=replace(item.scan, ranges=ranges))
    robot.drive_to(60)
    solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    robot.drive_to(90, "a")
    way_m = math.dist(*((pose.x, pose.y) for pose in (robot.truth[59], robot.truth[89])))
    found = robot.locator.locate("a", robot.scans[89].scan.stamp_s, robot.pose_of("a"))
    assert found.covariance[0, 0] > (DRIFT * way_m) ** 2


@pytest.mark.parametrize("is_blind", [False, True])
def test_of_inputs_that_part_after_the_solution_most_say_where_the_robot_is(
    device: ComputeDevice, is_blind: bool
) -> None:
    """A scan is matched there; without one the pose is less sure."""
    robot = Robot(device)
    robot.bends["b"] = lambda pose, step: Pose2(0.0, 0.0, 0.02 * max(0, step - 60)).compose(pose)
    robot.drive_to(60)
    solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    for at, item in enumerate(robot.scans[60:], 60):
        ranges = np.full_like(item.scan.ranges, np.inf) if is_blind else item.scan.ranges
        robot.scans[at] = replace(item, scan=replace(item.scan, ranges=ranges))
    robot.drive_to(150)
    robot.step, truth = 149, robot.truth[149]
    found = robot.locator.locate("b", robot.scans[149].scan.stamp_s, robot.pose_of("b"))
    assert found.fits != is_blind
    assert math.dist((found.pose.x, found.pose.y), (truth.x, truth.y)) < 0.1
    assert (found.covariance[0, 0] > 1.0) == is_blind


def test_a_place_that_is_seen_again_is_as_sure_as_before(device: ComputeDevice) -> None:
    robot = Robot(device)
    there = list(zip(robot.scans, robot.truth, strict=True))[:100]
    ways = [*there, *there[::-1]]
    robot.truth = [truth for _, truth in ways]
    robot.scans = [
        replace(item, scan=replace(item.scan, stamp_s=0.1 * step), odometry=truth)
        for step, (item, truth) in enumerate(ways)
    ]
    for at, item in enumerate(robot.scans[40:70], 40):
        ranges = np.full_like(item.scan.ranges, np.inf)
        robot.scans[at] = replace(item, scan=replace(item.scan, ranges=ranges))
    sigmas_m = []
    for step in (100, 200):
        robot.drive_to(step)
        walls = solved(robot).walls
        sigmas_m.append(math.sqrt(walls.covariance[0, 0]))
    way_m = math.dist(*((pose.x, pose.y) for pose in (robot.truth[39], robot.truth[69])))
    assert sigmas_m[0] == pytest.approx(DRIFT * way_m, rel=0.3)
    assert sigmas_m[1] < 0.3 * sigmas_m[0]


def test_a_new_room_is_matched_before_a_solution_has_seen_it(device: ComputeDevice) -> None:
    robot = Robot(device)
    for at, item in enumerate(robot.scans):  # a short sight
        ranges = np.where(item.scan.ranges < 2.5, item.scan.ranges, np.inf).astype(np.float32)
        robot.scans[at] = replace(item, scan=replace(item.scan, ranges=ranges))
    robot.drive_to(30)
    solved(robot, lattice=LATTICE, transforms=in_frame_of_a())
    for step in range(30, SCANS):
        drifted = Pose2(0.0, 0.003 * (step - 30), 0.0).compose(robot.pose_of("a"))
        robot.drive_to(step + 1, "")
        found = robot.locator.locate("a", robot.scans[step].scan.stamp_s, drifted)
        assert found.fits, step
        truth = robot.truth[step]
        assert math.dist((found.pose.x, found.pose.y), (truth.x, truth.y)) < 0.05, step
