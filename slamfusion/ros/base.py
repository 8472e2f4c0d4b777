"""``NodeBase``, the common part of the nodes, with ``Diagnostics`` and ``Worker``; ``run_node``."""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import logging
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.signals import SignalHandlerOptions

try:  # its cost does not grow with the number of subscriptions
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:  # rclpy before 7.1.5
    from rclpy.executors import SingleThreadedExecutor as Executor

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.errors import ConfigError, counted
from slamfusion.io.files import return_freed_memory
from slamfusion.ros import qos
from slamfusion.ros.parameters import TypedNode, missed_sections, unknown_parameters

T = TypeVar("T")
# Threads of workers that ``close`` could not end.
_unended: list[threading.Thread] = []

DIAGNOSTICS_TOPIC = "/diagnostics"
DIAGNOSTICS_PERIOD_S = 1.0
# Diagnostics key of a fusion: stamp of the last scan, once its map equals that of ``run``.
FINAL = "final at [s]"
UNKNOWN = "_NODE_NAME_UNKNOWN_"
# A larger forward jump of the clock is reported; nothing restarts.
FORWARD_JUMP_S = 10.0
# Simulated time that does not come for this long is reported, seconds.
CLOCK_LATE_S = 3.0
# The executor checks for a signal at this interval.
SPIN_S = 0.1
# Freed memory is returned to the system at this interval, seconds; taking it again costs time.
TRIM_S = 10.0
# Fast DDS 2.14 sometimes waits for ever when a node ends while another does (Fast-DDS issue 6193 is
# like it). After this time, seconds, the process ends with status 1.
END_S = 10.0
# Past events stay in the diagnostics this long, seconds.
SHOWN_S = 10.0
# Diagnostics key of a jump of the node's clock.
TIME_JUMP = "time jump"
# DDS knows a killed process for 20 s. Two writers of one name are two nodes after this, seconds.
DEAD_KNOWN_S = 45.0
# A folder of ``slamfusion.sh`` for nodes that were started together, so that only one of them logs
# what concerns all.
SESSION_VARIABLE = "SLAMFUSION_SESSION"
# A file that a node makes when it has started, for ``slamfusion.sh``.
STARTED_VARIABLE = "SLAMFUSION_STARTED"
# Loggers whose warnings stay true while a node runs: NumPy instead of OpenCL, kernels that are
# built at each start.
DEVICE_LOGGERS = ("slamfusion.compute", "slamfusion.compute.pocl_cache")


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus, better to worse."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Status:
    """One line of the diagnostics; the node's name is put before ``name``."""

    name: str
    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class Diagnostics:
    """Current problems by key, logged at start and, in the same words, at end; thread-safe."""

    def __init__(self, log: Any) -> None:
        self._log = log
        self._lock = threading.Lock()
        # Level, text, end time and logged text.
        self._now: dict[str, tuple[Level, str, float, str]] = {}
        self._since_s: dict[str, float] = {}

    def say(
        self,
        key: str,
        text: str | None,
        level: Level = Level.WARN,
        for_s: float = math.inf,
        *,
        after_s: float = 0.0,
        is_of_all: bool = False,
    ) -> None:
        """Report a problem, or with None its end.

        Args:
            key: a new text replaces the one of the same key.
            text: the cause, with what to do.
            for_s: the problem ends after this time, seconds.
            after_s: reported only after it has lasted this long, seconds.
            is_of_all: it concerns all nodes started together: one of them logs it.
        """
        now_s = time.monotonic()
        with self._lock:
            before = self._alive().get(key)
            if text is None:
                self._now.pop(key, None)
                self._since_s.pop(key, None)
            elif now_s - self._since_s.setdefault(key, now_s) < after_s:
                return
            else:
                self._now[key] = level, text, now_s + for_s, before[3] if before else text
        if text is None and before is not None:
            self._log.info(f"over: {before[3]}")
        if text is None or before is not None or (is_of_all and not is_first_to_say(text)):
            return
        # Two calls: rclpy ties a line of code to one level.
        if level == Level.ERROR:
            self._log.error(text)
        else:
            self._log.warning(text)

    def note(self, key: str, text: str, level: Level = Level.WARN) -> None:
        """Report a past event; it is shown for ``SHOWN_S``."""
        self.say(key, text, level, SHOWN_S)

    def clear(self, key: str) -> None:
        """Report the end of a problem, if there is one."""
        self.say(key, None)

    def is_on(self, key: str) -> bool:
        """Whether a problem is reported now."""
        with self._lock:
            return key in self._alive()

    def worst(self, fine: str = "ok") -> tuple[Level, str]:
        """Return the worst level and all problems, worst first, or ``fine``."""
        with self._lock:
            alive = sorted(self._alive().values(), key=lambda item: -item[0])
        if not alive:
            return Level.OK, fine
        return alive[0][0], "; ".join(text for _, text, *_ in alive)

    def _alive(self) -> dict[str, tuple[Level, str, float, str]]:
        now_s = time.monotonic()
        self._now = {key: item for key, item in self._now.items() if item[2] > now_s}
        return self._now


def is_first_to_say(text: str) -> bool:
    """Return whether this node is the first of its session to log a text; marks it as logged."""
    folder = os.environ.get(SESSION_VARIABLE)
    if not folder:
        return True
    said = Path(folder) / f"said-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    with contextlib.suppress(OSError):  # no folder, or full: rather twice than never
        try:
            said.touch(exist_ok=False)
        except FileExistsError:
            return False
    return True


class Worker(Generic[T]):
    """A thread that processes items in order from a bounded queue.

    When the queue is full, the oldest waiting item is dropped: the newest scan matters most. A
    failing item is passed with its error to ``on_error``, in the thread. The capacity, at least 1,
    may be changed.
    """

    def __init__(
        self,
        work: Callable[[T], None],
        capacity: int,
        on_error: Callable[[T, Exception], object],
        name: str = "worker",
    ) -> None:
        self.capacity = capacity
        self._work, self._on_error = work, on_error
        self._waiting: deque[T] = deque()
        self._is_busy = self._is_closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> list[T]:
        """Queue an item; return the dropped ones (after ``close`` the item itself)."""
        with self._changed:
            if self._is_closed:
                return [item]
            self._waiting.append(item)
            self._changed.notify_all()
            over = len(self._waiting) - self.capacity
            return [self._waiting.popleft() for _ in range(over)]

    def clear(self) -> list[T]:
        """Remove and return all waiting items."""
        with self._changed:
            taken = list(self._waiting)
            self._waiting.clear()
            self._changed.notify_all()
            return taken

    @property
    def waiting(self) -> int:
        """Number of waiting items."""
        return len(self._waiting)

    def is_idle(self, timeout_s: float = 0.0) -> bool:
        """Whether nothing waits or is in progress, within a time."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._waiting and not self._is_busy, timeout_s
            )

    def close(self, timeout_s: float = 5.0) -> bool:
        """Drop waiting items, finish the current one; return whether the thread has ended."""
        with self._changed:
            self._is_closed = True
        self.clear()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            _unended.append(self._thread)
        return not self._thread.is_alive()

    def _run(self) -> None:
        with contextlib.suppress(OSError):  # for ``top -H``
            task = Path(f"/proc/self/task/{threading.get_native_id()}/comm")
            task.write_text(self._thread.name)
        while True:
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                item = self._waiting.popleft()
                self._is_busy = True
            try:
                self._work(item)
            except Exception as error:  # noqa: BLE001  (the node continues)
                self._on_error(item, error)


class NodeBase:
    """Base of the nodes: subclasses add topics in their constructor, ``statuses`` and ``close``.

    Callbacks run in sequence in the thread of ``run_node`` and must be short; long work belongs in
    a ``Worker``. If a callback raises, its traceback is logged, the diagnostics report it, and the
    node continues.

    Args:
        name: the node's name unless ``--ros-args -r __node:=NAME`` says otherwise.
        arguments: ROS arguments of this node alone, after those of ``rclpy.init``.
    """

    def __init__(
        self, name: str, *, context: Any = None, arguments: Sequence[str] | None = None
    ) -> None:
        self.node = TypedNode(name, context=context, cli_args=arguments)
        self.name = str(self.node.get_name())  # without its namespace
        self.log = self.node.get_logger()
        self.diagnostics = Diagnostics(self.log)
        self.is_stopped = False
        self.exit_code = 0
        # Topics that had an incompatible writer.
        self._mismatched: set[str] = set()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.node.create_publisher(
            DiagnosticArray, DIAGNOSTICS_TOPIC, qos.STREAM
        )
        self.timer(DIAGNOSTICS_PERIOD_S, self.publish_diagnostics)
        threshold = JumpThreshold(
            min_forward=Duration(seconds=FORWARD_JUMP_S),
            min_backward=Duration(nanoseconds=-1),
            on_clock_change=False,
        )
        self._jump_handle = self.node.get_clock().create_jump_callback(
            threshold, post_callback=lambda jump: self._call("clock", self._on_jump, jump)
        )

    def statuses(self) -> list[Status]:
        """Return the lines of the diagnostics; by default one with all problems."""
        return [Status("node", *self.diagnostics.worst())]

    def on_time_jump(self, delta_s: float) -> None:
        """Handle a jump of the node's clock (simulated time): back, or far forward; seconds."""

    def close(self) -> None:
        """End threads; called once, before the node is destroyed."""

    def clock_s(self) -> float:
        """Return the node's time, seconds; simulated time if used."""
        return float(self.node.get_clock().now().nanoseconds * 1e-9)

    def resolved(self, topic: str) -> str:
        """Return the fully resolved name of a topic."""
        return str(self.node.resolve_topic_name(topic))

    def check_type(self, kind: Any, topic: str) -> None:
        """Raise ConfigError if this node has the topic with another type, which ends a process."""
        for other in (*self.node.publishers, *self.node.subscriptions):
            if other.topic_name == self.resolved(topic) and other.msg_type is not kind:
                message = (
                    f"wanted {type_name(kind)} on {other.topic_name!r}, found that this node has "
                    f"it as {type_name(other.msg_type)}; name another topic"
                )
                raise ConfigError(message)

    def writers(self, topic: str) -> list[str]:
        """Return the full names of the nodes that publish a topic, one for each publisher."""
        infos = self.node.get_publishers_info_by_topic(topic)
        return sorted(
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in infos
            if info.node_name != UNKNOWN
        )

    def name_writers(self, key: str, topic: str, outcome: str, *, is_sure: bool = False) -> None:
        """Report several nodes that publish a topic, and the outcome.

        Two of one name may be a dead one and its successor for a while, unless ``is_sure``.
        """
        nodes = self.writers(topic)
        others = sorted(set(nodes))
        if len(others) > 1:
            nodes, is_sure = others, True
        text = (
            f"{len(nodes)} nodes publish {self.resolved(topic)!r}, "
            f"{' and '.join(map(repr, nodes))}, and {outcome}"
        )
        after_s = 0.0 if is_sure else DEAD_KNOWN_S
        self.diagnostics.say(key, text if len(nodes) > 1 else None, after_s=after_s)

    def senders(self, topic: str, kind: Any) -> str:
        """Return in words who could publish a silent topic."""
        found = [one.topic_type for one in self.node.get_publishers_info_by_topic(topic)]
        if found and type_name(kind) not in found:
            return f"it carries {', '.join(sorted({*found}))}; wanted {type_name(kind)}"
        if not found:
            return "no node publishes it"
        return f"{counted(found.count(type_name(kind)), 'node')} could publish it"

    def open_device(self, wanted: str) -> ComputeDevice:
        """Open a compute device; its warnings stay in the diagnostics."""
        handler = logging.Handler(logging.WARNING)

        def emit(record: logging.LogRecord) -> None:
            if record.name in DEVICE_LOGGERS:
                key = f"device {record.name}"
                self.diagnostics.say(key, record.getMessage(), is_of_all=True)

        handler.emit = emit  # type: ignore[method-assign]
        logger = logging.getLogger(DEVICE_LOGGERS[0])
        logger.addHandler(handler)
        try:
            return open_device(wanted)
        finally:
            logger.removeHandler(handler)

    def subscribe(
        self, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any, **more: Any
    ) -> Any:
        """Return a subscription with a safe callback; incompatible writers are in diagnostics.

        ``more``: of rclpy; with ``raw=True`` the callback gets the bytes of the message.
        ConfigError: see ``check_type``.
        """
        events = SubscriptionEventCallbacks(incompatible_qos=lambda _: self._mismatched.add(topic))
        try:
            return self.node.create_subscription(
                kind,
                topic,
                lambda message: self._call(topic, callback, message),
                profile,
                event_callbacks=events,
                **more,
            )
        except RuntimeError:  # of rcl, without the reason
            self.check_type(kind, topic)
            raise

    def timer(self, period_s: float, callback: Callable[[], None]) -> Any:
        """Return a timer in real time, even with simulated time."""
        return self.node.create_timer(
            period_s, lambda: self._call("timer", callback), clock=self._steady
        )

    def stop(self, exit_code: int = 0) -> None:
        """End ``run_node``; from any thread."""
        self.exit_code = exit_code
        self.is_stopped = True

    def failed(self, _: object, error: Exception, key: str = "worker", where: str = "") -> str:
        """Report an unexpected error, with its traceback in the log once, and return the text."""
        if not self.diagnostics.is_on(key):
            self.log.error("".join(traceback.format_exception(error)))
        text = f"{where}{type(error).__name__}: {error}"
        self.diagnostics.note(key, text, Level.ERROR)
        return text

    def _call(self, what: str, callback: Callable[..., None], *arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception as error:  # noqa: BLE001  (a node must outlive a bad message)
            self.failed(what, error, f"callback {what}", f"{what}: ")

    def publish_diagnostics(self) -> None:
        """Publish one DiagnosticArray on ``/diagnostics``."""
        full_name = str(self.node.get_fully_qualified_name())
        own = self.name, str(self.node.get_namespace())
        count = self.node.get_node_names_and_namespaces().count(own)
        text = (
            f"{count} nodes are called {full_name!r}: their topics, parameters and diagnostics "
            "cannot be told apart; end one, or rename it with -r __node:=NAME (one that was killed "
            "is known for half a minute)"
        )
        self.diagnostics.say("namesake", text if count > 1 else None)
        text = "use_sim_time is on and no time comes on '/clock'; start its sender, or turn it off"
        is_timeless = self.clock_s() <= 0.0
        self.diagnostics.say("no clock", text if is_timeless else None, after_s=CLOCK_LATE_S)
        for topic in sorted(self._mismatched):
            self._name_mismatch(topic)
        message = DiagnosticArray()
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([line.level]),
                name=f"{full_name.lstrip('/')}: {line.name}",
                message=line.message,
                hardware_id=self.name,
                values=[KeyValue(key=key, value=shown(item)) for key, item in line.values.items()],
            )
            for line in self.statuses()
        ]
        self._diagnostics.publish(message)

    def _name_mismatch(self, topic: str) -> None:
        """Report writers that offer less than this node's readers of a topic ask for."""
        readers = [own for own in self.node.subscriptions if own.topic_name == self.resolved(topic)]
        checks = [
            qos_check_compatible(writer.qos_profile, reader.qos_profile)
            for writer in self.node.get_publishers_info_by_topic(topic)
            for reader in readers
        ]
        reasons = {
            reason.replace("ERROR: ", " ").strip(" ;")
            for found, reason in checks
            if found == QoSCompatibility.ERROR
        }
        text = (
            f"a writer on {self.resolved(topic)!r} offers less than is asked for "
            f"({'; '.join(sorted(reasons))}); nothing is heard from it"
        )
        # A reader that adapts to its writers does so within a period.
        late_s = DIAGNOSTICS_PERIOD_S
        self.diagnostics.say(f"qos {topic}", text if reasons else None, after_s=late_s)

    def _on_jump(self, jump: TimeJump) -> None:
        delta_s = jump.delta.nanoseconds * 1e-9
        if delta_s > 0.0 and self.clock_s() - delta_s <= 0.0:
            return  # the first time that was received
        self.diagnostics.note(TIME_JUMP, f"time jumped {jump_words(delta_s, self.clock_s())}")
        self.on_time_jump(delta_s)


def type_name(kind: Any) -> str:
    """Return the name of a message type as ROS tools show it."""
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def jump_words(delta_s: float, to_s: float) -> str:
    """Return a jump of time in words, seconds."""
    way = "forward" if delta_s > 0.0 else "back"
    return f"{way} by {abs(delta_s):.3f} s to {to_s:.3f} s"


def shown(value: object) -> str:
    """Return a value as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
    return str(value)


def run_node(make: Callable[[], NodeBase], arguments: Sequence[str] | None = None) -> int:
    """Run the node that ``make`` returns until it stops or a signal comes; return the exit code.

    Args:
        arguments: with ``--ros-args``; default: none.

    Raises:
        ConfigError: invalid arguments or topic names.
    """
    try:
        rclpy.init(args=list(arguments or []), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # Without the source positions of rcl.
        words = str(error).partition(", at /")[0].removeprefix("failed to initialize rcl: ")
        words = words.replace(". Error: error not set", "; wanted FROM:=TO with two valid names")
        # What rcl says of a value that is no YAML.
        advice = "; put a text with a colon in quotes: \"inputs:=['file:map.yaml']\""
        words = words.replace("parsing an event", f"parsing an event{advice}")
        raise ConfigError(f"ROS arguments: {words}") from error
    try:
        try:
            base = make()
        except NameValidationException as error:
            # ROS does not say whether it came from a parameter or a remapping.
            message = f"{invalid_name(error)}; correct it in the parameters or remappings"
            raise ConfigError(message) from None
        return_freed_memory()  # of the first launches of all kernels
        if mark := os.environ.get(STARTED_VARIABLE):
            with contextlib.suppress(OSError):  # who asked for it is gone
                Path(mark).touch()
        missed = missed_sections(base.node, arguments or ())
        for sentence in (*missed, *unknown_parameters(base.node)):
            base.log.warning(sentence)
        threading.Thread(target=_trim, name="memory", daemon=True).start()
        before = {
            number: signal.signal(number, lambda *_: base.stop())
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        executor = Executor()
        executor.add_node(base.node)
        try:
            with contextlib.suppress(ExternalShutdownException):
                while not base.is_stopped and rclpy.ok():
                    executor.spin_once(timeout_sec=SPIN_S)
        finally:
            executor.remove_node(base.node)
            executor.shutdown()
            base.close()
            faulthandler.dump_traceback_later(END_S, exit=True)
            base.node.destroy_node()
            faulthandler.cancel_dump_traceback_later()
            for number, handler in before.items():
                signal.signal(number, handler)
        if any(thread.is_alive() for thread in _unended):
            # Ending the interpreter aborts while a thread is in native code.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(base.exit_code)
        return base.exit_code
    finally:
        rclpy.try_shutdown()


def _trim() -> None:
    """Return freed memory to the system now and then: solutions leave holes among small objects."""
    while True:
        time.sleep(TRIM_S)
        return_freed_memory()


def invalid_name(error: NameValidationException) -> str:
    """Return an invalid name, its kind and the reason in one line."""
    # "Invalid KIND: REASON:", the name in quotes, and a mark below the wrong place.
    what, name, *_ = str(error).splitlines()
    kind, _, reason = what.removeprefix("Invalid ").rstrip(":").partition(": ")
    return f"{name.strip()} is no {kind}: {reason}"
