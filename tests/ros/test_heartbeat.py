"""What the events of a liveliness lease say: who fell silent, and whether the same one is back."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.ros.heartbeat import DOUBT_S, Liveliness

# Writers that live, how many more do than with the last event, and how many more do not.
LIVES, SILENT, RENEWED = (1, 1, 0), (0, -1, 1), (1, 1, -1)
GIVEN_UP, ANOTHER = (0, 0, -1), (1, 1, 0)
# The lease ran out once more and was renewed, both in one event.
AGAIN = (1, 0, 0)
# The same where a writer that never gave a sign of life was taken from the living.
FEWER, FEWER_LIVES, FEWER_SILENT, FEWER_RENEWED = (-1, -1, 0), (0, 1, 0), (-1, -1, 1), (0, 1, -1)
pytestmark = [pytest.mark.ros, pytest.mark.once]


def after(*events: tuple[int, int, int]) -> Liveliness:
    """Return what is known after events, of which one comes each tenth of a second."""
    found = Liveliness()
    for number, event in enumerate(events):
        found.take(*event, 0.1 * number)
    return found


def test_a_writer_that_falls_silent_is_dead_after_a_moment_of_doubt() -> None:
    found = after(LIVES, SILENT)
    assert not found.is_dead(0.1 + 0.9 * DOUBT_S)
    assert found.is_dead(0.1 + 1.1 * DOUBT_S)


def test_before_any_writer_nobody_is_dead() -> None:
    assert not Liveliness().is_dead(1e9)


@pytest.mark.parametrize(
    ("events", "is_back"),
    [
        ((LIVES,), False),
        ((LIVES, SILENT, RENEWED), True),
        ((LIVES, SILENT, RENEWED, AGAIN), True),
        ((LIVES, SILENT, RENEWED, SILENT, RENEWED), True),
        # The old one was given up, another one has come.
        ((LIVES, SILENT, GIVEN_UP, ANOTHER), False),
        ((LIVES, SILENT, RENEWED, SILENT, GIVEN_UP, ANOTHER), False),
        # Of one that was given up too early the count is too small from then on.
        ((FEWER, FEWER_LIVES, FEWER_SILENT, FEWER_RENEWED), True),
        ((LIVES, SILENT, FEWER, FEWER_LIVES), False),
    ],
)
def test_the_writer_that_had_fallen_silent_is_told_from_another_one(
    events: tuple[tuple[int, int, int], ...], is_back: bool
) -> None:
    found = after(*events)
    assert found.is_back == is_back
    assert not found.is_dead(1e9)


def test_who_was_forgiven_is_dead_only_when_it_falls_silent_anew() -> None:
    found = after(LIVES, SILENT)
    found.forgive()
    assert not found.is_dead(1e9)
    found.take(*RENEWED, 2.0)
    found.take(*SILENT, 3.0)
    assert found.is_dead(1e9)


def test_a_count_that_is_too_small_hides_neither_life_nor_silence() -> None:
    found = after(FEWER, FEWER_LIVES)
    assert not found.is_dead(1e9)
    assert found.take(*FEWER_SILENT, 3.0)
    assert found.is_dead(4.0)
    assert found.take(*FEWER_RENEWED, 5.0)
    assert not found.is_dead(1e9)


def test_a_living_writer_is_not_dead_because_another_one_is_taken_off() -> None:
    found = after(LIVES, SILENT, RENEWED)
    found.take(0, -1, 0, 3.0)
    assert not found.is_dead(1e9)
    found.take(*FEWER_SILENT, 4.0)
    assert found.is_dead(1e9)


def test_only_the_first_and_the_last_that_lives_is_news() -> None:
    found = Liveliness()
    events = (LIVES, (2, 1, 0), SILENT, GIVEN_UP, ANOTHER)
    news = [found.take(*event, 0.1 * number) for number, event in enumerate(events)]
    assert news == [True, False, True, False, True]
