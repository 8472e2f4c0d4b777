"""A folder of maps as a scene: a run's with its record, and any other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.cli.show import Finished, read_finished
from slamfusion.config import RunConfig
from slamfusion.errors import MapFileError
from slamfusion.evaluation.map_error import AGREE_FREE, AGREE_WALL, EXTRA_WALL, MISSING_WALL
from slamfusion.experiments.runs import TRIALS, packed_maps
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import save_map, write_tum
from slamfusion.jobs.fuse import FusedMaps, save_fused_maps
from slamfusion.jobs.fuse_documents import DoubledWalls, FuseDocument
from slamfusion.jobs.inputs import GivenMaps
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.report.drawn import fusion, room
from tests.web.maps import painted, texts, tiles

CELLS = np.full((20, 30), 100, dtype=np.int8)


def layers(found: Finished) -> dict[str, dict[str, Any]]:
    """Return the layers that a page shows, by name."""
    return {item["name"]: item for item in texts(found.scene.since(0)[0], "layer")}


def cells(found: Finished, name: str) -> list[list[int]]:
    """Return the cells of a layer, as a page shows them."""
    height, width = layers(found)[name]["size"]
    return painted(tiles(found.scene.since(0)[0], name), height, width, (0, 0)).tolist()


def write_run(folder: Path, **changes: Any) -> None:
    """Write what ``run`` does, as far as it is shown."""
    for name in ("fused", "a", "b", "c", "drawn"):
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
        "producers": [],
        "reference": "a",
        "fused_count": 2,
        "recommendation": {
            "use": "fused",
            "path": "fused",
            "best_single": "a",
            "confidence": "medium",
            "check": [{"from_s": 1, "to_s": 3.0, "x": 2.0, "y": -1.0, "what": "walls stand twice"}],
        },
        "saved_maps": [],
        **changes,
    }
    (folder / "fused.json").write_text(json.dumps(record), encoding="utf-8")


def test_a_run_is_shown_as_its_record_says(tmp_path: Path) -> None:
    write_run(tmp_path)
    found = read_finished(tmp_path)
    assert {name: layer["kind"] for name, layer in layers(found).items()} == {
        "fused": "fused",
        "agreement": "agreement",
        "a": "input",
        "b": "input",
        "c": "input",
        "drawn": "input",
    }
    hidden = [name for name, layer in layers(found).items() if not layer["is_shown"]]
    assert hidden == ["agreement", "c"]
    messages, _ = found.scene.since(0)
    (status,) = texts(messages, "status")
    assert status["headline"] == "Use the fused map and its path, but check 1 place first"
    assert (status["level"], status["figures"]["single SLAM"]) == ("warn", "a")
    assert status["places"] == [[2.0, -1.0]]
    events = [(item["stamp_s"], item["text"]) for item in texts(messages, "event")]
    # In the order of the drive, with its times.
    assert events == [(1.0, "place 1 to check: walls stand twice")]
    places = {item["name"]: item["transform"] for item in status["inputs"]}
    assert places == {"a": [0, 0, 0], "b": [1, 2, 0.5], "c": None, "drawn": [0, 0, 0]}
    assert texts(messages, "trail") == [
        {"type": "trail", "name": "a", "points": [[0.0, 0.0, 0.0], [1.0, 2.0, 1.0]]}
    ]


def test_the_path_of_a_saved_map_is_shown_and_a_damaged_one_named(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    poses = np.array([[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    path = tmp_path / "elsewhere" / "b-path.tum"
    write_tum(path, Trajectory(np.array([0.0, 1.0]), poses, "b"))
    write_run(tmp_path, saved_paths=[{"name": "b", "file": str(path)}])
    (tmp_path / "a.tum").write_text("nonsense\n", encoding="utf-8")
    messages, _ = read_finished(tmp_path).scene.since(0)
    assert texts(messages, "trail") == [
        {"type": "trail", "name": "b", "points": [[3.0, 0.0, 0.0], [4.0, 0.0, 1.0]]}
    ]
    events = [item["text"] for item in texts(messages, "event")]
    assert any(text.startswith("the path of a is not shown: ") for text in events)


def test_maps_without_a_record_lie_as_their_frames_say(tmp_path: Path) -> None:
    write_run(tmp_path)
    (tmp_path / "fused.json").unlink()
    (status,) = texts(read_finished(tmp_path).scene.since(0)[0], "status")
    assert "no record of their alignment" in status["headline"]
    assert {item["name"] for item in status["inputs"]} == {"a", "b", "c", "drawn"}
    assert all(item["transform"] == [0, 0, 0] for item in status["inputs"])


def test_a_map_that_cannot_be_read_is_named_and_the_others_shown(tmp_path: Path) -> None:
    write_run(tmp_path)
    (tmp_path / "b.pgm").write_bytes(b"nonsense")
    found = read_finished(tmp_path)
    assert "b" not in layers(found)
    assert "a" in layers(found)
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
    with pytest.raises(MapFileError, match="found no run and no maps"):
        read_finished(tmp_path / "none")


def write_fusion(folder: Path) -> FuseDocument:
    """Write a fusion as ``slamfusion fuse`` does, of a map and of folders; return its record."""
    result = fusion(rejected_name="far")
    files = tuple(folder / "given" / record.name / "map.yaml" for record in result.inputs)
    for path, record in zip(files, result.inputs, strict=True):
        save_map(record.grid, path.with_suffix(""))
    config = RunConfig()
    doubled = DoubledWalls.of(result, config)
    given = GivenMaps((files[0], *(path.parent for path in files[1:])))
    fused = FusedMaps(config, result, doubled, (), given)
    return save_fused_maps(fused, folder / "out")


def test_a_fusion_is_shown_with_its_inputs_where_they_were_laid(tmp_path: Path) -> None:
    record = write_fusion(tmp_path)
    found = read_finished(tmp_path)
    maps = layers(found)
    assert list(maps) == ["fused", "agreement", "room 0", "room 1", "room 2", "far"]
    assert cells(found, "room 1") == room("room 1", 1).cells.tolist()
    assert [name for name in maps if not maps[name]["is_shown"]] == ["agreement", "far"]
    (status,) = texts(found.scene.since(0)[0], "status")
    for item, laid in zip(status["inputs"][1:], plain(record.fusion)["inputs"][1:], strict=True):
        assert item["name"] == laid["name"]
        assert item["votes"] == laid["accepted"]
        assert item["transform"] == [laid["dx_m"], laid["dy_m"], laid["yaw_rad"]]
    # Of several fusions in a folder one is named, by its map or its record.
    for path in tmp_path.glob("out*"):
        path.with_name(path.name.replace("out", "again")).write_bytes(path.read_bytes())
    with pytest.raises(MapFileError, match=r"2 fusions in it \(again.json, out.json\); name one"):
        read_finished(tmp_path)
    assert read_finished(tmp_path / "again.yaml").scene.title == "SLAMfusion: again"
    assert read_finished(tmp_path / "out.json").scene.title == "SLAMfusion: out"
    with pytest.raises(MapFileError, match="no record of its fusion next to it"):
        read_finished(tmp_path / "given" / "far" / "map.yaml")


def test_a_drive_of_an_experiment_is_shown_over_the_truth(tmp_path: Path) -> None:
    codes = np.array([[AGREE_FREE, AGREE_WALL, MISSING_WALL, EXTRA_WALL]], dtype=np.int8)
    other = np.array([[AGREE_FREE, AGREE_WALL, AGREE_WALL, AGREE_FREE]], dtype=np.int8)
    for name in ("one", "two"):
        path = tmp_path / TRIALS / f"{name}.npz"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(packed_maps({"graph": codes, "consensus": other}, 0.05))
    found = read_finished(tmp_path)
    maps = layers(found)
    assert {name: layer["kind"] for name, layer in maps.items()} == {
        "truth": "fused",
        "graph": "input",
        "consensus": "input",
    }
    assert cells(found, "truth") == [[0, 100, 100, 0]]
    assert cells(found, "graph") == [[0, 100, -1, 100]]
    assert cells(found, "consensus") == [[0, 100, 100, 0]]
    assert [name for name in maps if maps[name]["is_shown"]] == ["truth", "graph"]
    assert found.also == ["two"]
    assert texts(found.scene.since(0)[0], "event") == []
    assert read_finished(tmp_path, "two").also == ["one"]
    with pytest.raises(MapFileError, match="no drive 'three' in it; --drive takes one of one, two"):
        read_finished(tmp_path, "three")
    (tmp_path / TRIALS / "two.npz").write_bytes(b"nonsense")
    with pytest.raises(MapFileError, match="cannot be read as the maps of a drive"):
        read_finished(tmp_path, "two")
