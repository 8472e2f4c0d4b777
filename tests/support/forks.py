"""Starts the installed command as a process of its own without loading Python anew each time.

One server for each test process has imported what the command imports, and does nothing else: no
device is open, no thread runs. It is forked for each start; the fork takes the environment, folder
and files that it is given and runs the installed script from its first line to its exit code.

A fork has what was loaded with Python itself, so a start whose environment differs from the
server's in anything that is read then is an ordinary one: see ``Server.can_start``.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import inspect
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

# Read when a node or a device begins, not when Python or a library is loaded.
READ_LATE = {"ROS_DOMAIN_ID", "POCL_DEVICES"}
# Written by pytest, and by OpenCV and pyopencl where they are loaded.
NOT_READ = {"PYTEST_CURRENT_TEST", "LD_LIBRARY_PATH", "PYOPENCL_HOME"}
# With these, coverage measures processes that are started, and would not know a fork.
MEASURED = ("COV_CORE_", "COVERAGE_")
# One request or answer; an environment is the most of it.
MOST_BYTES = 1 << 17
STREAMS = 3
# What the package has loaded where it is used, without what is below it: a fork has it loaded.
LOADED_LATE = [
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "pandas",
    "rich.console",
    "rich.progress",
    "rich.table",
    "scipy.fft",
    "scipy.ndimage",
    "scipy.sparse.csgraph",
    "scipy.sparse.linalg",
    "scipy.spatial.transform",
]


class Forked:
    """A started command, with the methods of ``subprocess.Popen`` that tests use.

    Attributes:
        pid: of the process.
        returncode: None while it runs; minus the signal that ended it.
    """

    def __init__(self, server: Server, pid: int) -> None:
        self._server = server
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, or None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code.

        Raises:
            subprocess.TimeoutExpired: it runs longer.
        """
        if self.returncode is None:
            self.returncode = self._server.wait(self.pid, timeout)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it without a chance to say good-bye."""
        self.send_signal(signal.SIGKILL)


class Server:
    """The process that is forked.

    Args:
        script: the installed command.
        modules: what it may import, with their submodules; what is not installed is passed over.
        env: the whole environment that it begins with.
        without: packages below those that are not imported.
    """

    def __init__(
        self,
        script: Path,
        modules: Iterable[str],
        env: Mapping[str, str],
        without: Iterable[str] = (),
    ) -> None:
        self._env = _read_early(env)
        self._is_usable = not any(name.startswith(MEASURED) for name in env)
        self._codes: dict[int, int] = {}
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        words = [str(script), ",".join(modules), ",".join(without), str(theirs.fileno())]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__, *words],
                env=dict(env),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        atexit.register(self._end)

    def _end(self) -> None:
        """Let it end with the test process."""
        self._channel.close()
        self._process.wait()

    def can_start(self, env: Mapping[str, str]) -> bool:
        """Return whether a fork is what a process with this environment would be."""
        return self._is_usable and _read_early(env) == self._env

    def start(
        self, arguments: list[str], env: Mapping[str, str], cwd: Path | None, files: list[int]
    ) -> Forked:
        """Start the command.

        Args:
            arguments: of the command.
            env: its whole environment.
            cwd: its folder; None is that of the tests.
            files: descriptors of its standard input, output and error.
        """
        late = {name: env[name] for name in READ_LATE & env.keys()}
        request = {"arguments": arguments, "env": late, "cwd": str(cwd or Path.cwd())}
        socket.send_fds(self._channel, [json.dumps(request).encode()], files)
        while True:
            answer = self._hear()
            if "code" not in answer:
                return Forked(self, answer["pid"])

    def wait(self, pid: int, timeout: float | None) -> int:
        """Return the exit code of a process that was started; see ``Forked.wait``."""
        until_s = None if timeout is None else time.monotonic() + timeout
        while pid not in self._codes:
            left_s = None if until_s is None else max(until_s - time.monotonic(), 0.0)
            if not select.select([self._channel], [], [], left_s)[0]:
                raise subprocess.TimeoutExpired([str(pid)], timeout or 0.0)
            self._hear()
        return self._codes.pop(pid)

    def _hear(self) -> dict[str, Any]:
        """Take one answer; exit codes are kept."""
        data = self._channel.recv(MOST_BYTES)
        if not data:
            raise RuntimeError("the process that is forked for each start has ended")
        answer: dict[str, Any] = json.loads(data)
        if "code" in answer:
            self._codes[answer["pid"]] = answer["code"]
        return answer


def _read_early(env: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in env.items() if name not in READ_LATE | NOT_READ}


def _load(modules: Iterable[str], without: Iterable[str]) -> None:
    """Import modules and all below them, except those that only run."""
    for name in modules:
        with contextlib.suppress(ImportError):
            module = importlib.import_module(name)
            for found in pkgutil.iter_modules(getattr(module, "__path__", []), f"{name}."):
                if found.name not in without and not found.name.endswith("__main__"):
                    _load([found.name], without)


def _serve(channel: socket.socket) -> tuple[dict[str, Any], list[int]]:
    """Fork for each request and tell of each end; return in the fork, with its request and files.

    Where the channel closes, the server ends.
    """
    woken, wake = os.pipe()
    for end in (woken, wake):
        os.set_blocking(end, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to the forks too
    while True:
        ready, _, _ = select.select([channel.fileno(), woken], [], [])
        if woken in ready:
            with contextlib.suppress(BlockingIOError):
                os.read(woken, MOST_BYTES)
            _tell_ends(channel)
        if channel.fileno() not in ready:
            continue
        data, files, _, _ = socket.recv_fds(channel, MOST_BYTES, STREAMS)
        if not data:
            sys.exit()
        pid = os.fork()
        if pid == 0:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for end in (woken, wake):
                os.close(end)
            channel.close()
            return json.loads(data), files
        for file in files:
            os.close(file)
        channel.send(json.dumps({"pid": pid}).encode())


def _tell_ends(channel: socket.socket) -> None:
    """Send the exit code of each process that has ended."""
    with contextlib.suppress(ChildProcessError):  # none is left
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            code = os.waitstatus_to_exitcode(status)
            channel.send(json.dumps({"pid": pid, "code": code}).encode())


def _become(script: str, request: dict[str, Any], files: list[int]) -> None:
    """Run the installed script in this process, as if it had just been started."""
    for number, file in enumerate(files):
        os.dup2(file, number)
        os.close(file)
    os.chdir(request["cwd"])
    for name in READ_LATE - request["env"].keys():
        os.environ.pop(name, None)
    os.environ.update(request["env"])
    sys.argv = [script, *request["arguments"]]
    try:
        runpy.run_path(script, run_name="__main__")
    except SystemExit as ended:
        if ended.code is not None and not isinstance(ended.code, int):
            raise
        _end(ended.code or 0)
    _end(0)


def _end(code: int) -> None:
    """End this process in the order in which Python does, but take no object apart.

    That would copy the memory of all libraries: 0.11 s of processor time for a fork, not 0.01 s.
    The ends of the drivers' libraries are run.
    """
    threading._shutdown()  # type: ignore[attr-defined]  # noqa: SLF001 - waits for all but daemons
    atexit._run_exitfuncs()  # noqa: SLF001
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            code = 120  # as Python says it
    ctypes.PyDLL(None).exit(code)  # no other thread of Python runs meanwhile


if __name__ == "__main__":
    path, wanted, unwanted, number = sys.argv[1:]
    sys.path[0] = str(Path(path).parent)  # as of a script that is started
    gc.disable()
    _load(wanted.split(","), unwanted.split(","))
    for late in LOADED_LATE:
        importlib.import_module(late)
    # Producers of other packages are looked for in the files of all: 0.1 s for a fork.
    pkgutil.resolve_name("slamfusion.slam.registry:producer_names")()
    # Whoever logs with rclpy is asked for its module, and the first answer looks at the files of
    # all that are loaded: 0.09 s of processor time for a fork.
    if "rclpy" in sys.modules:
        inspect.getmodule(inspect.currentframe())
    # What was loaded is not looked through at each end: 0.07 s of processor time for a fork, not
    # 0.4 s.
    gc.collect()
    gc.freeze()
    gc.enable()
    _become(path, *_serve(socket.socket(fileno=int(number))))
