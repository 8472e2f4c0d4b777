"""A folder of maps as a scene: a run's with its record, and any other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.errors import MapFileError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import save_map, write_tum
from slamfusion.page.finished import read_finished
from slamfusion.trajectory import Trajectory
from slamfusion.viewer.scene import Scene
from tests.viewer.maps import texts

pytestmark = pytest.mark.once

CELLS = np.full((20, 30), 100, dtype=np.int8)


class Told:
    """Takes maps as a feed does."""

    def __init__(self) -> None:
        self.maps: dict[str, tuple[OccupancyGrid, str]] = {}

    def put(self, name: str, grid: OccupancyGrid, kind: str) -> None:
        self.maps[name] = grid, kind


def write_run(folder: Path, **changes: Any) -> None:
    """Write what ``run`` does, as far as it is shown."""
    for name in ("fused", "a", "b", "drawn"):
        save_map(OccupancyGrid(CELLS, 0.05, Pose2(), name), folder / name)
    save_map(OccupancyGrid(CELLS, 0.05, Pose2(), "x"), folder / "fused_agreement", mode="raw")
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    write_tum(folder / "a.tum", Trajectory(np.array([0.0, 1.0]), poses, "a"))
    place = {"dx_m": 1.0, "dy_m": 2.0, "yaw_rad": 0.5, "score": 0.7}
    record = {
        "inputs": [
            {"name": "a", "accepted": True, "reason": "the reference", **dict.fromkeys(place, 0.0)},
            {"name": "b", "accepted": True, "reason": "fits", **place},
            {"name": "c", "accepted": False, "reason": "empty", **dict.fromkeys(place)},
        ],
        "reference": "a",
        "fused_count": 2,
        "verdict": {"sentence": "The scans bear out a best.", "sure": True},
        "saved_maps": [],
        **changes,
    }
    (folder / "fused.json").write_text(json.dumps(record), encoding="utf-8")


def test_a_run_is_shown_as_its_record_says(tmp_path: Path) -> None:
    write_run(tmp_path)
    found, told = read_finished(tmp_path), Told()
    found.feed(told)  # type: ignore[arg-type]
    assert {name: kind for name, (_, kind) in told.maps.items()} == {
        "fused": "fused",
        "agreement": "agreement",
        "a": "input",
        "b": "input",
        "drawn": "input",
    }
    messages, _ = found.scene.since(0)
    (status,) = texts(messages, "status")
    assert status["headline"] == "The scans bear out a best."
    places = {item["name"]: item["transform"] for item in status["inputs"]}
    assert places == {"a": [0, 0, 0], "b": [1, 2, 0.5], "c": None, "drawn": [0, 0, 0]}
    assert texts(messages, "trail") == [
        {"type": "trail", "name": "a", "points": [[0.0, 0.0], [1.0, 2.0]]}
    ]


def test_maps_without_a_record_lie_as_their_frames_say(tmp_path: Path) -> None:
    write_run(tmp_path)
    (tmp_path / "fused.json").unlink()
    (status,) = texts(read_finished(tmp_path).scene.since(0)[0], "status")
    assert "no record says how they lie" in status["headline"]
    assert {item["name"] for item in status["inputs"]} == {"a", "b", "drawn"}
    assert all(item["transform"] == [0, 0, 0] for item in status["inputs"])


def test_a_map_that_cannot_be_read_is_named_and_the_others_shown(tmp_path: Path) -> None:
    write_run(tmp_path)
    (tmp_path / "b.pgm").write_bytes(b"nonsense")
    found, told = read_finished(tmp_path), Told()
    found.feed(told)  # type: ignore[arg-type]
    assert "b" not in told.maps
    assert "a" in told.maps
    events = [item["text"] for item in texts(found.scene.since(0)[0], "event")]
    assert any(text.startswith("b is not shown: ") for text in events)


@pytest.mark.parametrize("text", ["nonsense", "[]", '{"inputs": 3}', "[" * 100_000])
def test_a_damaged_record_is_refused(tmp_path: Path, text: str) -> None:
    write_run(tmp_path)
    (tmp_path / "fused.json").write_text(text, encoding="utf-8")
    with pytest.raises(MapFileError, match="record of a run"):
        read_finished(tmp_path)


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="no map in it"):
        read_finished(tmp_path)
    with pytest.raises(MapFileError, match="wanted the folder of a run"):
        read_finished(tmp_path / "none")


def test_the_scene_of_a_folder_is_at_rest(tmp_path: Path) -> None:
    write_run(tmp_path)
    assert isinstance(read_finished(tmp_path).scene, Scene)
    assert not read_finished(tmp_path).scene.is_live
