"""What comes: the newest map of each input counts, and an input that is silent is stale."""

from __future__ import annotations

import threading

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, NormalizeConfig, RunConfig
from slamfusion.fusion.live import LiveFusion, State
from slamfusion.fusion.live.fusion import Mailbox
from slamfusion.io import files
from tests.fusion.live.maps import Drive, live_fusion, noise, three, touched


def test_the_newest_map_waits_and_is_taken_once() -> None:
    box = Mailbox()
    assert not box.has_new
    assert not box.has_come("x")
    box.put("x", three()["a"], 1.0)
    box.put("x", three()["b"], 3.0)
    box.put("y", lambda: three()["c"], 2.0, is_saved=True)
    assert box.has_new
    assert box.has_come("x")
    removed, fresh = box.take()
    assert (removed, list(fresh)) == ([], ["x", "y"])
    assert fresh["x"].read() is three()["b"]
    assert fresh["y"].read() is three()["c"], "read when its turn has come"
    assert (fresh["x"].maps, fresh["x"].waits_since_s) == (2, 1.0)
    assert not box.has_new
    assert box.take()[1] == {}


def test_no_message_of_many_threads_is_lost() -> None:
    box, taken = Mailbox(), []

    def send(name: str) -> None:
        for number in range(200):
            box.put(name, three()["a"], float(number))

    threads = [threading.Thread(target=send, args=(name,)) for name in "xyz"]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        taken += list(box.take()[1])
    for thread in threads:
        thread.join()
    taken += list(box.take()[1])
    assert set(taken) == {"x", "y", "z"}
    assert [item.maps for item in box.counts().values()] == [200] * 3


def test_an_input_is_stale_only_against_another_and_a_saved_one_never(
    device: ComputeDevice,
) -> None:
    drive = Drive(live_fusion(device, stale_after_s=5.0))
    for name in "abc":
        drive.live.put(name, three()[name], drive.now_s, is_saved=name == "c")
    drive.step()
    drive.now_s += 100.0
    drive.maybe()
    assert drive.accepted() == "abc"
    drive.step(touched(three()["a"], 1))
    assert drive.accepted() == "ac"
    reason = drive.input("b").reason
    assert reason.startswith("no map for more than 5 s since its only one")
    # A map server sends one map, and no more.
    assert "name a map that never changes as file:PATH" in reason
    drive.step(three()["b"])
    assert drive.accepted() == "abc"
    drive.now_s += 100.0
    drive.step(three()["a"])
    drive.live.reset()
    drive.step()
    assert drive.input("b").reason == "no map for more than 5 s"
    assert drive.input("b").state is State.LOST
    drive.step(three()["b"])
    assert drive.accepted() == "abc"
    drive.now_s += 100.0
    drive.step(noise().with_name("d"))
    assert drive.accepted() == "abc", "what cannot be used is no sign that others fell silent"


def test_before_the_first_fusion_memory_must_hold_the_maps_at_its_resolution(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = FusionConfig(normalize=NormalizeConfig(resolution=0.001))
    drive = Drive(LiveFusion(RunConfig(fusion=config), device))
    monkeypatch.setattr(files, "available_memory", lambda: 1000)
    update = drive.step(three()["a"], three()["b"])
    assert update.problem == "waits for 2 inputs that agree, has 0"
    assert "a: " in drive.input("a").reason
