"""What a finished run left in its folder, as a scene for the page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slamfusion.errors import MapFileError, SlamFusionError
from slamfusion.io import load_map
from slamfusion.io.trajectories import read_trajectory
from slamfusion.jobs.outputs import AGREEMENT, FUSED, RUN_RECORD
from slamfusion.page.feed import Feed
from slamfusion.viewer.scene import Kind, Scene

__all__ = ["Finished", "read_finished"]

KINDS: dict[str, Kind] = {FUSED: "fused", AGREEMENT: "agreement"}
IN_PLACE = [0.0, 0.0, 0.0]


@dataclass
class Finished:
    """A folder of maps.

    Attributes:
        scene: all but the maps.
        maps: their files by name, the fused one first.
        record: what the run says of itself; None in a folder without such a record.
    """

    scene: Scene
    maps: dict[str, Path] = field(default_factory=dict)
    record: Mapping[str, Any] | None = None

    def feed(self, feed: Feed) -> None:
        """Load the maps and show them; one that cannot be read becomes an event."""
        for name, path in self.maps.items():
            try:
                grid = load_map(path, name=name, warn=lambda _: None)
            except (SlamFusionError, OSError) as error:
                self.scene.put_event("error", f"{name} is not shown: {error}")
                continue
            kind = KINDS.get(name, "input")
            feed.put("agreement" if name == AGREEMENT else name, grid, kind)


def read_finished(folder: Path) -> Finished:
    """Read a run's folder, or any other that holds maps.

    Without the record of a run nobody knows how maps lie to each other: each is shown where its own
    frame has it.

    Raises:
        MapFileError: there is no map in it, or its record is damaged.
    """
    if not folder.is_dir():
        message = f"{folder}: wanted the folder of a run, or one with maps; name that"
        raise MapFileError(message)
    found = Finished(Scene(f"SLAMfusion: {folder.absolute().name}", is_live=False))
    files = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    found.maps = {name: files.pop(name) for name in (FUSED, AGREEMENT) if name in files} | files
    if (folder / RUN_RECORD).exists():
        found.record = _record(folder / RUN_RECORD)
        for path in map(Path, found.record.get("saved_maps", ())):
            found.maps.setdefault(path.stem, path)
        order = [*KINDS, *(str(item.get("name")) for item in found.record["inputs"])]
        found.maps = {name: found.maps[name] for name in order if name in found.maps} | found.maps
    if not found.maps:
        message = f"{folder}: no map in it (NAME.yaml); name the folder of a run"
        raise MapFileError(message)
    _tell(found)
    for name, x_m, y_m in _points(folder, list(found.maps)):
        found.scene.put_point(name, x_m, y_m)
    return found


def _record(path: Path) -> Mapping[str, Any]:
    """Return the record of a run."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        message = f"{path}: cannot be read as the record of a run ({error}); run it again"
        raise MapFileError(message) from error
    if not isinstance(record, dict) or not isinstance(record.get("inputs"), list):
        message = f"{path}: wanted the record of a run, found another document; run it again"
        raise MapFileError(message)
    return record


def _tell(found: Finished) -> None:
    """Say what became of each input, and what the run found."""
    record = found.record
    if record is None:
        names = [name for name in found.maps if KINDS.get(name) is None]
        told = [_input({"name": name, "reason": "as its own frame has it"}) for name in names]
        words = f"{len(found.maps)} maps; no record says how they lie to each other"
        found.scene.put_status(told, headline=words, level="plain", figures={})
        return
    told = [_input(item) for item in record["inputs"]]
    known = {item["name"] for item in told}
    # The map that is drawn at the fused path lies in the fused frame.
    others = [name for name in found.maps if name not in known and name not in KINDS]
    told += [_input({"name": name, "reason": "drawn at the fused path"}) for name in others]
    verdict = record.get("verdict") or {}
    figures = {
        "reference": str(record.get("reference")),
        "fused by": str(record.get("fused_mode") or "vote"),
        "phantom cells": str(record.get("phantom_cells")),
        "device": str(record.get("device")),
    }
    sentence = verdict.get("sentence") or f"{record.get('fused_count')} maps were fused"
    level = "good" if verdict.get("sure") else "plain"
    found.scene.put_status(told, headline=sentence, level=level, figures=figures)


def _input(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return an input as the page shows it; one that was never aligned has no place."""
    place: list[float] | None = IN_PLACE
    if "accepted" in item:
        values = [item.get(key) for key in ("dx_m", "dy_m", "yaw_rad")]
        numbers = [float(value) for value in values if isinstance(value, (int, float))]
        place = numbers if len(numbers) == len(IN_PLACE) else None
    return {
        "name": str(item.get("name")),
        "votes": bool(item.get("accepted")),
        "reason": str(item.get("reason")),
        "score": item.get("score"),
        "transform": place,
    }


def _points(folder: Path, names: list[str]) -> Iterator[tuple[str, float, float]]:
    """Yield the poses of the paths beside the maps: name, x, y."""
    for name in names:
        path = folder / f"{name}.tum"
        if path.exists():
            for x_m, y_m, _ in read_trajectory(path).poses:
                yield name, float(x_m), float(y_m)
