"""What a run records: counts, times, memory, warnings, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import SlamFusionError
from slamfusion.io import open_log, write_carmen
from slamfusion.io.log import LogScan
from slamfusion.slam.common.runner import run_producer
from tests.support.producers import DeadReckoning, ListLog, ResumableReckoning, room_drive, unseeing
from tests.test_deskew import sweeps


def test_a_run_counts_what_it_did() -> None:
    seen: list[int] = []
    run = run_producer(DeadReckoning(), room_drive(20), progress=seen.append)
    assert seen == list(range(1, 21))
    assert (run.name, run.scans, run.scans_used) == ("dead-reckoning", 20, 20)
    assert len(run.trajectory) == len(run.feed_s) == 20
    np.testing.assert_allclose(run.odometry.poses, run.trajectory.poses)
    assert run.trajectory.path_length_m() == pytest.approx(19 * 0.05)
    assert run.peak_memory_mb == 0.02
    assert run.process_peak_memory_mb > 10.0  # an interpreter with NumPy
    assert run.complete
    assert run.warnings == ()
    assert run.log is None
    assert 0.0 < run.feed_s.sum() <= run.time_s


def test_no_usable_scan_is_one_line_with_the_reasons() -> None:
    log = ListLog(unseeing(room_drive(4)))
    log.skips.add("cut-off line", 17)
    with pytest.raises(SlamFusionError) as caught:
        run_producer(DeadReckoning(), log, log=log)
    message = str(caught.value)
    for part in (
        "drive.log",
        "none of 4 scans",
        "4 x nothing seen (scan 1, 2, 3, 4)",
        "1 x cut-off line (line 17)",
    ):
        assert part in message
    assert "\n" not in message


def test_scans_without_odometry_have_no_odometry_path() -> None:
    scans = [LogScan(item.scan, None, item.line) for item in room_drive(3)]
    run = run_producer(DeadReckoning(), scans)
    assert run.odometry is None
    assert run.odometry_path_length_m is None


def test_a_limit_stops_without_a_doubt() -> None:
    run = run_producer(DeadReckoning(), room_drive(9), limit=4)
    assert (run.scans, run.complete, run.warnings) == (4, False, ())
    assert len(run.odometry) == 4
    exact = run_producer(DeadReckoning(), room_drive(4), limit=4)
    assert exact.complete


def test_a_limit_counts_in_the_log_only_the_scans_that_were_fed(tmp_path: Path) -> None:
    write_carmen(tmp_path / "turning.log", sweeps(20))
    log = open_log(tmp_path / "turning.log")
    for limit, count in ((9, 7), (None, 18)):  # how long a sweep takes is known at the third
        run = run_producer(DeadReckoning(), log, log=log, limit=limit)
        assert f"{count} scans are deskewed" in " ".join(run.log.notes)


def test_a_resumed_producer_is_fed_only_what_is_new(tmp_path: Path) -> None:
    first = ResumableReckoning()
    run_producer(first, room_drive(20), limit=8)
    first.save_state(tmp_path / "state")
    run = run_producer(ResumableReckoning.load_state(tmp_path / "state"), room_drive(20))
    whole = run_producer(ResumableReckoning(), room_drive(20))
    assert (run.known_scans, len(run.feed_s), run.scans) == (8, 12, 20)
    np.testing.assert_array_equal(run.grid.cells, whole.grid.cells)
    np.testing.assert_array_equal(run.trajectory.poses, whole.trajectory.poses)
    # The raw odometry of what was passed over counts too: the path begins there.
    np.testing.assert_array_equal(run.odometry.poses, whole.odometry.poses)


def test_a_limit_counts_only_what_is_fed_in_this_run() -> None:
    device = ResumableReckoning()
    run_producer(device, room_drive(20), limit=3)
    run = run_producer(device, room_drive(20), limit=4)
    assert (run.known_scans, len(run.feed_s), run.scans) == (3, 4, 7)


def test_a_log_that_is_known_already_is_one_line() -> None:
    device = ResumableReckoning()
    run_producer(device, room_drive(6))
    log = ListLog(room_drive(5))
    with pytest.raises(SlamFusionError) as caught:
        run_producer(device, log, log=log)
    assert str(caught.value) == (
        "drive.log: dead-reckoning knows every one of the 5 scans: its state goes up to 0.500 s; "
        "give a log that goes on from there"
    )


def test_many_blind_scans_are_a_doubt() -> None:
    scans = room_drive(10)
    blind = unseeing(room_drive(14)[10:])
    run = run_producer(DeadReckoning(), scans + blind)
    (sentence,) = run.warnings
    assert "4 of 14 scans could not be used" in sentence
    assert "4 x nothing seen" in sentence


@pytest.mark.parametrize(
    ("low", "in_a_row", "is_warned"),
    [
        (range(0, 100, 20), 1, False),  # 5 %
        (range(0, 100, 16), 1, True),  # 7 %
        (range(30, 37), 7, False),
        (range(30, 38), 8, True),
    ],
)
def test_many_bad_matches_or_many_in_a_row_are_a_doubt(
    low: range, in_a_row: int, is_warned: bool
) -> None:
    # Long enough that what comes in a row is a small share.
    count = 100 if in_a_row == 1 else 200
    device = DeadReckoning(dict.fromkeys(low, 0.3))
    run = run_producer(device, room_drive(count))
    assert run.low_scores_in_a_row == in_a_row
    assert bool(run.warnings) == is_warned
    if is_warned:
        assert f"{len(low)} of {count} scans" in run.warnings[0]
