"""Real nodes over real DDS: processes, an observer, and a domain for each test."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import itertools
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from slamfusion.ros import qos
from tests.cli.command import ENVIRONMENT, INSTALLED
from tests.ros import tf2
from tests.support.forks import Forked, Server

# Packages of the messages that nodes send and hear, and of what rclpy itself does.
MESSAGES = (
    *("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "map_msgs", "nav_msgs"),
    *("rcl_interfaces", "sensor_msgs", "service_msgs", "std_msgs", "std_srvs", "tf2_msgs"),
    "type_description_interfaces",
)
# Domains above this use ports that Linux hands out to anyone.
DOMAINS = 100
_STARTS = itertools.count(os.getpid() * 7)


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """Take a domain that no other test has, also not of another test run on this machine."""
    folder = Path(tempfile.gettempdir()) / "slamfusion-ros-domains"
    folder.mkdir(exist_ok=True)
    for _ in range(DOMAINS):
        number = 1 + next(_STARTS) % DOMAINS
        with (folder / str(number)).open("w") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield number
            return
    raise RuntimeError(f"all {DOMAINS} domains are in use")


def ros_environment(domain: int) -> dict[str, str]:
    """Return what is added to the environment of a node in a domain."""
    return {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "OMP_NUM_THREADS": "1",
        "POCL_MAX_PTHREAD_COUNT": "1",
        "PYTHONUNBUFFERED": "1",
        "RCUTILS_LOGGING_USE_STDOUT": "0",
        **tf2.environment(),
    }


@functools.cache
def server() -> Server:
    """Return what is forked for nodes, begun with the environment of all that are started."""
    # The second is imported with the first type of a message, and with it a reader of grammars; the
    # libraries of message packages with the first message of each.
    modules = ["rclpy", "rosidl_generator_py", *MESSAGES, "slamfusion"]
    return Server(INSTALLED, modules, {**ENVIRONMENT, **ros_environment(0)})


class Process:
    """One running node.

    Attributes:
        name: for messages.
        process: its process.
        output: file with everything that it prints.
    """

    def __init__(self, name: str, command: list[str], env: Mapping[str, str], output: Path) -> None:
        self.name = name
        self.output = output
        self.process: Forked | subprocess.Popen[bytes]
        whole = {**os.environ, **env}
        with output.open("w") as file, Path(os.devnull).open("rb") as nothing:
            if command[0] == str(INSTALLED) and server().can_start(whole):
                files = [nothing.fileno(), file.fileno(), file.fileno()]
                self.process = server().start(command[1:], whole, None, files)
                return
            # A test run in the background ignores Ctrl-C, and its children would too.
            self.process = subprocess.Popen(
                ["env", "--default-signal=INT", *command],
                env=whole,
                stdout=file,
                stderr=subprocess.STDOUT,
                stdin=nothing,
            )

    def text(self) -> str:
        """Return what it has printed."""
        return self.output.read_text(errors="replace")

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.process.send_signal(number)

    def kill(self) -> None:
        """End it without a chance to say good-bye."""
        self.process.kill()
        self.process.wait(10.0)

    def wait(self, timeout_s: float = 40.0) -> int:
        """Wait for its end and return the exit code."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            message = f"{self.name} has not ended in {timeout_s} s:\n{self.text()}"
            raise AssertionError(message) from None

    def interrupt(self, timeout_s: float = 40.0) -> int:
        """Press Ctrl-C and return the exit code."""
        self.signal(signal.SIGINT)
        return self.wait(timeout_s)


class Processes:
    """Starts ``slamfusion node`` and other programs; ends what is left."""

    def __init__(self, env: Mapping[str, str], folder: Path) -> None:
        self._env = env
        self._folder = folder
        self.running: list[Process] = []

    def __enter__(self) -> Processes:  # noqa: PYI034  (Self is newer than Python 3.10)
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.running:
            if process.is_running:
                process.signal(signal.SIGINT)
        for process in self.running:
            try:
                process.process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
            print(f"--- {process.name}: {process.process.returncode}")
            print(process.text()[-6000:])

    def node(
        self,
        kind: str,
        *ros_arguments: str,
        env: Mapping[str, str] | None = None,
        **parameters: Any,
    ) -> Process:
        """Start ``slamfusion node KIND``.

        Args:
            kind: e.g. ``tinyslam``.
            ros_arguments: after ``--ros-args``, e.g. ``-r``, ``__ns:=/robot``.
            env: added to the environment.
            parameters: by name; two underscores stand for a point.
        """
        words = [str(INSTALLED), "node", kind, "--ros-args", *ros_arguments]
        for name, value in parameters.items():
            words += ["-p", f"{name.replace('__', '.')}:={_yaml(value)}"]
        return self.start(kind, words, env)

    def start(self, name: str, command: list[str], env: Mapping[str, str] | None = None) -> Process:
        """Start any program in the test's domain."""
        output = self._folder / f"{len(self.running)}-{name}.txt"
        process = Process(name, command, {**self._env, **(env or {})}, output)
        self.running.append(process)
        return process


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(_yaml(item) for item in value) + "]"
    return f"'{value}'" if isinstance(value, str) else repr(value)


class Observer:
    """A node in the test's own process: listens, and says what it is told to."""

    def __init__(self, domain: int, name: str = "observer") -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._statuses: dict[str, Any] | None = None
        self._told_s: dict[str, float] = {}

    def __enter__(self) -> Observer:  # noqa: PYI034  (Self is newer than Python 3.10)
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def collect(self, kind: Any, topic: str, profile: Any = qos.STREAM) -> list[Any]:
        """Return a list that every message on a topic is added to."""
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, profile)
        return heard

    def publisher(self, kind: Any, topic: str, profile: Any = qos.STREAM) -> Any:
        """Return a publisher."""
        return self.node.create_publisher(kind, topic, profile)

    def wait(self, is_done: Callable[[], Any], timeout_s: float = 40.0, what: str = "") -> Any:
        """Listen until something is so, and return it; fail after the time."""
        until_s = time.monotonic() + timeout_s
        while not (found := is_done()):
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                raise AssertionError(f"waited {timeout_s} s for {what or 'it'}; it did not come")
            self._executor.spin_once(timeout_sec=min(left_s, 0.1))
        return found

    def listen(self, duration_s: float) -> None:
        """Listen for a time, for what must not come."""
        until_s = time.monotonic() + duration_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left_s, 0.1))

    def statuses(self) -> dict[str, Any]:
        """Return the newest diagnostics by name, filled while this listens."""
        if self._statuses is None:
            self._statuses = {}
            self.node.create_subscription(
                DiagnosticArray, "/diagnostics", self._keep_statuses, qos.STREAM
            )
        return self._statuses

    def wait_status(self, name: str, *words: str, timeout_s: float = 40.0) -> Any:
        """Wait until the diagnostics of a name hold all the words in their message."""
        statuses = self.statuses()

        def found() -> Any:
            status = statuses.get(name)
            is_said = status is not None and all(word in status.message for word in words)
            return status if is_said else None

        try:
            return self.wait(found, timeout_s)
        except AssertionError:
            now_s = time.monotonic()
            said = {
                f"{key}, {now_s - self._told_s[key]:.1f} s ago": item.message
                for key, item in statuses.items()
            }
            message = f"the diagnostics of {name!r} never said {words}; last {said}"
            raise AssertionError(message) from None

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        """Set a parameter of another node and return what it answered."""
        client = AsyncParameterClient(self.node, node)
        self.wait(client.services_are_ready, what=f"the parameters of {node}")
        future = client.set_parameters([Parameter(name, value=value)])
        self.wait(future.done, what=f"the answer of {node}")
        return future.result().results[0]

    def call(self, kind: Any, name: str, request: Any, timeout_s: float = 40.0) -> Any:
        """Call a service and return its answer."""
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, timeout_s, f"the service {name}")
        future = client.call_async(request)
        self.wait(future.done, timeout_s, f"the answer of {name}")
        return future.result()

    def _keep_statuses(self, message: Any) -> None:
        assert self._statuses is not None
        self._statuses |= {status.name: status for status in message.status}
        self._told_s |= dict.fromkeys((s.name for s in message.status), time.monotonic())


def values(status: Any) -> dict[str, str]:
    """Return the figures of a diagnostic status."""
    return {item.key: item.value for item in status.values}
