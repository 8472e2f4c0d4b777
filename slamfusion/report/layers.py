"""The maps of a report as layers: shown or not, over each other, asked cell by cell."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from slamfusion.align.records import FusionResult, InputRecord
from slamfusion.evaluation import MapError, maps_of_differences
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory
from slamfusion.viewer.scene import AGREEMENT, FUSED, TRUTH, Scene, layer_name, unlaid

# A browser keeps five bytes of each: six maps of 4000 x 4000 are drawn, and more are not.
MOST_CELLS = 100_000_000
# How hard tiles are packed: at 9 an eighth less than at 6, in eight times the time.
LEVEL = 6


@dataclass(frozen=True)
class Layers:
    """Maps that one can touch on a page.

    Attributes:
        recorded: what a scene says of them, as JSON that may stand in a script element; empty: they
            are too large.
        note: what the reader must know.
    """

    recorded: str
    note: str


def fusion_layers(
    result: FusionResult,
    paths: Mapping[str, Trajectory] | None = None,
    places: Sequence[tuple[float, float]] = (),
) -> Layers:
    """Return the fused map, the agreement and the inputs where they were laid.

    Args:
        result: what was fused; an input that was never aligned has no place and is left out, one
            that was rejected is hidden at first.
        paths: by input in the frame of its map, and as ``fused`` in the fused frame.
        places: x and y in the fused frame, metres, of what to check; the first has number 1.
    """
    placed = [record for record in result.inputs if record.accepted or record.alignment]
    too_large = _too_large(result.fused, result.agreement, *(record.grid for record in placed))
    if too_large is not None:
        return too_large
    scene = _scene([layer_name(record.name) for record in result.inputs])
    scene.put_status([_told(record, result.reference) for record in placed], places=places)
    for name, path in (paths or {}).items():
        scene.put_path(name if name == FUSED else layer_name(name), path)
    scene.put_map(FUSED, result.fused, "fused")
    scene.put_map(AGREEMENT, result.agreement, "agreement")
    for record in placed:
        scene.put_map(layer_name(record.name), record.grid, "input", is_shown=record.accepted)
    note = _NOTE if all(record.accepted for record in placed) else f"{_NOTE} {_HIDDEN}"
    return Layers(_recorded(scene), note)


def map_layers(grid: OccupancyGrid, path: Trajectory) -> Layers:
    """Return a map and the path in its frame."""
    too_large = _too_large(grid)
    if too_large is not None:
        return too_large
    scene = _scene([grid.name])
    scene.put_status([])
    scene.put_path(grid.name, path)
    scene.put_map(grid.name, grid, "fused")
    return Layers(_recorded(scene), _NOTE)


def error_layers(evaluations: Sequence[MapError]) -> Layers:
    """Return maps over the truth, as far as their differences tell them; the first is shown.

    Args:
        evaluations: at least one, all against one truth.
    """
    first = evaluations[0]
    differences = {item.name: item.difference for item in evaluations}
    truth, maps = maps_of_differences(differences, first.resolution, first.origin)
    too_large = _too_large(truth, *maps)
    if too_large is not None:
        return too_large
    names = [f"{grid.name} (map)" if grid.name == TRUTH else grid.name for grid in maps]
    scene = _scene(names)
    scene.put_status([unlaid(name) for name in names])
    scene.put_map(TRUTH, truth, "fused")
    for number, (name, grid) in enumerate(zip(names, maps, strict=True)):
        scene.put_map(name, grid, "input", is_shown=number == 0)
    return Layers(_recorded(scene), f"{_NOTE} {_LACKING}")


_NOTE = (
    "Drag the map, or click it and use the wheel, the arrow keys, + and -; 0 shows all of it. "
    "Point at a cell, or move the cross to it by keys, to see who says what there."
)
_LACKING = "A true wall that a map lacks is shown as unknown in it."
_HIDDEN = "An input that has no vote lies where it fits best, and is hidden at first."


def _too_large(*grids: OccupancyGrid) -> Layers | None:
    """Return what is shown in the place of maps that are too large; None where they are not."""
    cells = sum(grid.cells.size for grid in grids)
    if cells <= MOST_CELLS:
        return None
    text = (
        f"These maps have {cells / 1e6:.0f} million cells in all, and a page draws at most "
        f"{MOST_CELLS / 1e6:.0f} million as layers; the pictures below are smaller. "
        "`slamfusion show` draws maps from their files."
    )
    return Layers("", text)


def _scene(names: Sequence[str]) -> Scene:
    """Return a scene of layers of names in which nothing depends on the time of day."""
    return Scene("report", is_live=False, names=names, clock=lambda: 0.0, level=LEVEL)


def _told(record: InputRecord, reference: str) -> dict[str, Any]:
    """Return what the scene says of an input."""
    alignment = record.alignment
    place = Pose2() if alignment is None else alignment.transform
    return {
        "name": layer_name(record.name),
        "votes": record.accepted,
        "reason": "the reference" if record.name == reference else record.reason,
        "score": None if alignment is None else alignment.score,
        "transform": [place.x, place.y, place.yaw_rad],
    }


def _recorded(scene: Scene) -> str:
    """Return everything that a scene says; no letter of it can end a script element."""
    messages, _ = scene.since(0)
    texts = [message for message in messages if isinstance(message, str)]
    tiles = [base64.b64encode(item).decode() for item in messages if isinstance(item, bytes)]
    recorded = f'{{"messages":[{",".join(texts)}],"tiles":{json.dumps(tiles)}}}'
    return recorded.replace("<", "\\u003c")
