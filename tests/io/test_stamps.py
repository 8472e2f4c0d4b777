"""One stamp far from the others changes nothing; several in a row are a jump of time."""

from __future__ import annotations

from hypothesis import assume, given
from hypothesis import strategies as st

from slamfusion.io.stamps import AHEAD_S, CONFIRMING, Jump, StampGate

steps = st.sampled_from([0.02, 0.1, 0.5, 1.0])
backs = st.sampled_from([0.0, 0.2, 1.0, 30.0])


class Heard:
    """What came through a gate, in the way that a SLAM uses it."""

    def __init__(self, gate: StampGate[float]) -> None:
        self.gate = gate
        self.used_s: list[float] = []
        self.strays_s: list[float] = []
        self.jumps: list[Jump] = []

    def offer(self, stamp_s: float, **options: object) -> None:
        passed = self.gate.offer(stamp_s, stamp_s, **options)
        self.strays_s += passed.strays
        if passed.jump is not None:
            self.jumps.append(passed.jump)
            if passed.jump.is_back:
                self.used_s = []
        for item in passed.items:
            if not self.used_s or item > self.used_s[-1]:
                self.used_s.append(item)


@given(steps, backs, st.integers(1, 40), st.floats(-1e9, 1e9), st.booleans())
def test_no_single_stamp_is_a_jump(
    step_s: float, back_s: float, place: int, offset_s: float, has_arrivals: bool
):
    stamps_s = [1000.0 + step_s * index for index in range(60)]
    odd_s = stamps_s[place] + offset_s
    assume(odd_s not in stamps_s)
    heard = Heard(StampGate(back_s))
    for index, stamp_s in enumerate(stamps_s):
        options = {"arrived_s": step_s * index} if has_arrivals else {}
        if index == place:
            heard.offer(odd_s, **options)
        heard.offer(stamp_s, **options)
    assert heard.jumps == []
    # One that runs ahead by too little to be told keeps those before it out, and no others.
    lost_s = set(stamps_s) - set(heard.used_s)
    if odd_s in heard.used_s:
        assert all(stamp_s <= odd_s for stamp_s in lost_s)
        assert odd_s - stamps_s[place - 1] <= max(AHEAD_S, 2.0 * step_s) + 1.01 * step_s
    else:
        assert lost_s == set()
        # Left out here, or by whoever uses it: a little older than the last one.
        late = max(0.0, stamps_s[place - 1] - odd_s)
        assert heard.strays_s == [odd_s] or late <= max(back_s, 3.0 * step_s)


@given(steps, st.integers(20, 60), st.floats(10.0, 1e8))
def test_a_log_that_loops_is_a_jump_within_three_and_loses_none(
    step_s: float, count: int, first_s: float
):
    stamps_s = [first_s + step_s * index for index in range(count)]
    assume(stamps_s[-1] - stamps_s[CONFIRMING] > 1.0)
    heard = Heard(StampGate(1.0))
    for stamp_s in stamps_s + stamps_s[: CONFIRMING - 1]:
        heard.offer(stamp_s)
    assert heard.jumps == []
    assert heard.used_s == stamps_s
    heard.offer(stamps_s[CONFIRMING - 1])
    assert heard.jumps == [Jump(stamps_s[-1], stamps_s[0])]
    assert heard.used_s == stamps_s[:CONFIRMING]
    for stamp_s in stamps_s[CONFIRMING:]:
        heard.offer(stamp_s)
    assert heard.used_s == stamps_s
    assert heard.strays_s == []


def test_a_gap_is_passed_when_three_have_said_so_and_at_once_when_time_has_passed():
    heard = Heard(StampGate(1.0))
    for stamp_s in (0.0, 0.1, 0.2, 30.0, 30.1):
        heard.offer(stamp_s)
    assert heard.used_s == [0.0, 0.1, 0.2]
    heard.offer(30.2)
    assert heard.used_s == [0.0, 0.1, 0.2, 30.0, 30.1, 30.2]
    assert heard.jumps == [Jump(0.2, 30.0)]
    assert not heard.jumps[0].is_back

    waited = Heard(StampGate(1.0))
    waited.offer(0.0, arrived_s=500.0)
    waited.offer(30.0, arrived_s=530.0)
    assert waited.used_s == [0.0, 30.0]
    assert waited.jumps == []


def test_two_clocks_in_turn_are_no_jump():
    heard = Heard(StampGate(1.0))
    for index in range(50):
        heard.offer(100.0 + 0.1 * index)
        heard.offer(9.0 + 0.1 * index)
    assert heard.jumps == []
    assert heard.used_s == [100.0 + 0.1 * index for index in range(50)]
    assert len(heard.strays_s) == 49


def test_what_is_held_can_be_confirmed_from_outside_or_forgotten():
    heard = Heard(StampGate(1.0))
    heard.offer(100.0)
    heard.offer(5.0)
    assert heard.gate.held_for_s == 5.0
    passed = heard.gate.confirm()
    assert (passed.items, passed.jump) == ((5.0,), Jump(100.0, 5.0))
    assert heard.gate.newest_s == 5.0
    assert heard.gate.confirm().items == ()
    heard.offer(0.0)
    heard.gate.restart(3.0)
    assert (heard.gate.held, heard.gate.newest_s) == (0, 3.0)
    assert heard.gate.offer(3.5, 3.5).items == (3.5,)
