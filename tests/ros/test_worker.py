from __future__ import annotations

import threading

import pytest

from slamfusion.ros.worker import Worker


class Gate:
    """Work that waits until it is let go, and notes what it has seen."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.go = threading.Event()
        self.seen: list[object] = []
        self.errors: list[tuple[object, str]] = []

    def work(self, item: object) -> None:
        self.begun.set()
        assert self.go.wait(20.0)
        if item == "bad":
            message = "no good"
            raise ValueError(message)
        self.seen.append(item)

    def fail(self, item: object, error: Exception) -> None:
        self.errors.append((item, str(error)))


def held(gate: Gate, capacity: int) -> Worker[object]:
    """A worker that is busy with its first item."""
    worker: Worker[object] = Worker(gate.work, capacity, gate.fail)
    assert worker.put("first") == []
    assert gate.begun.wait(20.0)
    return worker


def test_the_oldest_waiting_item_is_dropped_and_counted():
    gate = Gate()
    worker = held(gate, 3)
    lost = [item for number in range(10) for item in worker.put(number)]
    assert lost == [0, 1, 2, 3, 4, 5, 6]
    assert (worker.dropped, worker.waiting) == (7, 3)
    gate.go.set()
    assert worker.wait_idle(20.0)
    assert gate.seen == ["first", 7, 8, 9]
    assert worker.done == 4
    assert worker.close()


def test_an_item_that_fails_is_reported_and_the_next_is_taken():
    gate = Gate()
    worker = held(gate, 5)
    worker.put("bad")
    worker.put("good")
    gate.go.set()
    assert worker.wait_idle(20.0)
    assert gate.errors == [("bad", "no good")]
    assert gate.seen == ["first", "good"]
    assert worker.failed == 1
    assert worker.is_alive
    assert worker.close()
    assert not worker.is_alive


def test_what_waits_can_be_taken_away():
    gate = Gate()
    worker = held(gate, 5)
    worker.put("second")
    worker.put("third")
    assert worker.clear() == ["second", "third"]
    assert worker.dropped == 0
    assert not worker.is_idle
    gate.go.set()
    assert worker.wait_idle(20.0)
    assert gate.seen == ["first"]
    assert worker.close()


def test_after_its_end_nothing_is_taken():
    gate = Gate()
    gate.go.set()
    worker: Worker[object] = Worker(gate.work, 2, gate.fail)
    assert worker.close()
    assert worker.put("late") == ["late"]
    assert gate.seen == []


def test_a_smaller_queue_drops_with_the_next_item():
    gate = Gate()
    worker = held(gate, 4)
    for number in range(4):
        worker.put(number)
    worker.resize(2)
    assert worker.put(4) == [0, 1, 2]
    gate.go.set()
    assert worker.wait_idle(20.0)
    assert gate.seen == ["first", 3, 4]
    assert worker.close()


def test_a_queue_without_room_is_refused():
    with pytest.raises(ValueError, match="at least one item"):
        Worker(print, 0, print)
