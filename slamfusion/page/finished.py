"""What a finished job left in its folder, as a scene for the page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from slamfusion.errors import MapFileError, SlamFusionError
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map
from slamfusion.io.trajectories import read_trajectory
from slamfusion.jobs.outputs import (
    AGREEMENT,
    AGREEMENT_END,
    DRAWN,
    FUSED,
    FUSED_PATH,
    REPORT,
    RUN_RECORD,
)
from slamfusion.viewer import scene
from slamfusion.viewer.scene import Feed, Kind, Scene, layer_name, unlaid

# The layers of the maps of a fusion, and their kinds, by the names of their files.
FUSION: dict[str, tuple[str, Kind]] = {
    FUSED: (scene.FUSED, "fused"),
    AGREEMENT: (scene.AGREEMENT, "agreement"),
}
MOST_NAMED = 8


@dataclass(frozen=True, eq=False)
class ShownMap:
    """A map of the page: the name of its layer, its kind, its file or its cells.

    ``is_shown`` at first; ``options`` of ``load_map``.
    """

    name: str
    kind: Kind
    source: Path | OccupancyGrid
    is_shown: bool = True
    options: Mapping[str, Any] = field(default_factory=dict)

    def load(self) -> OccupancyGrid:
        """Return its cells."""
        if isinstance(self.source, OccupancyGrid):
            return self.source
        return load_map(self.source, name=self.name, warn=lambda _: None, **self.options)


@dataclass
class Finished:
    """A folder of maps.

    Attributes:
        scene: all but the maps.
        maps: in the order in which they are shown.
        also: other drives of the folder, which can be shown by name.
        report: folder of the report; None: there is none.
    """

    scene: Scene
    maps: list[ShownMap] = field(default_factory=list)
    also: Sequence[str] = ()
    report: Path | None = None

    def feed(self, feed: Feed) -> None:
        """Load the maps and show them; one that cannot be read becomes an event."""
        for item in self.maps:
            try:
                grid = item.load()
            except (SlamFusionError, OSError) as error:
                self.scene.put_event("error", f"{item.name} is not shown: {error}")
                continue
            feed.put(item.name, grid, item.kind, is_shown=item.is_shown)


def read_finished(place: Path, drive: str = "") -> Finished:
    """Read what ``run``, ``fuse`` or an experiment wrote, or any folder with maps.

    Without a record of their alignment, each map is shown in its own frame.

    Args:
        place: the folder; or of several fusions in one folder the map or the record of one.
        drive: of an experiment, which of its drives; empty: the first.

    Raises:
        MapFileError: there is no map in it, its record is damaged, it has several, or no such
            drive.
    """
    record = _record_of(place)
    if record is not None:
        return _read_record(record)
    if not place.is_dir():
        raise MapFileError(f"{place}: found no run and no maps there; name a folder with either")
    files = {path.stem: path for path in sorted(place.glob("*.yaml"))}
    if not files:
        return _read_drive(place, drive)
    return _read_maps(place, files)


def _record_of(place: Path) -> Path | None:
    if place.is_file():
        path = place.with_suffix(".json")
        if not path.exists():
            message = f"{place}: no record of its fusion next to it ({path.name}); name the folder"
            raise MapFileError(message)
        return path
    if (place / RUN_RECORD).exists():
        return place / RUN_RECORD
    ends = (".yaml", f"{AGREEMENT_END}.yaml")
    found = [
        path
        for path in sorted(place.glob("*.json"))
        if all(path.with_name(path.stem + end).exists() for end in ends)
    ]
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:MOST_NAMED])
        message = f"{place}: {len(found)} fusions in it ({names}); name one, e.g. {found[0]}"
        raise MapFileError(message)
    return found[0] if found else None


# --- a run, a fusion --------------------------------------------------------------------------


def _read_record(path: Path) -> Finished:
    record = _load_record(path)
    inputs = [item for item in record["inputs"] if isinstance(item, dict)]
    stem = path.with_suffix("")
    found = _finished(_title(path))
    report = stem.with_name(REPORT)
    found.report = report if (report / "report.html").exists() else None
    found.maps = list(_maps_of(stem, record, inputs))
    entries = [_input(item) for item in inputs]
    drawn = stem.with_name(f"{DRAWN}.yaml")
    if path.name == RUN_RECORD and drawn.exists():
        # The map that is drawn at the fused path is in the fused frame.
        found.maps.append(ShownMap(DRAWN, "input", drawn))
        entries.append(unlaid(DRAWN, "drawn at the fused path"))
    figures = {
        "reference": str(record.get("reference")),
        "fused by": str(record.get("fused_mode") or "vote"),
        "phantom cells": str(record.get("phantom_cells")),
        "device": str(record.get("device")),
    }
    others = len(record.get("groups") or ()) - 1
    if others > 0:
        figures["further groups, not shown"] = str(others)
    headline, level = f"{record.get('fused_count')} maps were fused", "plain"
    places: list[tuple[float, float]] = []
    for stamp_s, event_level, text in sorted(_events(record)):
        found.scene.put_event(event_level, text, stamp_s)
    if record.get("recommendation"):
        answer = Recommendation.from_json(record["recommendation"])
        headline, level = answer.headline, answer.tone
        places = [(place.x, place.y) for place in answer.check]
        if answer.best_single:
            figures = {"single SLAM": answer.best_single, **figures}
    found.scene.put_status(entries, headline=headline, level=level, figures=figures, places=places)
    if path.name == RUN_RECORD and "producers" in record:
        _put_paths(found.scene, dict(_paths_of(stem, record, inputs)))
    return found


def _finished(title: str) -> Finished:
    """Return an empty scene whose times count from the start of the drive."""
    return Finished(Scene(f"SLAMfusion: {title}", is_live=False, clock=lambda: 0.0))


def _events(record: Mapping[str, Any]) -> Iterator[tuple[float, Literal["ok", "warn"], str]]:
    for number, place in enumerate((record.get("recommendation") or {}).get("check", ()), start=1):
        yield place["from_s"], "warn", f"place {number} to check: {place['what']}"
    for path in record.get("path_evidence") or ():
        for span in path["spans"]:
            if not span["agrees"]:
                away = f"leaves the recommended path, by up to {span['gap_m']:.1f} m"
                yield span["from_s"], "warn", f"{path['name']} {away}"
                yield span["to_s"], "ok", f"{path['name']} is back on the recommended path"


def _load_record(path: Path) -> Mapping[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        message = f"{path}: cannot be read as the record of a run ({error}); run it again"
        raise MapFileError(message) from error
    if not isinstance(record, dict) or not isinstance(record.get("inputs"), list):
        message = f"{path}: wanted the record of a run, found another document; run it again"
        raise MapFileError(message)
    return record


def _title(record: Path) -> str:
    return record.absolute().parent.name if record.name == RUN_RECORD else record.stem


def _maps_of(
    stem: Path, record: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]]
) -> Iterator[ShownMap]:
    yield ShownMap(scene.FUSED, "fused", stem.with_name(f"{stem.name}.yaml"))
    agreement = stem.with_name(f"{stem.name}{AGREEMENT_END}.yaml")
    yield ShownMap(scene.AGREEMENT, "agreement", agreement)
    # Producers write their maps into the folder.
    given = [Path(str(path)) for path in record.get("saved_maps", ())]
    made = [stem.with_name(f"{item.get('name')}.yaml") for item in _made(record, inputs)]
    files = [*made, *(_found(path, stem) for path in given)]
    settings = (record.get("config") or {}).get("map_files") or {}
    for item, path in zip(inputs, files, strict=False):
        options: dict[str, Any] = {"legacy_unknown": bool(settings.get("legacy_unknown"))}
        if path.suffix not in {".yaml", ".yml"} and not path.is_dir():
            options["resolution"] = record.get("resolution")
        source = path / f"{FUSED}.yaml" if path.is_dir() else path
        name = layer_name(str(item.get("name")))
        yield ShownMap(name, "input", source, bool(item.get("accepted")), options)


def _paths_of(
    stem: Path, record: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]]
) -> Iterator[tuple[str, Path]]:
    """Yield the map's layer and the file of the fused path and of each voter's."""
    yield scene.FUSED, stem.with_name(FUSED_PATH)
    made = [str(item.get("name")) for item in _made(record, inputs)]
    files = {name: stem.with_name(f"{name}.tum") for name in made}
    files |= {
        str(item.get("name")): _found(Path(str(item.get("file"))), stem)
        for item in record.get("saved_paths") or ()
    }
    for name in [str(item.get("name")) for item in inputs if item.get("accepted")]:
        if name in files:
            yield layer_name(name), files[name]


def _made(
    record: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]]
) -> Sequence[Mapping[str, Any]]:
    """Return the inputs that producers made; the given maps come after them."""
    return inputs[: max(len(inputs) - len(record.get("saved_maps", ())), 0)]


def _found(path: Path, stem: Path) -> Path:
    """Return the file of a map that a record names: from here, or from the record's folder."""
    own = stem.parent / path
    return own if not path.exists() and own.exists() else path


def _input(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return an input as the page shows it; one that was never aligned has no place."""
    values = [item.get(key) for key in ("dx_m", "dy_m", "yaw_rad")]
    numbers = [float(value) for value in values if isinstance(value, (int, float))]
    return {
        "name": layer_name(str(item.get("name"))),
        "votes": bool(item.get("accepted")),
        "reason": str(item.get("reason")),
        "score": item.get("score"),
        "transform": numbers if len(numbers) == len(values) else None,
    }


def _put_paths(shown: Scene, files: Mapping[str, Path]) -> None:
    """Put each path in the frame of the map of its name; a missing file is left out."""
    paths = {}
    for name, file in files.items():
        if not file.exists():
            continue
        try:
            paths[name] = read_trajectory(file)
        except SlamFusionError as error:
            shown.put_event("error", f"the path of {name} is not shown: {error}")
    start_s = min((float(path.stamps_s[0]) for path in paths.values()), default=0.0)
    for name, path in paths.items():
        shown.put_path(name, path, start_s)


# --- maps without a record --------------------------------------------------------------------


def _read_maps(folder: Path, files: Mapping[str, Path]) -> Finished:
    found = _finished(folder.absolute().name)
    inputs = {name: path for name, path in files.items() if name not in FUSION}
    found.maps = [
        ShownMap(layer, kind, files[name])
        for name, (layer, kind) in FUSION.items()
        if name in files
    ]
    found.maps += [ShownMap(layer_name(name), "input", path) for name, path in inputs.items()]
    entries = [unlaid(layer_name(name), "in its own frame") for name in inputs]
    words = f"{len(files)} maps; no record of their alignment"
    found.scene.put_status(entries, headline=words, level="plain", figures={})
    paths = {layer_name(name): folder / f"{name}.tum" for name in inputs}
    _put_paths(found.scene, {scene.FUSED: folder / FUSED_PATH, **paths})
    return found


# --- an experiment ----------------------------------------------------------------------------


def _read_drive(folder: Path, drive: str) -> Finished:
    """Read the maps of one drive of an experiment, over the truth."""
    from slamfusion.experiments.runs import kept_maps, kept_runs  # noqa: PLC0415  (the SLAMs load slowly)

    names = kept_runs(folder)
    if not names:
        raise MapFileError(
            f"{folder}: no map in it (NAME.yaml, or of an experiment trials/NAME.npz); name the "
            "folder of a run"
        )
    chosen = drive or names[0]
    if chosen not in names:
        listed = ", ".join(names[:MOST_NAMED])
        raise MapFileError(f"{folder}: no drive {drive!r} in it; --drive takes one of {listed}")
    truth, maps = kept_maps(folder, chosen)
    found = _finished(chosen)
    found.maps = [ShownMap("truth", "fused", truth)]
    found.maps += [
        ShownMap(grid.name, "input", grid, is_shown=number == 0) for number, grid in enumerate(maps)
    ]
    found.also = [name for name in names if name != chosen]
    entries = [unlaid(grid.name, "a true wall that it lacks is shown as unknown") for grid in maps]
    words = f"{chosen}: {len(maps)} maps over the truth"
    figures = {"other drives, by --drive": ", ".join(found.also) or "none"}
    found.scene.put_status(entries, headline=words, level="plain", figures=figures)
    return found
