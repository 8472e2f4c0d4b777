"""The player: of a log and of a bag, its rate, loop, lockstep, transforms, and how it ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from slamfusion.geometry import Pose2
from slamfusion.io import open_log
from slamfusion.ros import messages, qos
from slamfusion.ros.base import FINAL
from slamfusion.ros.frames import HAS_TF2, TransformInput
from tests.fusion.live.maps import three
from tests.io.bags import Bag
from tests.ros import tf2
from tests.ros.drives import FIRST_S, write_log
from tests.ros.live import Observer, Processes, values

pytestmark = pytest.mark.ros

COUNT = 20
MOUNT = Pose2(0.2, 0.1, 0.5)


def said(process: Any) -> list[str]:
    """What a process said of itself."""
    return [line for line in process.text().splitlines() if "tf2_msgs" not in line]


def test_a_log_comes_as_topics_with_its_own_stamps(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT, mount=MOUNT)
    heard = observer.collect(LaserScan, "scan")
    odometry = observer.collect(Odometry, "odom")
    clock = observer.collect(Clock, "/clock")
    transforms = TransformInput(observer.node)
    player = processes.node("player", file=str(log), rate=4.0)
    assert player.wait(30.0) == 0
    observer.listen(0.5)

    logged = list(open_log(log))
    assert [messages.stamp_s(item) for item in heard] == [item.scan.stamp_s for item in logged]
    for message, item in zip(heard, logged, strict=True):
        assert message.header.frame_id == "laser"
        assert list(message.ranges) == item.scan.ranges.tolist()
    poses = [messages.pose2_from_message(message.pose.pose) for message in odometry]
    assert [(pose.x, pose.y) for pose in poses] == [
        (item.odometry.x, item.odometry.y) for item in logged
    ]
    assert {(item.header.frame_id, item.child_frame_id) for item in odometry} == {
        ("odom", "base_link")
    }
    stamps_s = [messages.stamp_s(message.clock) for message in clock]
    assert stamps_s == sorted(stamps_s)
    assert len(stamps_s) > COUNT
    assert stamps_s[-1] == FIRST_S + 0.1 * (COUNT - 1)
    last = logged[-1]
    found = transforms.lookup("odom", "laser", last.scan.stamp_s)
    wanted = last.odometry.compose(last.scan.mount)
    assert (found.x, found.y) == pytest.approx((wanted.x, wanted.y), abs=1e-6)
    assert f"end of {log}: {COUNT} scans sent" in said(player)[-1]


def test_transforms_go_over_tf_where_it_is_there(
    processes: Processes, observer: Observer, tmp_path: Path
):
    tf2.skip_without()
    assert HAS_TF2
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415

    moving = observer.collect(TFMessage, "/tf", qos.TF)
    static = observer.collect(TFMessage, "/tf_static", qos.TF_STATIC)
    log = write_log(tmp_path, COUNT, mount=MOUNT)
    observer.collect(LaserScan, "scan")
    player = processes.node("player", file=str(log), rate=10.0, odometry="tf")
    assert player.wait(30.0) == 0
    observer.wait(lambda: len(moving) == COUNT, what="every transform")
    (transform,) = moving[0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    ((mount,),) = [message.transforms for message in static]
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "laser")
    assert mount.transform.translation.x == pytest.approx(0.2)


def test_a_loop_begins_again_with_time_back(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    heard = observer.collect(LaserScan, "scan")
    player = processes.node("player", file=str(log), rate=20.0, loop=True)
    observer.wait(lambda: len(heard) >= 3 * COUNT, what="three rounds")
    stamps_s = [messages.stamp_s(item) for item in heard[: 3 * COUNT]]
    assert stamps_s[:COUNT] == stamps_s[COUNT : 2 * COUNT] == stamps_s[2 * COUNT :]
    assert player.interrupt() == 0
    assert "Traceback" not in player.text()


def test_in_lockstep_a_scan_waits_for_every_answer(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    heard = observer.collect(LaserScan, "scan")
    answers = [observer.publisher(PoseStamped, f"{name}/pose") for name in ("one", "two")]
    # A second listener: lockstep waits for as many as it is to wait for.
    observer.collect(LaserScan, "scan", qos.SENSOR)
    player = processes.node("player", file=str(log), lockstep=True, wait_for=["one", "two"])
    stamps_s: list[float] = []
    for index in range(COUNT):
        observer.wait(lambda index=index: len({*map(messages.stamp_s, heard)}) == index + 1)
        stamps_s = sorted({*map(messages.stamp_s, heard)})
        for answer in answers:
            # Half an answer is none.
            observer.listen(0.02)
            assert len({*map(messages.stamp_s, heard)}) == index + 1
            stamp = messages.to_stamp(stamps_s[-1])
            answer.publish(messages.pose_to_message(Pose2(), "map", stamp))
    assert player.wait(30.0) == 0
    assert stamps_s == pytest.approx([FIRST_S + 0.1 * index for index in range(COUNT)])


def test_the_first_scan_is_sent_again_until_every_producer_hears(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    heard = observer.collect(LaserScan, "scan")
    answer = observer.publisher(PoseStamped, "one/pose")
    player = processes.node("player", file=str(log), rate=20.0, wait_for=["one"])
    observer.wait(lambda: len(heard) >= 2, what="the first scan twice")
    assert {messages.stamp_s(item) for item in heard} == {FIRST_S}
    answer.publish(messages.pose_to_message(Pose2(), "map", messages.to_stamp(FIRST_S)))
    # The others are not answered, and do not wait for it.
    assert player.wait(30.0) == 0
    observer.wait(lambda: len({*map(messages.stamp_s, heard)}) == COUNT, what="every scan")


def test_a_fusion_whose_map_is_saved_gets_every_scan_and_is_waited_for(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    heard = observer.collect(LaserScan, "scan")
    answer = observer.publisher(PoseStamped, "one/pose")
    state = observer.publisher(DiagnosticArray, "/diagnostics")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fused.tum").write_text("# of an earlier log")
    player = processes.node(
        "player",
        env={"HOME": str(tmp_path)},
        file=f"~/{log.name}",
        wait_for=["one"],
        maps=["fused/map"],
        save="~/out",
        rate=20.0,
    )
    # It has found the producer, and still waits.
    observer.wait(answer.get_subscription_count, what="the player")
    observer.listen(2.0)
    assert not heard
    fused = observer.publisher(OccupancyGrid, "fused/map", qos.MAP)
    observer.wait(lambda: heard, what="the first scan")
    assert messages.stamp_s(heard[0]) == FIRST_S
    last_s = FIRST_S + 0.1 * (COUNT - 1)

    def solve(until_s: float) -> None:
        final = KeyValue(key=FINAL, value=f"{until_s:.3f}")
        state.publish(DiagnosticArray(status=[DiagnosticStatus(values=[final])]))

    # The fused map is not that of the drive before the fusion has solved it.
    answer.publish(PoseStamped(header=heard[0].header))
    grid = three()["a"]
    fused.publish(messages.grid_to_message(grid, "fused_map", messages.to_stamp(last_s)))
    solve(0.0)
    observer.wait(lambda: "end of" in player.text(), what="the end of the log")
    observer.listen(2.0)
    assert player.is_running
    solve(last_s)
    assert player.wait() == 0
    assert (tmp_path / "out" / "fused.yaml").exists()
    assert not (tmp_path / "out" / "fused.tum").exists(), "no path came"


def test_a_scan_that_is_not_answered_is_sent_again_and_then_named(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    heard = observer.collect(LaserScan, "scan")
    observer.publisher(PoseStamped, "silent/pose")
    player = processes.node(
        "player", file=str(log), lockstep=True, wait_for=["silent"], lockstep_timeout_s=2.5
    )
    status = observer.wait_status("player: player", "playing")
    assert values(status)["scans sent"] == "1"
    assert player.wait(30.0) == 1
    observer.listen(0.5)
    assert "no pose at 100.000 s from silent within 2.5 s" in said(player)[-1]
    assert 2 <= len(heard) <= 4
    assert {messages.stamp_s(item) for item in heard} == {FIRST_S}


def test_producers_that_never_come_are_named(processes: Processes, tmp_path: Path):
    log = write_log(tmp_path, COUNT)
    player = processes.node(
        "player", file=str(log), lockstep=True, wait_for=["one", "two"], start_timeout_s=0.5
    )
    assert player.wait(30.0) == 1
    assert "waited 0.5 s for one, two; missing: one, two" in said(player)[-1]


def test_it_plays_without_listeners_and_names_them_and_an_unknown_parameter(
    processes: Processes, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    player = processes.node("player", file=str(log), rat=2.0, rate=20.0, start_timeout_s=0.2)
    assert player.wait(30.0) == 0
    assert any("no node listens on '/scan'" in line for line in said(player))
    words = "unknown parameter 'rat' is not used; the nearest known one is 'rate'"
    assert sum(words in line for line in said(player)) == 1


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({}, "name the log or bag with the parameter file"),
        ({"file": "absent.log"}, "absent.log: no such file; check the path"),
        ({"file": "absent.log", "lockstep": True}, "lockstep needs to know whom to wait for"),
        ({"file": "absent.log", "rate": 0.0}, "rate"),
        ({"file": "absent.log", "save": "/proc/none/here", "maps": "a/map"}, "/proc/none"),
        ({"file": ""}, "name the log or bag with the parameter file"),
        ({"file": "absent.log", "save": "."}, "save needs to know which maps: -p maps:="),
        ({"file": "absent.log", "save": ".", "maps": "a/b/map,a_b/map"}, "two maps would have one"),
        ({"file": "absent.log", "wait_for": 5}, "wait_for: wanted a list of names, found 5"),
    ],
)
def test_what_cannot_be_played_ends_the_node_with_one_line(
    parameters: dict[str, Any], words: str, processes: Processes
):
    player = processes.node("player", **parameters)
    assert player.wait(30.0) == 1
    (line,) = said(player)
    assert line.startswith("slamfusion: error: ")
    assert words in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--params-file", "absent.yaml"), "Couldn't parse params file"),
        (("--bogus",), "ROS arguments: ['--bogus']"),
    ],
)
def test_ros_arguments_that_cannot_be_end_the_node_with_a_word(
    arguments: tuple[str, ...], words: str, processes: Processes
):
    player = processes.node("player", *arguments)
    assert player.wait(30.0) == 1
    line = said(player)[-1]  # rcl may have logged one of its own
    assert line.startswith("slamfusion: error: ")
    assert words in line
    assert "Traceback" not in player.text()


def test_a_log_without_a_usable_scan_ends_with_the_reason(
    processes: Processes, observer: Observer, tmp_path: Path
):
    observer.collect(LaserScan, "scan")
    log = tmp_path / "blind.log"
    log.write_text("FLASER 3 1 2 3 0 0 nan 0 0 0 1.0 host 0\n" * 2)
    player = processes.node("player", file=str(log), rate=100.0)
    assert player.wait(30.0) == 1
    assert "blind.log" in said(player)[-1]


def test_a_bag_is_played_with_its_transforms(
    processes: Processes, observer: Observer, tmp_path: Path
):
    bag = Bag().transform(100.0, "base_link", "front_laser", (0.3, 0.1, 0.2), topic="/tf_static")
    for index in range(10):
        stamp_s = 100.0 + 0.1 * index
        bag.transform(stamp_s, "odom", "base_link", (0.05 * index, 0.0, 0.0))
        bag.scan(stamp_s, (1.0, 2.0, 3.0 + index), topic="/front/scan", frame="front_laser")
    path = bag.write(tmp_path)
    heard = observer.collect(LaserScan, "scan")
    transforms = TransformInput(observer.node)
    player = processes.node("player", file=str(path), rate=4.0)
    assert player.wait(40.0) == 0, player.text()
    observer.listen(0.5)
    assert [message.ranges[2] for message in heard] == [3.0 + index for index in range(10)]
    last_s = messages.stamp_s(heard[-1])
    assert last_s == pytest.approx(100.9)
    found = transforms.lookup("odom", "laser", last_s)
    assert (found.x, found.y, found.yaw_rad) == pytest.approx((0.75, 0.1, 0.0))
