"""The session of a producer: what is fed, what is left out, when a map is read, and new maps."""

from __future__ import annotations

import weakref
from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import LaserMounting, RunConfig
from slamfusion.errors import ScanError
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.slam.registry import make_producer
from slamfusion.slam.session import LeftOutError, ProducerSession, QueuedScan
from slamfusion.slam.tinyslam.slam import TinySlam
from tests.slam.drives import drive

pytestmark = pytest.mark.once


class Bench:
    """A session, its clock, and a drive whose scans are queued by their index."""

    def __init__(self, kind: str, *, wants_odometry: bool = True, scans: int = 24) -> None:
        self.now_s = 100.0
        self.opened: list[weakref.ref[ComputeDevice]] = []
        self.scans: list[LogScan] = drive(scans)[0]
        self.session = ProducerSession(
            kind, RunConfig(), self._open, wants_odometry=wants_odometry, clock=lambda: self.now_s
        )

    def _open(self) -> ComputeDevice:
        device = open_device()
        self.opened.append(weakref.ref(device))
        return device

    def queued(self, index: int, **changed: Any) -> QueuedScan:
        item = self.scans[index]
        queued = QueuedScan(
            item.scan.stamp_s,
            self.now_s - 0.5,
            self.session.generation,
            lambda: item.scan,
            lambda _: None if (pose := item.odometry) is None else np.array([astuple(pose)]),
        )
        return replace(queued, **changed)

    def feed(self, *indices: int) -> None:
        for index in indices:
            assert self.session.feed(self.queued(index)) is not None


@pytest.mark.parametrize(("kind", "is_drawn_aside"), [("tinyslam", False), ("graph", True)])
def test_the_map_is_that_of_the_producer_and_read_once(kind: str, is_drawn_aside: bool) -> None:
    bench = Bench(kind)
    session, alone = bench.session, make_producer(kind, RunConfig(), open_device())
    warm, *used = [device() for device in bench.opened]
    assert warm is None, "it keeps the memory of the compiler"
    assert len(used) == 1 + is_drawn_aside
    assert None not in used
    assert session.read_map(is_path_heard=True, is_paused=False) is None, "nothing was fed"
    for item in bench.scans:
        step = alone.feed(item.scan, item.odometry)
        answer = session.feed(bench.queued(bench.scans.index(item)))
        assert answer.pose == step.pose_map_base
        assert answer.odometry == item.odometry
    assert session.snapshot.unmapped == len(bench.scans)
    made = session.read_map(is_path_heard=True, is_paused=True)
    assert made.stamp_s == bench.scans[-1].scan.stamp_s
    assert made.trajectory is not None
    assert np.array_equal(session.draw(made).cells, alone.grid().cells)
    session.count_map()
    assert session.drawn.maps == 1
    assert session.drawn.shape == (alone.grid().width, alone.grid().height)
    assert (session.drawn.time_s is not None) is is_drawn_aside
    snapshot = session.snapshot
    assert (snapshot.fed, snapshot.unmapped, snapshot.is_settled) == (24, 0, True)
    assert snapshot.health.scans_used == alone.health.scans_used
    assert snapshot.memory_bytes > 0
    if is_drawn_aside:
        assert session.read_map(is_path_heard=True, is_paused=True) is None, "as before"


@pytest.mark.parametrize("mounting", ["as-given", "backward"])
def test_a_laser_that_contradicts_the_odometry_is_named(mounting: LaserMounting) -> None:
    bench = Bench("graph", scans=200)
    for item in bench.scans:
        scan = item.scan.remounted(mounting)
        bench.session.feed(bench.queued(bench.scans.index(item), read=lambda scan=scan: scan))
    assert bench.session.read_map(is_path_heard=False, is_paused=False) is not None
    found = bench.session.snapshot.contradictions
    assert len(found) == (mounting == "backward"), found
    assert all("or leave it out if you have set it" in sentence for sentence in found)


def test_a_path_that_nobody_heard_is_read_for_the_first_who_listens() -> None:
    bench = Bench("graph")
    bench.feed(*range(6))
    silent = bench.session.read_map(is_path_heard=False, is_paused=False)
    assert silent.trajectory is None
    assert bench.session.snapshot.is_path_due
    assert bench.session.read_map(is_path_heard=False, is_paused=False) is None
    heard = bench.session.read_map(is_path_heard=True, is_paused=False)
    assert len(heard.trajectory) == 6
    assert not bench.session.snapshot.is_path_due


def test_a_map_that_takes_long_is_due_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench("tinyslam")
    bench.feed(0, 1, 2)
    draw = TinySlam.grid

    def slow(producer: TinySlam) -> OccupancyGrid:
        bench.now_s += 0.5
        return draw(producer)

    monkeypatch.setattr(TinySlam, "grid", slow)
    bench.session.read_map(is_path_heard=False, is_paused=False)
    bench.now_s += 4.0
    assert not bench.session.is_map_due(1.0), "reading takes a tenth of the time at most"
    bench.now_s += 1.0
    assert bench.session.is_map_due(1.0)


def test_a_scan_sent_again_is_answered_again_and_an_older_one_is_not() -> None:
    bench = Bench("tinyslam")
    bench.feed(0, 1, 2)
    again = bench.session.feed(bench.queued(2))
    assert (again.pose, again.is_new) == (bench.session.snapshot.pose, False)
    assert bench.session.feed(bench.queued(1)) is None
    # Another one of the same stamp, as of a driver that does not set it.
    assert bench.session.feed(replace(bench.queued(1), stamp_s=bench.queued(2).stamp_s)) is None
    assert bench.session.snapshot.fed == 3
    assert bench.session.snapshot.left_out == {
        "sent again": 1,
        "stamp not later than the last one's": 2,
    }


def test_scans_before_the_first_odometry_are_left_out_and_later_ones_are_not() -> None:
    bench = Bench("tinyslam")
    session = bench.session
    assert session.is_before_odometry
    assert session.feed(bench.queued(0, odometry=lambda _: None)) is None
    assert session.snapshot.left_out == {"laser before odometry": 1}
    bench.feed(1)
    assert not session.is_before_odometry
    answer = session.feed(bench.queued(2, odometry=lambda _: None))
    assert answer.odometry is None
    assert session.snapshot.without_odometry == 2
    free = Bench("tinyslam", wants_odometry=False)
    assert not free.session.is_before_odometry
    assert free.session.feed(free.queued(0, odometry=lambda _: None)) is not None
    assert free.session.snapshot.without_odometry == 0


def test_what_cannot_be_read_or_fails_is_counted_and_the_next_scan_is_fed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench("tinyslam")
    session = bench.session
    bench.feed(0)

    def unread() -> LaserScan:
        reason = "no transform from the laser"
        raise LeftOutError(reason)

    assert session.feed(bench.queued(1, read=unread)) is None

    def fail(*_: object) -> None:
        raise ScanError("no room")

    with monkeypatch.context() as patch:
        patch.setattr(TinySlam, "feed", fail)
        assert session.feed(bench.queued(2)) is None
    assert session.snapshot.problem == "the SLAM failed: no room"
    assert session.snapshot.left_out == {"no transform from the laser": 1, "the SLAM failed": 1}
    bench.feed(3)
    assert session.snapshot.problem == ""
    assert session.snapshot.busy_since_s is None
    assert session.snapshot.fed == 2


def test_a_new_map_begins_with_its_first_scan_and_old_ones_are_not_fed() -> None:
    bench = Bench("tinyslam")
    session = bench.session
    bench.feed(4, 5)
    session.read_map(is_path_heard=True, is_paused=False)
    waiting = bench.queued(6)
    before = session.snapshot
    session.begin_new_map()
    assert session.feed(waiting) is None
    assert session.snapshot.fed_s == before.fed_s
    bench.feed(0)
    assert session.snapshot.fed_s == bench.scans[0].scan.stamp_s
    assert session.snapshot.fed == 3, "counts go on"
    made = session.read_map(is_path_heard=True, is_paused=False)
    assert made.generation == 1
    assert len(made.trajectory) == 1
