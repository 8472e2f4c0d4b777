"""A fork of the loaded command is a process like one that is started."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests.cli.command import SAMPLE, json_of, run, server

pytestmark = pytest.mark.once


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--version",), 0),
        (("evaluate", SAMPLE / "map_a.yaml"), 2),
        (("align", "absent.yaml", "absent.yaml"), 1),
        (("graph", "optimize", "bad.g2o", "--json"), 1),
    ],
)
def test_a_fork_says_and_ends_as_a_start_does(
    tmp_path: Path, arguments: tuple[str, ...], code: int
) -> None:
    (tmp_path / "bad.g2o").write_text("no graph\n", encoding="utf-8")
    forked, started = (run(*arguments, cwd=tmp_path, is_anew=anew) for anew in (False, True))
    assert forked.returncode == code
    assert vars(forked) == vars(started)


def test_each_fork_is_a_process_of_its_own_and_tells_its_signal() -> None:
    work = ["align", *(str(SAMPLE / f"map_{n}.yaml") for n in "ab"), "--device", "numpy"]
    with Path(os.devnull).open("r+b") as nothing:
        files = 3 * [nothing.fileno()]
        first, second = (server().start(work, os.environ, None, files) for _ in range(2))
    assert len({first.pid, second.pid, os.getpid()}) == 3
    with pytest.raises(subprocess.TimeoutExpired):
        first.wait(0.0)
    second.kill()
    assert (second.wait(20.0), first.poll()) == (-signal.SIGKILL, None)
    first.send_signal(signal.SIGINT)
    assert first.wait(20.0) == 130
    first.kill()  # it is gone; its number may be another's


def test_a_fork_opens_the_devices_that_its_own_environment_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Opening one in the test process names some for all that it starts afterwards."""
    monkeypatch.delenv("POCL_DEVICES", raising=False)
    assert server().can_start(os.environ)
    monkeypatch.setenv("POCL_DEVICES", "basic")
    assert server().can_start(os.environ)
    forked, started = (run("devices", "--json", is_anew=anew) for anew in (False, True))
    assert json_of(forked) == json_of(started)
    names = " ".join(device["name"] for device in json_of(forked)["devices"])
    assert "basic" in names
    assert "pthread" not in names


def test_what_is_read_while_a_library_loads_is_no_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    assert server().can_start({**os.environ, "ROS_DOMAIN_ID": "7"})
    assert not server().can_start({**os.environ, "OMP_NUM_THREADS": "17"})
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    assert not server().can_start(os.environ)
