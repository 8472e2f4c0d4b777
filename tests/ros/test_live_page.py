"""The live page in a real browser against real nodes that map a log."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from slamfusion.config import FusionNodeConfig
from slamfusion.errors import ConfigError
from slamfusion.fusion.live import LiveInput, State
from slamfusion.fusion.live.fusion import InputMessage
from slamfusion.fusion.live.inputs import Fit
from slamfusion.fusion.live.session import FusedMap, FusionState
from slamfusion.geometry import Pose2
from slamfusion.palette import FREE_RGB, UNKNOWN_RGB, WALL_RGB
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, Status
from slamfusion.ros.fusion_node import FusionNode
from slamfusion.ros.input_health import HeardPose
from slamfusion.ros.live_page import LivePage
from tests.ros.drives import write_log
from tests.ros.live import Observer, Process, Processes
from tests.support.browser import browser_page
from tests.web.maps import noise, painted, texts, tiles
from tests.web.test_server import batch, say

pytestmark = [pytest.mark.ros, pytest.mark.once]

PRODUCERS = ("tinyslam", "graph")
# The picture of the fused map alone, cell by cell, rows from the lowest.
READ_CELLS = """([height, width]) => {
  const canvas = document.querySelector("#map");
  const [left, top] = canvas.view.pixelOf("fused", height - 1, 0);
  const { data } = canvas.getContext("2d").getImageData(left, top, width, height);
  return Array.from(data);
}"""


def socket(url: str, origin: str = "") -> ClientConnection:
    """Connect to the socket of the page at an address, as that page or one from elsewhere."""
    own = url.partition("/#")[0]
    return connect(own.replace("http", "ws", 1) + "/ws", origin=origin or own, max_size=None)


def heard(page: ClientConnection, is_done: Callable[[list[Any]], object]) -> list[Any]:
    """Return what a page is told until it holds something."""
    messages: list[Any] = []
    until_s = time.monotonic() + 10.0
    while not is_done(messages):
        assert time.monotonic() < until_s, [item for item in messages if isinstance(item, str)]
        messages += batch(page)
    return messages


def test_an_input_called_fused_comes_and_goes_beside_the_fused_map() -> None:
    urls: list[str] = []
    base = SimpleNamespace(name="fusion", log=SimpleNamespace(info=urls.append))
    live = LivePage(base, FusionNodeConfig(page_port=0), lambda name: (True, name))
    grids = {name: noise(40, 50, seed=seed) for seed, name in enumerate(("fused", "input"))}
    source = SimpleNamespace(name="fused", pose=HeardPose(Pose2(1.0, 2.0, 0.0), None, 0.0, 0.0))
    place = Pose2(3.0, 0.0, 0.0)
    came, fit = InputMessage(maps=1), Fit(0.7, 0.8, is_tracked=True)
    record = LiveInput("fused", came, State.TRACKED, "fits", place, fit, None)
    lines = [Status("fusion", Level.OK, "all"), Status("input fused", Level.OK, "fits")]
    with closing(live), socket(urls[0].rpartition(" ")[2]) as page:
        say(page, type="hello", token="")
        live.put_fused(FusedMap(grids["fused"], grids["fused"], 1.0))
        live.put_input("fused", grids["input"])
        live.put_pose("fused", source.pose.pose)
        live.show(lines, FusionState({"fused": record}), [source])
        told = heard(
            page,
            lambda told: (
                all(tiles(told, layer) for layer in ("fused", "fused (input)"))
                and all(texts(told, kind) for kind in ("status", "trail"))
            ),
        )
        for layer, name in (("fused", "fused"), ("fused (input)", "input")):
            cells = painted(tiles(told, layer), 40, 50, (0, 0))
            assert np.array_equal(cells, grids[name].cells)
        status = texts(told, "status")[-1]
        assert [item["name"] for item in status["inputs"]] == ["fused (input)"]
        assert status["inputs"][0]["score"] == 0.7
        assert status["poses"] == [{"name": "fused (input)", "pose": [4.0, 2.0, 0.0]}]
        assert texts(told, "trail")[-1]["name"] == "fused (input)"
        live.show(lines[:1], FusionState(), [])
        told = heard(page, lambda told: texts(told, "layer"))
        assert texts(told, "layer") == [{"type": "layer", "name": "fused (input)", "gone": True}]


def address(node: Process, observer: Observer) -> str:
    """Return the page's address, which the node logs."""

    def said() -> str | None:
        found = re.search(r"the live page: (http://\S+)", node.text())
        return found and found[1]

    return str(observer.wait(said, what="the page's address"))


def votes(page: Any, name: str, wanted: str, timeout_s: float) -> None:
    selector = f'#inputs li[data-name="{name}"][data-votes="{wanted}"]'
    page.wait_for_selector(selector, timeout=1e3 * timeout_s)


def test_a_wrong_token_is_refused_before_the_device_is_opened(
    observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLAMFUSION_PAGE_TOKEN", "short")
    words = ["--ros-args", "-p", "page:=true", "-p", "device:=absent"]
    with pytest.raises(ConfigError, match="SLAMFUSION_PAGE_TOKEN: wanted 24 or more"):
        FusionNode(context=observer.node.context, arguments=words)


def test_the_page_shows_what_the_nodes_publish(
    processes: Processes, observer: Observer, tmp_path: Path
) -> None:
    inputs = [f"{name}/map" for name in PRODUCERS]
    (tmp_path / "saved").mkdir()
    fusion = processes.node(
        "fusion",
        inputs=inputs,
        page=True,
        page_port=0,
        live__stale_after_s=1000.0,
        save_path=str(tmp_path / "saved" / "lab"),
    )
    nodes = {name: processes.node(name, use_sim_time=True) for name in PRODUCERS}
    log = write_log(tmp_path, 30)
    processes.node("player", file=str(log), lockstep=True, wait_for=list(PRODUCERS))
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    url = address(fusion, observer)

    with pytest.raises(InvalidStatus, match="403"):
        socket(url, "http://evil.example")

    with browser_page() as page:
        page.goto(url)
        for name in PRODUCERS:
            votes(page, name, "true", 40.0)
        observer.listen(2.0)
        assert_same_pixels(page, observer, maps)

        page.click("#save")
        page.wait_for_selector("#answer.good", timeout=1e4)
        assert (tmp_path / "saved" / "lab.yaml").exists()

        killed_s = time.monotonic()
        nodes["tinyslam"].kill()
        votes(page, "tinyslam", "false", 4.0)
        assert time.monotonic() - killed_s < 4.0
        assert "tinyslam does not vote" in page.text_content("#events li >> nth=0")

        page.goto("about:blank")
        page.goto(url.partition("#")[0])
        votes(page, "graph", "true", 10.0)
        assert page.is_hidden("#commands"), "without the token one only looks"
    assert fusion.interrupt() == 0
    assert "Traceback" not in fusion.text()


def assert_same_pixels(page: Any, observer: Observer, maps: list[OccupancyGrid]) -> None:
    """The map on the page is the newest that was published, cell by cell."""
    for name in PRODUCERS:
        page.uncheck(f'#layers li[data-name="{name}"] input[type=checkbox]')
    page.uncheck("#show-paths")
    page.click("#pixels")
    until_s = time.monotonic() + 20.0
    while True:
        grid = messages.grid_from_message(maps[-1], "fused")
        assert grid.height < 700, "the map has to fit into the window"
        wanted = np.empty((*grid.cells.shape, 3), dtype=np.uint8)
        for value, rgb in ((-1, UNKNOWN_RGB), (0, FREE_RGB), (100, WALL_RGB)):
            wanted[grid.cells == value] = rgb
        data = page.evaluate(READ_CELLS, [grid.height, grid.width])
        found = np.array(data, dtype=np.uint8).reshape(grid.height, grid.width, 4)[::-1]
        known = found[..., 3] == 255
        shown = np.where(known[..., None], found[..., :3], np.uint8(UNKNOWN_RGB))
        if np.array_equal(shown, wanted):
            break
        assert time.monotonic() < until_s, f"{(shown != wanted).any(-1).mean():.1%} cells differ"
        observer.listen(0.2)  # the final map comes some seconds after the last scan
    assert (grid.cells == 100).sum() > 100
