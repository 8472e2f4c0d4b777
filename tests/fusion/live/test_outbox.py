"""The outbox: no faster than asked, of several maps only the last, its agreement once."""

from __future__ import annotations

import pytest

from slamfusion.fusion.live.outbox import GATHER_S, Fused, Outbox, Sent
from tests.fusion.live.maps import three


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def fused(stamp_s: float, arrived_s: float | None = None) -> Fused:
    return Fused(three()["a"], three()["b"], stamp_s, arrived_s)


def test_of_several_within_a_period_the_last_goes_and_waits_for_its_turn() -> None:
    clock = Clock()
    box = Outbox(2.0, clock)
    assert box.take() is None
    box.offer(fused(1.0))
    first = box.take()
    assert first is not None
    assert first.stamp_s == 1.0
    for stamp_s in (2.0, 3.0):
        box.offer(fused(stamp_s))
    clock.now_s += 0.499
    assert not box.is_due(lambda: False)
    assert box.take() is None
    clock.now_s += 0.002
    assert box.is_due(lambda: False)
    last = box.take()
    assert last is not None
    assert last.stamp_s == 3.0
    assert box.waiting is None
    box.rate_hz = 100.0
    box.offer(fused(4.0))
    clock.now_s += 0.011
    assert box.take() is not None


def test_the_agreement_waits_for_somebody_who_listens_and_goes_once() -> None:
    box = Outbox(1.0, Clock())
    asked = 0

    def is_heard() -> bool:
        nonlocal asked
        asked += 1
        return True

    assert not box.is_due(is_heard)
    assert asked == 0, "nobody is asked for nothing"
    box.offer(fused(1.0))
    box.take()
    assert box.has_agreement
    assert not box.is_due(lambda: False)
    assert box.is_due(is_heard)
    agreement = box.take_agreement()
    assert agreement is not None
    assert agreement.stamp_s == 1.0
    assert box.take_agreement() is None


def test_latency_counts_from_the_first_map_that_was_not_shown() -> None:
    clock = Clock()
    box = Outbox(1.0, clock)
    assert box.sent == Sent(0, 0.0, 0.0)
    for arrived_s in (99.0, 99.9):
        box.offer(fused(1.0, arrived_s))
    taken = box.take()
    assert taken is not None
    box.count(taken)
    assert box.sent.maps == 1
    assert box.sent.median_ms == pytest.approx(1000.0)
    clock.now_s += 2.0
    box.offer(fused(2.0))
    taken = box.take()
    assert taken is not None
    box.count(taken)
    assert box.sent.maps == 2
    assert box.sent.high_ms == pytest.approx(1000.0), "a saved map came at no time"


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_map_waits_a_moment_for_those_that_came_meanwhile(share: float) -> None:
    clock = Clock()
    box = Outbox(1.0, clock)
    assert not box.may_gather(lambda: True)
    box.offer(fused(1.0, clock.now_s))
    clock.now_s += share * GATHER_S
    assert box.may_gather(lambda: True) is (share < 1.0)
    assert not box.may_gather(lambda: False)
