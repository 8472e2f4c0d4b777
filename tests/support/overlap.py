"""Pairs of maps that share a part of their ground, and pairs that must not be believed.

A ``Draft`` says in names and numbers how a pair is made; it is small and can be sent to another
process. ``Draft.draw`` makes the ``Case``: two grids and the transform between them.

    for case in drawn(half_pairs(seed=1)):
        alignment = align_grids(case.reference, case.moving, config, device)
        case.is_right(alignment.transform)

The same draft always gives the same cells, whatever else is drawn. Recorded maps lie in the shared
folder; ``simulated`` needs none.
"""

from __future__ import annotations

import csv
import itertools
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from slamfusion.config import DrawnPlace, WorldConfig
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OCCUPIED, OccupancyGrid
from slamfusion.sim import draw_building
from slamfusion.sim.worlds import draw_floor
from tests.support.cuts import (
    Axis,
    Side,
    along,
    cropped,
    halves_of,
    kept,
    mirror_image,
    move_frame,
    wear,
)
from tests.support.datasets import MAPS, MapEntry, load_entry, map_entries

OVERLAPS = (0.6, 0.4, 0.3, 0.2, 0.1)
AXES: tuple[Axis, ...] = ("x", "y")
SIDES: tuple[Side, ...] = ("low", "high")

# What a pair is; the first three have a right answer, the others none that may be believed.
ONE_MAP, CROSS_SLAM, DRAWN = "one map cut in two", "cross-SLAM", "simulated"
POSITIVES = (ONE_MAP, CROSS_SLAM, DRAWN)
DIFFERENT, DISJOINT, MIRRORED = "different places", "disjoint halves", "mirrored"
NEGATIVES = (DIFFERENT, DISJOINT, MIRRORED, "scaled 1.1", "scaled 1.05", "scaled 1.02")

# Recorded maps of buildings, not bent, each with walls all over; one file for maps that are copies.
CUT_MAPS = (
    "multi-slam/nanorobot-real/cartographer.yaml",
    "multi-slam/nanorobot-real/gmapping.yaml",
    "multi-slam/nanorobot-real/karto.yaml",
    "multi-slam/nanorobot-real/map.yaml",
    "multi-slam/mit-csail/gmapping.yaml",
    "multi-slam/mit-csail/karto.yaml",
    "carpin/LongRun6.txt.gz",
    "carpin/LongRun7.txt.gz",
    "carpin/intel.txt.gz",
    "carpin/robot1_cast.txt.gz",
    "carpin/robot3_cast.txt.gz",
    "strands/aaf_y3/aaf_deployment16-cropped.pgm.gz",
    "strands/aaf_y4/y4_aaf-cropped.pgm.gz",
    "giraff/movecare_map.yaml",
    "giraff/movecare_map_integrationmeeting1903.yaml",
    "giraff/map_05_03_2019_4.yaml",
    "giraff/UMA_236_237.yaml",
    "giraff/Sarmis2_map_adj.yaml",
    "giraff/movecare_map_PREPILOT.pgm.gz",
    "rendered/freiburg_building101.png",
    "rendered/freiburg_building52.png",
    "rendered/freiburg_building79.png",
    "worlds/willow-full-0.1.pgm.gz",
)
# Copies of another file of the folder, and one without a wall under the usual thresholds.
REPEATED = (
    "carpin/intel1000.txt.gz",
    "worlds/turtlebot3/map.yaml",
    "worlds/turtlebot3/turtlebot3_world.yaml",
    "worlds/willow-full-0.05.pgm.gz",
    "rendered/intel_map.png",
)
# Mirror images of themselves: the mirrored map is the map.
MIRROR_SYMMETRIC = ("worlds/nav2/tb3_sandbox.yaml",)
# Two SLAMs of one place. In mit-csail the transform is that of their trajectories; the others are
# said to share a frame. Whole maps laid on each other by walls agree with all three within 0.06 m
# and 0.2 deg; parts of mit-csail as wide as 30 % within 0.1 m in the middle, 0.4 m at its ends.
CROSS_SLAM_MAPS = (
    ("multi-slam/mit-csail/karto.yaml", "multi-slam/mit-csail/gmapping.yaml"),
    (
        "multi-slam/husky-lar-gazebo-sim/map_gmapping.yaml",
        "multi-slam/husky-lar-gazebo-sim/map_hector.yaml",
    ),
    ("multi-slam/nanorobot-real/karto.yaml", "multi-slam/nanorobot-real/gmapping.yaml"),
)
# Simulated floors: no part of them is a copy of another. Size of the buildings in metres.
SIMULATED_SEEDS = range(72_100, 72_103)
SIMULATED_PLACES = ("office", "building", "hall", "yard")
BUILDING_M = (30.0, 20.0)
SIMULATED = tuple(f"sim/{place}/{seed}" for place in SIMULATED_PLACES for seed in SIMULATED_SEEDS)

# With fewer wall cells in common there is nothing to find.
COMMON_WALLS_MIN = 60
DROPPED_SHARE = 0.05
SPECK_SHARE = 0.05
# Halves that share nothing: the gap between them as a share of the whole extent.
GAP_SHARE = 0.05
DISJOINT_OVERLAP = -GAP_SHARE / ((1.0 - GAP_SHARE) / 2.0)
# Halves that are mirrored, scaled, or laid on other places.
HALF_OVERLAP = 0.5
# How near is right. Maps of two SLAMs disagree themselves by some cells.
TOLERANCE_CELLS, TOLERANCE_DEG = 2.0, 0.5
CROSS_TOLERANCE_M, CROSS_TOLERANCE_DEG = 0.3, 2.0


@dataclass(frozen=True)
class Part:
    """A map, whole or one half of it.

    Attributes:
        source: a file of places.csv, or ``sim/PLACE/SEED``.
        axis: across which it is cut; None leaves it whole.
        side: which half.
    """

    source: str
    axis: Axis | None = None
    side: Side = "low"

    @property
    def name(self) -> str:
        """The source, and which half."""
        return self.source if self.axis is None else f"{self.source} {self.axis} {self.side}"


@dataclass(frozen=True, eq=False)
class Case:
    """Two maps, and what is true of them.

    Attributes:
        name: of the pair, unique.
        what: one of ``POSITIVES`` or ``NEGATIVES``.
        place: of the reference.
        reference, moving: the maps, cells -1, 0, 100.
        truth: maps a point of the moving map's frame into the reference's, metres; None where no
            transform is right.
        overlap: of each half, along the axis; None without a truth.
        centre_m: middle of the ground in common, moving map's frame; None without a truth.
        tolerance_m: a right answer moves the centre to within this of where it belongs.
        tolerance_deg: a right answer turns within this.
        common_walls: wall cells on the ground in common, of the map that has fewer there.
    """

    name: str
    what: str
    place: str
    reference: OccupancyGrid
    moving: OccupancyGrid
    truth: Pose2 | None
    overlap: float | None = None
    centre_m: tuple[float, float] | None = None
    tolerance_m: float = math.nan
    tolerance_deg: float = math.nan
    common_walls: int = 0

    def error(self, transform: Pose2) -> tuple[float, float] | None:
        """Return metres at the centre and degrees by which it is wrong; None without a truth."""
        if self.truth is None or self.centre_m is None:
            return None
        found, wanted = (pose.transform(self.centre_m) for pose in (transform, self.truth))
        turn = wrap_angle(transform.yaw_rad - self.truth.yaw_rad)
        return math.dist(found, wanted), abs(math.degrees(turn))

    def is_right(self, transform: Pose2) -> bool:
        """Whether a transform is right; never where none is."""
        error = self.error(transform)
        return error is not None and error[0] <= self.tolerance_m and error[1] <= self.tolerance_deg


@dataclass(frozen=True)
class Draft:
    """How a case is made.

    Attributes:
        what: one of ``POSITIVES`` or ``NEGATIVES``.
        reference, moving: what is laid on what; halves of one place are cut by the same lines.
        overlap: of each half, along the axis; negative: a gap. Of whole maps, not used.
        seed: of yaw, origin, lattice, dropped cells and specks, together with the names.
        factor: lengths of the moving map are multiplied by this.
        dropped, specks: see ``cuts.wear``; what happens to the moving map.
        moves: whether the moving map gets another frame.
    """

    what: str
    reference: Part
    moving: Part
    overlap: float
    seed: int
    factor: float = 1.0
    dropped: float = DROPPED_SHARE
    specks: float = SPECK_SHARE
    moves: bool = True

    @property
    def name(self) -> str:
        """What, which parts, how much of them."""
        return f"{self.what}, {self.overlap:.0%}: {self.moving.name} to {self.reference.name}"

    @property
    def has_truth(self) -> bool:
        """Whether there is a right answer."""
        return self.what in POSITIVES

    def draw(self) -> Case | None:
        """Make the case; None where it has a truth and too few walls in common."""
        a, b = load_source(self.reference.source), load_source(self.moving.source)
        motion = known_transform(self.moving.source, self.reference.source)
        if motion is None:
            reference, moving = _own_half(a, self.reference, self), _own_half(b, self.moving, self)
            common = None
        else:
            reference, moving, common = self._cut(a, b, motion)
        if common is not None and self.has_truth and common[1] < COMMON_WALLS_MIN:
            return None
        if self.what == MIRRORED:
            moving = mirror_image(moving)
        rng = np.random.default_rng([self.seed, zlib.crc32(self.name.encode())])
        pose = Pose2()
        if self.moves:
            moving, pose = move_frame(moving, rng, self.factor)
        moving = wear(moving, rng, self.dropped, self.specks)
        case = Case(
            self.name,
            self.what,
            place_of(self.reference.source),
            reference.with_name(self.reference.name),
            moving.with_name(self.moving.name),
            None,
        )
        if not self.has_truth or motion is None or common is None:
            return case
        truth = motion.compose(pose)
        centre = truth.inverse().transform(common[0])
        across = self.reference.source != self.moving.source
        return replace(
            case,
            truth=truth,
            overlap=self.overlap,
            centre_m=(float(centre[0]), float(centre[1])),
            tolerance_m=CROSS_TOLERANCE_M if across else TOLERANCE_CELLS * reference.resolution,
            tolerance_deg=CROSS_TOLERANCE_DEG if across else TOLERANCE_DEG,
            common_walls=common[1],
        )

    def _cut(
        self, a: OccupancyGrid, b: OccupancyGrid, motion: Pose2
    ) -> tuple[OccupancyGrid, OccupancyGrid, tuple[npt.NDArray[np.float64], int] | None]:
        """Return both halves, and the strip's middle (a's frame, metres) and its wall cells."""
        axis = self.reference.axis
        if axis is None:
            return a, b, None
        places = along(a, a, Pose2(), axis), along(b, a, motion, axis)
        # What both know: two SLAMs of one log did not see equally far.
        ends = [_extent(grid, place) for grid, place in zip((a, b), places, strict=True)]
        low, high = max(end[0] for end in ends), min(end[1] for end in ends)
        halves = halves_of(low, high, self.overlap)
        strip = (halves.high_start, halves.low_end)
        shared = [kept(grid, place, strip) for grid, place in zip((a, b), places, strict=True)]
        walls = min(int(np.count_nonzero(grid.cells == OCCUPIED)) for grid in shared)
        rows, cols = np.nonzero(shared[0].cells >= 0)
        common = None
        if rows.size:
            common = shared[0].cell_centres(rows, cols).mean(axis=0), walls
        return (
            kept(a, places[0], halves.range_of(self.reference.side)),
            kept(b, places[1], halves.range_of(self.moving.side)),
            common,
        )


def _extent(grid: OccupancyGrid, places: npt.NDArray[np.float64]) -> tuple[int, int]:
    known = places[grid.cells >= 0]
    return math.floor(known.min()), math.ceil(known.max())


def _own_half(grid: OccupancyGrid, part: Part, draft: Draft) -> OccupancyGrid:
    """Return one half of a map cut by its own lines, or all of it."""
    if part.axis is None:
        return grid
    places = along(grid, grid, Pose2(), part.axis)
    halves = halves_of(*_extent(grid, places), draft.overlap)
    return kept(grid, places, halves.range_of(part.side))


@cache
def _entries() -> dict[str, MapEntry]:
    return {entry.file: entry for entry in map_entries()}


@cache
def load_source(source: str) -> OccupancyGrid:
    """Load a recorded map, or draw a simulated floor; cells -1, 0, 100, cropped."""
    if not source.startswith("sim/"):
        return cropped(load_entry(_entries()[source]))
    _, place, seed = source.split("/")
    rng = np.random.default_rng(int(seed))
    if place == "building":
        return cropped(draw_building(rng, *BUILDING_M)).with_name(source)
    config = WorldConfig(name=cast("DrawnPlace", place))
    return cropped(draw_floor(config, rng).grid).with_name(source)


def place_of(source: str) -> str:
    """Return the place by places.csv; a simulated floor is its own."""
    return source if source.startswith("sim/") else _entries()[source].place


def known_transform(source: str, target: str) -> Pose2 | None:
    """Return the motion from one map's frame to another's; None where it is not known."""
    if source == target:
        return Pose2()
    if not {(source, target), (target, source)} & set(CROSS_SLAM_MAPS):
        return None
    table = (MAPS / source).parent / "transforms.csv"
    if not table.exists():
        return Pose2()
    names = Path(source).stem, Path(target).stem
    with table.open(encoding="utf-8") as rows:
        for row in csv.DictReader(rows):
            if (row["source"], row["destination"]) == names:
                return Pose2(float(row["dx_m"]), float(row["dy_m"]), float(row["yaw_rad"]))
    raise LookupError(f"{table} has no row from {names[0]} to {names[1]}")


def other(side: Side) -> Side:
    """Return the other half."""
    return "high" if side == "low" else "low"


def _halves(
    what: str,
    pairs: Iterable[tuple[str, str]],
    overlaps: Iterable[float],
    seed: int,
    factor: float = 1.0,
) -> tuple[Draft, ...]:
    """Return the drafts of both axes, either side being the reference."""
    return tuple(
        Draft(what, Part(a, axis, side), Part(b, axis, other(side)), overlap, seed, factor)
        for overlap, (a, b), axis, side in itertools.product(overlaps, pairs, AXES, SIDES)
    )


def half_pairs(
    seed: int, overlaps: Sequence[float] = OVERLAPS, maps: Sequence[str] = CUT_MAPS
) -> tuple[Draft, ...]:
    """Return one map cut in two: both axes, either side being the reference."""
    return _halves(ONE_MAP, ((name, name) for name in maps), overlaps, seed)


def simulated(
    seed: int, overlaps: Sequence[float] = OVERLAPS, maps: Sequence[str] = SIMULATED
) -> tuple[Draft, ...]:
    """Return simulated floors cut in two; needs no recorded map."""
    return _halves(DRAWN, ((name, name) for name in maps), overlaps, seed)


def cross_slam_pairs(seed: int, overlaps: Sequence[float] = OVERLAPS) -> tuple[Draft, ...]:
    """Return a half that one SLAM mapped against the other half of another SLAM."""
    pairs = [pair for a, b in CROSS_SLAM_MAPS for pair in ((a, b), (b, a))]
    return _halves(CROSS_SLAM, pairs, overlaps, seed)


def disjoint_halves(seed: int, maps: Sequence[str] = CUT_MAPS) -> tuple[Draft, ...]:
    """Return two halves of one map with a gap of 5 % between them."""
    return _halves(DISJOINT, ((name, name) for name in maps), (DISJOINT_OVERLAP,), seed)


def _changed(what: str, seed: int, maps: Iterable[str], factor: float) -> tuple[Draft, ...]:
    """Return whole maps, and halves of those that are cut, against changed ones of themselves."""
    files = [file for file in maps if file not in REPEATED]
    whole = (Draft(what, Part(file), Part(file), 1.0, seed, factor) for file in files)
    cut = [(file, file) for file in files if file in CUT_MAPS or file.startswith("sim/")]
    return (*whole, *_halves(what, cut, (HALF_OVERLAP,), seed, factor))


def mirrored(seed: int, maps: Sequence[str] | None = None) -> tuple[Draft, ...]:
    """Return maps against mirror images of themselves, whole and halves."""
    files = list(_entries()) if maps is None else maps
    return _changed(MIRRORED, seed, (f for f in files if f not in MIRROR_SYMMETRIC), 1.0)


def scaled(seed: int, factor: float, maps: Sequence[str] | None = None) -> tuple[Draft, ...]:
    """Return maps against themselves at another scale, cells of one stated size."""
    return _changed(f"scaled {factor:g}", seed, list(_entries()) if maps is None else maps, factor)


def are_different_places(a: MapEntry, b: MapEntry) -> bool:
    """Whether places.csv says so; the drawings of worlds/stage may repeat places of rendered."""
    folders = {a.file.split("/")[0], b.file.split("/")[0]}
    repeats = folders == {"worlds", "rendered"} and "stage" in a.file + b.file
    return a.place != b.place and not repeats


def different_places(seed: int, count: int = 3000) -> tuple[Draft, ...]:
    """Return all pairs of whole maps of different places, and of their halves to make up the count.

    Args:
        seed: chooses the halves.
        count: of all pairs together, where so many can be made.
    """
    pairs = [
        (a.file, b.file)
        for a, b in itertools.combinations(_entries().values(), 2)
        if are_different_places(a, b)
    ]
    worn = {"dropped": 0.0, "specks": 0.0}
    whole = [Draft(DIFFERENT, Part(a), Part(b), 1.0, seed, moves=False, **worn) for a, b in pairs]
    cut = [pair for pair in pairs if not set(pair) - set(CUT_MAPS)]
    halves = [
        Draft(DIFFERENT, Part(a, i, s), Part(b, j, t), HALF_OVERLAP, seed, moves=False, **worn)
        for (a, b), i, s, j, t in itertools.product(cut, AXES, SIDES, AXES, SIDES)
    ]
    wanted = min(max(0, count - len(whole)), len(halves))
    chosen = np.random.default_rng(seed).choice(len(halves), wanted, replace=False)
    return (*whole, *(halves[index] for index in sorted(chosen)))


def drawn(drafts: Iterable[Draft]) -> Iterator[Case]:
    """Make the cases, without those with too few walls in common."""
    for draft in drafts:
        case = draft.draw()
        if case is not None:
            yield case


# Each kind of pairs, of a seed.
SETS: dict[str, Callable[[int], tuple[Draft, ...]]] = {
    "one-map": half_pairs,
    "cross-slam": cross_slam_pairs,
    "simulated": simulated,
    "different": different_places,
    "disjoint": disjoint_halves,
    "mirrored": mirrored,
    "scaled-1.1": partial(scaled, factor=1.1),
    "scaled-1.05": partial(scaled, factor=1.05),
    "scaled-1.02": partial(scaled, factor=1.02),
}
