"""The inbox: the newest map of each input waits, everything is counted, and it is taken once."""

from __future__ import annotations

import math
import threading

import pytest

from slamfusion.fusion.live.inbox import Inbox
from tests.fusion.live.maps import three


def test_the_newest_map_waits_and_is_taken_once_under_its_input_s_name() -> None:
    inbox = Inbox()
    assert not inbox.has_new
    inbox.put("x", three()["a"], 1.0, is_saved=False)
    inbox.put("x", three()["b"], 3.0, is_saved=False)
    inbox.put("y", three()["c"], 2.0, is_saved=True)
    assert inbox.has_new
    fresh, came = inbox.take()
    assert list(fresh) == ["x", "y"]
    grid = fresh["x"].grid
    assert grid is not None
    assert grid.name == "x"
    assert grid.cells is three()["b"].cells
    assert came == {"x": 3.0}, "a saved map grows never stale"
    assert fresh["x"].maps == 2
    assert not inbox.has_new
    assert inbox.take()[0] == {}


def test_the_rate_is_that_of_the_intervals_and_smoothed() -> None:
    inbox = Inbox()
    for received_s in (10.0, 10.5):
        inbox.put("x", three()["a"], received_s, is_saved=False)
    assert inbox.counts()["x"].rate_hz == pytest.approx(2.0)
    inbox.reject("x", "no", 11.5)
    assert inbox.counts()["x"].rate_hz == pytest.approx(2.0 + 0.3 * (1.0 - 2.0))
    inbox.put("x", three()["a"], 11.5, is_saved=False)
    assert math.isfinite(inbox.counts()["x"].rate_hz)


def test_what_cannot_be_read_takes_the_place_of_a_map_that_waits() -> None:
    inbox = Inbox()
    inbox.put("x", three()["a"], 1.0, is_saved=False)
    inbox.reject("x", "no cells", 2.0)
    item = inbox.take()[0]["x"]
    assert (item.grid, item.refused, item.maps, item.rejected) == (None, "no cells", 2, 1)
    inbox.count_rejected("x")
    assert inbox.counts()["x"].rejected == 2
    inbox.put("x", three()["a"], 3.0, is_saved=False)
    assert inbox.take()[0]["x"].refused is None


def test_an_input_that_was_dropped_comes_back_by_its_next_map_or_when_it_is_recalled() -> None:
    inbox = Inbox()
    inbox.recall("x", three()["a"])
    assert inbox.counts() == {}
    inbox.put("x", three()["a"], 1.0, is_saved=False)
    inbox.recall("x", three()["b"])
    waiting = inbox.take()[0]["x"].grid
    assert waiting is not None
    assert waiting.cells is three()["a"].cells, "it was not dropped"
    inbox.drop("x", "lost")
    inbox.refill({"x": three()["a"]})
    item = inbox.take()[0]["x"]
    assert (item.grid, item.gone) == (None, "lost")
    inbox.recall("x", three()["b"])
    item = inbox.take()[0]["x"]
    assert (item.grid, item.gone) == (three()["b"], None)
    inbox.drop("x", "lost")
    inbox.put("x", three()["a"], 2.0, is_saved=False)
    assert inbox.take()[0]["x"].gone is None


def test_maps_that_were_taken_wait_again_but_where_a_newer_one_does() -> None:
    inbox = Inbox()
    for name in "xy":
        inbox.put(name, three()["a"], 1.0, is_saved=False)
    inbox.take()
    newer = three()["c"].with_name("y")
    inbox.put("y", newer, 2.0, is_saved=False)
    inbox.refill({"x": three()["b"], "y": three()["b"]})
    fresh, _ = inbox.take()
    assert fresh["x"].grid is three()["b"]
    assert fresh["y"].grid is newer


def test_no_message_of_many_threads_is_lost() -> None:
    inbox, taken = Inbox(), []

    def send(name: str) -> None:
        for number in range(200):
            inbox.put(name, three()["a"], float(number), is_saved=False)

    threads = [threading.Thread(target=send, args=(name,)) for name in "xyz"]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        taken += list(inbox.take()[0])
    for thread in threads:
        thread.join()
    taken += list(inbox.take()[0])
    assert set(taken) == {"x", "y", "z"}
    assert [item.maps for item in inbox.counts().values()] == [200] * 3
