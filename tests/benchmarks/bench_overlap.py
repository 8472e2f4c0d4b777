"""Align maps that share only a part, and maps that share nothing, and count what is believed.

    python -m tests.benchmarks.bench_overlap --processes 2 --jsonl out/overlap.jsonl
    python -m tests.benchmarks.bench_overlap --only one-map --only cross-slam

Of pairs with a right answer each cell of the table counts: accepted and right / accepted and wrong
/ rejected, though the best candidate is right / rejected and not found, of how many. A second table
counts those alone that share wall enough to be believed (``WALL_ENOUGH_M``). Of the others none may
be accepted (at 1.02 times the scale it may be, where the scale is named).
"""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.progress import track
from rich.table import Table

from slamfusion.compute import shared_device
from slamfusion.config import FusionConfig
from slamfusion.fusion import align_grids
from slamfusion.json_values import plain
from tests.benchmarks.record import bench_parser, console_for
from tests.support.datasets import ABSENT, MAPS
from tests.support.overlap import NEGATIVES, OVERLAPS, POSITIVES, SETS, Draft

OUTCOMES = ("accepted right", "accepted wrong", "found, rejected", "not found")
# Metres of wall in common, counted by cells, with which a pair should be believed.
WALL_ENOUGH_M = 10


# A pair: how it was made (metres, degrees), how near the answer is (None where there is no right
# one), and ``align --json``. ``common_walls``: the wall cells on the ground in common, of the map
# that has fewer there.
Result = dict[str, Any]


def align(draft: Draft, on_device: str) -> tuple[str, Result | None]:
    """Return what a pair is, and what comes of it; None where it is left out."""
    case = draft.draw()
    if case is None:
        return draft.what, None
    device = shared_device(on_device)
    record = align_grids(case.reference, case.moving, FusionConfig(), device)
    error = case.error(record.transform)
    is_right = case.is_right(record.transform)
    return draft.what, {
        "name": case.name,
        "what": case.what,
        "place": case.place,
        "seed": draft.seed,
        "reference_map": draft.reference.source,
        "moving_map": draft.moving.source,
        "overlap": case.overlap,
        "common_walls": case.common_walls,
        "common_wall_m": case.common_walls * case.reference.resolution,
        "is_right": is_right,
        "outcome": OUTCOMES[2 * (not record.accepted) + (not is_right)],
        "error_m": None if error is None else error[0],
        "error_deg": None if error is None else error[1],
        "alignment": plain(record),
    }


def results_of(
    drafts: list[Draft], processes: int, on_device: str
) -> Iterator[tuple[str, Result | None]]:
    """Align all pairs in processes of their own, in no certain order."""
    # A device that was opened before a fork is of no use after it.
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes) as pool:
        yield from pool.imap_unordered(partial(align, on_device=on_device), drafts, chunksize=8)


def print_found(results: list[Result], console: Console) -> None:
    """Print the tables of pairs that have a right answer: all, and those with walls enough."""
    _print_counts(results, "overlap of each half", console)
    walled = [result for result in results if result["common_wall_m"] >= WALL_ENOUGH_M]
    _print_counts(walled, f"the same, at least {WALL_ENOUGH_M} m of wall in common", console)
    if any(result["what"] in POSITIVES for result in results):
        console.print(" / ".join(OUTCOMES))


def _print_counts(results: list[Result], title: str, console: Console) -> None:
    """Print how often each outcome came of the pairs that have a right answer."""
    table = Table("set", *(f"{overlap:.0%}" for overlap in OVERLAPS), title=title)
    for what in POSITIVES:
        row = []
        for overlap in OVERLAPS:
            some = [r for r in results if r["what"] == what and r["overlap"] == overlap]
            counts = Counter(result["outcome"] for result in some)
            row.append(" / ".join(str(counts[o]) for o in OUTCOMES) + f" of {len(some)}")
        if any(result["what"] == what for result in results):
            table.add_row(what, *row)
    if table.row_count:
        console.print(table)


def print_accepted(results: list[Result], console: Console) -> None:
    """Print how many of the pairs without a right answer are accepted, and each wrong one."""
    table = Table("pairs of", "accepted", "of", title="nothing here is right")
    for what in NEGATIVES:
        some = [result for result in results if result["what"] == what]
        if some:
            accepted = sum(result["alignment"]["accepted"] for result in some)
            table.add_row(what, str(accepted), str(len(some)))
    if table.row_count:
        console.print(table)
    for result in results:
        if result["outcome"] == "accepted wrong":
            off = (
                f", {result['error_m']:.2f} m, {result['error_deg']:.1f} deg off"
                if result["overlap"]
                else ""
            )
            reason = result["alignment"]["reason"]
            console.print(f"WRONG: {result['name']}{off}: {reason}", markup=False)


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of yaws, origins, specks")
    parser.add_argument("--only", choices=tuple(SETS), action="append", help="default: all")
    parser.add_argument("--jsonl", type=Path, help="file for one line a pair")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    names = arguments.only or tuple(SETS)
    if not MAPS.is_dir() and set(names) != {"simulated"}:
        parser.error(ABSENT + ", or ask for --only simulated")
    console = console_for("overlap", arguments.record, width=160)
    drafts = [draft for name in names for draft in SETS[name](arguments.seed)]
    results: list[Result] = []
    left_out: Counter[str] = Counter()
    with ExitStack() as stack:
        file: TextIO | None = None
        if arguments.jsonl is not None:
            arguments.jsonl.parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(arguments.jsonl.open("w", encoding="utf-8"))
        found = results_of(drafts, arguments.processes, arguments.device)
        for what, result in track(found, "pairs", total=len(drafts), console=Console(stderr=True)):
            if result is None:
                left_out[what] += 1
                continue
            results.append(result)
            if file is not None:
                print(json.dumps(plain(result), allow_nan=False), file=file, flush=True)
    results.sort(key=lambda result: result["name"])
    print_found(results, console)
    print_accepted(results, console)
    for what, count in left_out.items():
        console.print(f"{what}: {count} pairs with too few walls in common were left out")


if __name__ == "__main__":
    main()
