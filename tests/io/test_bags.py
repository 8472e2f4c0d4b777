"""Claims about reading ROS 1 and ROS 2 bags."""

from __future__ import annotations

import math
import pickle
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan, open_log
from slamfusion.io.bags.log import BagLog
from tests.support.datasets import DATASETS

pytest.importorskip("rosbags", reason="rosbags comes with the bags extra")

from tests.io.bags import KINDS, UPSIDE_DOWN, Bag, yaw_quaternion


def driven(bag: Bag | None = None) -> Bag:
    """Odometry from 10 s to 12 s: 1 m/s ahead and 0.5 rad/s left, every half second."""
    bag = bag or Bag()
    for k in range(5):
        bag.odometry(10.0 + 0.5 * k, (0.5 * k, 0.0, 0.25 * k))
    return bag


def read(bag: Bag, folder: Path, kind: str = "mcap", **config: Any) -> tuple[BagLog, list[LogScan]]:
    log = BagLog(bag.write(folder, kind), LogConfig(**config))
    return log, list(log)


def assert_pose(found: Pose2 | None, x: float, y: float, yaw_rad: float) -> None:
    assert found is not None
    assert (found.x, found.y, found.yaw_rad) == pytest.approx((x, y, yaw_rad), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_its_scans(tmp_path: Path, kind: str) -> None:
    bag = driven().scan(10.5, [1.0, math.inf, math.nan]).scan(11.25)
    path = bag.transform(10.0, "base_link", "laser", (0.2, 0.0, 0.3)).write(tmp_path, kind)
    log = open_log(path)
    first, second = list(pickle.loads(pickle.dumps(log)))  # noqa: S301 - as in another process
    assert isinstance(log, BagLog)
    assert first.scan.stamp_s == 10.5
    assert_pose(first.odometry, 0.5, 0.0, 0.25)
    assert_pose(second.odometry, 1.25, 0.0, 0.625)
    np.testing.assert_array_equal(first.scan.ranges, np.float32([1.0, np.inf, np.nan]))
    assert (first.scan.angle_min_rad, first.scan.angle_increment_rad) == (-0.5, 0.5)
    assert (first.scan.range_min_m, first.scan.range_max_m) == pytest.approx((0.1, 10.0))
    assert first.scan.mount == Pose2(0.2, 0.0, 0.0)
    assert (log.skips.total, log.notes, log.has_stamps) == (0, [], True)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_the_storage_file_alone_is_a_bag_too(tmp_path: Path, kind: str) -> None:
    path = driven().scan(10.5).write(tmp_path, kind)
    suffix = ".mcap" if kind == "mcap" else ".db3"
    (storage,) = path.glob(f"*{suffix}")
    alone = tmp_path / f"alone{suffix}"
    shutil.copy(storage, alone)
    assert len(list(open_log(alone))) == 1
    (path / "metadata.yaml").unlink()
    assert len(list(open_log(path))) == 1


def test_a_bag_without_message_definitions_is_read(tmp_path: Path) -> None:
    assert len(list(open_log(driven().scan(10.5).write(tmp_path, "sqlite3", version=8)))) == 1


def test_scans_without_odometry_in_reach_are_counted_skips(tmp_path: Path) -> None:
    bag = Bag()
    for stamp in (10.0, 10.1, 15.0):
        bag.odometry(stamp, (stamp, 0.0, 0.0))
    for stamp in (9.0, 9.97, 10.05, 12.5, 14.9, 15.03, 16.0):
        bag.scan(stamp)
    log, scans = read(bag, tmp_path)
    xs = [scan.odometry.x for scan in scans if scan.odometry]
    assert xs == pytest.approx([10.0, 10.05, 14.9, 15.0])
    assert log.skips.lines == {
        "laser before odometry": [1],
        "no odometry within 0.5 s of the laser": [4],
        "laser after odometry": [7],
    }


def test_the_heading_between_poses_turns_the_short_way(tmp_path: Path) -> None:
    bag = Bag().odometry(10.0, (0.0, 0.0, 3.0)).odometry(10.4, (0.0, 0.0, -3.0)).scan(10.1)
    (scan,) = read(bag, tmp_path)[1]
    assert scan.odometry is not None
    assert scan.odometry.yaw_rad == pytest.approx(3.0 + 0.25 * (2.0 * math.pi - 6.0))


def test_odometry_recorded_out_of_order_is_used_in_order(tmp_path: Path) -> None:
    bag = Bag()
    for stamp in (10.4, 10.0, 10.2):
        bag.odometry(stamp, (stamp, 0.0, 0.0))
    (scan,) = read(bag.scan(10.3), tmp_path)[1]
    assert_pose(scan.odometry, 10.3, 0.0, 0.0)


def test_transforms_are_the_odometry_where_no_messages_are(tmp_path: Path) -> None:
    bag = Bag().scan(10.25)
    bag.transform(10.0, "/odom", "base_footprint", (1.0, 0.0, 0.0), yaw_quaternion(0.0))
    bag.transform(10.5, "odom", "/base_footprint", (3.0, 2.0, 0.0), yaw_quaternion(2.0))
    bag.transform(0.0, "base_footprint", "base_link", (0.0, 0.0, 0.1), topic="/tf_static")
    bag.transform(
        0.0, "base_link", "laser", (0.2, -0.1, 0.0), yaw_quaternion(0.5), topic="/tf_static"
    )
    log, (scan,) = read(bag, tmp_path)
    assert_pose(scan.odometry, 2.0, 1.0, 1.0)
    assert_pose(scan.scan.mount, 0.2, -0.1, 0.5)
    assert log.notes == []


def test_a_bag_without_odometry_gives_scans_without_and_says_so(tmp_path: Path) -> None:
    log, scans = read(Bag().scan(1.0).scan(2.0), tmp_path)
    assert [scan.odometry for scan in scans] == [None, None]
    assert any("no odometry" in note for note in log.notes)
    assert any("taken: the laser sits upright" in note for note in log.notes)


def test_another_base_frame_moves_the_odometry_and_the_mount(tmp_path: Path) -> None:
    bag = driven().scan(10.5)
    bag.transform(10.0, "base_link", "rear", (-1.0, 0.0, 0.0), yaw_quaternion(math.pi / 2))
    bag.transform(10.0, "base_link", "laser", (0.2, 0.0, 0.0))
    (scan,) = read(bag, tmp_path, base_frame="rear")[1]
    turn = Pose2(0.5, 0.0, 0.25).compose(Pose2(-1.0, 0.0, math.pi / 2))
    assert_pose(scan.odometry, turn.x, turn.y, turn.yaw_rad)
    assert_pose(scan.scan.mount, 0.0, -1.2, -math.pi / 2)


def test_a_laser_that_hangs_upside_down_turns_the_other_way(tmp_path: Path) -> None:
    bag = driven().scan(10.5, [1.0, 2.0, 3.0], angle_min=-0.2, angle_increment=0.3)
    bag.transform(10.0, "base_link", "laser", (0.3, 0.1, 0.2), UPSIDE_DOWN)
    (scan,) = read(bag, tmp_path)[1]
    assert scan.scan.angle_min_rad == pytest.approx(0.2)
    assert scan.scan.angle_increment_rad == pytest.approx(-0.3)
    # The first beam points to the laser's right, which is the robot's left.
    assert scan.scan.points()[0] == pytest.approx(
        [0.3 + math.cos(0.2), 0.1 + math.sin(0.2)], abs=1e-6
    )


def test_a_laser_that_stands_upright_on_its_side_is_refused(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    bag = driven().scan(10.5).transform(10.0, "base_link", "laser", turn=(half, 0.0, 0.0, half))
    with pytest.raises(LogError, match="tilted by 90 degrees"):
        read(bag, tmp_path)


def test_a_laser_that_turns_on_the_robot_has_a_mount_for_each_time(tmp_path: Path) -> None:
    bag = driven().scan(10.5).scan(11.0)
    for stamp in (10.0, 11.0, 12.0):
        bag.transform(stamp, "base_link", "laser", turn=yaw_quaternion(stamp - 10.0))
    yaws = [scan.scan.mount.yaw_rad for scan in read(bag, tmp_path)[1]]
    assert yaws == pytest.approx([0.5, 1.0])


@pytest.mark.parametrize(
    "fields",
    [
        {"range_max": 0.0},
        {"range_max": math.nan},
        {"angle_increment": 0.0},
        {"angle_increment": 57.3},
        {"angle_min": math.nan},
    ],
)
def test_a_scan_of_impossible_geometry_is_a_counted_skip(
    tmp_path: Path, fields: dict[str, float]
) -> None:
    log, scans = read(driven().scan(10.5, **fields).scan(11.0), tmp_path)
    assert [scan.line for scan in scans] == [2]
    assert log.skips.counts == {"angles or ranges that cannot be a scan": 1}
    assert sum(" must " in note for note in log.notes) == 1


def test_scans_without_stamps_take_the_time_of_recording_and_say_so(tmp_path: Path) -> None:
    bag = Bag().scan(0.0).scan(0.0)
    log, scans = read(bag, tmp_path)
    assert [scan.scan.stamp_s for scan in scans] == [5.0, 6.0]
    assert any("when each was recorded" in note for note in log.notes)


def refusal(bag: Bag, folder: Path, **config: Any) -> str:
    with pytest.raises(LogError) as caught:
        read(bag, folder, **config)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_several_lasers_need_a_choice(tmp_path: Path) -> None:
    bag = driven().scan(10.5, topic="/front").scan(11.0, topic="/rear")
    path = bag.write(tmp_path)
    with pytest.raises(LogError, match=r"several .* /front, /rear; choose one with --scan-topic"):
        BagLog(path)
    (scan,) = BagLog(path, LogConfig(scan_topic="rear"))
    assert scan.scan.stamp_s == 11.0


def test_several_odometries_need_a_choice(tmp_path: Path) -> None:
    bag = driven().odometry(10.5, (9.0, 0.0, 0.0), topic="/visual").scan(10.5)
    path = bag.write(tmp_path)
    with pytest.raises(LogError, match=r"several .* /odom, /visual; choose one with --odom-topic"):
        BagLog(path)
    (scan,) = BagLog(path, LogConfig(odom_topic="/visual"))
    assert_pose(scan.odometry, 9.0, 0.0, 0.0)


def test_a_topic_that_is_not_there_names_those_that_are(tmp_path: Path) -> None:
    message = refusal(driven().scan(10.5), tmp_path, scan_topic="/laser")
    assert "no sensor_msgs/LaserScan topic '/laser' in it; found /scan" in message
    shutil.rmtree(tmp_path / "bag-mcap")
    message = refusal(driven().scan(10.5), tmp_path, odom_topic="/wheels")
    assert "found /odom" in message


def test_a_base_frame_that_is_not_there_names_those_that_are(tmp_path: Path) -> None:
    bag = driven().scan(10.5).transform(10.0, "base_link", "laser")
    message = refusal(bag, tmp_path, base_frame="chassis")
    assert "base_frame 'chassis'" in message
    assert "base_link, laser" in message


def test_a_bag_without_a_laser_names_its_topics(tmp_path: Path) -> None:
    message = refusal(driven(), tmp_path)
    assert "no laser in it" in message
    assert "/odom" in message


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_a_cut_off_bag_is_one_clear_line(tmp_path: Path, kind: str) -> None:
    path = driven().scan(10.5).write(tmp_path, kind)
    files = [path] if path.is_file() else [*path.glob("*.mcap"), *path.glob("*.db3")]
    data = files[0].read_bytes()
    files[0].write_bytes(data[: len(data) // 3])
    with pytest.raises(LogError, match="cannot be read as a bag") as caught:
        list(open_log(path))
    assert "\n" not in str(caught.value)


def test_a_bag_whose_storage_is_missing_is_one_clear_line(tmp_path: Path) -> None:
    path = driven().scan(10.5).write(tmp_path)
    next(path.glob("*.mcap")).unlink()
    with pytest.raises(LogError):
        open_log(path)


def test_without_rosbags_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = driven().scan(10.5).write(tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(LogError, match=r"pip install 'slamfusion\[bags\]'"):
        open_log(path)


@pytest.mark.datasets
def test_a_recorded_kinect_with_transforms() -> None:
    log = open_log(DATASETS / "rosbags" / "test_turtlebot.bag")
    scans = list(log)
    assert len(scans) == 819
    assert (log.skips.total, log.notes) == (0, [])
    assert_pose(scans[0].scan.mount, -0.087, 0.0125, 0.0)
    xy = np.array([(scan.odometry.x, scan.odometry.y) for scan in scans if scan.odometry])
    assert np.hypot(*np.diff(xy, axis=0).T).sum() == pytest.approx(5.4, abs=0.1)


@pytest.mark.datasets
def test_a_recorded_laser_that_hangs_upside_down() -> None:
    log = open_log(DATASETS / "rosbags" / "test_replay_crash.bag")
    scans = list(log)
    assert len(scans) == 136
    assert log.skips.total == 0
    assert_pose(scans[0].scan.mount, 0.291, 0.0, 0.0)
    assert scans[0].scan.angle_increment_rad == pytest.approx(-math.radians(0.5))
