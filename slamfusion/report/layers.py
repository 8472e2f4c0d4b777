"""The maps of a report as layers: shown or not, over each other, asked cell by cell."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from slamfusion.align.records import FusionResult, InputRecord
from slamfusion.evaluation import MapError, maps_of_differences
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory
from slamfusion.web.scene import AGREEMENT, FUSED, TRUTH, Kind, Scene, layer_name, unlaid

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
    """

    recorded: str
    note: str


# Of a map: the name of its layer, its cells, its kind, and whether it is shown at first.
_Map = tuple[str, OccupancyGrid, Kind, bool]


def fusion_layers(
    result: FusionResult,
    paths: Mapping[str, Trajectory] | None = None,
    places: Sequence[tuple[float, float]] = (),
) -> Layers:
    """Return the fused map, the agreement and the aligned inputs.

    Args:
        result: what was fused; an input that was never aligned is left out, one that was rejected
            is hidden at first.
        paths: by input in the frame of its map, and as ``fused`` in the fused frame.
        places: x and y in the fused frame, metres, of what to check; the first has number 1.
    """
    placed = [record for record in result.inputs if record.accepted or record.alignment]
    maps: list[_Map] = [
        (FUSED, result.fused, "fused", True),
        (AGREEMENT, result.agreement, "agreement", False),
        *((layer_name(own.name), own.grid, "input", own.accepted) for own in placed),
    ]
    return _layers(
        maps,
        "" if all(record.accepted for record in placed) else _HIDDEN,
        names=[layer_name(record.name) for record in result.inputs],
        inputs=[_told(record, result.reference) for record in placed],
        paths={
            name if name == FUSED else layer_name(name): path
            for name, path in (paths or {}).items()
        },
        places=places,
    )


def map_layers(grid: OccupancyGrid, path: Trajectory) -> Layers:
    """Return a map and the path in its frame."""
    return _layers([(grid.name, grid, "fused", True)], names=[grid.name], paths={grid.name: path})


def error_layers(evaluations: Sequence[MapError]) -> Layers:
    """Return the truth and maps as far as their differences give them; the first map is shown.

    Args:
        evaluations: at least one, all against one truth.
    """
    first = evaluations[0]
    differences = {item.name: item.difference for item in evaluations}
    truth, grids = maps_of_differences(differences, first.resolution, first.origin)
    names = [f"{grid.name} (map)" if grid.name == TRUTH else grid.name for grid in grids]
    maps: list[_Map] = [(TRUTH, truth, "fused", True)]
    maps += [
        (name, grid, "input", name == names[0]) for name, grid in zip(names, grids, strict=True)
    ]
    return _layers(maps, _LACKING, names=names, inputs=[unlaid(name) for name in names])


_NOTE = (
    "Drag the map, or click it and use the wheel, the arrow keys, + and -; 0 shows all of it. "
    "Point at a cell, or move the cross to it by keys, to see its value in each map."
)
_LACKING = "A true wall that a map lacks is shown as unknown in it."
_HIDDEN = "An input without a vote is at its best alignment, and hidden at first."


def _layers(
    maps: Sequence[_Map],
    note: str = "",
    *,
    names: Sequence[str],
    inputs: Sequence[Mapping[str, Any]] = (),
    paths: Mapping[str, Trajectory] = MappingProxyType({}),
    places: Sequence[tuple[float, float]] = (),
) -> Layers:
    """Return layers; see ``Scene`` for the names, the inputs and the paths."""
    cells = sum(grid.cells.size for _, grid, _, _ in maps)
    if cells > MOST_CELLS:
        text = (
            f"These maps have {cells / 1e6:.0f} million cells in all, and a page draws at most "
            f"{MOST_CELLS / 1e6:.0f} million as layers; the pictures below are smaller. "
            "`slamfusion show` draws maps from their files."
        )
        return Layers("", text)
    # Nothing depends on the time of day.
    scene = Scene("report", is_live=False, names=names, clock=lambda: 0.0, level=LEVEL)
    scene.put_status(inputs, places=places)
    scene.put_paths(paths)
    for name, grid, kind, is_shown in maps:
        scene.put_map(name, grid, kind, is_shown=is_shown)
    return Layers(_recorded(scene), f"{_NOTE} {note}".strip())


def _told(record: InputRecord, reference: str) -> dict[str, Any]:
    """Return an input as ``Scene.put_status`` takes it."""
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
    """Return all messages of a scene as JSON that cannot end a script element."""
    messages, _ = scene.since(0)
    texts = [message for message in messages if isinstance(message, str)]
    tiles = [base64.b64encode(item).decode() for item in messages if isinstance(item, bytes)]
    recorded = f'{{"messages":[{",".join(texts)}],"tiles":{json.dumps(tiles)}}}'
    return recorded.replace("<", "\\u003c")
