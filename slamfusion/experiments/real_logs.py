"""Fusion on recorded drives: the producers' and the fused maps against a reference map.

The reference is drawn from the scans at the best known trajectory, with the graph's map drawing;
its own errors are part of every number here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.measured import Row, map_figures, result_rows
from slamfusion.experiments import fusions
from slamfusion.experiments.page import Experiment
from slamfusion.experiments.runs import RunResult, Setup, Tell, packed_maps, run_all
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan, open_log, read_trajectory
from slamfusion.jobs.cases import CaseFile, place_files
from slamfusion.jobs.inputs import Warn, log_warning
from slamfusion.jobs.outputs import DRAWN
from slamfusion.jobs.results import map_inputs
from slamfusion.jobs.run_files import SavedMaps, free_name
from slamfusion.slam.common.mapper import MapJob
from slamfusion.slam.graph.node_map import Node, NodeMap
from slamfusion.slam.registry import BUILT_IN, settings_of
from slamfusion.trajectory import Trajectory

TITLE = "Fusion on recorded drives"
REFERENCE = "reference"
# Rows of the table besides the producers' maps and the one drawn at the fused path.
ROWS = (REFERENCE, fusions.FUSED_PATH, *fusions.FUSIONS, *map(fusions.drawn_at, BUILT_IN))
# Largest difference of the stamps of a scan and its reference pose (rounding), seconds.
SAME_TIME_S = 0.02
FIGURES = (
    "error",
    "map_to_truth_mean_m",
    "map_to_truth_p95_m",
    "truth_to_map_mean_m",
    "wall_f1",
    "faces_f1",
    "doubled_wall_share",
    "ate_rmse_m",
)


@dataclass(frozen=True)
class RealLog:
    """A recorded drive: log and best known trajectory, relative to the folder of the data sets."""

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


def logs_there(folder: Path, warn: Warn) -> list[str]:
    """Return the drives of ``REAL_LOGS`` whose files are in a folder."""
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
    folder: Path, names: Sequence[str], setup: Setup, others: Mapping[str, SavedMaps] | None = None
) -> Experiment:
    """Run the producers on drives of ``REAL_LOGS``, fuse in every way, and measure all maps.

    Args:
        others: saved maps of other SLAMs by drive; see ``other_slams``.
    """
    given = others or {}
    read = []
    for name, saved in given.items():
        read += map_inputs("map", name, saved.files)
        read += [("path", name, path) for path in saved.paths.values()]
    for name in names:
        files = REAL_LOGS[name]
        read += [("log", name, folder / files.log), ("truth", name, folder / files.reference)]

    def work(name: str, _: RunConfig, tell: Tell) -> RunResult:
        return _compare_on_log(folder, name, setup, given.get(name, SavedMaps((), (), {})), tell)

    found = run_all({name: name for name in names}, work, setup, read)
    inputs = [*BUILT_IN, *(name for saved in given.values() for name in saved.names)]
    return Experiment(
        "real-logs",
        TITLE,
        [row for result in found for row in result.rows],
        FIGURES,
        inputs=list(dict.fromkeys(inputs)),
        fusions=fusions.FUSIONS,
        notes=[(name, own.notes) for name, own in zip(names, found, strict=True)],
        remarks=[result.remark for result in found],
        read=read,
    )


def other_slams(
    names: Sequence[str], maps: Sequence[CaseFile], paths: Sequence[CaseFile]
) -> dict[str, SavedMaps]:
    """Return other SLAMs' maps and paths by drive, matched by file names (``jobs.cases``)."""
    files = {(item.case, item.method): item.path for item in place_files(names, maps)}
    found = {}
    for item in place_files(names, paths):
        of_drive = [key for key in files if key[0] == item.case]
        key = of_drive[0] if len(of_drive) == 1 else (item.case, item.method)
        if key not in files or key in found:
            raise ConfigError(f"{item.path}: which map of {item.case} is it of? name it as that is")
        found[key] = item.path
    others = {}
    for name in names:
        own = {key: free_name(key[1], ROWS) for key in files if key[0] == name}
        others[name] = SavedMaps(
            tuple(files[key] for key in own),
            tuple(own.values()),
            {shown: found[key] for key, shown in own.items() if key in found},
        )
    return others


def _compare_on_log(
    folder: Path, name: str, setup: Setup, saved: SavedMaps, tell: Tell
) -> RunResult:
    config, device, files = setup.config, setup.device, REAL_LOGS[name]
    scans = tuple(open_log(folder / files.log, config.log))
    trajectory = read_trajectory(folder / files.reference, config.log)
    reference, count = reference_map(scans, trajectory, config, device)
    others, their_paths = saved.load(config, None, log_warning)

    produced = fusions.produce_maps(dict.fromkeys(BUILT_IN, scans), config, device, tell)
    if not produced.paths:
        reasons = "; ".join(produced.notes.values())
        raise SlamFusionError(f"{name}: no producer made a map ({reasons})")
    made = fusions.fuse_in_every_way(
        produced,
        scans,
        config,
        device,
        saved=others,
        saved_paths=their_paths,
        drawn_cell_m=reference.resolution,
    )
    errors = made.path_errors(trajectory, SAME_TIME_S)
    if fusions.FUSED_PATH in errors:
        errors[DRAWN] = errors[fusions.FUSED_PATH]
    rows: list[Row] = []
    differences = {}
    for method, grid in made.maps.items():
        if grid is not None:
            found = fusions.against_truth(grid, reference, config, device)
            there = found.map_to_truth_m
            figures = {
                **map_figures(found),
                "map_to_truth_p95_m": None if there is None else there.p95,
                "ate_rmse_m": errors.get(method),
            }
            rows += result_rows(name, "", method, figures)
            differences[method] = found.difference
    doubled = doubled_wall_share(reference.classified(config.fusion.normalize).cells == 1)
    rows += result_rows(name, "", REFERENCE, {"doubled_wall_share": doubled})
    remark = f"the reference map is drawn by {count} of {len(scans)} scans at {files.source}"
    if made.choice:
        remark += f"; the scans support the path of {made.choice} best"
    maps = packed_maps(differences, reference.resolution)
    return RunResult(rows, made.notes, maps, f"{name}: {remark}.")


def reference_map(
    scans: Sequence[LogScan], trajectory: Trajectory, config: RunConfig, device: ComputeDevice
) -> tuple[OccupancyGrid, int]:
    """Return the map drawn from scans at robot poses in its frame, and the number of scans.

    Only scans with a pose at their own time are drawn: interpolated poses double walls.
    """
    settings = settings_of(config, "graph")
    stamps = np.array([item.scan.stamp_s for item in scans])
    nearest, is_known = trajectory.matches(stamps, SAME_TIME_S)
    if not is_known.any():
        raise SlamFusionError(f"no scan of the log has a pose at its time in {trajectory.name}")
    nodes = []
    for index in np.flatnonzero(is_known).tolist():
        scan = scans[index].scan
        ends = scan.points(scan.is_hit(settings.usable_range_m)).astype(np.float32)
        laser = np.array([scan.mount.x, scan.mount.y], dtype=np.float32)
        nodes.append(Node(ends, laser, 0.0, None))
    job = MapJob(nodes, trajectory.poses[nearest[is_known]], REFERENCE)
    return NodeMap(settings, device).draw(job), len(nodes)
