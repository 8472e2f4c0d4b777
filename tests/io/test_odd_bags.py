"""Bags that are odd, not unreadable: what can be told is read, the rest is named."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.io.bags import BagLog
from tests.io.bags import Bag

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
    with pytest.raises(LogError, match="choose one with tf_topic"):
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


def test_an_index_that_was_edited_by_hand_is_passed_over(tmp_path: Path) -> None:
    path = driven().scan(11.0).write(tmp_path)
    index = path / "metadata.yaml"
    text = re.sub(r"offered_qos_profiles:.*(\n      [ -].*)*\n", "offered_qos_profiles: ''\n",
                  index.read_text(encoding="utf-8"))  # fmt: skip
    index.write_text(text.replace("version: 9", "version: 5"), encoding="utf-8")
    assert len(list(BagLog(path))) == 1
