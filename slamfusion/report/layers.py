"""The maps of a report as layers: shown or not, over each other, asked cell by cell."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from slamfusion.align.records import FusionResult
from slamfusion.evaluation.map_error import MapError, maps_of_differences
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory
from slamfusion.web.scene import AGREEMENT, FUSED, TRUTH, Kind, Scene, layer_name, layer_status

# A browser keeps five bytes of each: six maps of 4000 x 4000 are drawn, and more are not.
MOST_CELLS = 100_000_000
# How hard tiles are packed: at 9 an eighth less than at 6, in eight times the time.
LEVEL = 6
NOTE = (
    "Drag the map, or click it and use the wheel, the arrow keys, + and -; 0 shows all of it. "
    "Point at a cell, or move the cross to it by keys, to see its value in each map."
)
# Of a map: its cells, its kind, and whether it is shown at first.
_Maps = Mapping[str, tuple[OccupancyGrid, Kind, bool]]


@dataclass(frozen=True)
class Layers:
    """Interactive maps of a page.

    Attributes:
        recorded: the scene as JSON, safe in a script element; empty: too large.
    """

    recorded: str
    note: str


def fusion_layers(
    result: FusionResult,
    paths: Mapping[str, Trajectory] | None = None,
    places: Sequence[tuple[float, float]] = (),
) -> Layers:
    """Return the fused map, the agreement and the aligned inputs; rejected ones are hidden first.

    Args:
        paths: by input in the frame of its map, and as ``fused`` in the fused frame.
        places: x and y in the fused frame, metres, of what to check; the first has number 1.
    """
    scene = _scene([layer_name(record.name) for record in result.inputs])
    maps: dict[str, tuple[OccupancyGrid, Kind, bool]] = {
        FUSED: (result.fused, "fused", True),
        AGREEMENT: (result.agreement, "agreement", False),
    }
    inputs: list[Mapping[str, Any]] = []
    for record in result.inputs:
        if not record.accepted and record.alignment is None:
            continue
        name, found = layer_name(record.name), record.alignment
        maps[name] = (record.grid, "input", record.accepted)
        reason = "the reference" if record.name == result.reference else record.reason
        measured = () if found is None else (found.score, found.transform)
        inputs.append(layer_status(name, reason, *measured, votes=record.accepted))
    scene.put_status(inputs, places=places)
    own = {name: name if name == FUSED else layer_name(name) for name in paths or {}}
    scene.put_paths({own[name]: path for name, path in (paths or {}).items()})
    hidden = "An input without a vote is at its best alignment, and hidden at first."
    return _layers(scene, maps, "" if all(item["votes"] for item in inputs) else hidden)


def map_layers(grid: OccupancyGrid, path: Trajectory) -> Layers:
    """Return a map and the path in its frame."""
    scene = _scene([grid.name])
    scene.put_status([], places=())
    scene.put_paths({grid.name: path})
    return _layers(scene, {grid.name: (grid, "fused", True)})


def error_layers(evaluations: Sequence[MapError]) -> Layers:
    """Return the one truth of maps, and the maps as far as their differences give them."""
    first = evaluations[0]
    differences = {item.name: item.difference for item in evaluations}
    truth, grids = maps_of_differences(differences, first.resolution, first.origin)
    names = [f"{grid.name} (map)" if grid.name == TRUTH else grid.name for grid in grids]
    scene = _scene(names)
    scene.put_status([layer_status(name) for name in names], places=())
    maps: dict[str, tuple[OccupancyGrid, Kind, bool]] = {TRUTH: (truth, "fused", True)}
    for name, grid in zip(names, grids, strict=True):
        maps[name] = (grid, "input", name == names[0])
    return _layers(scene, maps, "A true wall that a map lacks is shown as unknown in it.")


def _scene(names: Sequence[str]) -> Scene:
    """Return an empty scene; nothing of it depends on the time of day."""
    return Scene("report", is_live=False, names=names, clock=lambda: 0.0, level=LEVEL)


def _layers(scene: Scene, maps: _Maps, note: str = "") -> Layers:
    """Put the maps into a scene and return all its messages, if they are not too large."""
    cells = sum(grid.cells.size for grid, _, _ in maps.values())
    if cells > MOST_CELLS:
        text = (
            f"These maps have {cells / 1e6:.0f} million cells in all, and a page draws at most "
            f"{MOST_CELLS / 1e6:.0f} million as layers; the pictures below are smaller. "
            "`slamfusion show` draws maps from their files."
        )
        return Layers("", text)
    for name, (grid, kind, is_shown) in maps.items():
        scene.put_map(name, grid, kind, is_shown=is_shown)
    messages, _ = scene.since(0)
    texts = [message for message in messages if isinstance(message, str)]
    tiles = [base64.b64encode(item).decode() for item in messages if isinstance(item, bytes)]
    recorded = f'{{"messages":[{",".join(texts)}],"tiles":{json.dumps(tiles)}}}'
    # No text in it ends a script element.
    return Layers(recorded.replace("<", "\\u003c"), f"{NOTE} {note}".strip())
