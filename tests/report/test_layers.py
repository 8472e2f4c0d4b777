"""The layers of a page: what they hold is what was fused, in place and in a file of its own."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.config import RunConfig
from slamfusion.evaluation.map_error import compare_to_truth
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.fuse import FusedMaps, write_fusion_report
from slamfusion.palette import colours_of
from slamfusion.report.fusion_report import fused_section
from slamfusion.report.layers import MOST_CELLS, error_layers, fusion_layers
from slamfusion.trajectory import Trajectory
from tests.report.drawn import NASTY, fusion, room
from tests.report.test_reports import read
from tests.web.maps import painted, tiles

pytestmark = pytest.mark.once


def told(recorded: str) -> tuple[dict[str, list[dict[str, Any]]], list[bytes]]:
    """Return the messages by type, and the tiles."""
    assert "<" not in recorded
    found = json.loads(recorded)
    messages: dict[str, list[dict[str, Any]]] = {}
    for message in found["messages"]:
        messages.setdefault(message["type"], []).append(message)
    return messages, [base64.b64decode(tile) for tile in found["tiles"]]


def test_layers_hold_every_map_where_it_was_laid() -> None:
    result = fusion()
    path = Trajectory(np.arange(3.0), np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0.0]]), "room 1")
    messages, data = told(fusion_layers(result, {"room 1": path, "fused": path}).recorded)
    shown = {layer["name"]: layer["is_shown"] for layer in messages["layer"]}
    overlay = fused_section(result).pictures[1]
    rooms = ["room 0", "room 1", "room 2"]
    assert shown == {"fused": True, "agreement": False, **dict.fromkeys(rooms, True), NASTY: False}
    maps = {
        "fused": result.fused,
        "agreement": result.agreement,
        **{record.name: record.grid for record in result.inputs},
    }
    for layer in messages["layer"]:
        grid = maps[layer["name"]]
        cells = painted(tiles(data, layer["name"]), grid.height, grid.width, (0, 0))
        assert np.array_equal(cells, grid.cells), layer["name"]
        assert layer["anchor"] == [grid.origin.x, grid.origin.y, grid.origin.yaw_rad]
        # In the colour that it has on the overlay, and the path with it.
        if layer["name"] in rooms:
            assert tuple(layer["colours"]["wall"]) == overlay.legend[layer["name"]], layer["name"]
    (status,) = messages["status"]
    votes = {item["name"]: item["votes"] for item in status["inputs"]}
    assert votes == {**dict.fromkeys(rooms, True), NASTY: False}
    places = {item["name"]: item["transform"] for item in status["inputs"]}
    assert places["room 0"] == [0, 0, 0]
    assert places["room 1"] == [0.1, -0.2, 0.01]
    points = [[0, 0, 0], [1, 0, 1], [1, 2, 2]]
    assert {trail["name"]: trail["points"] for trail in messages["trail"]} == {
        "room 1": points,
        "fused": points,
    }


def test_larger_maps_are_pictures_alone_and_the_page_says_so(tmp_path: Path) -> None:
    result = fusion()
    side = int(np.sqrt(MOST_CELLS / 2)) + 1
    cells = np.broadcast_to(np.int8(-1), (side, side))
    huge = OccupancyGrid(cells, 0.05, Pose2(), "fused")
    few = replace(result, inputs=result.inputs[:1])
    layers = fusion_layers(replace(few, fused=huge, agreement=huge))
    assert layers.recorded == ""
    assert layers.note.startswith("These maps have 100 million cells in all, and a page draws at")
    path = write_fusion_report(FusedMaps(RunConfig(), few, None), tmp_path)
    assert "Drag the map" in read(path).text


def test_maps_against_the_truth_are_told_by_their_differences() -> None:
    truth, other = room("truth", 7), room("truth", 3)
    evaluations = [compare_to_truth(grid, truth) for grid in (other, room("graph", 4))]
    messages, data = told(error_layers(evaluations).recorded)
    shown = {layer["name"]: layer["is_shown"] for layer in messages["layer"]}
    assert shown == {"truth": True, "truth (map)": True, "graph": False}
    colours = {layer["name"]: tuple(layer["colours"]["wall"]) for layer in messages["layer"]}
    assert colours == colours_of(["truth", "truth (map)", "graph"])
    assert "event" not in messages  # nobody was asked to vote
    height, width = evaluations[0].difference.shape
    cells = {name: painted(tiles(data, name), height, width, (0, 0)) for name in shown}
    known = truth.cells[4:-4, 4:-4]
    assert known.shape == (height, width)
    # What one map hides of the truth the other tells, but where both have a wall too many.
    assert np.mean(cells["truth"] == known) > 0.99
    assert np.all((cells["truth"] == known) | (cells["truth"] == -1))
    is_right = other.cells[4:-4, 4:-4] == cells["truth (map)"]
    assert np.all(is_right | (known == 100))
