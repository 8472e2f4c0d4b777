"""Inputs that come and go while the fusion node runs: by hand, and as they are found."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan

from slamfusion.cli.program import run_program
from slamfusion.compute.layout import MOST_INPUTS
from slamfusion.config import FusionNodeConfig
from slamfusion.errors import ConfigError
from slamfusion.io.map_server import load_map, save_map
from slamfusion.ros import qos
from slamfusion.ros.base import NodeBase
from slamfusion.ros.fusion_inputs import FusionInputs, entry_for, fits, input_names, topic_of
from slamfusion.ros.live_client import LiveClient, LiveNodeError
from tests.fusion.live.maps import three, touched
from tests.ros.fused import Makers, fused_without_ros, share_equal
from tests.ros.live import Observer, Processes, values
from tests.support.documents import check_document

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"


def names(observer: Observer) -> list[str]:
    """Return the inputs that the node tells of next, in order."""
    statuses = observer.statuses()
    statuses.clear()
    observer.wait(lambda: FUSION in statuses, what="diagnostics")
    start = "fusion: input "
    return [name.removeprefix(start) for name in statuses if name.startswith(start)]


def tell_a_clock_that_is_off(makers: Makers) -> None:
    """One whose clock is off is named, and votes on."""
    for number in range(5):
        for name, ahead_s in (("a", 0.0), ("b", 30.0), ("c", 0.0)):
            makers.send(touched(three()[name], number), stamp_s=time.time() + ahead_s)
        makers.observer.listen(0.3)
    words = "all 4 inputs vote", "the clock of 'b' is 30.0 s ahead"
    makers.observer.wait_status(FUSION, *words)


def refuse_what_cannot_be() -> None:
    """Each is refused in one line, and the inputs stay as they are."""
    with LiveClient("fusion", 30.0) as client:
        for answer, said in (
            (client.add("a"), "inputs names one map twice"),
            (client.add("a/map"), "inputs names one map twice"),
            (client.add("again", "/a/map"), "inputs names one map twice"),
            (client.add("a", "d/map"), "inputs calls two maps 'a'"),
            (client.add("bad", "no topic"), "is no topic name"),
            (client.add("gone", "file:/nowhere/lab.yaml"), "/nowhere/lab.yaml"),
            (client.set("inputs", "[]"), "one at least must stay"),
            (client.set("inputs", "5"), "wanted a list of names, found 5"),
        ):
            assert not answer["success"]
            assert said in answer["message"]
            assert "\n" not in answer["message"]
        with pytest.raises(LiveNodeError, match="no input 'z'; the inputs are a, b, yard, lab"):
            client.remove("z")


@pytest.mark.once
def test_inputs_come_and_go_while_the_node_runs(
    processes: Processes, observer: Observer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def live(*words: str) -> str:
        assert run_program(["live", *words, "--json"]) == 0
        document = json.loads(capfd.readouterr().out)
        check_document(document, f"live {words[0]}")
        return str(document["message"])

    makers = Makers(observer, "ab")
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    # One is named, the others are found: not what is only read, nor what does not fit.
    observer.collect(OccupancyGrid, "read/map", qos.MAP)
    observer.publisher(OccupancyGrid, "far/away/map", qos.MAP)
    observer.publisher(OccupancyGrid, "robot9/fused/map", qos.MAP)
    node = processes.node(
        "fusion",
        inputs=["a/map"],
        discover="*/map, /*/fused/map",
        discovery_rate_hz=10.0,
        live__search_pause_s=0.0,
        live__stale_after_s=1000.0,
        lost_after_s=1.0,
    )
    makers.send_all()
    observer.wait_status(FUSION, "all 2 inputs vote")
    makers.start("c")
    makers.send(three()["c"])
    observer.wait_status(FUSION, "all 3 inputs vote")
    assert names(observer) == ["a", "b", "c"]
    assert "b is an input now (b/map)" in node.text()

    # One that is removed takes its vote with it, and is not found again.
    assert live("remove", "c") == "c is no input any more"
    observer.wait_status(FUSION, "all 2 inputs vote", "c is removed from the inputs (c/map)")
    wanted = fused_without_ros({name: three()[name] for name in "ab"})
    observer.wait(lambda: maps and share_equal(maps[-1], wanted) > 0.9, what="the map of two")
    count = len(maps)
    makers.send(touched(three()["c"], 1))
    makers.send(touched(three()["a"], 1))
    observer.wait(lambda: len(maps) > count, what="a map without c")
    assert names(observer) == ["a", "b"]
    assert node.text().count("c is removed") == 1

    # Under another name, its last map is heard at once, as a new input's; so is a saved map.
    assert live("add", "yard", "--topic", "c/map") == "yard is an input now (yard=c/map)"
    observer.wait_status(FUSION, "all 3 inputs vote")
    yaml, _ = save_map(three()["b"], tmp_path / "lab")
    live("add", "lab", "--topic", f"file:{yaml}")
    observer.wait_status(FUSION, "all 4 inputs vote")
    assert names(observer) == ["a", "b", "yard", "lab"]
    assert values(observer.statuses()["fusion: input yard"])["entry"] == "yard=c/map"

    refuse_what_cannot_be()
    assert names(observer) == ["a", "b", "yard", "lab"]
    tell_a_clock_that_is_off(makers)

    # One whose publisher has gone is not forgotten, but dead as others are.
    makers.stop("b")
    observer.wait_status("fusion: input b", "lost: no node publishes '/b/map'")
    observer.wait_status(FUSION, "3 of 4 inputs vote; not: b")
    assert node.interrupt() == 0
    assert "Traceback" not in node.text()


def test_words_of_a_pattern_are_those_between_slashes() -> None:
    assert fits("/robot1/map", "/*/map")
    assert not fits("/robot1/graph/map", "/*/map")
    assert not fits("/map", "/*/map")
    assert fits("/robot1/graph/map", "/robot?/*/map")
    assert fits("/robot1/graph/map", "/**/map")
    assert fits("/map", "/**/map")
    assert not fits("/robot1/map_updates", "/**/map")
    assert not fits("/Robot1/map", "/robot1/map")


def test_an_input_keeps_its_name_whoever_comes() -> None:
    first = input_names(["a/map", "file:lab.yaml", "yard=c/map"])
    assert first == {"a": "a/map", "lab": "file:lab.yaml", "yard": "yard=c/map"}
    later = input_names(["file:lab.yaml", "lab/map", "yard=c/map", "x/yard/map"], first)
    assert later == {
        "lab": "file:lab.yaml",
        "lab/map": "lab/map",
        "yard": "yard=c/map",
        "x/yard": "x/yard/map",
    }
    assert input_names(["a/map", "file:a.yaml"]) == {"a/map": "a/map", "file:a.yaml": "file:a.yaml"}
    with pytest.raises(ConfigError, match="calls two maps 'a'"):
        input_names(["a/map", "a=b/map"])


@pytest.mark.parametrize(
    ("given", "entry", "topic"),
    [
        (("robot3",), "robot3/map", "robot3/map"),
        (("robot3/graph",), "robot3/graph/map", "robot3/graph/map"),
        (("robot3", "/robot3/map"), "/robot3/map", "/robot3/map"),
        (("yard", "robot3/map"), "yard=robot3/map", "robot3/map"),
        (("lab", "file:x/lab.yaml"), "file:x/lab.yaml", None),
        (("lab", "file:a=b.yaml"), "lab=file:a=b.yaml", None),
    ],
)
def test_an_entry_has_a_name_and_a_topic(
    given: tuple[Any, ...], entry: str, topic: str | None
) -> None:
    assert entry_for(*given) == entry
    assert topic_of(entry) == topic
    assert [*input_names([entry])] == [given[0]]


def test_the_name_of_a_topic_is_one_of_an_input() -> None:
    assert entry_for("robot3/map") == entry_for("robot3")


def test_what_is_no_name_is_refused() -> None:
    for name in ("", "/", "/map", "a=b", "a,b", "file:lab"):
        with pytest.raises(ConfigError, match=f"'{name}' is no name of an input"):
            entry_for(name)


class Listener:
    """Stands for the source of a topic's maps; it hears nothing."""

    def __init__(self, name: str, topic: str) -> None:
        self.name, self.topic = name, topic
        self.is_closed = False

    def close(self) -> None:
        self.is_closed = True


def fusion_inputs(
    observer: Observer, *entries: str, removed: list[str] | None = None
) -> tuple[NodeBase, FusionInputs]:
    """Return the inputs of a node in this process, which listens to nothing."""
    gone = [] if removed is None else removed
    words = ["--ros-args", "-p", f"inputs:=[{','.join(entries)}]"] if entries else []
    base = NodeBase("fusing", context=observer.node.context, arguments=words)
    inputs = FusionInputs(
        base,
        ("fused/map",),
        is_open=not entries,
        load=load_map,
        listen=Listener,
        on_change=lambda names, _: gone.extend(names),
    )
    inputs.begin()
    return base, inputs


def test_what_finds_no_room_is_named_and_the_others_are_fused(observer: Observer) -> None:
    base, inputs = fusion_inputs(observer)
    for number in range(MOST_INPUTS + 2):
        observer.publisher(OccupancyGrid, f"robot{number:02}/map", qos.MAP)
    settings = FusionNodeConfig(discover="robot*/map", discovery_rate_hz=10.0)
    until_s = time.monotonic() + 20.0
    while "not fused" not in base.diagnostics.worst()[1] or len(inputs.entries) < MOST_INPUTS:
        assert time.monotonic() < until_s, inputs.entries
        inputs.discover(settings)
        time.sleep(0.02)
    assert len(inputs.sources) == MOST_INPUTS
    assert "at most 32 can be: remove others" in base.diagnostics.worst()[1]
    base.node.destroy_node()


def test_if_no_map_fits_the_pattern_those_that_are_published_are_named(observer: Observer) -> None:
    base, inputs = fusion_inputs(observer)
    observer.publisher(OccupancyGrid, "robot1/graph/map", qos.MAP)
    wanted = "no map fits discover, */map; published: /robot1/graph/map"
    for pattern, said in (("*/map", wanted), ("*/graph/map", "ok")):
        settings = FusionNodeConfig(discover=pattern, discovery_rate_hz=10.0)

        def is_said(settings: FusionNodeConfig = settings, said: str = said) -> bool:
            inputs.discover(settings)
            return base.diagnostics.worst()[1] == said

        observer.wait(is_said, 20.0, said)
    assert [*inputs.entries.values()] == ["robot1/graph/map"]
    base.node.destroy_node()


def test_a_topic_that_carries_no_maps_is_refused(observer: Observer) -> None:
    base, inputs = fusion_inputs(observer, "a/map")
    base.subscribe(LaserScan, "scan", print, qos.SENSOR)
    for entry, said in (
        ("/scan", "wanted nav_msgs/msg/OccupancyGrid on '/scan', found that this node has it as "),
        ("fused/map", "inputs: '/fused/map' is the map that this node makes"),
    ):
        (answer,) = base.node.set_parameters([Parameter("inputs", value=["a/map", entry])])
        assert not answer.successful
        assert said in answer.reason
    assert [*inputs.sources] == ["a"]
    base.node.destroy_node()


def test_one_that_is_put_in_the_place_of_another_comes_after_it(observer: Observer) -> None:
    removed: list[str] = []
    base, inputs = fusion_inputs(observer, "a=x/map", "b/map", removed=removed)
    before = inputs.sources["a"]
    (answer,) = base.node.set_parameters([Parameter("inputs", value=["a=y/map", "b/map"])])
    assert answer.successful
    assert inputs.sources["a"].topic == "y/map"
    assert before.is_closed
    assert removed == ["a"]
    # A text with commas is as good as a list.
    (answer,) = base.node.set_parameters([Parameter("inputs", value="b/map, c/map")])
    assert answer.successful
    assert [*inputs.sources] == ["b", "c"]
    base.node.destroy_node()
