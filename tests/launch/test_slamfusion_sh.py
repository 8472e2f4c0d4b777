"""``launch_scripts/slamfusion.sh``: what a person at a terminal does with it."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid

from slamfusion.io import load_map
from slamfusion.ros import qos
from tests.cli.command import INSTALLED, ROOT
from tests.ros.drives import offline_log, write_log
from tests.ros.live import Observer, Process, Processes

pytestmark = pytest.mark.ros

PARAMETERS = str(ROOT / "launch_scripts" / "slamfusion.yaml")
LEAST_SHM_KB = 327680
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - the real one
SCRIPT = str(ROOT / "launch_scripts" / "slamfusion.sh")


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


def start(
    processes: Processes, *words: str, before: tuple[str, ...] = (), command: Path = INSTALLED
) -> Process:
    env = {"SLAMFUSION": str(command)}
    return processes.start("slamfusion.sh", [*before, SCRIPT, *words], env)


def wait_said(observer: Observer, script: Process, words: str, timeout_s: float = 50.0) -> None:
    observer.wait(lambda: words in script.text(), timeout_s, f"{words!r}")


def test_a_log_is_fused_by_all_three_and_reported(
    domain: int, processes: Processes, tmp_path: Path
):
    log, out = write_log(tmp_path, 40), tmp_path / "a folder" / "live"
    # The file says otherwise of lockstep, and of how long to wait.
    words = ("-o", str(out), "--lockstep", "--params", PARAMETERS)
    script = start(processes, str(log), *words)
    assert script.wait(100.0) == 0
    assert nodes_in(domain) == {}
    for name in ("tinyslam", "gmapping", "graph", "fused"):
        assert (load_map(out / f"{name}.yaml").cells == 100).sum() > 200, name
    saved, wanted = load_map(out / "tinyslam.yaml"), offline_log("tinyslam", log)
    assert saved.cells.shape == wanted.cells.shape
    assert ((saved.cells == 100) == (wanted.cells >= 65)).all()
    assert (out / "report" / "report.html").stat().st_size > 10_000
    assert "unknown parameter" not in script.text()
    assert f"the fused map: {out}/fused.yaml" in script.text()


def test_a_node_that_dies_is_started_later_each_time_and_ctrl_c_ends_the_whole_group(
    domain: int, processes: Processes, observer: Observer
):
    words = ("--producers", "tinyslam", "--", "-r", "__ns:=/robot1")
    script = start(processes, *words, before=("setsid", "--wait"))
    statuses = observer.statuses()

    def wait_for_both() -> None:
        wanted = {f"robot1/{name}" for name in ("tinyslam", "fusion")}
        observer.wait(
            lambda: {key.partition(":")[0] for key in statuses} >= wanted, 50.0, "both nodes"
        )

    for number, pause in enumerate((1, 2)):
        observer.wait(
            lambda: [pid for pid, words in nodes_in(domain).items() if "node fusion" in words],
            50.0,
            "the fusion",
        )
        (victim,) = [pid for pid, words in nodes_in(domain).items() if "node fusion" in words]
        os.kill(victim, signal.SIGKILL)
        words = f"fusion has ended with 137; it is started again, in its frame, in {pause} s"
        wait_said(observer, script, words, 10.0)
        assert script.is_running, number
    observer.listen(0.5)
    statuses.clear()
    wait_for_both()
    # Large maps get their shared memory, where there is some.
    has_room = shutil.disk_usage(SHARED_MEMORY).free >= LEAST_SHM_KB * 1024
    for pid in nodes_in(domain):
        environment = Path(f"/proc/{pid}/environ").read_bytes()
        assert (b"fastdds-large-maps.xml" in environment) == has_room
    (leader,) = {os.getpgid(pid) for pid in nodes_in(domain)}
    assert leader != os.getpgid(0)
    os.killpg(leader, signal.SIGINT)
    assert script.wait(20.0) == 0
    assert "stopping every node" in script.text()
    assert nodes_in(domain) == {}
    assert "gmapping" not in script.text()


@pytest.mark.full
def test_ctrl_c_in_mid_log_saves_what_there_is(
    domain: int, processes: Processes, observer: Observer, tmp_path: Path
):
    log, out = write_log(tmp_path, 400), tmp_path / "live"
    out.mkdir()
    (out / "graph.yaml").write_text("of an earlier run")
    fused = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    # As a script that runs in the background of another one: it ignores SIGINT, which bash alone
    # cannot undo.
    before = ("env", "--ignore-signal=INT", "setsid", "--wait")
    words = (str(log), "-o", str(out), "--producers", "tinyslam,graph")
    script = start(processes, *words, before=before)
    observer.wait(lambda: len(fused) >= 3, 60.0, "some fused maps")
    (leader,) = {os.getpgid(pid) for pid in nodes_in(domain)}
    os.killpg(leader, signal.SIGINT)
    assert script.wait(20.0) == 0
    assert nodes_in(domain) == {}
    text = script.text()
    assert "stopping every node" in text
    assert "scans of" in text
    assert "the maps that have come are saved" in text
    assert f"stopped before the end of the log; the fused map so far: {out}/fused.yaml" in text
    assert "started again" not in text
    for name in ("tinyslam", "graph", "fused"):
        assert (load_map(out / f"{name}.yaml").cells == 100).sum() > 100, name
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(
    ("folder", "said"), [("file/live", "cannot be made"), ("/proc", "cannot be written to")]
)
def test_a_folder_that_cannot_be_written_to_is_found_before_the_log_plays(
    folder: str, said: str, domain: int, processes: Processes, tmp_path: Path
):
    (tmp_path / "file").write_text("")
    out = tmp_path / folder
    script = start(processes, str(write_log(tmp_path, 4)), "-o", str(out))
    assert script.wait(30.0) == 1
    assert script.text() == f"error: {out}: {said}; name another folder with -o\n"
    assert nodes_in(domain) == {}


def test_a_node_that_cannot_start_ends_all(domain: int, processes: Processes, tmp_path: Path):
    """The nodes are a stand-in: one ends at once, the other waits to be stopped."""
    command = tmp_path / "slamfusion"
    command.write_text('#!/bin/sh\nwhile [ "$2" = fusion ]; do sleep 0.2; done\nexit 1\n')
    command.chmod(0o755)
    script = start(processes, "--only", "tinyslam", command=command)
    assert script.wait(60.0) == 1
    assert "has ended with 1 3 times in a row soon after its start" in script.text()
    assert nodes_in(domain) == {}


@pytest.mark.full
def test_a_node_whose_start_takes_long_and_fails_ends_all(processes: Processes, tmp_path: Path):
    command = tmp_path / "slamfusion"
    command.write_text("#!/bin/sh\nsleep 11\nexit 3\n")
    command.chmod(0o755)
    script = processes.start("slamfusion.sh", [SCRIPT], {"SLAMFUSION": str(command)})
    assert script.wait(60.0) == 1
    assert "has ended with 3 3 times in a row" in script.text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--log", "absent.log"), "absent.log: no such log"),
        (("--params", "absent.yaml"), "absent.yaml: no such file"),
        (("--log",), "--log needs a value"),
        (("--fast",), "unknown option --fast"),
        ((str(ROOT / "README.md"),) * 2, "two logs"),
    ],
)
def test_wrong_words_are_refused(words: tuple[str, ...], said: str, processes: Processes):
    script = start(processes, *words)
    assert script.wait(30.0) == 1
    assert f"error: {said}" in script.text()
