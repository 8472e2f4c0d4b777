"""What may wait is given up for a map that comes, and nothing is lost by it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.live import LiveInput, LiveUpdate
from tests.fusion.live.maps import Drive, interrupted, started, three, touched


class Doorbell:
    """Says that a map waits, from the given question on; counts the questions."""

    def __init__(self, rings_at: int | None) -> None:
        self.asked = 0
        self._rings_at = rings_at

    def __call__(self) -> bool:
        self.asked += 1
        return self._rings_at is not None and self.asked >= self._rings_at


def drifted(device: ComputeDevice) -> Drive:
    """Return a drive whose ``b`` has changed so much that it waits to be aligned again."""
    drive = started(device, track_cells=1)
    drive.step(touched(three()["b"], 1, 0.003))
    assert drive.accepted() == "abc"
    assert not drive.input("b").is_tracked
    return drive


def rest(drive: Drive, is_wanted: Callable[[], bool]) -> LiveUpdate | None:
    drive.now_s += 0.1
    return interrupted(drive, is_wanted)


def figures(drive: Drive) -> list[object]:
    shown: list[LiveInput] = list(drive.live.inputs(drive.now_s))
    return [(r.name, r.transform, r.score, r.overlap, r.accepted, r.reason) for r in shown]


def test_an_alignment_that_may_wait_is_given_up_and_begun_again(device: ComputeDevice) -> None:
    undisturbed = drifted(device)
    bell = Doorbell(None)
    assert rest(undisturbed, bell) is not None
    assert undisturbed.input("b").is_tracked
    assert bell.asked > 20

    drive = drifted(device)
    before = figures(drive)
    # What was looked at in its map is kept, so each later try has less to do.
    for rings_at in (1, 2, 5, 10, bell.asked // 4):
        ringing = Doorbell(rings_at)
        assert rest(drive, ringing) is None
        assert ringing.asked == rings_at
        assert figures(drive) == before
    # The map that it was given up for is fused at once; then there is time.
    drive.step(touched(three()["c"], 2, 0.001))
    assert not drive.input("b").is_tracked
    rest(drive, Doorbell(None))
    assert drive.input("b").is_tracked
    assert drive.input("b").transform == undisturbed.input("b").transform


def test_what_changed_too_much_to_wait_is_aligned_whatever_comes(device: ComputeDevice) -> None:
    drive = started(device, track_cells=1)
    bell = Doorbell(1)
    drive.live.put("b", touched(three()["b"], 1, 0.05), drive.now_s)
    assert rest(drive, bell) is not None
    assert drive.input("b").is_tracked
    assert bell.asked == 0
    assert np.isfinite(drive.input("b").score)
