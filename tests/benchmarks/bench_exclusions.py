"""How many seconds of real failures, and of good paths, have no vote, on simulated drives.

    python -m tests.benchmarks.bench_exclusions --drives DIR --worlds 404,505,606 --lidars rplidar

Drives are those of ``bench_evidence``, which makes them, but kidnappings. Seconds are counted as in
``bench_partial``: faulty are those in which the path of the producer that a fault befell has left
the true one by 0.3 m, good those of all producers in which a path has not; each path is laid on the
true one where it has a vote. Nothing here depends on the machine's load.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.evidence import find_exclusions, judged_scans, score_paths
from tests.benchmarks.bench_drawn_maps import chosen
from tests.benchmarks.bench_partial import SECONDS, excluded_seconds
from tests.benchmarks.record import add_record_option, console_for
from tests.support.evidence_drives import read_drive


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--drives", type=Path, required=True)
    parser.add_argument("--worlds", default="1,101")
    parser.add_argument("--lidars", default="rplidar,hokuyo")
    parser.add_argument("--name", default="exclusions", help="of the table that --record keeps")
    parser.add_argument("--device", default="auto")
    add_record_option(parser)
    options = parser.parse_args()
    device = open_device(options.device)
    groups: dict[str, list[dict[str, float]]] = {}
    for folder in chosen(options.drives, options.worlds.split(","), options.lidars.split(",")):
        drive = read_drive(folder)
        evidence = score_paths(judged_scans(drive.scans), drive.paths, device)
        found = find_exclusions(evidence, device)
        harmed = drive.trial["harmed"]
        seconds = excluded_seconds(drive.truth, drive.paths, harmed, 0, found)
        groups.setdefault("a SLAM failed" if harmed else drive.trial["condition"], []).append(
            seconds
        )
        if seconds["good excluded"]:
            print(f"  {drive.key}: {seconds['good excluded']:.1f} good s excluded")
    columns = ("drives of", "number", "faulty s", "of them excluded", "good s", "of them excluded")
    table = Table(*columns, title="Seconds without a vote")
    for name, drives in groups.items():
        total = {kind: sum(seconds[kind] for seconds in drives) for kind in SECONDS}
        words = [
            (f"{total[kind]:.0f}", f"{total[f'{kind} excluded'] / total[kind]:.2%}")
            if total[kind]
            else ("0", "-")
            for kind in ("left", "good")
        ]
        table.add_row(name, str(len(drives)), *words[0], *words[1])
    console_for(options.name, options.record, width=110).print(table)


if __name__ == "__main__":
    main()
