"""``launch_scripts/slamfusion.sh``: every node with one command, and no process after it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.io import load_map
from tests.cli.command import INSTALLED, ROOT
from tests.ros.drives import offline_log, write_log
from tests.ros.live import Observer, Process, Processes

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


def test_a_log_ends_with_the_saved_maps_and_the_report(
    domain: int, processes: Processes, tmp_path: Path
):
    log, out = write_log(tmp_path, 40), tmp_path / "live"
    script = start(
        processes, "--log", str(log), "--lockstep", "--only", "tinyslam graph", "-o", str(out)
    )
    assert script.wait(100.0) == 0
    assert nodes_in(domain) == {}
    assert (out / "report" / "report.html").stat().st_size > 10_000
    saved = load_map(out / "tinyslam.yaml")
    wanted = offline_log("tinyslam", log)
    assert saved.cells.shape == wanted.cells.shape
    assert ((saved.cells == 100) == (wanted.cells >= 65)).all()
    fused = load_map(out / "fused.yaml")
    assert (fused.cells == 100).sum() > 200


def test_a_node_that_dies_is_started_again_and_ctrl_c_ends_all(
    domain: int, processes: Processes, observer: Observer
):
    script = start(processes, "--only", "tinyslam", "--", "-r", "__ns:=/robot1")
    statuses = observer.statuses()

    def has(name: str) -> bool:
        return any(key.startswith(f"robot1/{name}: ") for key in statuses)

    observer.wait(lambda: has("tinyslam") and has("fusion"), 60.0, "both nodes")
    (victim,) = [pid for pid, words in nodes_in(domain).items() if "node tinyslam" in words]
    os.kill(victim, signal.SIGKILL)
    words = "tinyslam has ended with 137; it is started again, with an empty map"
    observer.wait(lambda: words in script.text(), 60.0, "the word that it is started again")
    observer.listen(1.0)
    statuses.clear()
    observer.wait(lambda: has("tinyslam") and has("fusion"), 60.0, "both nodes again")
    assert script.interrupt(40.0) == 0
    assert "stopping every node" in script.text()
    assert nodes_in(domain) == {}


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
