"""``slamfusion live`` against a running fusion node."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

import rclpy
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap
from std_srvs.srv import Trigger

from slamfusion.cli.program import run_program
from slamfusion.io.map_server import load_map, save_map
from slamfusion.ros import messages, qos
from slamfusion.ros.live_client import LiveClient, LiveNodeError
from tests.cli.command import INSTALLED
from tests.fusion.live.maps import three
from tests.ros.fused import Makers, start_fusion
from tests.ros.live import Observer, Processes
from tests.support.documents import check_document

pytestmark = [pytest.mark.ros, pytest.mark.once]

NODE = "robot1/fusion"


def a_saved_map_becomes_an_input(observer: Observer, folder: Path) -> None:
    def load(url: str) -> LoadMap.Response:
        return observer.call(LoadMap, "robot1/load_map", LoadMap.Request(map_url=url))

    yaml, _ = save_map(three()["c"], folder / "plan")
    answer = load(f"file://{yaml}")
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    found = messages.grid_from_message(answer.map, "plan")
    assert np.array_equal(found.cells, load_map(yaml).cells)
    observer.wait_status(f"{NODE}: input plan", "walls match")
    # It is read again, as it is by then.
    save_map(three()["b"], folder / "plan")
    assert len(load(str(yaml)).map.data) == three()["b"].cells.size
    observer.wait_status(f"{NODE}: fusion", "plan is removed from the inputs", "3 of 4 inputs vote")
    (folder / "plan.yaml").write_text("image: none.pgm")
    assert load(str(yaml)).result == LoadMap.Response.RESULT_INVALID_MAP_DATA
    observer.wait_status(f"{NODE}: input plan", "walls match")  # the one before stays
    assert load(str(folder / "none.yaml")).result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
    observer.wait_status(f"{NODE}: fusion", "not loaded: ", "none.yaml")


def test_a_running_fusion_answers(
    processes: Processes, observer: Observer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def live(*words: str, code: int = 0) -> dict[str, Any]:
        assert run_program(["live", *words, "--node", NODE, "--json"]) == code
        document = json.loads(capfd.readouterr().out)
        check_document(document, f"live {words[0]}", failed=bool(code))
        return dict(document)

    makers = Makers(observer, prefix="robot1/")
    fusion = start_fusion(processes, "-r", "__ns:=/robot1", save_path=str(tmp_path / "lab"))
    observer.publisher(OccupancyGrid, "robot1/c/map", qos.SENSOR)
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
    other = str(tmp_path / "other")
    saved = live("save", "--path", f"{other}.yaml", "--format", "bmp", "--mode", "raw")
    assert saved == {"success": True, "message": f"{other}.yaml"}
    assert np.array_equal(load_map(f"{other}.yaml").cells, load_map(tmp_path / "lab.yaml").cells)
    assert (tmp_path / "other.bmp").exists()
    refused = live("save", "--path", "/nowhere/lab", code=1)
    assert "not saved: path '/nowhere/lab' leads out of" in refused["message"]
    assert "names no file; add a name" in live("save", "--path", str(tmp_path), code=1)["message"]
    for of_folder in (f"{tmp_path}/", ""):
        assert "names no file" in live("set", "save_path", of_folder, code=1)["message"]
    a_saved_map_becomes_an_input(observer, tmp_path)
    assert live("set", "max_publish_rate_hz", "2.5")["success"]
    answer = {"success": True, "message": "live.search_pause_s is 1000.0 now"}
    assert live("set", "live.search_pause_s", "1e3") == answer
    for text in ("*/never", ""):
        answer = {"success": True, "message": f"discover is {text!r} now"}
        assert live("set", "discover", text) == answer
    refused = live("set", "max_publish_rate_hz", "-1.0", code=1)
    assert not refused["success"]
    assert "max_publish_rate_hz" in refused["message"]
    assert live("reset")["success"]

    observer.wait(lambda: "b: walls match" in watching.text())
    watching.signal(signal.SIGINT)
    assert watching.wait() == 0
    assert "c: STALE no map on '/robot1/c/map' yet" in watching.text()
    assert "offers less" not in fusion.text(), "the map is read with what its writer offers"


def test_a_node_that_is_not_there_is_named(observer: Observer) -> None:
    message = "/fusion: waited 3 s for diagnostics; running nodes: /observer"
    assert observer.node.get_name() == "observer"
    with LiveClient("fusion", 3.0) as client, pytest.raises(LiveNodeError, match=message):
        client.status()
    message = "/observer: waited 3 s for diagnostics; it runs, but is no fusion node or is still"
    with LiveClient("observer", 3.0) as client, pytest.raises(LiveNodeError, match=message):
        client.status()


def test_only_the_node_that_is_named_carries_out_a_command(observer: Observer) -> None:
    asked: list[Any] = []
    observer.node.create_service(Trigger, "reset", lambda request, _: asked.append(request))
    message = "/fusion: waited 2 s for the service /reset; running nodes: /observer"
    with LiveClient("fusion", 2.0) as client, pytest.raises(LiveNodeError, match=message):
        client.call("reset")
    other = rclpy.create_node("other", context=observer.node.context)
    other.create_service(Trigger, "reset", lambda request, _: asked.append(request))
    message = "/reset is a service of /observer and /other, and either could answer"
    with LiveClient("other", 20.0) as client, pytest.raises(LiveNodeError, match=message):
        client.call("reset")
    observer.listen(0.2)
    assert not asked
    other.destroy_node()
