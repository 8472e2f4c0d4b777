"""Maps of one place, some of them bad, with the true map: what ``bench_vote`` fuses.

``cases(kind, seed)`` gives the cases of one kind:

- ``five-slams``: simulated worlds mapped by SLAMs of other people (recorded maps; no seed);
- ``degraded``: 3 to 9 copies of a true map, each in a frame of its own, up to half of them bad;
- ``pairs``: the same with two copies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy

from slamfusion.compute import open_device
from slamfusion.config import RunConfig
from slamfusion.experiments.fusions import against_truth
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid
from slamfusion.io.map_server import load_map
from slamfusion.sim import named_course, thin_walls
from slamfusion.sim.worlds import draw_floor
from tests.support.datasets import DATASETS, MAPS
from tests.support.degrade import Degradation, degrade_map, trinary

KINDS = ("five-slams", "degraded", "pairs")
# Recorded maps that lie beside the folder of the tests' data sets.
FIVE_SLAMS = DATASETS.parent / "second" / "maps" / "five-slams"
# True maps of which copies are made: drawn places, whose walls are solid, and recorded maps.
DRAWN_PLACES = ("office", "hall", "corridor")
RECORDED = {  # with whether grey is unknown
    "five-slams": (FIVE_SLAMS / "office" / "ground_truth.yaml", True),
    "gazebo": (MAPS / "multi-slam" / "husky-lar-gazebo-sim" / "map_gmapping.yaml", False),
    "flat": (MAPS / "giraff" / "UMA_236_237.yaml", False),
}
COUNTS = (5, 6, 7, 8, 9)
PAIRS = (("half", "half"), *(("good", fault) for fault in ("askew", "thick", "old", "noisy")))


@dataclass(frozen=True, eq=False)
class Case:
    """Maps of one place.

    Attributes:
        name: unique.
        inputs: maps of distinct names.
        truths: true maps in one frame, by how their walls are drawn: ``thin`` or ``solid``.
        poses: of each input's frame in the frame of the true maps, metres; to about 0.5 m and a few
            degrees, which is where the bench looks for the best fit.
    """

    name: str
    inputs: tuple[OccupancyGrid, ...]
    truths: Mapping[str, OccupancyGrid]
    poses: Mapping[str, Pose2]


def cases(kind: str, seed: int) -> Iterator[Case]:
    """Yield the cases of a kind; the same seed gives the same cases.

    Args:
        kind: one of ``KINDS``.
        seed: of everything random; the recorded maps have none and come with seed 0 only.
    """
    makers: dict[str, Callable[[], Iterator[Case]]] = {
        "five-slams": _five_slams,
        "degraded": lambda: _copied("degraded", seed, _degraded(seed)),
        "pairs": lambda: _copied("pairs", seed, PAIRS),
    }
    if kind != "five-slams" or seed == 0:
        yield from makers[kind]()


# --- maps of other SLAMs -------------------------------------------------------------------------


def _five_slams() -> Iterator[Case]:
    """Yield every recorded world; it has a folder with ``ground_truth.yaml`` and the maps."""
    for path in sorted(FIVE_SLAMS.glob("*/ground_truth.yaml")):
        yield _recorded_world(f"five-slams {path.parent.name}", path)


def _recorded_world(name: str, path: Path) -> Case:
    device = open_device()
    truth = load_map(path, legacy_unknown=True)
    maps = [
        load_map(file, legacy_unknown=True)
        for file in sorted(path.parent.glob("*.yaml"))
        if file != path
    ]
    grids = tuple(grid.with_name(grid.name.removesuffix("_map")) for grid in maps)
    config = RunConfig()
    poses = {g.name: against_truth(g, truth, config, device).transform for g in grids}
    return Case(name, grids, {"thin": truth}, poses)


# --- degraded copies -----------------------------------------------------------------------------


def _degraded(seed: int) -> list[list[str]]:
    """Return, for each case, what copies it has: 3 or 4 for each fault, and 5 to 9 with several."""
    bad = [[fault] * (1 + (index + seed) % 2) for index, fault in enumerate(FAULTS)]
    counts = [len(faults) + 2 for faults in bad]
    rng = np.random.default_rng([seed, 1])
    bad += [rng.choice(FAULTS, count // 2, replace=False).tolist() for count in COUNTS]
    return [
        ["good"] * (count - len(faults)) + faults
        for count, faults in zip([*counts, *COUNTS], bad, strict=True)
    ]


def _true_maps(place: str, rng: np.random.Generator) -> dict[str, OccupancyGrid]:
    """Return the true maps of a place, by how their walls are drawn."""
    if place in DRAWN_PLACES:
        solid = draw_floor(named_course(place, 0).world, rng).grid
        return {"thin": thin_walls(solid), "solid": solid}
    path, legacy_unknown = RECORDED[place]
    return {"thin": trinary(load_map(path, legacy_unknown=legacy_unknown))}


def _copied(kind: str, seed: int, wanted: Sequence[Sequence[str]]) -> Iterator[Case]:
    """Yield a case for each list of copies (keys of ``COPIES``); the places take turns."""
    names = [*DRAWN_PLACES, *(name for name, (path, _) in RECORDED.items() if path.is_file())]
    for index, copies in enumerate(wanted):
        place = names[(seed + index) % len(names)]
        faults = "+".join(dict.fromkeys(copy for copy in copies if copy != "good"))
        name = f"{kind} {len(copies)} of {place}, {faults}, seed {seed}"
        chance = np.random.default_rng([seed, KINDS.index(kind), index])
        yield _copies_of(name, place, copies, chance)


def _copies_of(name: str, place: str, copies: Sequence[str], rng: np.random.Generator) -> Case:
    """Make copies of a true map, each with a yaw, an offset and a lattice of its own."""
    truths = _true_maps(place, rng)
    truth = truths["thin"]
    # Beams leak through outer walls.
    margin = round(2.0 / truth.resolution)
    box = CellBox(-margin, -margin, truth.height + margin, truth.width + margin)
    truth = truth.crop(box)
    inputs, poses = [], {}
    # The order says nothing about which maps are good.
    for number, copy in enumerate(rng.permutation(copies).tolist()):
        degradation, before, after = COPIES[copy](rng)
        degradation = replace(
            degradation,
            yaw_rad=float(rng.uniform(-math.pi, math.pi)),
            shift_share=(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.3, 0.3))),
            origin_yaw_rad=float(rng.uniform(-math.pi, math.pi)) * float(rng.integers(0, 2)),
            margin_share=float(rng.uniform(0.0, 0.5)),
        )
        cells = _jitter(truth.cells, rng, reach=1.0, smooth=5.0)
        if before is not None:
            cells = before(cells, truth.resolution, rng)
        source = OccupancyGrid(cells, truth.resolution, truth.origin)
        grid, pose = degrade_map(source, rng, degradation)
        cells = grid.cells if after is None else after(grid.cells, grid.resolution, rng)
        inputs.append(OccupancyGrid(cells, grid.resolution, grid.origin, f"{copy}{number}"))
        poses[f"{copy}{number}"] = pose
    return Case(name, tuple(inputs), truths, poses)


def _jitter(cells: I8, rng: np.random.Generator, *, reach: float, smooth: float) -> I8:
    """Move each cell by up to ``reach`` cells along each axis; near cells move alike.

    Args:
        cells: (H, W).
        rng: source of the motion.
        reach: cells.
        smooth: standard deviation of the smoothing of the motion, cells.
    """
    height, width = cells.shape
    noise = rng.standard_normal((2, height, width))
    moved = scipy.ndimage.gaussian_filter(noise, (0.0, smooth, smooth))
    moved = np.clip(moved * reach / (2.0 * moved.std()), -reach, reach)
    rows, cols = np.indices(cells.shape)
    rows = np.clip(np.rint(rows + moved[0]), 0, height - 1).astype(np.intp)
    cols = np.clip(np.rint(cols + moved[1]), 0, width - 1).astype(np.intp)
    return np.ascontiguousarray(cells[rows, cols])


def _shake(cells: I8, resolution: float, rng: np.random.Generator) -> I8:  # noqa: ARG001 - all faults are called alike
    """Move every cell on its own, by up to two cells."""
    return _jitter(cells, rng, reach=2.0, smooth=0.7)


def _make_old(cells: I8, resolution: float, rng: np.random.Generator) -> I8:
    """Replace boxes of 1.5 m by other parts of the map, until a quarter of the walls is covered."""
    side = round(1.5 / resolution)
    walls = cells == OCCUPIED
    known = scipy.ndimage.uniform_filter((cells != UNKNOWN).astype(np.float32), side)
    crowded = scipy.ndimage.uniform_filter(walls.astype(np.float32), side)
    inside = np.zeros_like(walls)
    half = side // 2 + 1
    inside[half:-half, half:-half] = True
    places = np.argwhere(inside & (known > 0.6) & (crowded > 0.5 / side))
    old, covered = cells.copy(), np.zeros_like(walls)
    for _ in range(200):
        if not len(places) or (covered & walls).sum() > 0.25 * walls.sum():
            break
        (row, col), (row1, col1) = places[rng.integers(len(places), size=2)] - side // 2
        part = cells[row1 : row1 + side, col1 : col1 + side]
        old[row : row + side, col : col + side] = np.rot90(part, int(rng.integers(1, 4)))
        covered[row : row + side, col : col + side] = True
    return old


def _leak(cells: I8, resolution: float, rng: np.random.Generator) -> I8:
    """Let beams through walls: streaks of free cells behind them, with an end point each."""
    rows, cols = np.nonzero(cells == OCCUPIED)
    count = len(rows) // 15
    chosen = rng.choice(len(rows), size=count, replace=False)
    angles = rng.uniform(-math.pi, math.pi, count)
    leaky = cells.copy()
    height, width = cells.shape
    for index, angle in zip(chosen, angles, strict=True):
        reach = rng.uniform(0.5, 4.0) / resolution
        steps = np.arange(-3.0, reach, 0.7)
        row = np.rint(rows[index] + steps * math.sin(angle)).astype(np.intp)
        col = np.rint(cols[index] + steps * math.cos(angle)).astype(np.intp)
        within = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        row, col = row[within], col[within]
        if not len(row) or cells[row[0], col[0]] != FREE:  # the beam comes from inside the place
            continue
        leaky[row, col] = FREE
        leaky[row[-1], col[-1]] = OCCUPIED
    return leaky


def _blur(cells: I8, resolution: float, rng: np.random.Generator) -> I8:  # noqa: ARG001 - all faults are called alike
    """Return percent: walls fade into what is around them."""
    sigma = float(rng.uniform(1.0, 2.0))
    walls = scipy.ndimage.gaussian_filter((cells == OCCUPIED).astype(np.float64), sigma)
    percent = np.rint(100.0 * np.minimum(1.0, walls * 2.0 * sigma)).astype(np.int8)
    return np.where((cells == UNKNOWN) & (percent < 65), np.int8(UNKNOWN), percent)


Change = Callable[[I8, float, np.random.Generator], I8]
# How a copy is rendered in its own frame, and what is done to its cells before and after.
Copy = tuple[Degradation, Change | None, Change | None]

# No wall is off by more than about a cell, and nearly all of the place is known.
GOOD = Degradation(bend_cells=0.3, crop_share=0.995, flip_share=0.0003, speckle_share=0.01)


def _rendered(rng: np.random.Generator, **ranges: tuple[float, float]) -> Copy:
    """Return a good copy but for some figures, each drawn from its range."""
    drawn = {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}
    return replace(GOOD, **drawn), None, None  # type: ignore[arg-type]  # fields of floats


COPIES: dict[str, Callable[[np.random.Generator], Copy]] = {
    "good": _rendered,
    "half": lambda rng: _rendered(rng, crop_share=(0.6, 0.75)),
    "askew": lambda rng: _rendered(rng, bend_cells=(4.0, 8.0)),
    "bent": lambda rng: _rendered(rng, bend_cells=(15.0, 50.0)),
    "thick": lambda rng: (replace(GOOD, wall_change_cells=int(rng.integers(1, 4))), None, None),
    "old": lambda _: (GOOD, _make_old, None),
    "cropped": lambda rng: _rendered(rng, crop_share=(0.4, 0.7)),
    "noisy": lambda rng: (_rendered(rng, flip_share=(0.02, 0.05))[0], _shake, None),
    "blurred": lambda _: (GOOD, None, _blur),
    "speckled": lambda _: (GOOD, _leak, None),
}
FAULTS = ("bent", "thick", "old", "cropped", "noisy", "blurred", "speckled")
