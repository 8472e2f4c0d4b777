"""What nav2's map saver and map server would be asked, asked of the fusion's services.

nav2_msgs is not on the Python package index: requests and answers here have its fields.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from rclpy.clock import Clock

from slamfusion.config import FusionNodeConfig
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from slamfusion.ros.base import Diagnostics
from slamfusion.ros.fusion_services import FusionServices
from tests.fusion.live.maps import three


class Node:
    """As much of the fusion node as its services ask for.

    Attributes:
        answers: the services' callbacks by name.
    """

    def __init__(self, folder: Path) -> None:
        self.settings = FusionNodeConfig(save_path=str(folder / "lab"))
        self.published: Any = (None, three()["a"])
        self.answers: dict[str, Any] = {}
        quiet = SimpleNamespace(info=str, warning=str, error=str)
        self.log, self.diagnostics = quiet, Diagnostics(quiet)
        self.node = SimpleNamespace(create_service=self.create_service, get_clock=Clock)

    def create_service(self, _: Any, name: str, callback: Any) -> None:
        self.answers[name] = callback

    def nothing_fused(self) -> str:
        return "nothing is fused"

    def ask_reset(self) -> None:
        raise NotImplementedError

    def load_input(self, entry: str) -> tuple[OccupancyGrid | None, str]:
        assert entry == "file:/maps/lab.yaml"
        return three()["b"], ""


def asked(**fields: Any) -> SimpleNamespace:
    defaults = {"image_format": "", "map_mode": "", "free_thresh": 0.0, "occupied_thresh": 0.0}
    return SimpleNamespace(**{"map_topic": "", "map_url": "", **defaults, **fields})


@pytest.mark.once
def test_nav2s_requests_are_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("Nav2SaveMap", "Nav2LoadMap"):  # their types only name the service
        monkeypatch.setattr(f"slamfusion.ros.fusion_services.{name}", object)
    node = Node(tmp_path)
    FusionServices(node, node)

    def save(**fields: Any) -> bool:
        return bool(node.answers["~/save_map"](asked(**fields), SimpleNamespace()).result)

    cells = three()["a"].cells
    assert save()
    assert (load_map(tmp_path / "lab.yaml").cells == cells).all()
    limits = {"free_thresh": 0.25, "occupied_thresh": 0.7}
    assert save(
        map_topic="/fused/map",
        map_url=str(tmp_path / "other"),
        image_format="png",
        map_mode="raw",
        **limits,
    )
    text = (tmp_path / "other.yaml").read_text()
    for words in ("image: other.png", "mode: raw", "free_thresh: 0.25", "occupied_thresh: 0.7"):
        assert words in text
    assert not save(map_topic="/map")
    assert "wanted the topic fused/map, found '/map'" in node.diagnostics.worst()[1]
    assert not save(map_url="/etc/lab")
    assert not save(map_mode="odd")
    node.published = None
    assert not save()

    response = SimpleNamespace(map=None, result=None)
    answer = node.answers["~/load_map"](asked(map_url="file:///maps/lab.yaml"), response)
    assert answer.result == 0
    assert answer.map.info.width == three()["b"].width
