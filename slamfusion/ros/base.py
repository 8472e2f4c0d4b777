"""``NodeBase``: what every node shares, and ``run_node``, which runs one to its end.

Diagnostics, the names of what is wrong, callbacks that cannot bring the node down, jumps of the
clock, and a clean end.
"""

from __future__ import annotations

import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import qos_policy_name_from_kind
from rclpy.signals import SignalHandlerOptions

from slamfusion.errors import ConfigError
from slamfusion.ros import qos
from slamfusion.ros.parameters import TypedNode, unknown_parameters
from slamfusion.ros.session import is_first_to_say

DIAGNOSTICS_TOPIC = "/diagnostics"
DIAGNOSTICS_PERIOD_S = 1.0
# A clock that goes on by more at once is worth a word; it is no reason to start over.
FORWARD_JUMP_S = 10.0
# The executor looks for a signal this often.
SPIN_S = 0.1
# The longest rest of an executor, seconds.
REST_MAX_S = 0.02
# Words about a jump of the clock stay in the diagnostics this long.
JUMP_SHOWN_S = 10.0


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus, better to worse."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Status:
    """One line of the diagnostics.

    Attributes:
        name: of the part; the node's name is put before it.
        level: how it is.
        message: why, for people.
        values: figures by name; floats are shown with four digits.
    """

    name: str
    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class Diagnostics:
    """What is wrong now, each by a key; said once in the log when it comes and when it goes.

    Safe between threads.

    Args:
        log: an rclpy logger.
    """

    def __init__(self, log: Any) -> None:
        self._log = log
        self._lock = threading.Lock()
        self._now: dict[str, tuple[Level, str, float | None]] = {}
        self._counts: dict[str, int] = {}

    def add(
        self,
        key: str,
        level: Level,
        text: str,
        for_s: float | None = None,
        *,
        is_of_all: bool = False,
    ) -> None:
        """Say that something is wrong.

        Args:
            key: what; the same key replaces the words that it had.
            level: how bad.
            text: why, for people, with what to do.
            for_s: it is over after this time, seconds; default: until ``clear``.
            is_of_all: as true of the nodes started with this one: one of them says it in the log.
        """
        until_s = None if for_s is None else time.monotonic() + for_s
        with self._lock:
            is_new = key not in self._alive()
            self._now[key] = (level, text, until_s)
            self._counts[key] = self._counts.get(key, 0) + 1
        if is_new and is_of_all:
            is_new = is_first_to_say(text)
        # Two calls: rclpy ties a place in the code to one level.
        if is_new and level == Level.ERROR:
            self._log.error(text)
        elif is_new:
            self._log.warning(text)

    def clear(self, key: str) -> None:
        """Say that something is right again, if it was wrong."""
        with self._lock:
            gone = self._alive().get(key)
            self._now.pop(key, None)
        if gone is not None:
            self._log.info(f"over: {gone[1]}")

    def is_on(self, key: str) -> bool:
        """Whether something is wrong now."""
        with self._lock:
            return key in self._alive()

    def count(self, key: str) -> int:
        """How often something was said to be wrong so far."""
        with self._lock:
            return self._counts.get(key, 0)

    def worst(self, fine: str = "ok") -> tuple[Level, str]:
        """Return the worst level and the words of everything that is wrong, worst first.

        Args:
            fine: the words where nothing is.
        """
        with self._lock:
            alive = sorted(self._alive().values(), key=lambda item: -item[0])
        if not alive:
            return Level.OK, fine
        return alive[0][0], "; ".join(text for _, text, _ in alive)

    def _alive(self) -> dict[str, tuple[Level, str, float | None]]:
        now_s = time.monotonic()
        for key, (_, _, until_s) in list(self._now.items()):
            if until_s is not None and until_s <= now_s:
                del self._now[key]
        return self._now


class NodeBase:
    """A node: subclasses add topics in their constructor, ``statuses`` and ``close``.

    Callbacks run one after the other in the thread of ``run_node`` and must be short; what takes
    long belongs into a ``Worker``. A callback that raises is logged with its traceback, named in
    the diagnostics, and the node goes on.

    Args:
        name: the node's name unless ``--ros-args -r __node:=NAME`` says otherwise.
        context: rclpy's; default: the one of ``rclpy.init``.
        arguments: ROS arguments of this node alone, beside those of ``rclpy.init``.

    Attributes:
        node: the rclpy node.
        log: its logger.
        diagnostics: what is wrong now.
        is_stopped: whether ``stop`` was called.
        exit_code: of the process, see ``stop``.
    """

    def __init__(
        self, name: str, *, context: Any = None, arguments: Sequence[str] | None = None
    ) -> None:
        self.node = TypedNode(name, context=context, cli_args=arguments)
        self.log = self.node.get_logger()
        self.diagnostics = Diagnostics(self.log)
        self.is_stopped = False
        self.exit_code = 0
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.node.create_publisher(
            DiagnosticArray, DIAGNOSTICS_TOPIC, qos.STREAM
        )
        self.timer(DIAGNOSTICS_PERIOD_S, self.publish_diagnostics)
        self._jump_handle = self.node.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=Duration(seconds=FORWARD_JUMP_S),
                min_backward=Duration(nanoseconds=-1),
                on_clock_change=False,
            ),
            post_callback=lambda jump: self._call("clock", self._on_jump, jump),
        )

    # --- for subclasses ----------------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return the lines of the diagnostics; one with all that is wrong unless overridden."""
        return [Status("node", *self.diagnostics.worst())]

    def on_time_jump(self, delta_s: float) -> None:
        """Act on a jump of the node's clock (simulated time): back, or far forward; seconds."""

    def close(self) -> None:
        """End threads; called once, before the node is destroyed."""

    @property
    def rest(self) -> float:
        """How many times as long as it has worked the executor rests, 20 ms at most; 0: never.

        rclpy looks at every subscription each time it wakes, so what that costs grows with the
        square of their number; while it rests messages gather, and it wakes less often.
        """
        return 0.0

    # --- what a node has ---------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The node's name, without its namespace."""
        return str(self.node.get_name())

    @property
    def is_sim_time(self) -> bool:
        """Whether the node's clock is that of ``/clock``."""
        return bool(self.node.get_clock().ros_time_is_active)

    def clock_s(self) -> float:
        """Return the node's time, seconds: simulated time where it is used."""
        return float(self.node.get_clock().now().nanoseconds * 1e-9)

    def publisher(self, kind: Any, topic: str, profile: Any) -> Any:
        """Return a publisher."""
        return self.node.create_publisher(kind, topic, profile)

    def subscribe(
        self, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any
    ) -> Any:
        """Return a subscription whose callback cannot bring the node down.

        A writer whose quality of service does not fit is named in the diagnostics.
        """
        key = f"qos {topic}"

        def on_mismatch(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            self.diagnostics.add(
                key,
                Level.WARN,
                f"a writer on {self.node.resolve_topic_name(topic)!r} offers less than is asked "
                f"for ({policy}); nothing is heard from it",
            )

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

    def publish_diagnostics(self) -> None:
        """Publish one DiagnosticArray on ``/diagnostics``."""
        self._name_namesakes()
        message = DiagnosticArray()
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.status = [self._status(item) for item in self.statuses()]
        self._diagnostics.publish(message)

    def _name_namesakes(self) -> None:
        """Name other nodes that have this one's name and namespace."""
        own = self.name, str(self.node.get_namespace())
        count = self.node.get_node_names_and_namespaces().count(own)
        if count > 1:
            text = (
                f"{count} nodes are called {self.node.get_fully_qualified_name()!r}: their topics, "
                "parameters and diagnostics cannot be told apart; end one, or rename it with "
                "-r __node:=NAME (one that was killed is known for half a minute)"
            )
            self.diagnostics.add("namesake", Level.WARN, text)
        else:
            self.diagnostics.clear("namesake")

    def _status(self, status: Status) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([status.level]),
            name=f"{self.node.get_fully_qualified_name().lstrip('/')}: {status.name}",
            message=status.message,
            hardware_id=self.name,
            values=[KeyValue(key=key, value=_shown(item)) for key, item in status.values.items()],
        )

    def _on_jump(self, jump: TimeJump) -> None:
        delta_s = jump.delta.nanoseconds * 1e-9
        if delta_s > 0.0 and self.clock_s() - delta_s <= 0.0:
            return  # the first time that was ever heard
        how = "forward" if delta_s > 0.0 else "back"
        self.diagnostics.add(
            "time jump",
            Level.WARN,
            f"time jumped {how} by {abs(delta_s):.3f} s to {self.clock_s():.3f} s",
            JUMP_SHOWN_S,
        )
        self.on_time_jump(delta_s)

    def _call(self, what: str, callback: Callable[..., None], *arguments: Any) -> None:
        """Call back; name what it raises and go on."""
        key = f"callback {what}"
        try:
            callback(*arguments)
        except Exception as error:  # noqa: BLE001  (a node must outlive a bad message)
            if not self.diagnostics.is_on(key):
                self.log.error(traceback.format_exc())
            text = f"{what}: {type(error).__name__}: {error}"
            self.diagnostics.add(key, Level.ERROR, text, JUMP_SHOWN_S)


def _shown(value: object) -> str:
    """Return a figure as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def run_node(make: Callable[[], NodeBase], arguments: Sequence[str] | None = None) -> int:
    """Start rclpy, make a node, run it until it stops or a signal comes, and clean up.

    SIGINT and SIGTERM end it in order: what is being worked on ends, threads are joined.

    Args:
        make: makes the node; called after rclpy has started.
        arguments: with ``--ros-args``; default: none.

    Returns:
        The exit code: 0, or what the node gave to ``stop``.

    Raises:
        ConfigError: the arguments cannot be understood, or a name of a topic is none.
    """
    try:
        rclpy.init(args=list(arguments or []), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # Without the places in rcl's sources.
        words = str(error).partition(", at /")[0].removeprefix("failed to initialize rcl: ")
        words = words.replace(". Error: error not set", "; wanted FROM:=TO with two valid names")
        message = f"ROS arguments: {words}"
        raise ConfigError(message) from error
    try:
        base = _made(make)
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


def _made(make: Callable[[], NodeBase]) -> NodeBase:
    """Make a node.

    Raises:
        ConfigError: a name of a topic, a service or the node is none; where it came from, a
            parameter or a remapping, ROS does not say.
    """
    try:
        return make()
    except NameValidationException as error:
        message = f"{invalid_name(error)}; mend it in the parameters or remappings"
        raise ConfigError(message) from None


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
