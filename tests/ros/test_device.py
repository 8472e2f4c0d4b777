"""What is wrong with a node's device stands in its log and its diagnostics."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.compute import pocl_cache
from slamfusion.ros.base import Diagnostics, Level
from slamfusion.ros.device import open_node_device
from tests.ros.live import Observer, Processes

pytestmark = [pytest.mark.ros, pytest.mark.once]


class Log:
    """Keeps what a node's logger is told."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warning(self, text: str) -> None:
        self.warnings.append(text)


def test_without_any_room_for_kernels_the_node_says_that_numpy_computes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in (pocl_cache.FOLDER, pocl_cache.CACHES):
        monkeypatch.setenv(name, os.devnull)
    monkeypatch.setattr(pocl_cache, "_why_not", lambda _: os.strerror(28))
    monkeypatch.setattr("slamfusion.compute.device.find_devices", list)
    log = Log()
    diagnostics = Diagnostics(log)
    pocl_cache.find_cache.cache_clear()
    try:
        assert open_node_device("auto", diagnostics).name.startswith("NumPy")
    finally:
        pocl_cache.find_cache.cache_clear()
    level, text = diagnostics.worst()
    assert level == Level.WARN
    assert f"PoCL's cache {os.devnull} cannot be written" in text
    assert "NumPy computes instead" in text
    assert log.warnings == [text]


def test_a_device_that_is_fine_is_no_warning() -> None:
    diagnostics = Diagnostics(Log())
    open_node_device("numpy", diagnostics)
    assert diagnostics.worst() == (Level.OK, "ok")


@pytest.mark.full
def test_a_node_without_pocls_cache_says_so_and_works(
    processes: Processes, observer: Observer, tmp_path: Path
) -> None:
    cache = tmp_path / "file"
    cache.write_bytes(b"")
    node = processes.node("tinyslam", env={pocl_cache.FOLDER: str(cache)})
    words = f"PoCL's cache {cache} cannot be written", "built for this process only"
    status = observer.wait_status("tinyslam: slam", *words)
    assert status.level == bytes([Level.WARN])
    assert node.interrupt() == 0
    (line,) = [line for line in node.text().splitlines() if "[WARN]" in line and words[0] in line]
    assert words[1] in line
