"""What the fused map loses when one of the producers goes wrong half-way, on simulated drives.

    python -m tests.benchmarks.bench_partial --drives out/drives --make
    python -m tests.benchmarks.bench_partial --drives out/drives --from 70 --faults "shifted by 2 m"

Each producer in turn is made wrong from a part of the drive on: its path is turned, shifted, or
stands still (its odometry is lost), and its map is that of all its scans at this path, drawn by
``draw_map``. The maps are fused by consensus, with every map as it is, with the layer of whoever
left the others drawn anew without that time, and with that time filled at the fused path; each is
held against the true map beside the fusion of the three producers' own maps, which nothing befell.
Last, the map is drawn at the fused path, as ``run`` does, and held beside the one that is drawn
without the fault. All have the frame of one reference, a producer that is not the harmed one: the
lattice that the cells lie on changes the figures by up to 0.02. Precision and recall of walls are
those of ``evaluate``: faces at 0.1 m, and walls as [F16] counts them.

Paths are laid on the true one where they have a vote: of a path that breaks in the middle either
half is right. Faulty seconds are those in which the harmed producer's path has left the true one by
0.3 m, good seconds those of all producers in which a path has not.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.table import Table

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.evidence import Exclusions, JudgedScans, find_exclusions, judged_scans, score_paths
from slamfusion.evidence.drawn_map import DrawnScan, draw_map, drawn_scans
from slamfusion.evidence.exclusion import parted
from slamfusion.evidence.path_frames import fit_frame, fit_onto, pose_distances
from slamfusion.fusion.path_check import moved_path
from slamfusion.geometry import compose_poses
from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.fuse_drive import Filling, Layers, draw_layers, fuse_layers
from slamfusion.jobs.fused_path import draw_like, fuse_weighed_paths
from slamfusion.jobs.inputs import RUN_DEFAULTS
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory
from tests.benchmarks.bench_evidence import moved_from
from tests.benchmarks.record import add_record_option, console_for
from tests.support.evidence_drives import Drive, drive_trials, key_of, make_drive, read_drive

F64 = npt.NDArray[np.float64]
Fault = Callable[[Trajectory, float], Trajectory]
# Course, laser and world of each place: corridors, an office, a hall with people.
PLACES = "corridor loop/rplidar/1,slip/rplidar/404,people/rplidar/505"
SHARES = "50,70,90"
FACES_M = 0.1
# What a fault may cost.
MOST_LOST = 0.01
SECONDS = ("left", "left excluded", "after", "after excluded", "good", "good excluded")
MEASURES = ("faces precision", "faces recall", "walls precision", "walls recall")
# What becomes of the map: all maps vote as they are; layers without the excluded time, and filled,
# vote; the map is drawn at the fused path.
AS_MADE, WITHOUT, FILLED, DRAWN = WAYS = ("as made", "without", "filled", "drawn")


def stood_still(path: Trajectory, share: float) -> Trajectory:
    """Return a path that stands still from a share of it on."""
    first = int(share * len(path))
    poses = path.poses.copy()
    poses[first:] = poses[first]
    return Trajectory(path.stamps_s, poses, path.name)


def moved_by(*motion: float) -> Fault:
    """Return what moves a path from a share of it on, by a motion in the robot's frame there."""
    return lambda path, share: moved_from(path, share, motion)


FAULTS: dict[str, Fault] = {
    **{f"turned by {deg} deg": moved_by(0.0, 0.0, math.radians(deg)) for deg in (3, 10, 30)},
    **{f"shifted by {away:g} m": moved_by(0.0, away, 0.0) for away in (0.5, 2.0, 10.0)},
    "odometry lost": stood_still,
}


@dataclass(frozen=True, eq=False)
class Place:
    """A drive on which nothing befell a producer.

    Attributes:
        drive: with the producers' own paths.
        maps: the producers' own, by name.
        truth: the true map.
        drawn: the scans as they are drawn.
        judged: the scans that say who is right.
        unharmed: measures of the fused map of the producers' own maps, and of the drawn one, by
            reference.
    """

    drive: Drive
    maps: dict[str, OccupancyGrid]
    truth: OccupancyGrid
    drawn: list[DrawnScan]
    judged: JudgedScans
    unharmed: dict[str, dict[str, dict[str, float]]]


@dataclass
class Cell:
    """What one fault did.

    Attributes:
        place, harmed, percent, fault: what befell whom, and from where on.
        unharmed: measures of the voted and of the drawn map without the fault.
        found: the same with it, by way.
        accepted: inputs that voted, by way.
        seconds: ``left``, in which the harmed producer's path had left the true one, ``after`` the
            fault, and ``good``, of all producers, in which a path had not; of each those excluded.
    """

    place: str
    harmed: str
    percent: int
    fault: str
    unharmed: dict[str, dict[str, float]]
    found: dict[str, dict[str, float]]
    accepted: dict[str, int]
    seconds: dict[str, float]

    def lost(self, measure: str, way: str) -> float:
        """Return by how much a measure is lower than without the fault."""
        whole = self.unharmed[DRAWN if way == DRAWN else AS_MADE]
        return whole[measure] - self.found[way][measure]


def fused_measures(
    layers: Layers, reference: str, truth: OccupancyGrid, device: ComputeDevice
) -> tuple[dict[str, float], int]:
    """Return precision and recall of a fused map, or of the one fallen back to, and its voters."""
    vote = replace(RUN_DEFAULTS.fusion.vote, mode="consensus")
    fusion_config = replace(RUN_DEFAULTS.fusion, vote=vote, reference=reference)
    config = replace(RUN_DEFAULTS, fusion=fusion_config)
    fusion = fuse_layers(layers, config, device, shared_frame=True)
    grid, voters = fusion.fallback or layers.grids[0], 0
    if fusion.result is not None:
        grid, voters = fusion.result.fused, len(fusion.result.accepted)
    return measures_of(grid, truth, device), voters


def measures_of(
    grid: OccupancyGrid, truth: OccupancyGrid, device: ComputeDevice
) -> dict[str, float]:
    """Return precision and recall of a map."""
    (found,) = evaluate_maps([grid], truth, RUN_DEFAULTS, device)
    faces = {item.tolerance_m: item for item in found.faces.agreements}[FACES_M]
    values = (*(faces.precision, faces.recall), *(found.wall_precision, found.wall_recall))
    return {name: value or 0.0 for name, value in zip(MEASURES, values, strict=True)}


def drawn_at(
    fused: Trajectory, path: Trajectory, own: OccupancyGrid, scans: list[DrawnScan],
    device: ComputeDevice,
) -> OccupancyGrid:  # fmt: skip
    """Return the map that scans draw at the fused path, on the lattice of a producer's map."""
    motion = fit_onto(fused, [path])
    assert motion is not None
    return draw_like(scans, moved_path(fused, motion), device, own)


def read_place(folder: Path, device: ComputeDevice) -> Place:
    """Read a drive, and fuse the producers' own maps as ``run`` does."""
    drive = read_drive(folder)
    maps = {name: load_map(folder / f"{name}.yaml").with_name(name) for name in drive.paths}
    truth = load_map(folder / "truth.yaml")
    grids = list(maps.values())
    judged, scans = judged_scans(drive.scans), drawn_scans(drive.scans)
    evidence = score_paths(judged, drive.paths, device)
    exclusions = find_exclusions(evidence, device)
    fused = fuse_weighed_paths(drive.paths, evidence, exclusions, device).trajectory
    filling = Filling(fused, lambda: scans)
    layers = draw_layers(grids, drive.paths, exclusions, lambda _: scans, device, filling)
    for words in layers.sentences():
        print(f"  {drive.key}, no fault: {words}")
    unharmed = {}
    for name, grid in maps.items():
        drawn = drawn_at(fused, drive.paths[name], grid, scans, device)
        unharmed[name] = {
            AS_MADE: fused_measures(layers, name, truth, device)[0],
            DRAWN: measures_of(drawn, truth, device),
        }
        for way, found in unharmed[name].items():
            print(f"{drive.key} in the frame of {name}, {way}: {_shown(found)}", flush=True)
    return Place(drive, maps, truth, scans, judged, unharmed)


def measure_fault(
    place: Place, harmed: str, percent: int, fault: str, device: ComputeDevice
) -> Cell:
    """Let a fault befall a producer, and fuse."""
    drive = place.drive
    wrong = FAULTS[fault](drive.paths[harmed], percent / 100.0)
    own = place.maps[harmed]
    drawn = draw_map(
        place.drawn, wrong, device, resolution=own.resolution, origin=own.origin, name=harmed
    )
    grids = [drawn if name == harmed else grid for name, grid in place.maps.items()]
    paths = {name: wrong if name == harmed else path for name, path in drive.paths.items()}
    reference = next(name for name in drive.paths if name != harmed)
    evidence = score_paths(place.judged, paths, device)
    exclusions = find_exclusions(evidence, device)
    fused = fuse_weighed_paths(paths, evidence, exclusions, device).trajectory
    voting = {
        AS_MADE: Layers.as_made(grids, paths),
        WITHOUT: draw_layers(grids, paths, exclusions, lambda _: place.drawn, device),
        FILLED: draw_layers(
            grids, paths, exclusions, lambda _: place.drawn, device,
            Filling(fused, lambda: place.drawn),
        ),
    }  # fmt: skip
    found, accepted = {}, {}
    for way, layers in voting.items():
        found[way], accepted[way] = fused_measures(layers, reference, place.truth, device)
    grid = drawn_at(fused, paths[reference], place.maps[reference], place.drawn, device)
    found[DRAWN] = measures_of(grid, place.truth, device)
    return Cell(
        drive.key,
        harmed,
        percent,
        fault,
        place.unharmed[reference],
        found,
        accepted,
        excluded_seconds(drive.truth, paths, harmed, percent, exclusions),
    )


def _shown(measures: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.3f}" for name, value in measures.items())


def excluded_seconds(
    truth: Trajectory, paths: Mapping[str, Trajectory], harmed: str, percent: int, found: Exclusions
) -> dict[str, float]:
    """Return seconds with and without a vote, of the harmed producer and of all; see ``Cell``."""
    seconds = dict.fromkeys(SECONDS, 0.0)
    for name, path in paths.items():
        lasts_s = np.append(np.diff(path.stamps_s), 0.0)
        votes = found.votes_at(name, path.stamps_s)
        true = truth.poses[truth.nearest(path.stamps_s)]
        has_left = parted(_gaps_m(path.poses, true, votes), path.stamps_s)
        is_after = np.arange(len(path)) >= int(percent / 100.0 * len(path))
        kinds = {"left": has_left & (name == harmed), "good": ~has_left}
        kinds["after"] = is_after & (name == harmed)
        for kind, here in kinds.items():
            seconds[kind] += float(lasts_s[here].sum())
            seconds[f"{kind} excluded"] += float(lasts_s[here & ~votes].sum())
    return seconds


def _gaps_m(poses: F64, true: F64, votes: npt.NDArray[np.bool_]) -> F64:
    """Return how far poses are from the true ones when laid on them where a path votes, (N,)."""
    kept = votes if votes.any() else ~votes
    motion = fit_frame(poses[kept], true[kept])
    return pose_distances(compose_poses((motion.x, motion.y, motion.yaw_rad), poses), true)


def places(words: str, folder: Path, device: ComputeDevice, *, make: bool) -> Iterator[Place]:
    """Yield the drives that are asked for."""
    for word in words.split(","):
        course, lidar, world = word.split("/")
        (trial,) = drive_trials([int(world)], courses=[course], lidars=[lidar])
        if make:
            make_drive(trial, folder, device)
        yield read_place(folder / key_of(trial), device)


def cells_table(cells: Sequence[Cell]) -> Table:
    """Return what faults cost the fused map, with all maps as they are and with layers."""
    columns = ("fault", *MEASURES, "each within 0.01", "faulty s excluded", "good s excluded")
    title = f"Lost to a fault, mean (largest): {' > '.join(WAYS)}"
    table = Table(*columns, title=title)
    groups = {fault: [cell for cell in cells if cell.fault == fault] for fault in FAULTS}
    for percent in sorted({cell.percent for cell in cells}):
        groups[f"from {percent} %"] = [cell for cell in cells if cell.percent == percent]
    for place in dict.fromkeys(cell.place for cell in cells):
        groups[place] = [cell for cell in cells if cell.place == place]
    groups["all"] = list(cells)
    for name, own in groups.items():
        if own:
            table.add_row(name, *_figures(own))
    return table


def _figures(cells: Sequence[Cell]) -> list[str]:
    """Return the losses of each measure, how often all are small, and the shares of seconds."""
    losses = np.array(
        [[[cell.lost(measure, way) for way in WAYS] for cell in cells] for measure in MEASURES]
    )
    words = [
        " > ".join(f"{loss.mean():+.3f} ({loss.max():+.3f})" for loss in own.T) for own in losses
    ]
    small = (losses <= MOST_LOST).all(axis=0).mean(axis=0)
    total = {kind: sum(cell.seconds[kind] for cell in cells) for kind in SECONDS}
    shares = [total[f"{kind} excluded"] / max(total[kind], 1e-9) for kind in ("left", "good")]
    within = " > ".join(f"{share:.0%}" for share in small)
    return [*words, within, f"{shares[0]:.1%}", f"{shares[1]:.2%}"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--drives", type=Path, required=True, help="folder that keeps the drives")
    parser.add_argument("--make", action="store_true", help="make the drives that are not there")
    parser.add_argument("--places", default=PLACES, help="COURSE/LASER/WORLD, with commas")
    parser.add_argument("--from", dest="shares", default=SHARES, help="percent of the drive")
    parser.add_argument("--faults", default=",".join(FAULTS))
    parser.add_argument("--harmed", default=",".join(BUILT_IN))
    parser.add_argument("--json", type=Path, help="write what came of each fault")
    parser.add_argument("--device", default="auto")
    add_record_option(parser)
    options = parser.parse_args()
    device = open_device(options.device)
    cells = []
    for place in places(options.places, options.drives, device, make=options.make):
        wanted = itertools.product(
            options.harmed.split(","),
            map(int, options.shares.split(",")),
            options.faults.split(","),
        )
        for harmed, percent, fault in wanted:
            began_s = time.perf_counter()
            cell = measure_fault(place, harmed, percent, fault, device)
            cells.append(cell)
            lost = ", ".join(
                f"{name} {' > '.join(f'{cell.lost(name, way):+.3f}' for way in WAYS)}"
                for name in MEASURES
            )
            seconds = ", ".join(f"{kind} {value:.1f}" for kind, value in cell.seconds.items())
            print(
                f"  {harmed} {fault} from {percent} %: {lost}; voters {cell.accepted}; seconds: "
                f"{seconds}; took {time.perf_counter() - began_s:.1f} s",
                flush=True,
            )
            if options.json:
                options.json.write_text(json.dumps([asdict(item) for item in cells], indent=1))
    console_for("partial", options.record, width=220).print(cells_table(cells))


if __name__ == "__main__":
    main()
