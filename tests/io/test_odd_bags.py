"""Bags that are odd, not unreadable: what can be told is read, the rest is named."""

from __future__ import annotations

import math
import re
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.io import open_log
from slamfusion.io.bags.log import BagLog
from slamfusion.io.bags.storage import zstd
from tests.io.bags import SCAN, TEXT, Bag, message_of

TURN = 2.0 * math.pi


def driven(stamp_s: float = 10.0) -> Bag:
    """One metre in ten seconds, the laser 0.1 m ahead of the base."""
    bag = Bag().transform(stamp_s, "base_link", "laser", (0.1, 0.0, 0.2), topic="/tf_static")
    for second in range(11):
        at_s = stamp_s + second
        bag.transform(at_s, "odom", "base_link", (0.1 * second, 0.0, 0.0))
        bag.odometry(at_s, (0.1 * second, 0.0, 0.0))
    return bag


def test_one_zero_stamp_is_skipped_and_not_all(tmp_path: Path) -> None:
    log = BagLog(driven().scan(0.0).scan(11.0).scan(12.0).write(tmp_path))
    assert [item.scan.stamp_s for item in log] == [11.0, 12.0]
    assert log.skips.counts == {"no time stamp": 1}


def test_scans_of_another_clock_name_both(tmp_path: Path) -> None:
    bag = driven(1_700_000_000.0).scan(21.0).scan(22.0)
    with pytest.raises(LogError, match=r"scans from 21\.000 s.*from 1700000000\.000 s.*two clocks"):
        list(BagLog(bag.write(tmp_path)))


def test_ranges_in_millimetres_are_named(tmp_path: Path) -> None:
    bag = driven().scan(11.0, (2300.0, 800.0, 4100.0))
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
    path = driven().scan(11.0).write(tmp_path)
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
    assert item.odometry is not None
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
    bag = driven()
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
    bag = driven().transform(10.0, "base_link", "rear", (-0.1, 0.0, 0.2), topic="/tf_static")
    for stamp_s, frame, first in ((11.0, "laser", -1.5), (11.1, "rear", 0.0)):
        bag.scan(stamp_s, frame=frame, angle_min=first, angle_increment=0.5)
    scans = [item.scan for item in BagLog(bag.write(tmp_path))]
    assert [(len(scan), scan.mount.x) for scan in scans] == [(3, 0.1), (3, -0.1)]


def test_scans_of_two_lasers_with_one_stamp_are_both_used(tmp_path: Path) -> None:
    bag = driven().transform(10.0, "base_link", "rear", (-0.1, 0.0, 0.2), topic="/tf_static")
    for stamp_s in (11.0, 11.1, 11.1):
        bag.scan(stamp_s).scan(stamp_s, frame="rear")
    log = BagLog(bag.write(tmp_path))
    scans = [item.scan for item in log]
    assert [scan.mount.x for scan in scans] == [0.1, -0.1, 0.1, -0.1]
    assert [scan.stamp_s for scan in scans] == pytest.approx([11.0, 11.0, 11.1, 11.1], abs=1e-5)
    assert log.skips.total == 2


def test_an_index_that_was_edited_by_hand_is_passed_over(tmp_path: Path) -> None:
    path = driven().scan(11.0).write(tmp_path)
    index = path / "metadata.yaml"
    text = re.sub(r"offered_qos_profiles:.*(\n      [ -].*)*\n", "offered_qos_profiles: ''\n",
                  index.read_text(encoding="utf-8"))  # fmt: skip
    index.write_text(text.replace("version: 9", "version: 5"), encoding="utf-8")
    assert len(list(BagLog(path))) == 1


NOTED = "/note"


def with_a_text(folder: Path, kind: str) -> Path:
    """A bag with a scan and a text; returns its storage file."""
    bag = driven().scan(11.0).add(11.0, NOTED, TEXT, data="hello")
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


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_a_bag_that_packs_each_message_may_be_given_as_its_file_alone(
    tmp_path: Path, kind: str
) -> None:
    folder = Bag().scan(10.0).scan(10.1).write(tmp_path, kind, packed="MESSAGE")
    (path,) = [item for item in folder.iterdir() if item.suffix != ".yaml"]
    assert len(list(open_log(path))) == 2


def test_a_missing_file_of_several_is_said(tmp_path: Path) -> None:
    path = driven().scan(11.0).write(tmp_path)
    index = path / "metadata.yaml"
    text = index.read_text(encoding="utf-8")
    index.write_text(text.replace("- bag-mcap.mcap", "- bag-mcap.mcap\n  - x_1.mcap"), "utf-8")
    log = open_log(path)
    assert len(list(log)) == 1
    assert log.notes == ["x_1.mcap is missing in the bag; the rest is read"]


def test_a_laser_topic_without_a_message_is_no_choice(tmp_path: Path) -> None:
    path = driven().scan(11.0).scan(11.0, topic="/unused").write(tmp_path, "sqlite3")
    with sqlite3.connect(path / "bag-sqlite3.db3") as base:
        base.execute(
            "DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = '/unused')"
        )
    (path / "metadata.yaml").unlink()
    assert len(list(open_log(path))) == 1
