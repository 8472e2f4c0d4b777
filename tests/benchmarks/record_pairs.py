"""Align pairs of maps whose right answer is known, and keep the nearest to the decision as a CSV.

    python -m tests.benchmarks.record_pairs --out tests/fusion/recorded_pairs.csv

Pairs: maps of different places by places.csv (no answer is right), the Halmstad pairs against their
annotation, recorded maps against degraded copies of themselves, and drawn buildings of one size
with other rooms. Only the numbers that the decision looks at are kept, never a map, and only of the
pairs that lie nearest to it: how near a pair is, is the least change of one number alone that turns
the decision round. So the choice of rows knows nothing of how the decision is made.
"""

from __future__ import annotations

import argparse
import csv
import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from slamfusion.compute import open_device
from slamfusion.fusion.accept import Evidence, decide
from slamfusion.fusion.align import align_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import common_resolution, normalize_grid
from slamfusion.fusion.records import Alignment
from slamfusion.grid import OccupancyGrid
from slamfusion.sim import draw_building
from tests.benchmarks.bench_places import Aligner, different_places
from tests.support.drawn import case_error, drawn_cases
from tests.support.halmstad import RIGHT_DEGREES, RIGHT_PIXELS, annotated_error, load_place
from tests.support.recorded_pairs import COLUMNS, RecordedPair, changed, row_of, value_of

# Numbers that are looked at one at a time, and the change of each that is taken as large: shares
# and ratios by 0.5, z by 2.5, wall cells by 50.
LARGE = dict.fromkeys(COLUMNS, 0.5) | {"z": 2.5, "walls": 50.0}
# Changes that are tried, as shares of a large one, smallest first.
STEPS = np.linspace(0.005, 1.0, 200)
# Rows kept for each number and each of: wrong and rejected, right and accepted, right and rejected.
KEPT = 3
COMMAND = "python -m tests.benchmarks.record_pairs --out tests/fusion/recorded_pairs.csv"


class Recorder:
    """Aligns pairs and keeps what the decision looked at."""

    def __init__(self, on_device: str) -> None:
        self.device = open_device(on_device)
        self.aligner = Aligner(self.device, prove=False)

    def of(
        self, source: str, found: tuple[Alignment, GridFeatures, GridFeatures], *, is_right: bool
    ) -> RecordedPair:
        """Return the record of an aligned pair."""
        alignment, reference, moving = found
        evidence = Evidence(
            score=alignment.score,
            overlap=alignment.overlap,
            walls=min(len(reference.wall_points), len(moving.wall_points)),
            statistics=alignment.statistics,
            bound_gap=None,
            rival=False,
            search="full",
            near_start=False,
        )
        accepted = decide(evidence)[0]
        assert accepted == alignment.accepted, "the record leaves out what the decision looked at"
        return RecordedPair(
            source, alignment.reference, alignment.moving, is_right, accepted, evidence
        )

    def align(
        self, reference: OccupancyGrid, moving: OccupancyGrid
    ) -> tuple[Alignment, GridFeatures, GridFeatures]:
        """Align two grids."""
        config = self.aligner.config
        size = common_resolution([reference, moving], config.normalize)
        a, b = (
            GridFeatures(normalize_grid(grid, size, config.normalize, self.device), self.device)
            for grid in (reference, moving)
        )
        return align_features(a, b, config.align, self.device), a, b

    def different_places(self) -> Iterator[RecordedPair]:
        """Every pair of maps of different places."""
        for a, b in different_places():
            found = self.aligner.align(a, b)
            if found[0].statistics:
                yield self.of("different places", found, is_right=False)

    def halmstad(self) -> Iterator[RecordedPair]:
        """Every annotated pair of sensor maps."""
        for place in ("F5", "HIH", "E5", "KPT4A"):
            grids = load_place(place)
            config = self.aligner.config
            features = {
                name: GridFeatures(
                    normalize_grid(grid, grid.resolution, config.normalize, self.device),
                    self.device,
                )
                for name, grid in grids.items()
            }
            for a, b in itertools.combinations(features, 2):
                found = align_features(features[a], features[b], config.align, self.device)
                pixels, degrees = annotated_error(grids[b], found)
                is_right = pixels < RIGHT_PIXELS and degrees < RIGHT_DEGREES
                yield self.of("halmstad", (found, features[a], features[b]), is_right=is_right)

    def degraded(self, per_base: int) -> Iterator[RecordedPair]:
        """Recorded maps against degraded copies of themselves."""
        for case in drawn_cases(per_base, seed=1):
            found = self.align(case.truth, case.moving)
            cells, degrees = case_error(case, found[0])
            is_right = cells <= 1.0 and degrees <= 0.5
            yield self.of("degraded copy", found, is_right=is_right)

    def other_rooms(self, count: int) -> Iterator[RecordedPair]:
        """Drawn buildings of one size, with other rooms."""
        for seed in range(count):
            a, b = (
                draw_building(np.random.default_rng([seed, which]), 12.0, 10.0, 0.1).with_name(
                    f"building {seed} {which}"
                )
                for which in range(2)
            )
            yield self.of("other rooms", self.align(a, b), is_right=False)


def distance(pair: RecordedPair, column: str) -> float:
    """Return the least change of one number that turns the decision, in large ones; 2 for none."""
    value = value_of(pair.evidence, column)
    if value is None:
        return 2.0
    for step in STEPS:
        for sign in (-1.0, 1.0):
            other = max(0.0, value + sign * step * LARGE[column])
            if decide(changed(pair.evidence, column, other))[0] != pair.accepted:
                return float(step)
    return 2.0


def nearest(pairs: list[RecordedPair]) -> list[RecordedPair]:
    """Return the pairs nearest to the decision, along each number and on either side of it."""
    kept: dict[int, RecordedPair] = {}
    for column in COLUMNS:
        for side in ((False, False), (True, True), (True, False)):
            own = [pair for pair in pairs if (pair.is_right, pair.accepted) == side]
            by_distance = sorted((distance(pair, column), i) for i, pair in enumerate(own))
            for far, index in by_distance[:KEPT]:
                if far < 1.0:
                    kept[id(own[index])] = own[index]
    wrongly = [pair for pair in pairs if pair.accepted and not pair.is_right]
    kept |= {id(pair): pair for pair in wrongly}
    return [pair for pair in pairs if id(pair) in kept]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--everything", type=Path, help="write every pair here, too")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--per-base", type=int, default=12, help="degraded copies of each map")
    parser.add_argument("--buildings", type=int, default=100)
    arguments = parser.parse_args()
    console = Console()
    recorder = Recorder(arguments.device)
    pairs = list(
        track(
            itertools.chain(
                recorder.other_rooms(arguments.buildings),
                recorder.degraded(arguments.per_base),
                recorder.halmstad(),
                recorder.different_places(),
            ),
            "pairs",
            console=console,
        )
    )
    if arguments.everything is not None:
        write(arguments.everything, pairs, "every pair")
    kept = nearest(pairs)
    write(arguments.out, kept, f"the nearest to the decision of {len(pairs)} pairs")
    counts = Counter((pair.source, pair.is_right, pair.accepted) for pair in pairs)
    for (source, is_right, accepted), count in sorted(counts.items()):
        words = ("right" if is_right else "wrong", "accepted" if accepted else "rejected")
        console.print(f"{source}: {count} {', '.join(words)}")
    console.print(f"{len(kept)} rows in {arguments.out}")


def write(path: Path, pairs: list[RecordedPair], what: str) -> None:
    """Write a table of pairs."""
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(f"# {what}; written by\n")
        file.write(
            "# python -m tests.benchmarks.record_pairs --out tests/fusion/recorded_pairs.csv\n"
        )
        rows = [row_of(pair) for pair in pairs]
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
