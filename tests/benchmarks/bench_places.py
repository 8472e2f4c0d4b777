"""Align recorded maps of the same and of different places, and count what is believed.

    python -m tests.benchmarks.bench_places --record

The table counts every pair of maps of different places by places.csv (none may be accepted), the
pairs of one place, and the Halmstad pairs against their annotation. ``align`` shows one pair.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator

from rich.console import Console
from rich.progress import track
from rich.table import Table

from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import FusionConfig
from slamfusion.fusion import align_grids
from tests.benchmarks.record import bench_parser, console_for
from tests.support.datasets import MapEntry, align_entries, map_entries
from tests.support.halmstad import RIGHT_DEGREES, RIGHT_PIXELS, annotated_error, load_place
from tests.support.overlap import are_different_places

Pair = tuple[MapEntry, MapEntry]
# Of the table of counts: pairs, right, accepted, accepted wrong.
Counts = tuple[str, str, str, str]
CONFIG = FusionConfig()


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


def count_pairs(pairs: Iterable[Pair], device: ComputeDevice) -> tuple[int, list[Alignment]]:
    """Align pairs; return how many there are, and the alignments that are accepted."""
    records = [align_entries(a, b, CONFIG, device) for a, b in pairs]
    return len(records), [record for record in records if record.accepted]


def bench_halmstad(device: ComputeDevice, console: Console) -> list[Counts]:
    """Print which Halmstad pairs are wrong by their annotation."""
    rows: list[Counts] = []
    for place in ("F5", "HIH", "E5", "KPT4A"):
        counts: Counter[str] = Counter()
        grids = load_place(place)
        for a, b in itertools.combinations(grids, 2):
            record = align_grids(grids[a], grids[b], CONFIG, device)
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
    device = open_device(arguments.device)
    table = Table("pairs", "right", "accepted", "accepted wrong", title="all pairs")
    for row in bench_halmstad(device, console):
        table.add_row(*row)
    count, accepted = count_pairs(same_place(), device)
    table.add_row(f"{count} pairs of one place", "no truth", str(len(accepted)), "-")
    pairs = track(list(different_places()), "different places", console=Console(stderr=True))
    count, accepted = count_pairs(pairs, device)
    for record in accepted:
        console.print(f"WRONG: {record.moving} to {record.reference}: {record.reason}")
    wrong = str(len(accepted))
    table.add_row(f"{count} pairs of different places", "none can be", wrong, wrong)
    console.print(table)


if __name__ == "__main__":
    main()
