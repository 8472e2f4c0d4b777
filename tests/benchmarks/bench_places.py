"""Align recorded maps of the same and of different places, and count what is believed.

    python -m tests.benchmarks.bench_places --pictures out/places

Tables: every pair of maps of different places by places.csv (none may be accepted), the pairs of
one place, the Halmstad pairs against their annotation, and last the counts of all, which --record
keeps. With --pictures each pair of
one place is drawn, the reference's walls in one colour and the moving map's in another, to be
looked at.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import PIL.Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.pair import Pair as MapPair
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import FusionConfig
from slamfusion.fusion.lattice_vote import warp_onto
from slamfusion.grid import CellBox
from tests.benchmarks.record import add_record_option, console_for
from tests.support.datasets import MapEntry, load_entry, map_entries
from tests.support.halmstad import RIGHT_DEGREES, RIGHT_PIXELS, annotated_error, load_place
from tests.support.overlap import are_different_places

Pair = tuple[MapEntry, MapEntry]
# Of the table of counts: pairs, right, accepted, accepted wrong.
Counts = tuple[str, str, str, str]


def different_places() -> Iterator[Pair]:
    """Every pair of maps of different places."""
    for a, b in itertools.combinations(map_entries(), 2):
        if are_different_places(a, b):
            yield a, b


def same_place() -> Iterator[Pair]:
    """Every pair of maps of one place, drawings and Halmstad left out."""
    for a, b in itertools.combinations(map_entries(), 2):
        if a.place == b.place and not (a.is_drawing or b.is_drawing or "halmstad" in a.place):
            yield a, b


class Aligner:
    """Aligns pairs, keeping the features of each map and resolution."""

    def __init__(self, device: ComputeDevice) -> None:
        self.config = FusionConfig()
        self.device = device
        self.features: dict[tuple[str, float], GridFeatures] = {}

    def feature(self, entry: MapEntry, resolution: float) -> GridFeatures:
        """Return the prepared map."""
        key = (entry.file, resolution)
        if key not in self.features:
            grid = normalize_grid(load_entry(entry), resolution, self.config.normalize, self.device)
            self.features[key] = GridFeatures(grid, self.device)
        return self.features[key]

    def align(self, a: MapEntry, b: MapEntry) -> tuple[Alignment, GridFeatures, GridFeatures]:
        """Align the larger of two maps to the smaller."""
        resolution = min(entry.cell_size_m or 0.05 for entry in (a, b))
        first, second = self.feature(a, resolution), self.feature(b, resolution)
        if math.prod(first.shape) > math.prod(second.shape):
            first, second = second, first
        return align_pair(MapPair(first, second), self.config.align), first, second


def draw_pair(
    path: Path,
    alignment: Alignment,
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
) -> None:
    """Write a picture of both maps' walls: reference orange, moving blue, both black."""
    height, width = reference.shape
    margin = max(height, width) // 4
    box = CellBox(-margin, -margin, height + margin, width + margin)
    lattice = reference.grid.lattice
    own = np.pad(reference.grid.cells, margin, constant_values=-1)
    other = warp_onto(moving.grid, alignment.transform, lattice, box, device)
    picture = np.full((*own.shape, 3), 255, dtype=np.uint8)
    picture[(own == 0) | (other == 0)] = (238, 238, 238)
    picture[own == 1] = (230, 120, 0)
    picture[other == 1] = (0, 90, 220)
    picture[(own == 1) & (other == 1)] = (0, 0, 0)
    PIL.Image.fromarray(np.flipud(picture)).save(path)


def bench_different(aligner: Aligner, console: Console) -> list[Counts]:
    """Print which pairs of different places are accepted, and the nearest misses."""
    records = [
        aligner.align(a, b)[0]
        for a, b in track(list(different_places()), "different places", console=console)
    ]
    accepted = [record for record in records if record.accepted]
    for record in accepted:
        console.print(f"WRONG: {record.moving} to {record.reference}: {record.reason}")
    columns = ("share", "better", "expected_wrong", "rival_ratio", "wall_match", "wall_clash")
    misses = Table("moving", "reference", *columns, title="least wrong ones expected")
    searched = [(record, record.evidence) for record in records if record.evidence is not None]
    for record, match in sorted(searched, key=lambda item: item[1].expected_wrong)[:8]:
        numbers = {**vars(match), **record.statistics}
        misses.add_row(record.moving, record.reference, *(f"{numbers[c]:.2g}" for c in columns))
    console.print(misses)
    wrong = str(len(accepted))
    return [(f"{len(records)} pairs of different places", "none can be", wrong, wrong)]


def bench_same(aligner: Aligner, console: Console, pictures: Path | None) -> list[Counts]:
    """Print the pairs of one place."""
    columns = ("accepted", "dx m", "dy m", "yaw deg", "score", "match", "next", "s")
    table = Table("moving", "reference", *columns, "reason", title="one place")
    accepted = 0
    for a, b in same_place():
        record, reference, moving = aligner.align(a, b)
        pose = record.transform
        accepted += record.accepted
        table.add_row(
            record.moving,
            record.reference,
            "yes" if record.accepted else "no",
            f"{pose.x:.2f}",
            f"{pose.y:.2f}",
            f"{math.degrees(pose.yaw_rad):.2f}",
            f"{record.score:.2f}",
            f"{record.statistics.get('wall_match', math.nan):.2f}",
            f"{math.nan if record.evidence is None else record.evidence.rival_ratio:.2f}",
            f"{record.time_s:.2f}",
            record.reason,
        )
        if pictures is not None:
            name = f"{record.reference}--{record.moving}.png".replace("/", "_")
            draw_pair(pictures / name, record, reference, moving, aligner.device)
    console.print(table)
    return [(f"{table.row_count} pairs of one place", "no truth", str(accepted), "-")]


def bench_halmstad(aligner: Aligner, console: Console) -> list[Counts]:
    """Print which Halmstad pairs are wrong by their annotation."""
    rows: list[Counts] = []
    for place in ("F5", "HIH", "E5", "KPT4A"):
        counts: Counter[str] = Counter()
        grids = load_place(place)
        features = {
            name: GridFeatures(
                normalize_grid(grid, grid.resolution, aligner.config.normalize, aligner.device),
                aligner.device,
            )
            for name, grid in grids.items()
        }
        for a, b in itertools.combinations(features, 2):
            record = align_pair(MapPair(features[a], features[b]), aligner.config.align)
            pixels, degrees = annotated_error(grids[b], record)
            is_right = pixels < RIGHT_PIXELS and degrees < RIGHT_DEGREES
            counts["pairs"] += 1
            counts["right"] += is_right
            counts["accepted"] += record.accepted
            counts["accepted wrong"] += record.accepted and not is_right
            if record.accepted and not is_right:
                console.print(f"WRONG: {b} to {a}: {pixels:.1f} px, {degrees:.2f} deg")
        if counts["pairs"]:
            right = f"{counts['right']} of {counts['pairs']}"
            accepted, wrong = (str(counts[name]) for name in ("accepted", "accepted wrong"))
            rows.append((f"Halmstad {place}", right, accepted, wrong))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=Path, help="folder for the pictures of one place")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--skip-different", action="store_true")
    add_record_option(parser)
    arguments = parser.parse_args()
    device = open_device(arguments.device)
    console = Console(width=180)
    aligner = Aligner(device)
    rows = bench_halmstad(aligner, console) + bench_same(aligner, console, arguments.pictures)
    if not arguments.skip_different:
        rows += bench_different(aligner, console)
    table = Table("pairs", "right", "accepted", "accepted wrong", title="all pairs")
    for row in rows:
        table.add_row(*row)
    console_for("places", arguments.record, width=180).print(table)


if __name__ == "__main__":
    main()
