"""Fusion on recorded drives: each producer's map and the fused ones against the reference map.

Nobody knows the truth of a recorded building. The nearest thing to it is the map that is drawn
from the scans at the poses of the best trajectory known, cell by cell as the graph draws its map;
its own errors are part of every number here.
"""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.evaluation import MapError, Row, doubled_wall_share, result_rows
from slamfusion.evidence import JudgedScans
from slamfusion.experiments.drive_paths import (
    CHOICE,
    DRAWN,
    FUSED_PATH,
    draw_paths,
    drawn_at,
    drive_layers,
    judge_scans,
    path_errors,
    weigh_paths,
)
from slamfusion.experiments.records import RatiosJson, RealLogNumbersJson, RealLogTableJson
from slamfusion.experiments.sheets import Sheet
from slamfusion.experiments.voting import FUSIONS, against_truth, vote_every_way
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan, open_log, read_trajectory
from slamfusion.jobs.cases import CaseFile, place_files
from slamfusion.jobs.fuse_drive import produce_maps
from slamfusion.jobs.inputs import Warn
from slamfusion.jobs.saved_maps import SavedMaps, free_name, path_at_scans
from slamfusion.slam.common.mapper import MapJob
from slamfusion.slam.graph.node_map import Node, NodeMap
from slamfusion.slam.registry import BUILT_IN, settings_of
from slamfusion.trajectory import Trajectory

__all__ = [
    "NAME",
    "REAL_LOGS",
    "RealLog",
    "RealLogRow",
    "RealLogTable",
    "compare_on_logs",
    "logs_there",
    "other_slams",
    "reference_map",
]

_LOG = logging.getLogger(__name__)

NAME = "real-logs"
TITLE = "Fusion on recorded drives"
REFERENCE = "reference"
# Rows of the table beside the producers' maps and what the scans draw at the fused path.
ROWS = (REFERENCE, FUSED_PATH, *FUSIONS, *map(drawn_at, BUILT_IN))
# A scan belongs to a pose of the reference at its very time; stamps are rounded here and there.
SAME_TIME_S = 0.02
NO_NUMBER = "-"
# Faces this near to the reference's are right, metres.
FACES_M = 0.1

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class RealLog:
    """A recorded drive of the data sets.

    Attributes:
        log: scans with odometry, in the folder of the data sets.
        reference: the best trajectory known, likewise.
        source: what that is, in words.
    """

    log: str
    reference: str
    source: str


REAL_LOGS: dict[str, RealLog] = {
    "mit-csail": RealLog(
        "mit-csail/mit-csail.clf.gz",
        "mit-csail/mit-csail-reference-graph.log.gz",
        "the nodes of the reference graph, 0.004 m on the relations",
    ),
    "intel": RealLog(
        "intel/intel-910-raw.log.gz",
        "intel/intel-estimate-11439.txt.gz",
        "the estimate of another laser SLAM over all scans, 0.022 m on the relations",
    ),
}


@dataclass(frozen=True, eq=False)
class RealLogRow:
    """One map of a recorded drive.

    Attributes:
        log: name of the drive.
        method: a producer, a way to vote, what the scans draw at a path, or the reference map.
        doubled_share: of its wall cells, with a parallel wall close by.
        error: against the reference map, where the map lies best on it; None for that map itself,
            and for a map that is missing.
        path_error_m: absolute error of the path of a producer, and of the fused one in the row of
            the map drawn at it, against the reference trajectory; None for other maps.
    """

    log: str
    method: str
    doubled_share: float
    error: MapError | None
    path_error_m: float | None = None

    def numbers(self) -> RealLogNumbersJson:
        """Return what is measured, by name; lengths in metres."""
        error = self.error
        there = None if error is None else error.map_to_truth
        back = None if error is None else error.truth_to_map
        return {
            "error": None if error is None else error.error,
            "wall_distance_mean_m": None if there is None else there.mean_m,
            "wall_distance_p95_m": None if there is None else there.p95_m,
            "reference_to_map_mean_m": None if back is None else back.mean_m,
            "wall_f1": None if error is None else error.wall_f1,
            "faces_f1": None if error is None else error.faces.f1(FACES_M),
            "doubled_wall_share": self.doubled_share,
            "path_error_m": self.path_error_m,
        }


COLUMNS = {
    "error": ("[F16] error", "{:.1f}"),
    "wall_distance_mean_m": ("to the reference's walls, mean m", "{:.3f}"),
    "wall_distance_p95_m": ("95 %, m", "{:.3f}"),
    "reference_to_map_mean_m": ("from them, mean m", "{:.3f}"),
    "wall_f1": ("wall F1", "{:.3f}"),
    "faces_f1": ("faces F1 at 0.1 m", "{:.3f}"),
    "doubled_wall_share": ("doubled walls", "{:.1%}"),
    "path_error_m": ("path, ATE m", "{:.3f}"),
}


@dataclass(frozen=True)
class RealLogTable:
    """All maps of all recorded drives.

    Attributes:
        title: of the experiment.
        rows: of each drive the producers, the ways to vote, and the reference map.
        notes: what went wrong, by drive and method.
        references: what the reference map of each drive was drawn from.
        choices: the SLAM of each drive whose path is taken, see ``choose_path``, where the
            scans can tell.
        others: SLAMs whose saved maps took part beside the producers, by drive.
    """

    title: str
    rows: tuple[RealLogRow, ...]
    notes: Mapping[tuple[str, str], str]
    references: Mapping[str, str]
    choices: Mapping[str, str] = field(default_factory=dict)
    others: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def logs(self) -> list[str]:
        """Return the drives, in order."""
        return list(dict.fromkeys(row.log for row in self.rows))

    def _best_input(self, log: str) -> str:
        """Return the SLAM of a drive whose map has the smallest error."""
        errors = self._errors(log)
        inputs = (*BUILT_IN, *self.others.get(log, ()))
        return min((name for name in inputs if name in errors), key=errors.__getitem__)

    def _errors(self, log: str) -> dict[str, float]:
        """Return the [F16] errors of a drive, by method."""
        return {row.method: row.error.error for row in self.rows if row.log == log and row.error}

    def ratios(self, log: str) -> dict[str, float]:
        """Return the error of every way to vote over that of the drive's best input."""
        errors = self._errors(log)
        best = errors[self._best_input(log)]
        return {mode: errors[mode] / best for mode in FUSIONS if mode in errors}

    def overall(self) -> dict[str, RatiosJson]:
        """Return for each way to vote the mean of the ratios of all drives, and the worst."""
        found: dict[str, RatiosJson] = {}
        for mode in FUSIONS:
            ratios = [self.ratios(log)[mode] for log in self.logs() if mode in self.ratios(log)]
            if ratios:
                found[mode] = {"ratio": sum(ratios) / len(ratios), "worst": max(ratios)}
        return found

    def borne_out(self) -> frozenset[str]:
        """Return nothing: single drives of different places allow no test."""
        return frozenset()

    def sheets(self, *, details: bool) -> list[Sheet]:
        """Return a table for each drive; ``details`` adds nothing."""
        del details
        found = []
        for log in self.logs():
            rows = []
            for row in (row for row in self.rows if row.log == log):
                numbers: dict[str, object] = {**row.numbers()}
                cells = [
                    NO_NUMBER if (value := numbers[key]) is None else form.format(value)
                    for key, (_, form) in COLUMNS.items()
                ]
                rows.append((row.method, *cells))
            heading = ("map", *(text for text, _ in COLUMNS.values()))
            note = f"Against the map that is drawn by {self.references[log]}."
            found.append(Sheet(log, heading, tuple(rows), note))
        if self.notes:
            rows_left = tuple((log, what, why) for (log, what), why in self.notes.items())
            found.append(Sheet("What was left out", ("log", "what", "reason"), rows_left))
        return found

    def sentences(self) -> list[str]:
        """Return each way to vote against the best input, and over all drives."""
        lines = []
        for log in self.logs():
            best = self._best_input(log)
            lines += [
                f"{log}: {mode} {100.0 * (ratio - 1.0):+.1f} % against {best}, the best input."
                for mode, ratio in self.ratios(log).items()
            ]
            if log in self.choices:
                lines.append(f"{log}: the scans bear out the path of {self.choices[log]} best.")
        for mode, values in self.overall().items():
            change, worst = (100.0 * (values[key] - 1.0) for key in ("ratio", "worst"))
            lines.append(
                f"all logs: {mode} {change:+.1f} % against the best inputs, "
                f"{worst:+.1f} % where it stands worst."
            )
        return lines

    def to_csv(self) -> str:
        """Return every map, a line each."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(["log", "map", *COLUMNS])
        for row in self.rows:
            writer.writerow([row.log, row.method, *row.numbers().values()])
        return buffer.getvalue()

    def figure_rows(self) -> list[Row]:
        """Return every map of every drive; the reference maps are no methods."""
        return [
            figure
            for row in self.rows
            if row.method != REFERENCE
            for figure in result_rows(row.log, "", row.method, {**row.numbers()})  # type: ignore[dict-item]
        ]

    def to_json(self) -> RealLogTableJson:
        """Return every map and what they say."""
        return {
            "title": self.title,
            "maps": [{"log": row.log, "map": row.method, **row.numbers()} for row in self.rows],
            "overall": self.overall(),
            "notes": [
                {"log": log, "what": what, "reason": why} for (log, what), why in self.notes.items()
            ],
            "references": dict(self.references),
            "choices": dict(self.choices),
            "others": {log: list(names) for log, names in self.others.items()},
        }


def logs_there(folder: Path, warn: Warn) -> list[str]:
    """Return the recorded drives of ``REAL_LOGS`` whose files lie in a folder.

    Args:
        folder: of the data sets.
        warn: told in a sentence of each that is skipped.

    Raises:
        SlamFusionError: there is none.
    """
    names = []
    for name, files in REAL_LOGS.items():
        absent = [path for path in (files.log, files.reference) if not (folder / path).is_file()]
        if absent:
            warn(f"skipped: {name}: {folder / absent[0]} is not there")
        else:
            names.append(name)
    if not names:
        message = f"no recorded drive in {folder}; wanted {' or '.join(REAL_LOGS)} there"
        raise SlamFusionError(message)
    return names


def compare_on_logs(
    folder: Path,
    names: Sequence[str],
    config: RunConfig,
    device: ComputeDevice,
    progress: Progress | None = None,
    others: Mapping[str, SavedMaps] | None = None,
) -> RealLogTable:
    """Run the producers on recorded drives, fuse their maps in every way, and measure all maps.

    Args:
        folder: of the data sets.
        names: of ``REAL_LOGS``; those whose files lie there.
        config: settings of producers and fusion.
        device: computes.
        progress: told the drives, and the scans of each producer.
        others: saved maps of other SLAMs, with their paths or without, by drive; see
            ``other_slams``.

    Raises:
        LogError, TrajectoryError: a file cannot be read.
        SlamFusionError: no producer made a map, or no scan has a pose in the reference.
        OSError: a file cannot be opened.
    """
    rows: list[RealLogRow] = []
    notes: dict[tuple[str, str], str] = {}
    references: dict[str, str] = {}
    choices: dict[str, str] = {}
    took_part: dict[str, Sequence[str]] = {}
    for name in names:
        saved = (others or {}).get(name, SavedMaps((), (), {}))
        part = _compare_on_log(folder, name, config, device, progress, saved)
        rows += part.rows
        notes |= part.notes
        references |= part.references
        choices |= part.choices
        took_part |= part.others
    return RealLogTable(TITLE, tuple(rows), notes, references, choices, took_part)


def other_slams(
    names: Sequence[str], maps: Sequence[CaseFile], paths: Sequence[CaseFile]
) -> dict[str, SavedMaps]:
    """Return the saved maps of other SLAMs, and the paths that were found with them, by drive.

    Whose drive a file is of, and by which SLAM, its name tells; see ``slamfusion.jobs.cases``.

    Args:
        names: of the drives.
        maps: of other SLAMs.
        paths: of some of these.

    Raises:
        ConfigError: a file is of no drive, or a path of no map.
    """
    own = place_files(names, maps)
    files = {(item.case, item.method): item.path for item in own}
    found = {}
    for item in place_files(names, paths):
        of_drive = [key for key in files if key[0] == item.case]
        key = of_drive[0] if len(of_drive) == 1 else (item.case, item.method)
        if key not in files or key in found:
            message = f"{item.path}: which map of {item.case} is it of? name it as that is"
            raise ConfigError(message)
        found[key] = item.path
    return {
        name: SavedMaps(
            tuple(path for (case, _), path in files.items() if case == name),
            tuple(free_name(method, ROWS) for case, method in files if case == name),
            {
                free_name(method, ROWS): path
                for (case, method), path in found.items()
                if case == name
            },
        )
        for name in names
    }


def _compare_on_log(
    folder: Path,
    name: str,
    config: RunConfig,
    device: ComputeDevice,
    progress: Progress | None,
    saved: SavedMaps,
) -> RealLogTable:
    """Return the maps of one drive."""
    files = REAL_LOGS[name]
    scans = tuple(open_log(folder / files.log, config.log))
    trajectory = read_trajectory(folder / files.reference, config.log)
    reference, count = reference_map(scans, trajectory, config, device)
    others, their_paths = saved.load(config, None, _LOG.warning)

    def tell(producer: str, done: int, total: int) -> None:
        if progress is not None:
            progress(f"{name}, {producer}", done, total)

    fed = dict.fromkeys(BUILT_IN, scans)
    made = produce_maps(fed, config, device, tell)
    notes = dict(made.reasons)
    if not made.grids:
        message = f"{name}: no producer made a map ({'; '.join(notes.values())})"
        raise SlamFusionError(message)
    # Saved maps may have any frame.
    align = replace(config.fusion.align, shared_frame=not others)
    config = replace(config, fusion=replace(config.fusion, align=align))
    judged = judge_scans(scans, notes)
    at_scans = _at_scans(their_paths, judged, notes)
    weighed = weigh_paths(judged, {**made.paths, **at_scans}, device, notes)
    fed |= dict.fromkeys(at_scans, scans)
    layers = drive_layers([*made.grids, *others], weighed, scans, fed, device)
    fused = vote_every_way(layers, config, device, notes, shared_frame=not others)

    errors = path_errors(weighed, trajectory, SAME_TIME_S)
    if FUSED_PATH in errors:
        errors[DRAWN] = errors[FUSED_PATH]
    drawn = draw_paths(scans, weighed, reference.resolution, device)

    rows = []
    maps = {**made.maps, **{grid.name: grid for grid in others}}
    for method, grid in {**maps, **fused, **drawn}.items():
        if grid is not None:
            found = against_truth(grid, reference, config, device)
            doubled = _doubled(grid, config)
            rows.append(RealLogRow(name, method, doubled, found, errors.get(method)))
    rows.append(RealLogRow(name, REFERENCE, _doubled(reference, config), None))
    why = {(name, what): text for what, text in notes.items()}
    drawn_from = f"{count} of {len(scans)} scans at {files.source}"
    choices = {name: weighed.choice} if weighed.choice else {}
    took_part = {name: saved.names} if others else {}
    return RealLogTable(TITLE, tuple(rows), why, {name: drawn_from}, choices, took_part)


def _at_scans(
    paths: Mapping[str, Trajectory], judged: JudgedScans | None, notes: dict[str, str]
) -> dict[str, Trajectory]:
    """Return paths of other SLAMs at the scans; ``notes`` are told which were not used, and why."""
    found = {}
    for name, path in paths.items():
        if judged is None:
            notes[f"{name}, path"] = notes[CHOICE]
            continue
        try:
            found[name] = path_at_scans(path, judged)
        except SlamFusionError as error:
            notes[f"{name}, path"] = str(error)
    return found


def _doubled(grid: OccupancyGrid, config: RunConfig) -> float:
    return doubled_wall_share(grid, normalize=config.fusion.normalize)


def reference_map(
    scans: Sequence[LogScan], trajectory: Trajectory, config: RunConfig, device: ComputeDevice
) -> tuple[OccupancyGrid, int]:
    """Return the map that scans draw at known poses, and how many scans drew it.

    Only scans with a pose at their very time draw: carried on by odometry to the scans between, or
    interpolated, poses are off by enough to double walls (on mit-csail 18 and 10 % of them, not 7).

    Args:
        scans: in the order of time.
        trajectory: poses of the robot in the frame of the map.
        config: the graph's settings say how cells are counted.
        device: computes.

    Raises:
        SlamFusionError: no scan has a pose.
    """
    settings = settings_of(config, "graph")
    stamps = np.array([item.scan.stamp_s for item in scans])
    nearest, is_known = trajectory.matches(stamps, SAME_TIME_S)
    if not is_known.any():
        message = f"no scan of the log has a pose at its time in {trajectory.name}"
        raise SlamFusionError(message)
    nodes = []
    for index in np.flatnonzero(is_known).tolist():
        scan = scans[index].scan
        ends = scan.points(scan.is_hit(settings.usable_range_m)).astype(np.float32)
        laser = np.array([scan.mount.x, scan.mount.y], dtype=np.float32)
        nodes.append(Node(ends, laser, 0.0, None))
    job = MapJob(nodes, trajectory.poses[nearest[is_known]], REFERENCE)
    return NodeMap(settings, device).draw(job), len(nodes)
