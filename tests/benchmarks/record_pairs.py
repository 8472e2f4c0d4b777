"""Align pairs of maps whose right answer is known, and keep the nearest to the decision as a CSV.

    python -m tests.benchmarks.record_pairs --out tests/align/recorded_pairs.csv

With --everything FILE all pairs are kept, too; --pairs FILE decides those once more and chooses
among them, without aligning anything, after a limit of the decision has moved.

Pairs: those of ``tests.support.overlap`` (maps cut in two, of one SLAM and of two, with a gap,
mirrored, at another scale, and of different places), the Halmstad pairs against their annotation,
recorded maps against degraded copies of themselves, and drawn buildings of one size with other
rooms. Of each kind so many are taken, spread evenly. Only the numbers that the decision looks at
are kept, never a map, and only of the pairs that lie nearest to it: how near a pair is, is the
least change of one number alone that turns the decision round. So the choice of rows knows nothing
of how the decision is made.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from rich.console import Console

from slamfusion.align.align import align_pair
from slamfusion.align.answer import ground_prior
from slamfusion.align.decide import Evidence, decide
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import common_resolution, normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.compute import open_device
from slamfusion.config import AlignConfig, NormalizeConfig
from slamfusion.grid import OccupancyGrid
from slamfusion.sim import draw_building
from tests.support.drawn import BASES, case_error, drawn_cases
from tests.support.halmstad import RIGHT_DEGREES, RIGHT_PIXELS, annotated_error, load_place
from tests.support.overlap import (
    Draft,
    cross_slam_pairs,
    different_places,
    disjoint_halves,
    drawn,
    half_pairs,
    mirrored,
    scaled,
    simulated,
)
from tests.support.recorded_pairs import (
    COLUMNS,
    RecordedPair,
    changed,
    load_pairs,
    row_of,
    value_of,
)

T = TypeVar("T")

# Numbers that are looked at one at a time, and the change of each that is taken as large.
LARGE = dict.fromkeys(COLUMNS, 0.5) | {
    "walls": 50.0,
    "common_m": 50.0,
    "witnesses": 5.0,
    "better": 5.0,
    "scale": 0.05,
}
# Changes that are tried, as shares of a large one, smallest first.
STEPS = np.linspace(0.005, 1.0, 200)
# Rows kept for each number and each of: wrong and rejected, right and accepted, right and rejected.
KEPT = 4
# Larger by more than what is believed with a word.
WRONG_SCALES = (1.05, 1.1)
SEED = 1
COMMAND = "python -m tests.benchmarks.record_pairs --out tests/align/recorded_pairs.csv"


class Recorder:
    """Aligns pairs and keeps what the decision looked at."""

    def __init__(self, on_device: str, each: int) -> None:
        self.device = open_device(on_device)
        self.each = each

    def of(
        self, source: str, found: tuple[Alignment, GridFeatures, GridFeatures], *, is_right: bool
    ) -> RecordedPair:
        """Return the record of an aligned pair."""
        alignment, reference, moving = found
        match = alignment.evidence
        assert match is not None
        evidence = Evidence(
            walls=min(len(reference.wall_points), len(moving.wall_points)),
            common_m=match.common_m,
            share=match.share,
            witnesses=match.pieces,
            better=match.better,
            ratio=match.rival_ratio,
            rival=None if alignment.runner_up is None else "elsewhere",
            pairs=1,
            prior=ground_prior(Pair(reference, moving), is_plain=match.good_maps),
            statistics=alignment.statistics,
            search="full",
            mirrored=match.mirrored,
            scale=match.scale,
            scaled_share=match.scaled_share or 0.0,
            clean_share=match.rival_share,
            common_ground=alignment.overlap,
            held_m=match.held_m,
            beside_lines_m=match.beside_lines_m,
            is_plain=match.good_maps,
            is_sharp=match.sharp_maps,
        )
        decision = decide(evidence).kind
        said = alignment.decision
        assert decision == said, f"the record leaves out what was looked at: {decision}, {said}"
        names = alignment.reference, alignment.moving
        return RecordedPair(source, *names, is_right, decision, evidence)

    def align(
        self, reference: OccupancyGrid, moving: OccupancyGrid
    ) -> tuple[Alignment, GridFeatures, GridFeatures]:
        """Align two grids."""
        normal = NormalizeConfig()
        size = common_resolution([reference, moving], normal)
        a, b = (
            GridFeatures(normalize_grid(grid, size, normal, self.device), self.device)
            for grid in (reference, moving)
        )
        return align_pair(Pair(a, b), AlignConfig()), a, b

    def overlapping(self, drafts: Sequence[Draft]) -> Iterator[RecordedPair]:
        """Pairs of ``tests.support.overlap``."""
        for case in drawn(spread(drafts, self.each)):
            found = self.align(case.reference, case.moving)
            if found[0].evidence is not None:
                yield self.of(case.what, found, is_right=case.is_right(found[0].transform))

    def halmstad(self) -> Iterator[RecordedPair]:
        """Annotated pairs of sensor maps."""
        grids = {place: load_place(place) for place in ("F5", "HIH", "E5", "KPT4A")}
        pairs = [
            (place, a, b) for place in grids for a, b in itertools.combinations(grids[place], 2)
        ]
        for place, a, b in spread(pairs, self.each):
            found = self.align(grids[place][a], grids[place][b])
            pixels, degrees = annotated_error(grids[place][b], found[0])
            is_right = pixels < RIGHT_PIXELS and degrees < RIGHT_DEGREES
            yield self.of("halmstad", found, is_right=is_right)

    def degraded(self) -> Iterator[RecordedPair]:
        """Recorded maps against degraded copies of themselves."""
        for case in drawn_cases(max(1, self.each // len(BASES)), SEED):
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


def spread(items: Sequence[T], count: int) -> Sequence[T]:
    """Return so many at most, spread evenly."""
    if len(items) <= count:
        return items
    return [items[i * len(items) // count] for i in range(count)]


def distance(pair: RecordedPair, column: str) -> float:
    """Return the least change of one number that turns the decision, in large ones; 2 for none."""
    value = value_of(pair.evidence, column)
    if value is None:
        return 2.0
    for step in STEPS:
        for sign in (-1.0, 1.0):
            other = value + sign * step * LARGE[column]
            if decide(changed(pair.evidence, column, other)).accepted != pair.accepted:
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
    parser.add_argument("--pairs", type=Path, help="a table of every pair, instead of aligning")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--each", type=int, default=48, help="pairs of each kind, at most")
    parser.add_argument("--buildings", type=int, default=100)
    arguments = parser.parse_args()
    console = Console()
    if arguments.pairs is not None:
        pairs = [
            replace(pair, decision=decide(pair.evidence).kind)
            for pair in load_pairs(arguments.pairs)
        ]
    else:
        pairs = align_all(arguments, console)
    if arguments.everything is not None:
        write(arguments.everything, pairs, "every pair")
    kept = nearest(pairs)
    write(arguments.out, kept, f"the nearest to the decision of {len(pairs)} pairs")
    counts = Counter((pair.source, pair.is_right, pair.decision) for pair in pairs)
    for (source, is_right, decision), count in sorted(counts.items()):
        words = "right" if is_right else "wrong", decision
        console.print(f"{source}: {count} {', '.join(words)}")
    console.print(f"{len(kept)} rows in {arguments.out}")


def align_all(arguments: argparse.Namespace, console: Console) -> list[RecordedPair]:
    """Align the pairs of all kinds."""
    recorder = Recorder(arguments.device, arguments.each)
    kinds = (
        recorder.other_rooms(arguments.buildings),
        recorder.overlapping(simulated(SEED)),
        recorder.overlapping(half_pairs(SEED)),
        recorder.overlapping(cross_slam_pairs(SEED)),
        recorder.overlapping(disjoint_halves(SEED)),
        recorder.overlapping(mirrored(SEED)),
        recorder.overlapping([draft for by in WRONG_SCALES for draft in scaled(SEED, by)]),
        recorder.overlapping(different_places(SEED)),
        recorder.degraded(),
        recorder.halmstad(),
    )
    pairs: list[RecordedPair] = []
    for kind in kinds:
        began = time.perf_counter()
        own = list(kind)
        pairs += own
        took = time.perf_counter() - began
        source = own[0].source if own else "none"
        console.print(f"{source}: {len(own)} pairs in {took:.0f} s")
    return pairs


def write(path: Path, pairs: list[RecordedPair], what: str) -> None:
    """Write a table of pairs."""
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(f"# {what}; written by\n# {COMMAND}\n")
        rows = [row_of(pair) for pair in pairs]
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
