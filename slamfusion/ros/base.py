"""``NodeBase``: what every node shares, and ``run_node``, which runs one to its end.

Diagnostics, which name what is wrong; callbacks that cannot bring the node down; a ``Worker`` for
what takes long; the compute device; jumps of the clock; a clean end.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import os
import signal
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
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSCompatibility, qos_check_compatible, qos_policy_name_from_kind
from rclpy.signals import SignalHandlerOptions

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.errors import ConfigError
from slamfusion.ros import qos
from slamfusion.ros.parameters import TypedNode, unknown_parameters

T = TypeVar("T")

DIAGNOSTICS_TOPIC = "/diagnostics"
DIAGNOSTICS_PERIOD_S = 1.0
# Of a fusion: the stamp of the last scan, once its map is what ``run`` makes of the drive.
FINAL = "final at [s]"
# A clock that goes on by more at once is named; it is no reason to start over.
FORWARD_JUMP_S = 10.0
# The executor looks for a signal this often.
SPIN_S = 0.1
# The longest rest of an executor, seconds.
REST_MAX_S = 0.02
# What has passed stays in the diagnostics this long, seconds.
SHOWN_S = 10.0
# A folder for as long as nodes that were started together run, so that one of them says what holds
# for all; ``slamfusion.sh`` makes one.
SESSION_VARIABLE = "SLAMFUSION_SESSION"
# A file that a node makes when its start is over, where ``slamfusion.sh`` asks for it.
STARTED_VARIABLE = "SLAMFUSION_STARTED"
# Whose warnings stay true while a node runs and cost it time: NumPy in place of OpenCL, kernels
# that are built at each start. That the wheel's PoCL was changed costs nothing.
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
    """What is wrong now, each by a key; logged once when it comes and once when it is over.

    Safe between threads.
    """

    def __init__(self, log: Any) -> None:
        self._log = log
        self._lock = threading.Lock()
        # Level, words, and until when it holds.
        self._now: dict[str, tuple[Level, str, float]] = {}
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
        """Report that something is wrong, or with None that it is right again.

        Args:
            key: what; the same key replaces the words that it had.
            text: why, for people, with what to do.
            for_s: it is over after this time, seconds; default: until it is right.
            after_s: it counts once it has been wrong for this long, seconds.
            is_of_all: as true of the nodes started with this one: one of them logs it.
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
                self._now[key] = level, text, now_s + for_s
        if text is None and before is not None:
            self._log.info(f"over: {before[1]}")
        if text is None or before is not None or (is_of_all and not is_first_to_say(text)):
            return
        # Two calls: rclpy ties a place in the code to one level.
        if level == Level.ERROR:
            self._log.error(text)
        else:
            self._log.warning(text)

    def note(self, key: str, text: str, level: Level = Level.WARN) -> None:
        """Report something that has passed; it is shown for ``SHOWN_S``."""
        self.say(key, text, level, SHOWN_S)

    def clear(self, key: str) -> None:
        """Report that something is right again, if it was wrong."""
        self.say(key, None)

    def is_on(self, key: str) -> bool:
        """Whether something is wrong now."""
        with self._lock:
            return key in self._alive()

    def worst(self, fine: str = "ok") -> tuple[Level, str]:
        """Return the worst level and all that is wrong, worst first, or ``fine``."""
        with self._lock:
            alive = sorted(self._alive().values(), key=lambda item: -item[0])
        if not alive:
            return Level.OK, fine
        return alive[0][0], "; ".join(text for _, text, _ in alive)

    def _alive(self) -> dict[str, tuple[Level, str, float]]:
        now_s = time.monotonic()
        self._now = {key: item for key, item in self._now.items() if item[2] > now_s}
        return self._now


def is_first_to_say(text: str) -> bool:
    """Return whether no node of this session has said the same; the caller now has."""
    folder = os.environ.get(SESSION_VARIABLE)
    if not folder:
        return True
    said = Path(folder) / f"said-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    with contextlib.suppress(OSError):  # the folder is gone, or full: rather twice than never
        try:
            said.touch(exist_ok=False)
        except FileExistsError:
            return False
    return True


class Worker(Generic[T]):
    """A thread that takes items one by one, in order, from a queue that never grows.

    When the queue is full the oldest waiting item is dropped: a robot's newest scan says most of
    where it is. What is being worked on is never dropped. An item that fails is passed with its
    error to ``on_error``, in the thread, and the next one is taken.

    Attributes:
        capacity: items that may wait, at least 1; may be changed.
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
        """Queue an item; return what was dropped for it, after ``close`` the item itself."""
        with self._changed:
            if self._is_closed:
                return [item]
            self._waiting.append(item)
            self._changed.notify_all()
            over = len(self._waiting) - self.capacity
            return [self._waiting.popleft() for _ in range(over)]

    def clear(self) -> list[T]:
        """Remove everything that waits, and return it."""
        with self._changed:
            taken = list(self._waiting)
            self._waiting.clear()
            self._changed.notify_all()
            return taken

    @property
    def waiting(self) -> int:
        """Items that wait now."""
        return len(self._waiting)

    def is_idle(self, timeout_s: float = 0.0) -> bool:
        """Whether nothing waits and nothing is worked on, or comes to that within a time."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._waiting and not self._is_busy, timeout_s
            )

    def close(self, timeout_s: float = 5.0) -> bool:
        """Drop what waits, let the current item end, and return whether the thread has ended."""
        with self._changed:
            self._is_closed = True
        self.clear()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
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
            except Exception as error:  # noqa: BLE001  (a node goes on; the error is named)
                self._on_error(item, error)


class NodeBase:
    """A node: subclasses add topics in their constructor, ``statuses`` and ``close``.

    Callbacks run one after the other in the thread of ``run_node`` and must be short; what takes
    long belongs into a ``Worker``. A callback that raises is logged with its traceback, named in
    the diagnostics, and the node goes on.

    Args:
        name: the node's name unless ``--ros-args -r __node:=NAME`` says otherwise.
        arguments: ROS arguments of this node alone, after those of ``rclpy.init``.

    Attributes:
        node: the rclpy node.
        rest: the executor rests this many times as long as it has worked, 20 ms at most; 0: never.
            rclpy looks at every subscription each time it wakes, so what that costs grows with the
            square of their number; while it rests messages gather, and it wakes less often.
    """

    def __init__(
        self, name: str, *, context: Any = None, arguments: Sequence[str] | None = None
    ) -> None:
        self.node = TypedNode(name, context=context, cli_args=arguments)
        self.log = self.node.get_logger()
        self.diagnostics = Diagnostics(self.log)
        self.is_stopped = False
        self.exit_code = 0
        self.rest = 0.0
        # How topics are read on which a writer was found that offers less.
        self._mismatched: dict[str, Any] = {}
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

    # --- for subclasses ----------------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return the lines of the diagnostics; one with all that is wrong unless overridden."""
        return [Status("node", *self.diagnostics.worst())]

    def on_time_jump(self, delta_s: float) -> None:
        """Act on a jump of the node's clock (simulated time): back, or far forward; seconds."""

    def close(self) -> None:
        """End threads; called once, before the node is destroyed."""

    # --- what a node has ---------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The node's name, without its namespace."""
        return str(self.node.get_name())

    def clock_s(self) -> float:
        """Return the node's time, seconds: simulated time where it is used."""
        return float(self.node.get_clock().now().nanoseconds * 1e-9)

    def resolved(self, topic: str) -> str:
        """Return the whole name of a topic, remapped."""
        return str(self.node.resolve_topic_name(topic))

    def open_device(self, wanted: str) -> ComputeDevice:
        """Open a compute device; its warnings stay in the diagnostics. See ``open_device``."""
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
        self, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any
    ) -> Any:
        """Return a subscription whose callback cannot bring the node down.

        A writer whose quality of service does not fit is named in the diagnostics while it is
        there, and until the topic is read another way.
        """
        if topic in self._mismatched:
            self._mismatched[topic] = profile

        def on_mismatch(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            self._mismatched[topic] = profile
            text = (
                f"a writer on {self.resolved(topic)!r} offers less than is asked for ({policy}); "
                "nothing is heard from it"
            )
            self.diagnostics.say(f"qos {topic}", text)

        return self.node.create_subscription(
            kind,
            topic,
            lambda message: self._call(topic, callback, message),
            profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=on_mismatch),
        )

    def timer(self, period_s: float, callback: Callable[[], None]) -> Any:
        """Return a timer in real time, also where the node's own time is simulated."""
        return self.node.create_timer(
            period_s, lambda: self._call("timer", callback), clock=self._steady
        )

    def stop(self, exit_code: int = 0) -> None:
        """Let ``run_node`` come to its end; may be called from any thread."""
        self.exit_code = exit_code
        self.is_stopped = True

    def failed(self, _: object, error: Exception, key: str = "worker", where: str = "") -> str:
        """Name an error that was not expected, of a worker's item or a callback; return its words.

        The log has its traceback, once while it is named.
        """
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

    # --- diagnostics and time ----------------------------------------------------------------

    def publish_diagnostics(self) -> None:
        """Publish one DiagnosticArray on ``/diagnostics``."""
        self._name_namesakes()
        for topic, profile in list(self._mismatched.items()):
            infos = self.node.get_publishers_info_by_topic(topic)
            found = [qos_check_compatible(info.qos_profile, profile)[0] for info in infos]
            if QoSCompatibility.ERROR not in found:  # every writer can be heard now
                del self._mismatched[topic]
                self.diagnostics.clear(f"qos {topic}")
        message = DiagnosticArray()
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([line.level]),
                name=f"{self.node.get_fully_qualified_name().lstrip('/')}: {line.name}",
                message=line.message,
                hardware_id=self.name,
                values=[KeyValue(key=key, value=shown(item)) for key, item in line.values.items()],
            )
            for line in self.statuses()
        ]
        self._diagnostics.publish(message)

    def _name_namesakes(self) -> None:
        """Name other nodes that have this one's name and namespace."""
        own = self.name, str(self.node.get_namespace())
        count = self.node.get_node_names_and_namespaces().count(own)
        text = (
            f"{count} nodes are called {self.node.get_fully_qualified_name()!r}: their topics, "
            "parameters and diagnostics cannot be told apart; end one, or rename it with "
            "-r __node:=NAME (one that was killed is known for half a minute)"
        )
        self.diagnostics.say("namesake", text if count > 1 else None)

    def _on_jump(self, jump: TimeJump) -> None:
        delta_s = jump.delta.nanoseconds * 1e-9
        if delta_s > 0.0 and self.clock_s() - delta_s <= 0.0:
            return  # the first time that was ever heard
        how = "forward" if delta_s > 0.0 else "back"
        text = f"time jumped {how} by {abs(delta_s):.3f} s to {self.clock_s():.3f} s"
        self.diagnostics.note("time jump", text)
        self.on_time_jump(delta_s)


def shown(value: object) -> str:
    """Return a figure as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
    return str(value)


def run_node(make: Callable[[], NodeBase], arguments: Sequence[str] | None = None) -> int:
    """Start rclpy, make a node, run it until it stops or a signal comes, and clean up.

    SIGINT and SIGTERM end it in order: what is being worked on ends, threads are joined.

    Args:
        make: makes the node; called after rclpy has started.
        arguments: with ``--ros-args``; default: none.

    Returns the exit code: 0, or that of ``stop``.

    Raises:
        ConfigError: the arguments cannot be understood, or a name of a topic is none.
    """
    try:
        rclpy.init(args=list(arguments or []), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # Without the places in rcl's sources.
        words = str(error).partition(", at /")[0].removeprefix("failed to initialize rcl: ")
        words = words.replace(". Error: error not set", "; wanted FROM:=TO with two valid names")
        raise ConfigError(f"ROS arguments: {words}") from error
    try:
        try:
            base = make()
        except NameValidationException as error:
            # Whether it came from a parameter or a remapping ROS does not say.
            message = f"{invalid_name(error)}; correct it in the parameters or remappings"
            raise ConfigError(message) from None
        if mark := os.environ.get(STARTED_VARIABLE):
            with contextlib.suppress(OSError):  # who asked for it is gone
                Path(mark).touch()
        for sentence in unknown_parameters(base.node):
            base.log.warning(sentence)
        before = {
            number: signal.signal(number, lambda *_: base.stop())
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            _spin(base)
        finally:
            base.close()
            base.node.destroy_node()
            for number, handler in before.items():
                signal.signal(number, handler)
        return base.exit_code
    finally:
        rclpy.try_shutdown()


def invalid_name(error: NameValidationException) -> str:
    """Return in one line what is no name, of what, and why."""
    # "Invalid KIND: REASON:", the name in quotes, and a mark below the wrong place.
    what, name, *_ = str(error).splitlines()
    kind, _, reason = what.removeprefix("Invalid ").rstrip(":").partition(": ")
    return f"{name.strip()} is no {kind}: {reason}"


def _spin(base: NodeBase) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(base.node)
    try:
        while not base.is_stopped and rclpy.ok():
            began_s = time.thread_time()
            executor.spin_once(timeout_sec=SPIN_S)
            if base.rest:
                time.sleep(min(base.rest * (time.thread_time() - began_s), REST_MAX_S))
    except ExternalShutdownException:
        pass
    finally:
        executor.remove_node(base.node)
        executor.shutdown()
