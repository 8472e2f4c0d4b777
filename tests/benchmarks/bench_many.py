"""Fuse many maps of a simulated site, and count how many lie in their places, and how long it took.

    python -m tests.benchmarks.bench_many --maps 10,20 --seeds 1
    python -m tests.benchmarks.bench_many --maps 10,20,40,80 --seeds 1,2 --record

Maps of 700 x 700 cells at any turn, neighbours 20 to 60 % overlapping, bent by 1.5 cells, one cell
of a hundred wrong; every fifth is of another building (``tests.support.sites``). A map is right
where it lies within 0.5 m of its place (``ManyMaps.errors_m``), and wrong where it was fused and
does not; a map that shares ground with others and was not fused is lost; a lone one that was left
out is right. Times are of
``fuse_maps`` in this process, wall clock and processor time; the first fusion compiles the kernels
and is not counted.
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace

from rich.table import Table

from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig, VoteConfig
from slamfusion.jobs.fuse import fuse_maps
from tests.benchmarks.record import bench_parser, console_for
from tests.support.sites import ManyMaps, many_maps

RIGHT_M = 0.5
CONFIG = replace(
    RunConfig(), fusion=replace(RunConfig().fusion, vote=VoteConfig("consensus", extent="union"))
)


def measure(count: int, seed: int, cells: int, device: ComputeDevice) -> tuple[str, ...]:
    """Fuse the maps of one site; return the row of the table."""
    site = many_maps(count, seed, cells)
    began, began_cpu = time.perf_counter(), time.process_time()
    result = fuse_maps(list(site.grids), CONFIG, device).result
    wall_s, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    errors: dict[str, float] = {}
    for group in (result, *result.others):
        errors |= _errors(site, group)
    is_lone = {
        grid.name: site.buildings.count(building) == 1
        for grid, building in zip(site.grids, site.buildings, strict=True)
    }
    right = [error for error in errors.values() if error <= RIGHT_M]
    left_out = [grid.name for grid in site.grids if grid.name not in errors]
    lone = sum(is_lone[name] for name in left_out)
    searched = sum(not pair.reason.startswith("tracked") for pair in result.pairs)
    wrong, lost = len(errors) - len(right), len(left_out) - lone
    return (
        *map(str, (count, seed, len(right) + lone, wrong, lost)),
        f"{max(right, default=0.0):.2f}",
        str(searched),
        *(f"{value:.1f}" for value in (wall_s, cpu_s)),
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0:.0f}",
    )


def _errors(site: ManyMaps, group: FusionResult) -> dict[str, float]:
    transforms = {
        record.name: record.alignment.transform
        for record in group.accepted
        if record.alignment is not None
    }
    return site.errors_m(group.reference, transforms)


def main() -> None:
    """Measure and print."""
    parser = bench_parser(__doc__)
    parser.add_argument("--maps", default="10,20", help="numbers of maps")
    parser.add_argument("--seeds", default="1", help="seeds of the sites")
    parser.add_argument("--cells", type=int, default=700, help="cells on a side of a map")
    parser.add_argument("--device", default="auto")
    asked = parser.parse_args()
    device = open_device(asked.device)
    measure(7, 0, 200, device)
    table = Table(title=f"Many maps of {asked.cells} x {asked.cells} cells")
    columns = ("maps", "seed", "right", "wrong", "lost", "worst m", "searches")
    for name in (*columns, "wall s", "CPU s", "peak MiB"):
        table.add_column(name, justify="right")
    console = console_for("many", asked.record)
    for count in map(int, asked.maps.split(",")):
        for seed in map(int, asked.seeds.split(",")):
            table.add_row(*measure(count, seed, asked.cells, device))
    console.print(table)


if __name__ == "__main__":
    main()
