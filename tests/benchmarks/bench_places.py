"""Align recorded maps of the same and of different places, and count what is believed.

    python -m tests.benchmarks.bench_places --record

The table counts every pair of maps of different places by places.csv (none may be accepted), the
pairs of one place, and the Halmstad pairs against their annotation. ``align`` shows one pair.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator

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
from tests.benchmarks.record import bench_parser, console_for
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

    def align(self, a: MapEntry, b: MapEntry) -> Alignment:
        """Align the larger of two maps to the smaller."""
        resolution = min(entry.cell_size_m or 0.05 for entry in (a, b))
        first, second = self.feature(a, resolution), self.feature(b, resolution)
        if math.prod(first.shape) > math.prod(second.shape):
            first, second = second, first
        return align_pair(MapPair(first, second), self.config.align)


def count_pairs(aligner: Aligner, pairs: Iterable[Pair]) -> tuple[int, list[Alignment]]:
    """Align pairs; return how many there are, and the alignments that are accepted."""
    records = [aligner.align(a, b) for a, b in pairs]
    return len(records), [record for record in records if record.accepted]


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
    parser = bench_parser(__doc__)
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    console = console_for("places", arguments.record, width=180)
    aligner = Aligner(open_device(arguments.device))
    table = Table("pairs", "right", "accepted", "accepted wrong", title="all pairs")
    for row in bench_halmstad(aligner, console):
        table.add_row(*row)
    count, accepted = count_pairs(aligner, same_place())
    table.add_row(f"{count} pairs of one place", "no truth", str(len(accepted)), "-")
    pairs = track(list(different_places()), "different places", console=Console(stderr=True))
    count, accepted = count_pairs(aligner, pairs)
    for record in accepted:
        console.print(f"WRONG: {record.moving} to {record.reference}: {record.reason}")
    wrong = str(len(accepted))
    table.add_row(f"{count} pairs of different places", "none can be", wrong, wrong)
    console.print(table)


if __name__ == "__main__":
    main()
