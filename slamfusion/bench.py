"""Time this machine: alignment, vote and the [F16] batch, each against a baseline of the same run.

A machine's seconds say little about another's; ratios against the plain exhaustive search, the
NumPy twins and a copy of memory travel better. Everything is drawn from fixed seeds.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.config import AlignConfig, FusionConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion import align_grids, fuse_grids
from slamfusion.fusion.align import track_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.motions import displacement
from slamfusion.fusion.normalize import normalize_grid
from slamfusion.fusion.proof import LatticeScore
from slamfusion.fusion.records import Alignment
from slamfusion.fusion.search import SearchWindow
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.jobs.documents import versions
from slamfusion.jobs.tool_records import BenchDocument, BenchEntryJson, BenchResultsJson
from slamfusion.sim import Degradation, degrade_map, draw_building
from slamfusion.vote.tiles import vote_grids

__all__ = ["Entry", "bench_document", "run_benchmarks"]

I8 = npt.NDArray[np.int8]

SEED = 2016
RESOLUTION = 0.05
WITHOUT_PROOF = FusionConfig(align=AlignConfig(prove=False))
WITH_PROOF = FusionConfig(align=AlignConfig(prove=True))
# [F16], section V: the whole batch on a Titan X.
F16_BATCH_S = 25.0
# An alignment counts as right within this of the truth.
RIGHT_CELLS = 1.0
RIGHT_YAW_RAD = math.radians(0.5)


@dataclass(frozen=True)
class Sizes:
    """How much work the benchmark does.

    Attributes:
        align_cells: side of the two maps that are aligned.
        small_cells: side of the two maps that the exhaustive search and the twins can finish.
        vote_cells: side of the grids that vote.
        trios, trio_cells: how many places the [F16] batch has, and the side of their maps.
        runs: of each measurement; the median counts.
        exhaustive_yaws: yaws of the large search set that the plain search is timed on.
    """

    align_cells: int = 800
    small_cells: int = 120
    vote_cells: int = 4000
    trios: int = 6
    trio_cells: int = 400
    runs: int = 5
    exhaustive_yaws: int = 2


FULL = Sizes()
QUICK = Sizes(align_cells=400, vote_cells=1000, trios=1, trio_cells=160, runs=1)
TWINS = Sizes(align_cells=120, vote_cells=1000, trios=1, trio_cells=120, runs=1)


@dataclass(frozen=True)
class Entry:
    """One measurement.

    Attributes:
        name: what was done.
        seconds: median over the runs, wall time.
        runs: how often it was done.
        baseline: what it is compared with.
        baseline_seconds: the same for the baseline.
        must, stretch: the targets of the design, on two cores; None where there is none.
        target_of: ``seconds`` or ``ratio``, what the targets bound.
        detail: whatever else was found.
    """

    name: str
    seconds: float
    runs: int
    baseline: str
    baseline_seconds: float
    must: float | None = None
    stretch: float | None = None
    target_of: Literal["seconds", "ratio"] = "seconds"
    detail: dict[str, Any] = field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """Seconds over the baseline's seconds; smaller is better."""
        return self.seconds / self.baseline_seconds

    def to_json(self) -> BenchEntryJson:
        """Return plain values, the ratio and whether the targets are met among them."""
        value = self.ratio if self.target_of == "ratio" else self.seconds
        return {
            "name": self.name,
            "seconds": self.seconds,
            "runs": self.runs,
            "baseline": self.baseline,
            "baseline_seconds": self.baseline_seconds,
            "must": self.must,
            "stretch": self.stretch,
            "target_of": self.target_of,
            "detail": self.detail,
            "ratio": self.ratio,
            "meets_must": None if self.must is None else value <= self.must,
            "meets_stretch": None if self.stretch is None else value <= self.stretch,
        }


def run_benchmarks(device: ComputeDevice, *, quick: bool = False) -> BenchResultsJson:
    """Time alignment, vote and the [F16] batch.

    Args:
        device: the device to time; the NumPy twins get maps small enough for them.
        quick: smaller maps and fewer runs, for a look; targets do not apply to them.

    Returns:
        ``entries``: a list of measurements, see ``Entry``; ``ratio`` is seconds over baseline
        seconds, smaller is better. ``quick``: as given.
    """
    sizes = (QUICK if quick else FULL) if device.is_opencl else TWINS
    entries = [
        *_time_alignment(device, sizes),
        *_time_small_alignment(device, sizes),
        _time_vote(device, sizes),
        *_time_batch(device, sizes),
    ]
    if sizes is not FULL:
        entries = [dataclasses.replace(e, must=None, stretch=None) for e in entries]
    return {"entries": [entry.to_json() for entry in entries], "quick": quick}


def bench_document(results: BenchResultsJson, device: ComputeDevice) -> BenchDocument:
    """Return what ``slamfusion bench`` prints as JSON: measurements, and what made them."""
    return {**results, "device": device.name, "versions": versions()}


# -- alignment -------------------------------------------------------------------------------------


def _time_alignment(device: ComputeDevice, sizes: Sizes) -> list[Entry]:
    """Align two maps of one building without proof, with proof, and from the last transform."""
    reference, moving, truth = _draw_pair(sizes.align_cells)
    size = _size(sizes.align_cells)
    lattice = _search_set(reference, moving, WITH_PROOF, device)
    plain, yaws = _time_exhaustive(lattice, sizes.exhaustive_yaws)
    words = f"plain exhaustive search of the same {_members(lattice)} poses, same device"
    if yaws < lattice.yaw_count:
        words += f", extrapolated from {yaws} of {lattice.yaw_count} yaws"

    entries = []
    for kind, config, must, stretch in (
        ("without proof", WITHOUT_PROOF, 0.15, 0.1),
        ("with proof", WITH_PROOF, 0.5, 0.14),
    ):
        align = partial(align_grids, reference, moving, config, device)
        seconds, found = _median_seconds(align, sizes.runs)
        detail = _describe(found, truth, reference, moving)
        entries.append(
            Entry(
                f"align {size}, +-180 degrees, {kind}",
                seconds,
                sizes.runs,
                words,
                plain,
                must,
                stretch,
                detail=detail,
            )
        )
    entries.append(_time_tracking(device, sizes, (reference, moving, truth), entries[0].seconds))
    return entries


def _time_tracking(
    device: ComputeDevice,
    sizes: Sizes,
    pair: tuple[OccupancyGrid, OccupancyGrid, Pose2],
    searched: float,
) -> Entry:
    """Align a new moving map from a transform that is a few cells off; the reference is prepared.

    The moving map's normalisation and features are part of the time; ``prepared_s`` is without.
    """
    reference, moving, truth = pair
    start = Pose2(0.1, -0.05, math.radians(1.0)).compose(truth)
    held = _prepare(reference, device)

    def track() -> Alignment:
        return track_features(held, _prepare(moving, device), device, start)

    seconds, found = _median_seconds(track, sizes.runs)
    ready = _prepare(moving, device)
    prepared, _ = _median_seconds(lambda: track_features(held, ready, device, start), sizes.runs)
    detail = {**_describe(found, truth, reference, moving), "prepared_s": prepared}
    return Entry(
        f"align {_size(sizes.align_cells)}, tracked from the last transform",
        seconds,
        sizes.runs,
        "the search over +-180 degrees without proof",
        searched,
        0.03,
        0.01,
        detail=detail,
    )


def _time_small_alignment(device: ComputeDevice, sizes: Sizes) -> list[Entry]:
    """Align two small maps, which the exhaustive search and the NumPy twins can finish."""
    reference, moving, truth = _draw_pair(sizes.small_cells)
    size = _size(sizes.small_cells)
    proven, found = _median_seconds(
        lambda: align_grids(reference, moving, WITH_PROOF, device), sizes.runs
    )
    lattice = _search_set(reference, moving, WITH_PROOF, device)
    plain, _ = _time_exhaustive(lattice, lattice.yaw_count)
    searched, quickly = _median_seconds(
        lambda: align_grids(reference, moving, WITHOUT_PROOF, device), sizes.runs
    )
    began = time.perf_counter()
    align_grids(reference, moving, WITHOUT_PROOF, NumpyDevice())
    twins = time.perf_counter() - began
    return [
        Entry(
            f"align {size}, +-180 degrees, with proof",
            proven,
            sizes.runs,
            f"plain exhaustive search of the same {_members(lattice)} poses, same device",
            plain,
            detail=_describe(found, truth, reference, moving),
        ),
        Entry(
            f"align {size}, +-180 degrees, without proof",
            searched,
            sizes.runs,
            "the same on the NumPy twins, one run",
            twins,
            detail=_describe(quickly, truth, reference, moving),
        ),
    ]


def _search_set(
    reference: OccupancyGrid, moving: OccupancyGrid, config: FusionConfig, device: ComputeDevice
) -> LatticeScore:
    """Return the written-down search set over all yaws and its score."""
    held, moved = _prepare(reference, device), _prepare(moving, device)
    window = SearchWindow((0.0, 0.0, 0.0), None, math.pi)
    return LatticeScore(held, moved, config.align, window, device)


def _time_exhaustive(lattice: LatticeScore, most_yaws: int) -> tuple[float, int]:
    """Score every shift at up to ``most_yaws`` yaws; return seconds for all yaws, and how many."""
    count, height, width = lattice.shape
    chosen = np.unique(np.linspace(0, count - 1, min(most_yaws, count)).round().astype(np.int64))
    # A few yaws at once, so that the scores of a batch stay near 64 MB.
    batch = max(1, (1 << 24) // (height * width))
    lattice.score_box(chosen[:1], (0, 1), (0, min(width, 64)))
    began = time.perf_counter()
    for first in range(0, len(chosen), batch):
        lattice.score_box(chosen[first : first + batch], (0, height), (0, width)).max()
    seconds = time.perf_counter() - began
    return seconds * count / len(chosen), len(chosen)


# -- vote ------------------------------------------------------------------------------------------


def _time_vote(device: ComputeDevice, sizes: Sizes) -> Entry:
    """Let three grids vote, against copying them to arrays that are already there."""
    grids = _draw_votes(sizes.vote_cells)
    targets = [np.zeros_like(grid) for grid in grids]

    def copy() -> None:
        for grid, target in zip(grids, targets, strict=True):
            np.copyto(target, grid)

    runs = 3 * sizes.runs
    vote_s, copy_s = [], []
    vote_grids(grids, device, unknown_votes=True)
    for _ in range(runs):
        # In turns, so that both see the machine in the same mood.
        copy_s.append(_seconds(copy))
        vote_s.append(_seconds(lambda: vote_grids(grids, device, unknown_votes=True)))
    return Entry(
        f"vote of three {_size(sizes.vote_cells)} grids",
        median(vote_s),
        runs,
        "copy of the three grids",
        median(copy_s),
        3.0,
        2.0,
        target_of="ratio",
        detail={"fastest_s": min(vote_s), "fastest_copy_s": min(copy_s)},
    )


def _draw_votes(cells: int) -> list[I8]:
    """Return three grids of a building, each with its own 3 % of wrong cells."""
    rng = np.random.default_rng(SEED)
    building = draw_building(rng, cells * RESOLUTION, cells * RESOLUTION, RESOLUTION).cells
    trinary = np.where(building > 0, 1, building).astype(np.int8)
    grids = []
    for _ in range(3):
        grid = trinary.copy()
        wrong = rng.integers(0, grid.size, grid.size * 3 // 100)
        grid.flat[wrong] = rng.integers(-1, 2, len(wrong))
        grids.append(grid)
    return grids


# -- the [F16] batch -------------------------------------------------------------------------------


def _time_batch(device: ComputeDevice, sizes: Sizes) -> list[Entry]:
    """Register three maps of each place to its truth, fuse them, register the fused map.

    [F16] aligns two maps to the reference in each fusion (12 in 6); ours aligns all three pairs, to
    see whether they close, and so does 6 registrations more.
    """
    trios = [_draw_trio(sizes.trio_cells, n) for n in range(sizes.trios)]
    entries = []
    for kind, config, runs, must, stretch in (
        ("without proof", WITHOUT_PROOF, max(1, sizes.runs // 2), 4.0, 1.5),
        ("with proof", WITH_PROOF, 1, None, None),
    ):
        seconds, detail = _median_seconds(partial(_run_batch, trios, config, device), runs)
        entries.append(
            Entry(
                f"[F16] batch: {sizes.trios} trios of {_size(sizes.trio_cells)}, {kind}",
                seconds,
                runs,
                "the authors' batch of six trios on a Titan X, as published",
                F16_BATCH_S,
                must,
                stretch,
                detail=detail,
            )
        )
    return entries


def _run_batch(
    trios: list[tuple[OccupancyGrid, list[OccupancyGrid]]],
    config: FusionConfig,
    device: ComputeDevice,
) -> dict[str, Any]:
    """Do the batch once; the error of an alignment to the truth is the [F16] error."""
    maps, fused = [], []
    failed = 0
    for truth, inputs in trios:
        maps += [align_grids(truth, grid, config, device) for grid in inputs]
        try:
            result = fuse_grids(inputs, config, device)
        except AlignmentError:
            failed += 1
            continue
        fused.append(align_grids(truth, result.fused, config, device))
    return {
        "registrations": len(maps) + 3 * len(trios) + len(fused),
        "accepted": sum(a.accepted for a in maps + fused),
        "fusions_failed": failed,
        "mean_error_maps": _mean([a.error for a in maps]),
        "mean_error_fused": _mean([a.error for a in fused]),
    }


def _draw_trio(cells: int, number: int) -> tuple[OccupancyGrid, list[OccupancyGrid]]:
    """Return a true map and three maps of all of it, each with its own turn and faults."""
    rng = np.random.default_rng((SEED, number))
    truth = draw_building(rng, cells * RESOLUTION, cells * RESOLUTION, RESOLUTION)
    return truth, [
        _draw_map(truth, rng, wall_change)[0].with_name(f"map {n}")
        for n, wall_change in enumerate((0, 1, 0))
    ]


# -- shared ----------------------------------------------------------------------------------------


def _draw_pair(cells: int) -> tuple[OccupancyGrid, OccupancyGrid, Pose2]:
    """Return two maps of one building, and the true transform of the second into the first."""
    rng = np.random.default_rng(SEED)
    truth = draw_building(rng, cells * RESOLUTION, cells * RESOLUTION, RESOLUTION)
    reference, first = degrade_map(truth, rng, Degradation(resample=False, flip_share=0.005))
    whole, second = _draw_map(truth, rng, 1)
    # A turned square needs a larger box: keep the middle.
    row, col = max(0, whole.height - cells) // 2, max(0, whole.width - cells) // 2
    box = CellBox(row, col, min(row + cells, whole.height), min(col + cells, whole.width))
    moving = whole.crop(box)
    pair = reference.with_name("reference"), moving.with_name("moving")
    return *pair, first.inverse().compose(second)


def _draw_map(
    truth: OccupancyGrid, rng: np.random.Generator, wall_change: int
) -> tuple[OccupancyGrid, Pose2]:
    """Return a faulty map of the place, and its transform into the truth's frame."""
    degradation = Degradation(
        yaw_rad=float(rng.uniform(-math.pi, math.pi)),
        shift_share=(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.3, 0.3))),
        wall_change_cells=wall_change,
        flip_share=0.005,
        speckle_share=0.01,
    )
    return degrade_map(truth, rng, degradation)


def _prepare(grid: OccupancyGrid, device: ComputeDevice) -> GridFeatures:
    """Normalise a grid and hand it to the device."""
    normalized = normalize_grid(grid, RESOLUTION, FusionConfig().normalize, device)
    return GridFeatures(normalized, device)


def _describe(
    found: Alignment, truth: Pose2, reference: OccupancyGrid, moving: OccupancyGrid
) -> dict[str, Any]:
    """Return how an alignment came out: the error is where the moving map's centre lands."""
    centre = np.array([moving.width, moving.height]) * moving.resolution / 2.0
    own = moving.origin.transform(centre)
    landed = np.concatenate((found.transform.transform(own), [found.transform.yaw_rad]))
    wanted = np.concatenate((truth.transform(own), [truth.yaw_rad]))
    shift, turn = displacement(landed, wanted)
    cells = shift / reference.resolution
    return {
        "shapes": [[g.height, g.width] for g in (reference, moving)],
        "accepted": found.accepted,
        "bound_gap": found.bound_gap,
        "off_cells": cells,
        "off_deg": math.degrees(turn),
        "right": cells <= RIGHT_CELLS and turn <= RIGHT_YAW_RAD,
    }


def _median_seconds(work: Callable[[], Any], runs: int) -> tuple[float, Any]:
    """Do the work once unmeasured and ``runs`` times measured; return the median and a result."""
    result = work()
    return median(_seconds(work) for _ in range(runs)), result


def _seconds(work: Callable[[], Any]) -> float:
    """Return the wall time of one run."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _mean(values: list[float]) -> float | None:
    """Return the mean, None of nothing."""
    return sum(values) / len(values) if values else None


def _members(lattice: LatticeScore) -> str:
    """Return the size of the search set in words."""
    return f"{math.prod(lattice.shape):.2g}"


def _size(cells: int) -> str:
    """Return a square size in words."""
    return f"{cells} x {cells}"
