"""``slamfusion show``: a finished job in the browser, map over map."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion import experiments
from slamfusion.cli import options
from slamfusion.cli.help import Command, Number
from slamfusion.cli.output import notice, print_if_json
from slamfusion.cli.paths import FILE
from slamfusion.config import FusionNodeConfig, MapFileConfig, RunConfig
from slamfusion.errors import MapFileError, SlamFusionError, counted
from slamfusion.jobs import outputs
from slamfusion.jobs.inputs import load_maps
from slamfusion.json_values import POSE_KEYS

if TYPE_CHECKING:
    from slamfusion.jobs.records import ShowDocument
    from slamfusion.web.scene import Kind, Scene

DEFAULTS = FusionNodeConfig()
MOST_NAMED = 8


@click.command("show", cls=Command, examples=["show out", "show out --port 8080"])
@click.argument("folder", metavar="DIR", type=FILE)
@click.option(
    "--port",
    type=Number(int, 0, 65535),
    default=0,
    metavar="N",
    help="Port of the page. [default: any free port]",
)
@click.option(
    "--host",
    default=DEFAULTS.page_host,
    metavar="ADDRESS",
    help="Address of the page. 0.0.0.0 makes it visible to the whole network. "
    f"[default: {DEFAULTS.page_host}]",
)
@click.option(
    "--drive",
    default="",
    metavar="NAME",
    help="Drive of an experiment to show. [default: the first]",
)
@options.common
def command(folder: Path, port: int, host: str, drive: str) -> None:
    """Show the maps of a run in the browser.

    DIR is a folder that `slamfusion run`, `fuse` or `experiment` wrote, a fused map, or any folder
    with maps. The page shows layers, paths, the difference of two maps, and the value of a cell in
    each map. Ctrl-C ends it.
    """
    from slamfusion.web.server import PageServer  # noqa: PLC0415  (an extra)

    found = read_finished(folder, drive)
    server = PageServer(found.scene, host=host, port=port, report=found.report)
    document: ShowDocument = {"url": server.url, "maps": found.maps}
    if not print_if_json(document):
        print(server.url)
        notice("open that address in a browser; Ctrl-C ends it")
        if found.also:
            notice(f"other drives there, by --drive: {', '.join(found.also)}")
    with contextlib.closing(server), contextlib.suppress(KeyboardInterrupt):
        sys.stdout.flush()
        threading.Event().wait()


@dataclass
class Finished:
    """A folder of maps.

    Attributes:
        maps: names of the layers, in the order in which they are shown.
        also: other drives of the folder, which can be shown by name.
        report: folder of the report.
        config, resolution: how the files of the maps are read; see ``load_maps``.
    """

    scene: Scene
    maps: list[str] = field(default_factory=list)
    also: Sequence[str] = ()
    report: Path | None = None
    config: RunConfig = field(default_factory=RunConfig)
    resolution: float | None = None

    def put(self, name: str, kind: Kind, path: Path, *, shown: bool = True) -> None:
        """Load a map and show it; one that cannot be read becomes an event."""
        self.maps.append(name)
        size_m = self.resolution
        try:
            (grid,) = load_maps([path], self.config, resolution=size_m, warn=lambda _: None)
        except (SlamFusionError, OSError) as error:
            self.scene.put_event("error", f"{name} is not shown: {error}")
        else:
            self.scene.put_map(name, grid, kind, is_shown=shown)

    def put_paths(self, files: Mapping[str, Path]) -> None:
        """Put each path in the frame of the map of its name; a missing file is left out."""
        from slamfusion.io.trajectories import read_trajectory  # noqa: PLC0415

        paths = {}
        for name, file in files.items():
            try:
                if file.exists():
                    paths[name] = read_trajectory(file)
            except SlamFusionError as error:
                self.scene.put_event("error", f"the path of {name} is not shown: {error}")
        self.scene.put_paths(paths)


def read_finished(place: Path, drive: str = "") -> Finished:
    """Read what ``run``, ``fuse`` or an experiment wrote, or any folder with maps.

    Without a record of their alignment, each map is shown in its own frame.

    Args:
        place: the folder; or of several fusions in one folder the map or the record of one.
        drive: of an experiment; empty: the first.
    """
    path = _record_of(place)
    if path is not None:
        try:
            return _read_record(path, json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, RecursionError, LookupError, TypeError) as error:
            message = f"{path}: cannot be read as the record of a run ({error}); run it again"
            raise MapFileError(message) from error
    if not place.is_dir():
        raise MapFileError(f"{place}: found no run and no maps there; name a folder with either")
    files = {path.stem: path for path in sorted(place.glob("*.yaml"))}
    return _read_maps(place, files) if files else _read_drive(place, drive)


def _record_of(place: Path) -> Path | None:
    """Return the record of a run or fusion, if there is one."""
    if place.is_file():
        path = place.with_suffix(".json")
        if not path.exists():
            message = f"{place}: no record of its fusion next to it ({path.name}); name the folder"
            raise MapFileError(message)
        return path
    if (place / outputs.RUN_RECORD).exists():
        return place / outputs.RUN_RECORD
    ends = (".yaml", f"{outputs.AGREEMENT_END}.yaml")
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


def _finished(title: str) -> Finished:
    """Return an empty scene whose times count from the start of the drive."""
    from slamfusion.web.scene import Scene  # noqa: PLC0415  (loads slowly)

    return Finished(Scene(f"SLAMfusion: {title}", is_live=False, clock=lambda: 0.0))


def _read_record(path: Path, record: Mapping[str, Any]) -> Finished:
    from slamfusion.geometry import Pose2  # noqa: PLC0415  (loads slowly)
    from slamfusion.web import scene  # noqa: PLC0415

    inputs, stem, is_run = record["inputs"], path.with_suffix(""), path.name == outputs.RUN_RECORD
    found = _finished(path.absolute().parent.name if is_run else path.stem)
    report = stem.with_name(outputs.REPORT)
    found.report = report if (report / "report.html").exists() else None
    layers = {item["name"]: scene.layer_name(item["name"]) for item in inputs}
    entries = []
    for item in inputs:
        # An input that was never aligned has no pose.
        pose = None if item["dx_m"] is None else Pose2(*(item[key] for key in POSE_KEYS))
        told = layers[item["name"]], item["reason"], item["score"], pose
        entries.append(scene.layer_status(*told, votes=item["accepted"]))
    # The map that is drawn at the fused path is in the fused frame.
    drawn = stem.with_name(f"{outputs.DRAWN}.yaml")
    has_drawn = is_run and drawn.exists()
    if has_drawn:
        entries.append(scene.layer_status(outputs.DRAWN, "drawn at the fused path"))
    _put_status(found.scene, record, entries)

    def near(name: str) -> Path:
        """Return a file that the record names: from here, or from the record's folder."""
        own = stem.parent / name
        return own if not Path(name).exists() and own.exists() else Path(name)

    # Producers write their maps into the folder; the given maps come after them.
    given = record.get("saved_maps", ())
    made = [item["name"] for item in inputs[: len(inputs) - len(given)]]
    if is_run and "producers" in record:
        paths = {name: stem.with_name(f"{name}.tum") for name in made}
        paths |= {item["name"]: near(item["file"]) for item in record.get("saved_paths") or ()}
        voted = [item["name"] for item in inputs if item["accepted"] and item["name"] in paths]
        fused = {scene.FUSED: stem.with_name(outputs.FUSED_PATH)}
        found.put_paths(fused | {layers[name]: paths[name] for name in voted})
    found.put(scene.FUSED, "fused", stem.with_name(f"{stem.name}.yaml"))
    agreement = stem.with_name(f"{stem.name}{outputs.AGREEMENT_END}.yaml")
    found.put(scene.AGREEMENT, "agreement", agreement)
    files = [*(stem.with_name(f"{name}.yaml") for name in made), *map(near, given)]
    settings = (record.get("config") or {}).get("map_files") or {}
    found.config = RunConfig(map_files=MapFileConfig(bool(settings.get("legacy_unknown"))))
    found.resolution = record.get("resolution")
    for item, file in zip(inputs, files, strict=True):
        found.put(layers[item["name"]], "input", file, shown=item["accepted"])
    if has_drawn:
        found.put(outputs.DRAWN, "input", drawn)
    return found


def _put_status(shown: Scene, record: Mapping[str, Any], entries: list[dict[str, Any]]) -> None:
    from slamfusion.evidence.recommendation import Recommendation  # noqa: PLC0415  (loads slowly)

    figures = {
        "reference": str(record.get("reference")),
        "fused by": str(record.get("fused_mode") or "vote"),
        "phantom cells": str(record.get("phantom_cells")),
        "device": str(record.get("device")),
    }
    others = len(record.get("groups") or ()) - 1
    if others > 0:
        figures["further groups, not shown"] = str(others)
    headline, level, places = f"{record.get('fused_count')} maps were fused", "plain", []
    for stamp_s, event_level, text in sorted(_events(record)):
        shown.put_event(event_level, text, stamp_s)
    if record.get("recommendation"):
        answer = Recommendation.from_json(record["recommendation"])
        headline, level = answer.headline, answer.tone
        places = [(place.x, place.y) for place in answer.check]
        if answer.best_single:
            figures = {"single SLAM": answer.best_single, **figures}
    shown.put_status(entries, headline=headline, level=level, figures=figures, places=places)


def _events(record: Mapping[str, Any]) -> Iterable[tuple[float, Any, str]]:
    """Yield the time, the level and the words of what happened on the drive."""
    for number, place in enumerate((record.get("recommendation") or {}).get("check", ()), start=1):
        yield place["from_s"], "warn", f"place {number} to check: {place['what']}"
    for path in record.get("path_evidence") or ():
        for span in path["spans"]:
            if not span["agrees"]:
                away = f"leaves the recommended path, by up to {span['gap_m']:.1f} m"
                yield span["from_s"], "warn", f"{path['name']} {away}"
                yield span["to_s"], "ok", f"{path['name']} is back on the recommended path"


def _read_maps(folder: Path, files: Mapping[str, Path]) -> Finished:
    from slamfusion.web import scene  # noqa: PLC0415  (loads slowly)

    found = _finished(folder.absolute().name)
    inputs = [name for name in files if name not in {outputs.FUSED, outputs.AGREEMENT}]
    layers = {name: scene.layer_name(name) for name in inputs}
    entries = [scene.layer_status(layers[name], "in its own frame") for name in inputs]
    words = f"{counted(len(files), 'map')}; no record of their alignment"
    found.scene.put_status(entries, headline=words, level="plain", figures={})
    paths = {layers[name]: folder / f"{name}.tum" for name in inputs}
    found.put_paths({scene.FUSED: folder / outputs.FUSED_PATH, **paths})
    if outputs.FUSED in files:
        found.put(scene.FUSED, "fused", files[outputs.FUSED])
    if outputs.AGREEMENT in files:
        found.put(scene.AGREEMENT, "agreement", files[outputs.AGREEMENT])
    for name in inputs:
        found.put(layers[name], "input", files[name])
    return found


def _read_drive(folder: Path, drive: str) -> Finished:
    """Read the maps of one drive of an experiment, over the truth."""
    from slamfusion.web.scene import TRUTH, layer_status  # noqa: PLC0415

    names = experiments.runs.kept_runs(folder)
    if not names:
        raise MapFileError(
            f"{folder}: no map in it (NAME.yaml, or of an experiment trials/NAME.npz); name the "
            "folder of a run"
        )
    chosen = drive or names[0]
    if chosen not in names:
        listed = ", ".join(names[:MOST_NAMED])
        raise MapFileError(f"{folder}: no drive {drive!r} in it; --drive takes one of {listed}")
    truth, maps = experiments.runs.kept_maps(folder, chosen)
    found = _finished(chosen)
    found.also = [name for name in names if name != chosen]
    what = "a true wall that it lacks is shown as unknown"
    entries = [layer_status(grid.name, what) for grid in maps]
    words = f"{chosen}: {counted(len(maps), 'map')} over the truth"
    figures = {"other drives, by --drive": ", ".join(found.also) or "none"}
    found.scene.put_status(entries, headline=words, level="plain", figures=figures)
    found.scene.put_map(TRUTH, truth, "fused")
    for grid in maps:
        found.scene.put_map(grid.name, grid, "input", is_shown=grid is maps[0])
    found.maps = [TRUTH, *(grid.name for grid in maps)]
    return found
