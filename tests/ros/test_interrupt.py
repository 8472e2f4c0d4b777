"""Waits of a node's thread: what ends them, and that nothing else does."""

from __future__ import annotations

import threading

from slamfusion.ros.interrupt import Interrupt

LONG_S = 30.0


def test_a_wait_ends_when_what_it_waits_for_comes_true() -> None:
    interrupt, found = Interrupt(), list[int]()

    def change() -> None:
        with interrupt.changing():
            found.append(1)

    thread = threading.Timer(0.01, change)
    thread.start()
    assert interrupt.wait_for(lambda: bool(found), LONG_S)
    assert not interrupt.is_set
    thread.join()


def test_the_end_of_the_node_ends_every_wait() -> None:
    interrupt = Interrupt()
    thread = threading.Timer(0.01, interrupt.set)
    thread.start()
    interrupt.pause(LONG_S)
    assert interrupt.is_set
    assert interrupt.wait_for(lambda: False, LONG_S)
    thread.join()


def test_a_wait_that_nothing_ends_says_so() -> None:
    interrupt = Interrupt()
    assert not interrupt.wait_for(lambda: False, 0.0)
    with interrupt.locked():
        assert not interrupt.is_set
