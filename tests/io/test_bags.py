"""Claims about reading ROS 1 and ROS 2 bags."""

from __future__ import annotations

import math
import pickle
import re
import shutil
import sqlite3
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

from rosbags.rosbag1 import Reader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from slamfusion.io.bags.storage import zstd
from tests.io.bags import KINDS, SCAN, TEXT, UPSIDE_DOWN, Bag, message_of, yaw_quaternion


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
    with pytest.raises(LogError, match="not a whole bag: a file of it is missing; copy all of it"):
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


# --- odd bags -------------------------------------------------------------------------------------

TURN = 2.0 * math.pi


def mounted_drive(stamp_s: float = 10.0) -> Bag:
    """One metre in ten seconds, the laser 0.1 m ahead of the base."""
    bag = Bag().transform(stamp_s, "base_link", "laser", (0.1, 0.0, 0.2), topic="/tf_static")
    for second in range(11):
        at_s = stamp_s + second
        bag.transform(at_s, "odom", "base_link", (0.1 * second, 0.0, 0.0))
        bag.odometry(at_s, (0.1 * second, 0.0, 0.0))
    return bag


def test_one_zero_stamp_is_skipped_and_not_all(tmp_path: Path) -> None:
    log = BagLog(mounted_drive().scan(0.0).scan(11.0).scan(12.0).write(tmp_path))
    assert [item.scan.stamp_s for item in log] == [11.0, 12.0]
    assert log.skips.counts == {"no time stamp": 1}


def test_scans_of_another_clock_name_both(tmp_path: Path) -> None:
    bag = mounted_drive(1_700_000_000.0).scan(21.0).scan(22.0)
    with pytest.raises(LogError, match=r"scans from 21\.000 s.*from 1700000000\.000 s.*two clocks"):
        list(BagLog(bag.write(tmp_path)))


def test_ranges_in_millimetres_are_named(tmp_path: Path) -> None:
    bag = mounted_drive().scan(11.0, (2300.0, 800.0, 4100.0))
    with pytest.raises(LogError, match=r"median of 2300 with a range_max of 10 m: millimetres\?"):
        BagLog(bag.write(tmp_path))


@pytest.mark.parametrize("child", ["odom", "map", "laser", "", "robot"])
def test_odometry_of_no_frame_of_the_robot_is_of_its_base(tmp_path: Path, child: str) -> None:
    bag = Bag().transform(10.0, "base_link", "laser", (0.1, 0.0, 0.2), topic="/tf_static")
    for second in range(3):
        bag.transform(10.0 + second, "odom", "base_link", (0.1 * second, 0.0, 0.0))
        bag.odometry(10.0 + second, (0.1 * second, 0.0, 0.0), child=child)
    log = BagLog(bag.scan(11.0).write(tmp_path))
    (item,) = log
    assert item.scan.mount.x == pytest.approx(0.1)
    assert any("taken: 'base_link'" in note for note in log.notes)


@pytest.mark.parametrize(("topic", "has_pose"), [("none", False), ("tf", True), (None, True)])
def test_odometry_may_be_left_out_or_come_from_transforms(
    tmp_path: Path, topic: str | None, has_pose: bool
) -> None:
    path = mounted_drive().scan(11.0).write(tmp_path)
    (item,) = BagLog(path, LogConfig(odom_topic=topic))
    assert (item.odometry is not None) == has_pose


def two_robots() -> Bag:
    """Two robots whose frames have the same names, each in its own namespace."""
    bag = Bag()
    for name, ahead, step in (("robot1", 0.1, 0.1), ("robot2", -0.3, 0.5)):
        mount = (ahead, 0.0, 0.0)
        bag.transform(10.0, "base_link", "laser", mount, topic=f"/{name}/tf_static")
        for second in range(3):
            place = (step * second, 0.0, 0.0)
            bag.transform(10.0 + second, "odom", "base_link", place, topic=f"/{name}/tf")
            bag.odometry(10.0 + second, place, topic=f"/{name}/odom")
        bag.scan(11.0, topic=f"/{name}/scan")
    return bag


@pytest.mark.parametrize(("name", "ahead", "x"), [("robot1", 0.1, 0.1), ("robot2", -0.3, 0.5)])
def test_of_several_robots_the_one_of_the_scans_is_read(
    tmp_path: Path, name: str, ahead: float, x: float
) -> None:
    (item,) = BagLog(two_robots().write(tmp_path), LogConfig(scan_topic=f"/{name}/scan"))
    assert item.scan.mount.x == pytest.approx(ahead)
    assert item.odometry.x == pytest.approx(x)


def test_transforms_of_two_robots_are_never_mixed(tmp_path: Path) -> None:
    bag = two_robots().scan(11.0, topic="/scan")
    path = bag.write(tmp_path)
    with pytest.raises(LogError, match="choose one with --tf-topic"):
        BagLog(path, LogConfig(scan_topic="/scan", odom_topic="tf"))
    config = LogConfig(scan_topic="/scan", odom_topic="tf", tf_topic="/robot2/tf")
    (item,) = BagLog(path, config)
    assert item.scan.mount.x == pytest.approx(-0.3)
    with pytest.raises(LogError, match="no transforms on 'tf3'"):
        BagLog(path, LogConfig(scan_topic="/scan", tf_topic="tf3"))


def test_a_sweep_in_parts_is_put_together(tmp_path: Path) -> None:
    bag = mounted_drive()
    ranges = np.linspace(1.0, 3.0, 36)
    step = TURN / 36
    for sweep in range(3):
        for part in range(12):
            beams = slice(3 * part, 3 * part + 3)
            bag.scan(
                11.0 + 0.2 * sweep + 0.01 * part,
                ranges[beams],
                angle_min=-math.pi + 3 * part * step,
                angle_increment=step,
            )
    scans = [item.scan for item in BagLog(bag.write(tmp_path))]
    assert [scan.stamp_s for scan in scans] == pytest.approx([11.0, 11.2, 11.4])
    for scan in scans:
        assert np.allclose(scan.ranges, ranges)
        assert scan.angle_min_rad == pytest.approx(-math.pi)


def test_scans_of_two_lasers_are_not_put_together(tmp_path: Path) -> None:
    bag = mounted_drive().transform(10.0, "base_link", "rear", (-0.1, 0.0, 0.2), topic="/tf_static")
    for stamp_s, frame, first in ((11.0, "laser", -1.5), (11.1, "rear", 0.0)):
        bag.scan(stamp_s, frame=frame, angle_min=first, angle_increment=0.5)
    scans = [item.scan for item in BagLog(bag.write(tmp_path))]
    assert [(len(scan), scan.mount.x) for scan in scans] == [(3, 0.1), (3, -0.1)]


def test_scans_of_two_lasers_with_one_stamp_are_both_used(tmp_path: Path) -> None:
    bag = mounted_drive().transform(10.0, "base_link", "rear", (-0.1, 0.0, 0.2), topic="/tf_static")
    for stamp_s in (11.0, 11.1, 11.1):
        bag.scan(stamp_s).scan(stamp_s, frame="rear")
    log = BagLog(bag.write(tmp_path))
    scans = [item.scan for item in log]
    assert [scan.mount.x for scan in scans] == [0.1, -0.1, 0.1, -0.1]
    assert [scan.stamp_s for scan in scans] == pytest.approx([11.0, 11.0, 11.1, 11.1], abs=1e-5)
    assert log.skips.total == 2


def test_an_index_that_was_edited_by_hand_is_passed_over(tmp_path: Path) -> None:
    path = mounted_drive().scan(11.0).write(tmp_path)
    index = path / "metadata.yaml"
    text = re.sub(r"offered_qos_profiles:.*(\n      [ -].*)*\n", "offered_qos_profiles: ''\n",
                  index.read_text(encoding="utf-8"))  # fmt: skip
    index.write_text(text.replace("version: 9", "version: 5"), encoding="utf-8")
    assert len(list(BagLog(path))) == 1


NOTED = "/note"


def with_a_text(folder: Path, kind: str) -> Path:
    """A bag with a scan and a text; returns its storage file."""
    bag = mounted_drive().scan(11.0).add(11.0, NOTED, TEXT, data="hello")
    (path,) = [item for item in bag.write(folder, kind).iterdir() if item.suffix != ".yaml"]
    return path


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"ros2msg", b"jsonsch"),
        (b"ros2msg", b"protobu"),
        (b"ros2msg\x0c\0\0\0string data", b"ros2msg\x0c\0\0\0\xff\xfe {;;;]]]"),
    ],
)
def test_schemas_of_another_topic_do_not_matter(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = with_a_text(tmp_path, "mcap")
    head = TEXT.encode() + b"\x07\0\0\0"
    data = path.read_bytes()
    assert data.count(head + old) == 2  # in its chunk and at the end
    path.write_bytes(data.replace(head + old, head + new))
    for place in (path, path.parent):
        assert len(list(open_log(place))) == 1


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_another_encoding_of_another_topic_does_not_matter(tmp_path: Path, kind: str) -> None:
    path = with_a_text(tmp_path, kind)
    if kind == "mcap":
        name = NOTED.encode() + b"\x03\0\0\0"
        path.write_bytes(path.read_bytes().replace(name + b"cdr", name + b"jsn"))
    else:
        with sqlite3.connect(path) as base:
            base.execute("UPDATE topics SET serialization_format = 'json' WHERE name = ?", [NOTED])
            base.execute(
                "UPDATE message_definitions SET encoding = 'unknown' WHERE topic_type = ?", [TEXT]
            )
    index = path.parent / "metadata.yaml"
    text = index.read_text(encoding="utf-8")
    head, tail = text.split(f"name: {NOTED}")
    tail = tail.replace("serialization_format: cdr", "serialization_format: json", 1)
    index.write_text(f"{head}name: {NOTED}{tail}", encoding="utf-8")
    for place in (path, path.parent):
        log = open_log(place)
        assert len(list(log)) == 1
        assert log.notes == []


def test_a_laser_in_another_encoding_is_named_with_it(tmp_path: Path) -> None:
    path = next(Bag().scan(11.0).write(tmp_path).glob("*.mcap"))
    name = b"/scan\x03\0\0\0"
    path.write_bytes(path.read_bytes().replace(name + b"cdr", name + b"jsn"))
    with pytest.raises(LogError, match=r"no laser in it: .* found /scan \(in jsn\)"):
        open_log(path)


def test_messages_as_ros1_writes_them_in_an_mcap_file(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    message = message_of(store.types, SCAN, 11.0, 1, Bag().scan(11.0).messages[0][3])
    with writer:
        scans = writer.add_connection(
            "/scan", SCAN, typestore=get_typestore(Stores.LATEST), serialization_format="ros1"
        )
        writer.write(scans, 11 * 10**9, store.serialize_ros1(message, SCAN))
    (item,) = open_log(next((tmp_path / "bag").glob("*.mcap")))
    assert item.scan.stamp_s == 11.0


def long_drive(folder: Path, kind: str) -> Path:
    """A bag of several chunks: 11 s with four scans a second of 20000 beams."""
    bag, random = Bag(), np.random.default_rng(1)
    for number in range(44):
        at_s = 10.0 + 0.25 * number
        bag.odometry(at_s, (0.1 * number, 0.0, 0.0))
        bag.scan(at_s, random.uniform(1.0, 9.0, 20_000), angle_increment=1e-4)
    path = bag.write(folder, kind)
    return path if path.is_file() else next(path.glob("*.mcap"))


@pytest.mark.parametrize("kept", [0.5, 0.8, 0.999])
def test_a_cut_off_mcap_is_read_to_where_it_goes(tmp_path: Path, kept: float) -> None:
    path = long_drive(tmp_path, "mcap")
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    for place in (path, path.parent):
        log = open_log(place)
        stamps = [item.scan.stamp_s for item in log]
        assert stamps == pytest.approx(10.0 + 0.25 * np.arange(len(stamps)))
        assert len(stamps) >= 44 * kept - 14  # a chunk has 14 scans
        assert [note for note in log.notes if "read as far as it goes" in note]


def test_a_damaged_chunk_ends_the_reading_and_is_said(tmp_path: Path) -> None:
    path = long_drive(tmp_path, "ros1-lz4")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 100_000] = bytes(100_000)
    path.write_bytes(data)
    log = open_log(path)
    assert 10 <= len(list(log)) < 44
    assert [note for note in log.notes if "it is damaged" in note]


@pytest.mark.parametrize("kind", ["ros1", "ros1-lz4"])
@pytest.mark.parametrize("is_active", [True, False])
def test_a_ros1_bag_without_an_index_is_read(tmp_path: Path, kind: str, *, is_active: bool) -> None:
    path = long_drive(tmp_path, kind)
    with Reader(path) as reader:
        last = reader.chunks[max(reader.chunks)]
        count = len(reader.chunks)
    data = bytearray(path.read_bytes()[: last.datapos + last.datasize * 2 // 3])
    if is_active:  # the last chunk has no length yet, and the bag no index
        data[last.datapos - 4 : last.datapos] = bytes(4)
        at = data.index(b"index_pos=") + len(b"index_pos=")
        data[at : at + 8] = bytes(8)
    path = tmp_path / ("a.bag.active" if is_active else "a.bag")
    path.write_bytes(data)
    log = open_log(path)
    stamps = [item.scan.stamp_s for item in log]
    assert count > 2
    assert stamps == pytest.approx(10.0 + 0.25 * np.arange(len(stamps)))
    assert len(stamps) >= 13 * (count - 1)  # a chunk has 13 or 14
    assert [note for note in log.notes if "read as far as it goes" in note]


def packed(path: Path) -> Path:
    """Pack a file as ROS 2 does, away from its folder."""
    target = path.parent.parent / f"alone{path.suffix}.zstd"
    target.write_bytes(zstd.compress(path.read_bytes()))
    return target


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_a_packed_storage_file_alone_is_a_bag(tmp_path: Path, kind: str) -> None:
    assert len(list(open_log(packed(with_a_text(tmp_path, kind))))) == 1


def test_a_packed_file_that_is_cut_off_is_read_to_where_it_goes(tmp_path: Path) -> None:
    path = packed(long_drive(tmp_path, "mcap"))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert 1 <= len(list(open_log(path))) < 44
    path.write_bytes(data[:20])
    with pytest.raises(LogError, match="nothing of it can be unpacked"):
        open_log(path)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_a_bag_that_packs_each_message_may_be_given_as_its_file_alone(
    tmp_path: Path, kind: str
) -> None:
    folder = Bag().scan(10.0).scan(10.1).write(tmp_path, kind, packed="MESSAGE")
    (path,) = [item for item in folder.iterdir() if item.suffix != ".yaml"]
    assert len(list(open_log(path))) == 2


def test_a_missing_file_of_several_is_said(tmp_path: Path) -> None:
    path = mounted_drive().scan(11.0).write(tmp_path)
    index = path / "metadata.yaml"
    text = index.read_text(encoding="utf-8")
    index.write_text(text.replace("- bag-mcap.mcap", "- bag-mcap.mcap\n  - x_1.mcap"), "utf-8")
    log = open_log(path)
    assert len(list(log)) == 1
    assert log.notes == ["x_1.mcap is missing in the bag; the rest is read"]


def test_a_laser_topic_without_a_message_is_no_choice(tmp_path: Path) -> None:
    path = mounted_drive().scan(11.0).scan(11.0, topic="/unused").write(tmp_path, "sqlite3")
    with sqlite3.connect(path / "bag-sqlite3.db3") as base:
        base.execute(
            "DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = '/unused')"
        )
    (path / "metadata.yaml").unlink()
    assert len(list(open_log(path))) == 1
