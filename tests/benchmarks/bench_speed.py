"""Time alignment, vote and the batch of [F16]: ``python -m tests.benchmarks.bench_speed``.

Seconds of one machine say little about another, so each row also shows a baseline of the same run:
the NumPy twins, a copy of memory. What a device has to do is the same on any: a second table counts
it, as for one with memory of its own, such as a GPU. Everything is drawn from fixed seeds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from slamfusion.align.align import align_each, track_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice, NumpyDevice, open_device
from slamfusion.compute.arrays import DeviceArray, Scalar
from slamfusion.compute.opencl import OpenCLArray, OpenCLDevice
from slamfusion.config import FusionConfig, RunConfig
from slamfusion.fusion import align_grids, fuse_grids
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.sim import draw_building, named_course, simulate
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.registry import BUILT_IN, make_producer, producer
from tests.benchmarks.record import bench_parser, console_for
from tests.support.degrade import Degradation, degrade_map

SEED = 2016
RESOLUTION = 0.05
CONFIG = FusionConfig()
TRIOS = 6
SCANS = 400


def main() -> None:
    """Print a table of all measurements."""
    parser = bench_parser(__doc__)
    parser.add_argument("--device", default="auto", help="index or part of a name; numpy")
    parser.add_argument("--runs", type=int, default=5, help="of each; the median counts")
    parser.add_argument(
        "--side", type=int, default=800, help="of the large maps, cells; 240 or more"
    )
    options = parser.parse_args()
    device = open_device(options.device)
    table = Table("work", "time", "against", title=f"speed on {device.name}")
    for row in (
        *time_alignment(device, options.side, options.runs),
        time_small_alignment(device, options.runs),
        time_vote(device, 5 * options.side, 3 * options.runs),
        time_batch(device, options.side // 2, max(1, options.runs // 2)),
    ):
        table.add_row(*row)
    console = console_for("speed", options.record, width=160)
    console.print(table)
    if not isinstance(device, NumpyDevice):
        console.print(count_work(options.side))


def time_alignment(device: ComputeDevice, side: int, runs: int) -> list[tuple[str, ...]]:
    """Search over all yaws, then track a new moving map from a transform some cells off."""
    reference, moving, truth = draw_pair(side)
    # Under another name a grid is another one, so that no features are kept.
    searched = seconds(
        lambda: align_grids(
            reference.with_name("still"), moving.with_name("moved"), CONFIG, device
        ),
        runs,
    )
    start = Pose2(0.1, -0.05, math.radians(1.0)).compose(truth)
    held = prepare(reference, device)
    tracked = seconds(lambda: track_pair(Pair(held, prepare(moving, device)), start), runs)
    work = f"align {side} x {side},"
    return [
        (f"{work} +-180 degrees", shown(searched), ""),
        (f"{work} tracked from the last transform", shown(tracked), f"{shown(searched)}: search"),
    ]


def time_small_alignment(device: ComputeDevice, runs: int) -> tuple[str, ...]:
    """Align two maps that the NumPy twins can finish too."""
    reference, moving, _ = draw_pair(120)
    own = seconds(lambda: align_grids(reference, moving, CONFIG, device), runs)
    twins = seconds(lambda: align_grids(reference, moving, CONFIG, NumpyDevice()), 1)
    return "align 120 x 120, +-180 degrees", shown(own), f"{shown(twins)}: NumPy twins, one run"


def time_vote(device: ComputeDevice, side: int, runs: int) -> tuple[str, ...]:
    """Let three grids vote; the baseline copies them to arrays that are already there."""
    rng = np.random.default_rng(SEED)
    building = draw_building(rng, side * RESOLUTION, side * RESOLUTION, RESOLUTION).cells
    grids = []
    for _ in range(3):
        grid = np.where(building > 0, 1, building).astype(np.int8)
        wrong = rng.integers(0, grid.size, grid.size * 3 // 100)
        grid.flat[wrong] = rng.integers(-1, 2, len(wrong))
        grids.append(grid)
    targets = [np.zeros_like(grid) for grid in grids]

    def copy() -> None:
        for grid, target in zip(grids, targets, strict=True):
            np.copyto(target, grid)

    voted = seconds(lambda: device.vote_majority(grids, unknown_votes=True), runs)
    ratio = voted / seconds(copy, runs)
    return f"vote of three {side} x {side} grids", shown(voted), f"{ratio:.2f} times their copy"


def time_batch(device: ComputeDevice, side: int, runs: int) -> tuple[str, ...]:
    """Align three maps of each place with its truth, fuse them, align the fused map."""
    trios = []
    for number in range(TRIOS):
        rng = np.random.default_rng((SEED, number))
        truth = draw_building(rng, side * RESOLUTION, side * RESOLUTION, RESOLUTION)
        maps = [
            draw_map(truth, rng, change)[0].with_name(f"map {n}")
            for n, change in enumerate((0, 1, 0))
        ]
        trios.append((truth, maps))

    def batch() -> None:
        for truth, maps in trios:
            fused = fuse_grids(maps, CONFIG, device).fused
            for _ in align_each(truth, (*maps, fused), CONFIG, device):
                pass

    work = f"[F16] batch: {TRIOS} trios of {side} x {side}"
    published = "25 s: the authors' batch of six trios on a Titan X, as published"
    return work, shown(seconds(batch, runs)), published


def draw_pair(side: int) -> tuple[OccupancyGrid, OccupancyGrid, Pose2]:
    """Return two maps of one building, and the true transform of the second into the first."""
    rng = np.random.default_rng(SEED)
    truth = draw_building(rng, side * RESOLUTION, side * RESOLUTION, RESOLUTION)
    reference, first = degrade_map(truth, rng, Degradation(resample=False, flip_share=0.005))
    whole, second = draw_map(truth, rng, 1)
    # A turned square needs a larger box: keep the middle.
    row, col = max(0, whole.height - side) // 2, max(0, whole.width - side) // 2
    box = CellBox(row, col, min(row + side, whole.height), min(col + side, whole.width))
    pair = reference.with_name("reference"), whole.crop(box).with_name("moving")
    return *pair, first.inverse().compose(second)


def draw_map(
    truth: OccupancyGrid, rng: np.random.Generator, wall_change: int
) -> tuple[OccupancyGrid, Pose2]:
    """Return a faulty map of the place, and its transform into the truth's frame."""
    faults = Degradation(
        yaw_rad=float(rng.uniform(-math.pi, math.pi)),
        shift_share=(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.3, 0.3))),
        wall_change_cells=wall_change,
        flip_share=0.005,
        speckle_share=0.01,
    )
    return degrade_map(truth, rng, faults)


def prepare(grid: OccupancyGrid, device: ComputeDevice) -> GridFeatures:
    """Normalise a grid and hand it to the device."""
    return GridFeatures(normalize_grid(grid, RESOLUTION, CONFIG.normalize, device), device)


class CountingDevice(OpenCLDevice):
    """A device that counts its work, and shares no memory with the host.

    Attributes:
        work: kernels started, their work items, bytes sent and fetched, and how often the host
            waited for the device.
    """

    def __init__(self, *, small_kernels: bool = False) -> None:
        super().__init__(small_kernels=small_kernels)
        self.shares_memory, self.work = False, np.zeros(5)

    def launch(self, name: str, size: tuple[int, ...], *arguments: Any) -> None:
        self.work += (1, math.prod(size), 0, 0, 0)
        super().launch(name, size, *arguments)

    def upload(self, array: npt.NDArray[Scalar]) -> OpenCLArray[Scalar]:
        self.work += (0, 0, array.nbytes, 0, 0)
        return super().upload(array)

    def download(self, handle: DeviceArray[Scalar]) -> npt.NDArray[Scalar]:
        self.work += (0, 0, 0, handle.size * handle.dtype.itemsize, 1)
        return super().download(handle)

    def map_host(self, handle: OpenCLArray[Any], array: npt.NDArray[Any]) -> None:
        self.work += (0, 0, 0, array.nbytes, 1)
        super().map_host(handle, array)


def count_work(side: int) -> Table:
    """Return what a device has to do for an alignment, and for a scan of each SLAM."""
    heads = ("launches", "1000 items", "kB sent", "kB fetched", "waits")
    table = Table("work", *heads, title="what a device does")

    def count(work: str, device: CountingDevice, times: int) -> None:
        launches, items, sent, fetched, waits = device.work / times
        table.add_row(
            work, f"{launches:.1f}", f"{items / 1e3:.1f}", f"{sent / 1e3:.1f}",
            f"{fetched / 1e3:.1f}", f"{waits:.1f}",
        )  # fmt: skip

    device = CountingDevice()
    reference, moving, truth = draw_pair(side)
    align_grids(reference, moving, CONFIG, device)
    count(f"align {side} x {side}, +-180 degrees", device, 1)
    held = prepare(reference, device)
    track_pair(Pair(held, prepare(moving, device)), truth)
    device.work[:] = 0.0
    track_pair(Pair(held, prepare(moving, device)), truth)
    count(f"align {side} x {side}, tracked", device, 1)
    scans = simulate(named_course("office", SEED), open_device()).scans[:SCANS]
    for name in BUILT_IN:
        device = CountingDevice(small_kernels=producer(name).prefers_small_kernels)
        run_producer(make_producer(name, RunConfig(), device), scans)
        count(f"a scan of {name}, mean of {SCANS}, {len(scans[0].scan)} beams", device, len(scans))
    return table


def seconds(work: Callable[[], Any], runs: int) -> float:
    """Do the work once unmeasured and some times measured; return the median wall time."""
    work()
    spent = []
    for _ in range(runs):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return median(spent)


def shown(time_s: float) -> str:
    """Return a time with two digits."""
    return f"{time_s:.0f} s" if time_s >= 10.0 else f"{time_s:.2g} s"


if __name__ == "__main__":
    main()
