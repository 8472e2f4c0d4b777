from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

import rclpy
import rclpy.logging
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from slamfusion.errors import ConfigError
from slamfusion.ros import qos
from slamfusion.ros.base import (
    SESSION_VARIABLE,
    Diagnostics,
    Level,
    NodeBase,
    Status,
    Worker,
    run_node,
)
from slamfusion.ros.messages import to_stamp
from tests.ros.live import Observer, values
from tests.support.fresh import run_python

pytestmark = pytest.mark.ros


def test_troubles_are_said_once_and_the_worst_comes_first(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO)
    diagnostics = Diagnostics(logging.getLogger("drawn"))
    assert diagnostics.worst("fine") == (Level.OK, "fine")
    for _ in range(3):
        diagnostics.say("a", "a is low")
    for text in ("b is gone", "b is gone since 2 s"):
        diagnostics.say("b", text, Level.ERROR)
    assert diagnostics.worst() == (Level.ERROR, "b is gone since 2 s; a is low")
    diagnostics.clear("b")
    diagnostics.clear("b")
    diagnostics.say("c", "c is late", after_s=600.0)
    assert diagnostics.worst() == (Level.WARN, "a is low")
    assert [record.message for record in caplog.records] == [
        "a is low",
        "b is gone",
        "over: b is gone",
    ]


def test_messages_load_their_types_without_the_generator():
    script = (
        "from slamfusion.cli.node import import_rclpy; import_rclpy(); import sys\n"
        "from rosidl_generator_py import import_type_support\n"
        "import_type_support('std_msgs'); print(*sys.modules)"
    )
    done = run_python(script)
    assert done.returncode == 0, done.stderr
    assert not set(done.stdout.split()) & {"em", "lark"}


def test_a_log_of_ros_takes_troubles_of_every_level():
    # rclpy ties a place in the code to one level, and raises at the second.
    diagnostics = Diagnostics(rclpy.logging.get_logger("drawn"))
    for number, level in enumerate((Level.WARN, Level.ERROR, Level.STALE, Level.ERROR)):
        diagnostics.say(f"trouble {number}", f"it is {level.name}", level)
    assert diagnostics.worst()[0] == Level.STALE


class Drawn(NodeBase):
    """A node that stumbles over a word."""

    def __init__(self, context: Context) -> None:
        super().__init__("drawn", context=context)
        self.heard: list[str] = []
        self.jumps_s: list[float] = []
        self.subscribe(String, "words", self._hear, qos.STREAM)

    def _hear(self, message: Any) -> None:
        if message.data == "bad":
            text = "no good"
            raise ValueError(text)
        self.heard.append(message.data)

    def on_time_jump(self, delta_s: float) -> None:
        self.jumps_s.append(delta_s)

    def statuses(self) -> list[Status]:
        return [Status("ear", *self.diagnostics.worst(), {"words": len(self.heard), "share": 0.5})]


class Spun:
    """A node that lives in the test's process and is spun by it."""

    def __init__(self, domain: int, *arguments: str) -> None:
        self.context = Context()
        rclpy.init(args=list(arguments), context=self.context, domain_id=domain)
        self.base = Drawn(self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.base.node)

    def close(self) -> None:
        self.executor.shutdown()
        self.base.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.02)


@pytest.fixture
def spun(domain: int) -> Iterator[Spun]:
    node = Spun(domain)
    yield node
    node.close()


def wait(observer: Observer, spun: Spun, is_done: Any, what: str) -> Any:
    def found() -> Any:
        spun.spin()
        return is_done()

    return observer.wait(found, what=what)


def test_a_callback_that_raises_is_named_and_the_node_goes_on(spun: Spun, observer: Observer):
    words = observer.publisher(String, "words")
    statuses = observer.statuses()
    wait(observer, spun, words.get_subscription_count, "the listener")
    for word in ("one", "bad", "two"):
        words.publish(String(data=word))
    wait(observer, spun, lambda: spun.base.heard == ["one", "two"], "the words")
    status = wait(
        observer,
        spun,
        lambda: next((s for s in statuses.values() if "no good" in s.message), None),
        "the diagnostics",
    )
    assert status.name == "drawn: ear"
    assert status.message == "words: ValueError: no good"
    assert status.level == bytes([Level.ERROR])
    assert values(status) == {"words": "2", "share": "0.5"}


def test_simulated_time_that_is_missing_or_jumps_is_told(domain: int, observer: Observer):
    spun = Spun(domain, "--ros-args", "-p", "use_sim_time:=true")
    missing = "use_sim_time is on and no time comes on '/clock'"
    wait(observer, spun, lambda: missing in spun.base.diagnostics.worst()[1], "the missing time")
    clock = observer.publisher(Clock, "/clock")
    wait(observer, spun, clock.get_subscription_count, "the listener")
    base = spun.base
    # The first time, small steps, far forward, back.
    for time_s in (500.0, 500.1, 500.2, 600.2, 600.3, 5.0):

        def is_there(time_s: float = time_s) -> bool:
            clock.publish(Clock(clock=to_stamp(time_s)))
            return abs(base.clock_s() - time_s) < 1e-6

        wait(observer, spun, is_there, f"the time {time_s}")
    assert base.jumps_s == pytest.approx([100.0, -595.3])
    base.publish_diagnostics()
    assert base.diagnostics.worst() == (Level.WARN, "time jumped back by 595.300 s to 5.000 s")
    spun.close()


def test_a_writer_that_offers_too_little_is_named(spun: Spun, observer: Observer):
    writer = observer.publisher(String, "words", qos.SENSOR)
    _, words = wait(
        observer,
        spun,
        lambda: spun.base.diagnostics.is_on("qos words") and spun.base.diagnostics.worst(),
        "the mismatch",
    )
    assert words == (
        "a writer on '/words' offers less than is asked for (Best effort publisher and reliable "
        "subscription); nothing is heard from it"
    )
    observer.node.destroy_publisher(writer)
    wait(observer, spun, lambda: not spun.base.diagnostics.is_on("qos words"), "its end")


def test_who_publishes_a_silent_topic_is_named_with_its_type(spun: Spun, observer: Observer):
    node = spun.base
    assert node.senders("words", String) == "no node publishes it"
    observer.publisher(Clock, "words", qos.STREAM)
    wanted = "it carries rosgraph_msgs/msg/Clock; wanted std_msgs/msg/String"
    observer.wait(lambda: node.senders("words", String) == wanted, what="the type")
    observer.publisher(String, "words2", qos.STREAM)
    wanted = "1 node could publish it"
    observer.wait(lambda: node.senders("words2", String) == wanted, what="the publisher")
    with pytest.raises(ConfigError, match="wanted rosgraph_msgs/msg/Clock on '/words', found"):
        node.subscribe(Clock, "words", print, qos.STREAM)


def test_a_node_of_the_same_name_is_named_until_it_ends(spun: Spun, observer: Observer):
    statuses = observer.statuses()
    # The same name in another namespace is another node.
    elsewhere = rclpy.create_node("drawn", namespace="/robot2", context=observer.node.context)
    wait(observer, spun, lambda: "drawn: ear" in statuses, "the diagnostics")
    assert statuses["drawn: ear"].message == "ok"
    twin = rclpy.create_node("drawn", context=observer.node.context)
    words = "2 nodes are called '/drawn': their topics, parameters and diagnostics cannot be told"
    wait(observer, spun, lambda: words in statuses["drawn: ear"].message, "the word of the twin")
    assert "rename it with -r __node:=NAME" in statuses["drawn: ear"].message
    assert statuses["drawn: ear"].level == bytes([Level.WARN])
    twin.destroy_node()
    wait(observer, spun, lambda: statuses["drawn: ear"].message == "ok", "the end of the word")
    elsewhere.destroy_node()


class Misnamed(NodeBase):
    """A node whose parameter is a topic."""

    def __init__(self) -> None:
        super().__init__("misnamed")
        topic = self.node.declare_parameter("topic", "fine").value
        self.subscribe(String, topic, print, qos.STREAM)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("-p", "topic:=a//b/map"),
            "'/a//b/map' is no topic name: topic name must not contain repeated '/'; correct it",
        ),
        (("-p", "topic:='a b'"), "'a b' is no topic name: topic name must not contain characters"),
        (("-p", "topic:='0bad'"), "'0bad' is no topic name: "),
        (
            ("-p", "topic:=[file:lab.yaml]"),
            "ROS arguments: Couldn't parse parameter override rule: '-p topic:=[file:lab.yaml]'",
        ),
        (
            ("-r", "fine:=0bad"),
            "ROS arguments: Couldn't parse remap rule: '-r fine:=0bad'; wanted FROM:=TO with two ",
        ),
    ],
)
@pytest.mark.usefixtures("domain")
def test_a_bad_name_of_a_topic_is_one_line(words: tuple[str, ...], said: str):
    with pytest.raises(ConfigError) as raised:
        run_node(Misnamed, ["--ros-args", *words])
    assert str(raised.value).startswith(said)
    assert ("put a text with a colon in quotes" in str(raised.value)) == ("file:" in words[1])
    assert "\n" not in str(raised.value)


STUCK = """
import ctypes
from slamfusion.ros import base
class Stuck(base.NodeBase):
    def __init__(self):
        super().__init__("stuck")
        self.is_stopped = True
        # As a lock that Fast DDS never gets, with Python's own lock held.
        self.node.destroy_node = lambda: ctypes.PyDLL(None).sleep(60)
base.END_S = 0.5
base.run_node(Stuck)
"""
BUSY = """
import atexit, ctypes
from slamfusion.ros import base
class Busy(base.NodeBase):
    def __init__(self):
        super().__init__("busy")
        self.is_stopped = True
    def close(self):
        worker = base.Worker(ctypes.CDLL(None).sleep, 1, print)
        worker.put(60)
        while worker.waiting:
            pass
        worker.close(0.1)
        print("closed")
atexit.register(print, "finalized")
base.run_node(Busy)
"""


@pytest.mark.usefixtures("domain")
def test_a_node_that_the_middleware_does_not_let_go_ends_all_the_same() -> None:
    done = run_python(STUCK)
    assert done.returncode == 1
    assert "in run_node" in done.stderr


@pytest.mark.usefixtures("domain")
def test_a_node_ends_while_its_worker_is_in_native_code() -> None:
    done = run_python(BUSY)
    assert (done.returncode, done.stdout.split()) == (0, ["closed"])


class Log:
    """Keeps warnings, as a logger of rclpy takes them."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def warning(self, text: str) -> None:
        self.said.append(text)


def test_of_the_nodes_of_a_session_one_says_what_holds_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = Log(), Log()
    first, second = (Diagnostics(log) for log in logs)
    monkeypatch.setenv(SESSION_VARIABLE, str(tmp_path))
    for told in (first, second):
        told.say("device", "no GPU", is_of_all=True)
        told.say("own", "no scans")
    assert [log.said for log in logs] == [["no GPU", "no scans"], ["no scans"]]
    # Each goes on to have it in its diagnostics.
    assert second.worst() == (Level.WARN, "no GPU; no scans")


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
            raise ValueError("no good")
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
    assert worker.waiting == 3
    gate.go.set()
    assert worker.is_idle(20.0)
    assert gate.seen == ["first", 7, 8, 9]
    assert worker.close()
    assert worker.put("late") == ["late"]


def test_an_item_that_fails_is_reported_and_the_next_is_taken():
    gate = Gate()
    worker = held(gate, 5)
    worker.put("bad")
    worker.put("good")
    gate.go.set()
    assert worker.is_idle(20.0)
    assert gate.errors == [("bad", "no good")]
    assert gate.seen == ["first", "good"]
    assert worker.close()
