"""What the fusion's services answer, without a node; also what nav2's would be asked.

nav2_msgs is not on the Python package index: its requests and answers here have its fields.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.srv import LoadMap
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.clock import Clock
from rclpy.parameter import Parameter

from slamfusion.config import FusionNodeConfig
from slamfusion.fusion.live.session import FusionState
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map, save_map
from slamfusion.ros.base import Diagnostics
from slamfusion.ros.fusion_services import FusionServices
from tests.fusion.live.maps import three

pytestmark = pytest.mark.once


class Node:
    """As much of the fusion node as its services ask for.

    Attributes:
        answers: the services' callbacks by name.
    """

    def __init__(self, folder: Path) -> None:
        self.settings = FusionNodeConfig(save_path=str(folder / "lab"))
        self.published: Any = (None, three()["a"])
        self.drive = SimpleNamespace(locator=SimpleNamespace(solution=None))
        self.session = SimpleNamespace(snapshot=FusionState())
        self.inputs: Any = SimpleNamespace(entries={"a": "a/map"}, load=self.load)
        self.answers: dict[str, Any] = {}
        self.warnings: list[str] = []
        quiet = SimpleNamespace(info=str, warning=self.warnings.append, error=str)
        self.log, self.diagnostics = quiet, Diagnostics(quiet)
        self.node = SimpleNamespace(
            create_service=self.create_service, get_clock=Clock,
            add_on_set_parameters_callback=lambda _: None,
        )  # fmt: skip

    def create_service(self, _: Any, name: str, callback: Any) -> None:
        self.answers[name] = callback

    def ask_reset(self) -> None:
        raise NotImplementedError

    def load(self, path: str) -> OccupancyGrid:
        assert path == "/maps/lab.yaml"
        return three()["b"]


def asked(**fields: Any) -> SimpleNamespace:
    defaults = {"image_format": "", "map_mode": "", "free_thresh": 0.0, "occupied_thresh": 0.0}
    return SimpleNamespace(**{"map_topic": "", "map_url": "", **defaults, **fields})


def save_as(node: Node, **fields: Any) -> tuple[bool, str]:
    """Ask for ``save_map_as``, and return its answer."""
    given = [Parameter(name, value=value).to_parameter_msg() for name, value in fields.items()]
    request = SetParametersAtomically.Request(parameters=given)
    result = node.answers["save_map_as"](request, SetParametersAtomically.Response()).result
    return result.successful, result.reason


def test_a_map_is_loaded_from_its_path_alone(tmp_path: Path) -> None:
    node = Node(tmp_path)
    FusionServices(node)
    for url in ("/maps/lab.yaml", "file:///maps/lab.yaml", " file:///maps/lab.yaml \n"):
        answer = node.answers["load_map"](LoadMap.Request(map_url=url), LoadMap.Response())
        assert answer.result == LoadMap.Response.RESULT_SUCCESS
        assert answer.map.info.width == three()["b"].width


def test_save_as_names_all_that_it_does_not_take(tmp_path: Path) -> None:
    node = Node(tmp_path)
    FusionServices(node)
    path = str(tmp_path / "other")
    wanted = "path, format and mode as texts, free_thresh and occupied_thresh as numbers"
    assert save_as(node, path=path, colour="red", mode=5, occupied_thresh=True) == (
        False,
        f"not saved: wanted {wanted}, found colour = 'red', mode = 5, occupied_thresh = True",
    )
    taken = save_as(node, path=path, mode="raw", occupied_thresh=1, free_thresh=0.3)
    assert taken == (True, f"{path}.yaml")


def test_a_save_path_in_a_missing_folder_is_named_at_the_start(tmp_path: Path) -> None:
    node = Node(tmp_path / "new")
    FusionServices(node)
    assert "no map can be saved: save_path" in node.warnings[0]
    assert f"there is no folder '{tmp_path}/new'; make it first" in node.warnings[0]


def test_a_saved_input_is_not_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    node = Node(Path("~"))
    FusionServices(node)
    (tmp_path / "sub").mkdir()
    yaml, picture = save_map(three()["b"], tmp_path / "yard")
    floor = yaml.rename(tmp_path / "floor.yaml")
    node.inputs.entries["floor"] = "file:~/floor.yaml"
    before = picture.read_bytes()
    taken, why = save_as(node, path=str(tmp_path / "sub" / ".." / "yard"))
    assert not taken
    assert f"would replace the input {picture} (of {floor})" in why
    assert picture.read_bytes() == before
    assert not yaml.exists()
    assert save_as(node, path="~/yard", format="png")[0]


def test_nav2s_requests_are_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("Nav2SaveMap", "Nav2LoadMap"):  # their types only name the service
        monkeypatch.setattr(f"slamfusion.ros.fusion_services.{name}", object)
    node = Node(tmp_path)
    FusionServices(node)

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
    node.published, node.session.snapshot = None, FusionState(sent_maps=1)
    assert not save()
    assert "not saved: nothing is fused since the reset" in node.diagnostics.worst()[1]

    response = SimpleNamespace(map=None, result=None)
    answer = node.answers["~/load_map"](asked(map_url="file:///maps/lab.yaml"), response)
    assert answer.result == 0
    assert answer.map.info.width == three()["b"].width
