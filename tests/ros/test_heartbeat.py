"""What the events of a liveliness lease say: who fell silent, and whether the same one is back."""

from __future__ import annotations

import signal
import sys
from typing import Any, cast

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.ros import heartbeat
from slamfusion.ros.base import NodeBase
from slamfusion.ros.heartbeat import DOUBT_S, Heartbeat, Liveliness
from tests.cli.command import ROOT
from tests.ros.live import Observer, Process, Processes

# Writers that live, that do not, and how many more do not than with the last event.
LIVES, SILENT, RENEWED = (1, 0, 0), (0, 1, 1), (1, 0, -1)
GIVEN_UP, ANOTHER = (0, 0, -1), (1, 0, 0)
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
        # The lease ran out once more and was renewed, both in one event.
        ((LIVES, SILENT, RENEWED, LIVES), True),
        ((LIVES, SILENT, RENEWED, SILENT, RENEWED), True),
        # The old one was given up, another one has come.
        ((LIVES, SILENT, GIVEN_UP, ANOTHER), False),
        ((LIVES, SILENT, RENEWED, SILENT, GIVEN_UP, ANOTHER), False),
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


@pytest.mark.parametrize("is_known", [False, True])
def test_to_a_new_reader_only_a_writer_that_was_there_is_back(is_known: bool) -> None:
    found = after(LIVES, SILENT)
    assert found.take(*ANOTHER, 3.0, is_known=is_known)
    assert found.is_back == is_known


class Watch:
    """A heartbeat in the test's own node, whose reader is made anew soon."""

    def __init__(self, observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(heartbeat, "RENEW_S", 0.5)
        self.observer = observer
        self.node = observer.node
        self.readers = 0
        self.heartbeat = Heartbeat(cast("NodeBase", self), "a/pose", 1.0, lambda: None)
        create = observer.node.create_subscription

        def count(*args: Any, **options: Any) -> Any:
            self.readers += 1
            return create(*args, **options)

        monkeypatch.setattr(observer.node, "create_subscription", count)

    def wait(self, what: str, *, is_dead: bool, readers: int = 1) -> None:
        """Look again and again until the writers are so and this many readers were made."""

        def is_so() -> bool:
            self.heartbeat.look()
            is_alive = self.heartbeat._writers._alive > 0
            state = self.heartbeat.is_dead if is_dead else is_alive
            return state and self.readers >= readers

        self.observer.wait(is_so, what=what)


def start_writer(processes: Processes, monkeypatch: pytest.MonkeyPatch) -> Process:
    monkeypatch.chdir(ROOT)
    return processes.start("writer", [sys.executable, "-m", "tests.ros.pose_writer", "a/pose"])


def test_readers_made_anew_hear_of_the_one_that_goes_on(
    processes: Processes, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch(observer, monkeypatch)
    writer = start_writer(processes, monkeypatch)
    watch.wait("the writer", is_dead=False)
    writer.signal(signal.SIGSTOP)
    watch.wait("silence, to three readers", is_dead=True, readers=3)
    writer.signal(signal.SIGCONT)
    watch.wait("the writer again", is_dead=False)
    assert watch.heartbeat.is_back
    assert not watch.heartbeat.is_dead


def test_readers_made_anew_tell_another_writer_from_the_dead_one(
    processes: Processes, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch(observer, monkeypatch)
    writer = start_writer(processes, monkeypatch)
    watch.wait("the writer", is_dead=False)
    writer.kill()
    watch.wait("silence, to three readers", is_dead=True, readers=3)
    start_writer(processes, monkeypatch)
    watch.wait("another writer", is_dead=False)
    assert not watch.heartbeat.is_back
    assert not watch.heartbeat.is_dead


def test_only_the_first_and_the_last_that_lives_is_news() -> None:
    found = Liveliness()
    events = (LIVES, (2, 0, 0), SILENT, GIVEN_UP, ANOTHER)
    news = [found.take(*event, 0.1 * number) for number, event in enumerate(events)]
    assert news == [True, False, True, False, True]
