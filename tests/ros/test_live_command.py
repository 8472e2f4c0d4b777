"""``slamfusion live`` against a running fusion node."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.cli.program import run_program
from slamfusion.ros.live_client import LiveClient, LiveNodeError
from tests.cli.command import INSTALLED
from tests.fusion.live.maps import three
from tests.ros.fused import Makers, start_fusion
from tests.ros.live import Observer, Processes
from tests.support.documents import check_document

pytestmark = [pytest.mark.ros, pytest.mark.once]

NODE = "robot1/fusion"


def test_a_running_fusion_answers(
    processes: Processes,
    observer: Observer,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def live(*words: str, code: int = 0) -> dict[str, Any]:
        assert run_program(["live", *words, "--node", NODE, "--json"]) == code
        document = json.loads(capfd.readouterr().out)
        check_document(document, f"live {words[0]}", failed=bool(code))
        return dict(document)

    makers = Makers(observer, prefix="robot1/")
    start_fusion(processes, "-r", "__ns:=/robot1", save_path=str(tmp_path / "lab"))
    for name in "ab":
        makers.send(three()[name])
    watching = processes.start("watch", [str(INSTALLED), "live", "watch", "--node", NODE])
    observer.wait_status(f"{NODE}: fusion", "2 of 3 inputs vote; not: c")

    found = live("status")
    assert found["node"] == f"/{NODE}"
    assert "2 of 3 inputs vote" in found["fusion"]["message"]
    assert [(line["name"], line["level"]) for line in found["inputs"]] == [
        ("a", "ok"),
        ("b", "ok"),
        ("c", "stale"),
    ]
    saved = live("save")
    assert saved == {"success": True, "message": str(tmp_path / "lab.yaml")}
    assert (tmp_path / "lab.pgm").exists()
    assert live("set", "max_publish_rate_hz", "2.5")["success"]
    refused = live("set", "max_publish_rate_hz", "-1.0", code=1)
    assert not refused["success"]
    assert "max_publish_rate_hz" in refused["message"]
    assert live("reset")["success"]

    observer.wait(lambda: "b: walls match" in watching.text())
    watching.signal(signal.SIGINT)
    assert watching.wait() == 0
    assert "c: STALE no map on '/robot1/c/map' yet" in watching.text()


def test_a_node_that_is_not_there_is_named(observer: Observer) -> None:
    message = "/fusion: heard no diagnostics in 0.5 s; nodes that are there: /observer"
    with LiveClient("fusion", 0.5) as client, pytest.raises(LiveNodeError, match=message):
        client.status()
    del observer
