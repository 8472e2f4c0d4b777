"""Compare votes with their inputs: is the fused map never worse than the good maps it is made of?

    python -m tests.benchmarks.bench_vote --cases five-slams,degraded --modes majority,consensus

Each case fuses maps of one place, some of them bad, and compares the inputs and every fused map
with the true maps, of thin and of solid walls (``vote_cases``). Good inputs are those whose wall F1
against thin walls is within 0.02 of the best: against solid walls, of which no laser sees the
inside, a map gains by thickening its walls. These bars are judged:

- ``f1``: the wall F1 (walls within 0.1 m) is at least the best good input's less 0.01;
- ``error``: the error of [F16] is at most 1.1 times the mean of the good inputs;
- ``thickness``, ``doubled``: the mean thickness of walls and the share of doubled walls lie within
  the range of the good inputs, to a tenth of a cell and one wall cell in a hundred (less than the
  range is no fault where the true map has less). Both depend on how walls lie on cells, so every
  map is drawn on the cells of the fused map, and then on those of the true map;
- of two maps instead ``common``: on ground that both know, the wall F1 is at least that of the
  worse one less 0.01; and ``adds``: of the true walls that one of them shows, 0.4 m and more from
  all that the other knows (nearer is a wall that the other may draw askew), 95 % are there.

The summary counts cases of three or more inputs in which two good ones agree, and pairs that could
be aligned.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
import scipy
from rich.progress import track
from rich.table import Table

from slamfusion.align.align import track_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import common_resolution, normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import EvaluateConfig, FusionConfig, NormalizeConfig, VoteMode
from slamfusion.errors import AlignmentError
from slamfusion.evaluation.distances import sample_on_lattice, wall_centres
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.wall_faces import Nearness, wall_thickness
from slamfusion.fusion.pipeline import fuse_grids, vote_again
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import IDENTITY, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, trinary_cells
from slamfusion.vote.walls import SAME_WALL_M
from tests.benchmarks.record import bench_parser, console_for
from tests.benchmarks.vote_cases import KINDS, Case, cases

THRESHOLDS = NormalizeConfig()
TOLERANCE_M = EvaluateConfig().tolerance_m
GOOD_WITHIN, F1_LOSS, ERROR_RATIO, ADDED_SHARE = 0.02, 0.01, 1.1, 0.95
# Two good maps alone span no range: how far outside is still inside, metres and share.
THICKNESS_SLACK_M, DOUBLED_SLACK = 0.005, 0.01
# Two maps agree where the F1 of their walls, one against the other, is at least this.
AGREEMENT = 0.9
BARS = ("f1", "error", "thickness", "doubled", "common", "adds")


@dataclass(frozen=True)
class Figures:
    """How good a map is.

    Attributes:
        f1: of walls within 0.1 m of the true ones, 0 to 1.
        error: of [F16].
        thickness_m: mean of the walls; NaN without a wall.
        doubled: share of the walls that have a parallel one close by, 0 to 1.
    """

    f1: float
    error: float
    thickness_m: float
    doubled: float


@dataclass(frozen=True, eq=False)
class Fused:
    """A fused map.

    Attributes:
        grid: None where the inputs could not be aligned.
        starts: poses of its frame in the frame of the true maps by which to look for the best fit.
        time_s: processor time of the fusion, or of the vote alone.
        reason: why there is none.
    """

    grid: OccupancyGrid | None
    starts: tuple[Pose2, ...] = ()
    time_s: float = 0.0
    reason: str = ""


@dataclass(frozen=True)
class Row:
    """A fused map against one true map.

    Attributes:
        case: its name.
        truth: ``thin`` or ``solid``.
        mode: of the vote.
        counts: in the summary: two good inputs agree, or it is of a pair that was aligned.
        fused: of the fused map; None where the inputs could not be aligned.
        inputs: of each input.
        good: names of the good inputs.
        margins: by bar; at least 0 where it holds.
        time_s: see ``Fused``.
        reason: why there is no fused map.
    """

    case: str
    truth: str
    mode: str
    counts: bool
    fused: Figures | None
    inputs: Mapping[str, Figures]
    good: tuple[str, ...]
    margins: Mapping[str, float]
    time_s: float
    reason: str


# --- fuse ----------------------------------------------------------------------------------------


def fuse_case(case: Case, modes: Sequence[str], device: ComputeDevice) -> dict[str, Fused]:
    """Align the maps of a case once and fuse them in several modes."""
    result: FusionResult | None = None
    made = {}
    for mode in modes:
        config = FusionConfig()
        vote = replace(config.vote, mode=mode, extent="union")  # type: ignore[arg-type]  # words of a command line
        config = replace(config, vote=vote)
        began_s = time.process_time()
        try:
            if result is None:
                result = fuse_grids(case.inputs, config, device)
            else:
                result = vote_again(result, config, device)
        except AlignmentError as error:
            return dict.fromkeys(modes, Fused(None, reason=str(error)))
        starts = [
            case.poses[record.name].compose(record.alignment.transform.inverse())
            for record in result.accepted
            if record.alignment is not None
        ]
        made[mode] = Fused(result.fused, tuple(starts), time.process_time() - began_s)
    return made


# --- measure -------------------------------------------------------------------------------------


def place_on(
    truth: OccupancyGrid, grid: OccupancyGrid, starts: Iterable[Pose2], device: ComputeDevice
) -> Pose2:
    """Return the pose of a map's frame in the truth's at which its wall F1 is best.

    Args:
        truth: the true map.
        grid: the map.
        starts: poses within about 0.5 m and a few degrees; each is refined.
        device: computes.
    """
    resolution = common_resolution([truth, grid], THRESHOLDS)
    features = [
        GridFeatures(normalize_grid(item, resolution, THRESHOLDS, device), device)
        for item in (truth, grid)
    ]
    poses: list[Pose2] = []
    for start in starts:
        if all(_apart(start, other) for other in poses[1::2]):
            poses += [track_pair(Pair(features[0], features[1]), start).transform, start]
    walls = _walls(truth)
    return max(poses, key=lambda pose: _f1(_walls(grid, pose), walls))


def _apart(a: Pose2, b: Pose2) -> bool:
    step = a.inverse().compose(b)
    return math.hypot(step.x, step.y) > 0.05 or abs(step.yaw_rad) > 0.005


def measure(
    grid: OccupancyGrid,
    truth: OccupancyGrid,
    pose: Pose2,
    fused: tuple[OccupancyGrid, Pose2] | None = None,
) -> Figures:
    """Measure a map against a true map.

    Args:
        grid: the map.
        truth: the true map.
        pose: of the map's frame in the truth's, metres.
        fused: the fused map on whose cells thickness and doubled walls are measured first, with the
            pose of its frame in the truth's.
    """
    found, true = (
        trinary_cells(item.cells, THRESHOLDS).astype(np.int64)
        for item in (_drawn_on(truth, grid, pose), truth)
    )
    if fused is None:
        drawn = _drawn_on(truth, grid, pose)
    else:
        lattice, there = fused
        drawn = _drawn_on(truth, _drawn_on(lattice, grid, there.inverse().compose(pose)), there)
    drawn = drawn.classified(THRESHOLDS)
    thickness = wall_thickness(drawn)
    return Figures(
        _f1(_walls(grid, pose), _walls(truth)),
        float(np.linalg.norm((true - found).ravel())),
        math.nan if thickness is None else thickness.mean,
        doubled_wall_share(drawn.cells == 1),
    )


def _drawn_on(lattice: OccupancyGrid, grid: OccupancyGrid, pose: Pose2) -> OccupancyGrid:
    """Return a map on the cells of another one; pose of its frame in the other's."""
    whole = CellBox(0, 0, lattice.height, lattice.width)
    cells = sample_on_lattice(grid.classified(THRESHOLDS), lattice, whole, pose)
    return replace(lattice, cells=np.where(cells == 1, np.int8(OCCUPIED), cells))


def _walls(grid: OccupancyGrid, pose: Pose2 = IDENTITY) -> F64:
    return wall_centres(grid.classified(THRESHOLDS), pose)


def _f1(walls: F64, true_walls: F64) -> float:
    """Return the F1 of walls, (N, 2) metres, against true ones; 0 where one side has none."""
    return Nearness.between(walls, true_walls).agreement(TOLERANCE_M).f1 or 0.0


# --- judge ---------------------------------------------------------------------------------------


def good_inputs(f1: Mapping[str, float]) -> tuple[str, ...]:
    """Return the names of the inputs whose wall F1 is within 0.02 of the best."""
    return tuple(name for name, own in f1.items() if own >= max(f1.values()) - GOOD_WITHIN)


def judge_bars(fused: Figures | None, good: Sequence[Figures], truth: Figures) -> dict[str, float]:
    """Return the margin by which a fused map of three or more meets each bar; below 0 it does not.

    Args:
        fused: of the fused map; None misses every bar without end.
        good: of the good inputs.
        truth: of the true map itself.
    """
    if fused is None:
        return dict.fromkeys(BARS[:4], -math.inf)
    best = max(item.f1 for item in good)
    mean_error = float(np.mean([item.error for item in good]))
    return {
        "f1": fused.f1 - best + F1_LOSS,
        "error": (ERROR_RATIO * mean_error - fused.error) / max(mean_error, 1.0),
        "thickness": THICKNESS_SLACK_M
        + _inside(fused.thickness_m, [item.thickness_m for item in good], truth.thickness_m),
        "doubled": DOUBLED_SLACK
        + _inside(fused.doubled, [item.doubled for item in good], truth.doubled),
    }


def _inside(value: float, good: Sequence[float], true: float) -> float:
    """Return how far a value lies inside a range of values; below 0 outside."""
    return min(value - min(*good, true), max(good) - value)


def judge_pair(
    fused: tuple[OccupancyGrid, Pose2] | None,
    inputs: Sequence[tuple[OccupancyGrid, Pose2]],
    truth: OccupancyGrid,
) -> dict[str, float]:
    """Return the margins of a fused map of two: on common ground, and in what only one saw.

    Args:
        fused: the map with the pose of its frame in the truth's; None misses both bars.
        inputs: likewise, two.
        truth: the true map.
    """
    if fused is None:
        return dict.fromkeys(BARS[4:], -math.inf)
    reach, apart = (math.ceil(span / truth.resolution) for span in (TOLERANCE_M, SAME_WALL_M))
    whole = CellBox(0, 0, truth.height, truth.width)
    known = []
    for grid, pose in inputs:
        found = sample_on_lattice(grid.classified(THRESHOLDS), truth, whole, pose)
        known.append(scipy.ndimage.binary_closing(found != UNKNOWN, iterations=reach))
    is_common = known[0] & known[1]
    true_walls = _walls(truth)

    def within(walls: F64, mask: npt.NDArray[np.bool_]) -> F64:
        rows, cols = truth.cell_indices(walls)
        is_on = (rows >= 0) & (rows < truth.height) & (cols >= 0) & (cols < truth.width)
        is_on[is_on] = mask[rows[is_on], cols[is_on]]
        return walls[is_on]

    walls, *own = (_walls(grid, pose) for grid, pose in (fused, *inputs))
    common = partial(within, mask=is_common)
    scores = [_f1(common(item), common(true_walls)) for item in (walls, *own)]
    shown = []
    for mine, here, other in ((own[0], known[0], known[1]), (own[1], known[1], known[0])):
        alone = within(true_walls, here & ~scipy.ndimage.binary_dilation(other, iterations=apart))
        shown.append(alone[Nearness.between(alone, mine).map_to_truth <= TOLERANCE_M])
    added = Nearness.between(np.concatenate(shown), walls).agreement(TOLERANCE_M).precision
    return {
        "common": scores[0] - min(scores[1:]) + F1_LOSS,
        "adds": (1.0 if added is None else added) - ADDED_SHARE,
    }


def measure_case(case: Case, fused: Mapping[str, Fused], device: ComputeDevice) -> Iterator[Row]:
    """Yield a row for each fused map and true map."""
    lattice = case.truths["thin"]
    inputs = [
        (grid, place_on(lattice, grid, [case.poses[grid.name]], device)) for grid in case.inputs
    ]
    placed = {
        mode: None
        if item.grid is None
        else (item.grid, place_on(lattice, item.grid, item.starts, device))
        for mode, item in fused.items()
    }
    walls = {grid.name: _walls(grid, pose) for grid, pose in inputs}
    good = good_inputs({name: _f1(own, _walls(lattice)) for name, own in walls.items()})
    agreed = max((_f1(walls[a], walls[b]) for a, b in combinations(good, 2)), default=0.0)
    for kind, truth in case.truths.items():
        true = measure(truth, truth, IDENTITY)
        for mode, item in placed.items():
            own = {grid.name: measure(grid, truth, pose, item) for grid, pose in inputs}
            found = None if item is None else measure(item[0], truth, item[1])
            if len(inputs) == 2:
                margins = judge_pair(item, inputs, truth)
            else:
                margins = judge_bars(found, [own[name] for name in good], true)
            counts = item is not None if len(inputs) == 2 else agreed >= AGREEMENT
            how = fused[mode]
            yield Row(
                case.name, kind, mode, counts, found, own, good, margins, how.time_s, how.reason
            )


# --- tables --------------------------------------------------------------------------------------


def summary_table(rows: Sequence[Row], modes: Sequence[str]) -> Table:
    """Return, of each mode and bar, the share of cases that meet it, and the worst case."""
    table = Table("mode", "bar", "thin", "solid", "worst margin", "worst case")
    for mode in modes:
        own = [row for row in rows if row.mode == mode and row.counts]
        for bar in (*BARS, "all"):
            judged = [(_margin(row, bar), row) for row in own if bar == "all" or bar in row.margins]
            if not judged:
                continue
            shares = [
                _share([margin for margin, row in judged if row.truth == kind])
                for kind in ("thin", "solid")
            ]
            worst, row = min(judged, key=lambda pair: pair[0])
            words = ("", "") if bar == "all" else (f"{worst:.3f}", f"{row.case}, {row.truth}")
            table.add_row(mode, bar, *shares, *words)
        times = [row.time_s for row in own if row.fused is not None]
        table.add_row(mode, "processor s", "", "", f"{max(times, default=0.0):.1f}", "longest")
    return table


def _margin(row: Row, bar: str) -> float:
    return min(row.margins.values()) if bar == "all" else row.margins[bar]


def _share(margins: Sequence[float]) -> str:
    held = sum(margin >= 0.0 for margin in margins)
    return f"{held} of {len(margins)}" if margins else ""


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def main() -> None:
    """Read the options and run."""
    parser = bench_parser(__doc__)
    parser.add_argument("--cases", type=_names, default=KINDS, help=f"default: {','.join(KINDS)}")
    parser.add_argument("--modes", type=_names, default=get_args(VoteMode), help="default: all")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write all figures, after each case"
    )
    options = parser.parse_args()
    if not set(options.cases) <= set(KINDS):
        parser.error(f"--cases takes {', '.join(KINDS)}, found {', '.join(options.cases)}")
    device = open_device()
    rows: list[Row] = []
    for kind in options.cases:
        for seed in range(options.seeds):
            found = cases(kind, seed)
            for case in track(found, f"{kind} {seed}", disable=not sys.stderr.isatty()):
                fused = fuse_case(case, options.modes, device)
                rows += measure_case(case, fused, device)
                if options.json is not None:
                    document: list[dict[str, Any]] = [asdict(row) for row in rows]
                    options.json.write_text(json.dumps(document, indent=1), encoding="utf-8")
    console_for("vote", options.record, width=200).print(summary_table(rows, options.modes))


if __name__ == "__main__":
    main()
