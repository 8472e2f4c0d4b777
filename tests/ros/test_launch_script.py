"""``launch_scripts/slamfusion.sh``: every node with one command, and no process after it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from tests.cli.command import INSTALLED, ROOT
from tests.ros.live import Process, Processes

pytestmark = pytest.mark.ros

SCRIPT = ROOT / "launch_scripts" / "slamfusion.sh"


def nodes_in(domain: int) -> dict[int, str]:
    """The running nodes of a domain: process and command line."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            environment = (folder / "environ").read_bytes().split(b"\0")
            words = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:  # it has ended, or is another user's
            continue
        if f"ROS_DOMAIN_ID={domain}".encode() in environment and b"node" in words:
            found[int(folder.name)] = b" ".join(words).decode()
    return found


def start(processes: Processes, *words: str) -> Process:
    env = {"SLAMFUSION": str(INSTALLED)}
    return processes.start("slamfusion.sh", [str(SCRIPT), *words], env)


def test_a_node_that_cannot_start_ends_all(domain: int, processes: Processes):
    script = start(processes, "--only", "tinyslam", "--", "-p", "device:=absent")
    assert script.wait(60.0) == 1
    assert "has ended with 1 3 times in a row soon after its start" in script.text()
    assert nodes_in(domain) == {}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--log", "absent.log"), "absent.log: no such log"),
        (("--params", "absent.yaml"), "absent.yaml: no such file"),
        (("--log",), "--log needs a value"),
        (("--fast",), "unknown option --fast"),
    ],
)
def test_wrong_words_are_refused(words: tuple[str, ...], said: str, processes: Processes):
    script = start(processes, *words)
    assert script.wait(30.0) == 1
    assert f"error: {said}" in script.text()
