"""A small fusion to report on: a room seen by three maps, and a fourth that fits nowhere."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.align.decide import MatchEvidence
from slamfusion.align.records import Alignment, FusionResult, InputRecord, RunnerUp
from slamfusion.evaluation.map_error import compare_to_truth
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.fuse_documents import Evaluation
from slamfusion.palette import Rgb
from slamfusion.report.canvas import to_form
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.trajectory import Trajectory
from slamfusion.vote.tiles import GridLayer
from tests.support.producers import DeadReckoning, room_drive

NASTY = "<script>alert('$x_1$')</script>/../../é机"
REASON = "its runner-up at 180° scores 0.97 & <b>more</b>"


def pixels(figure: Any) -> npt.NDArray[np.uint8]:
    """RGB of a figure, (H, W, 3), row 0 at the top."""
    png = np.frombuffer(to_form(figure, "png"), dtype=np.uint8)
    image = cv2.imdecode(png, cv2.IMREAD_COLOR)
    return np.asarray(image[..., ::-1], dtype=np.uint8)


def near(image: npt.NDArray[np.uint8], rgb: Rgb, slack: int = 12) -> npt.NDArray[np.bool_]:
    """Pixels of about a colour, (H, W)."""
    return np.asarray((np.abs(image.astype(int) - rgb) <= slack).all(axis=2))


def centre(image: npt.NDArray[np.uint8], rgb: Rgb, slack: int = 12) -> tuple[float, float]:
    """Mean column and row of a colour, as shares of the picture."""
    rows, cols = np.nonzero(near(image, rgb, slack))
    assert rows.size, f"no pixel of colour {rgb}"
    return float(cols.mean()) / image.shape[1], float(rows.mean()) / image.shape[0]


def room(name: str, seed: int, *, height: int = 40, width: int = 60) -> OccupancyGrid:
    """A walled room with an unknown border and a few wrong cells."""
    rng = np.random.default_rng(seed)
    cells = np.full((height, width), -1, dtype=np.int8)
    cells[4:-4, 4:-4] = 0
    for edge in (4, -5):
        cells[edge, 4:-4] = 100
        cells[4:-4, edge] = 100
    wrong = (rng.random(cells.shape) < 0.03) & (cells == 0)
    cells[wrong] = 100
    return OccupancyGrid(cells, 0.05, Pose2(-3.0, 500.0), name)


def explains(share: float) -> MatchEvidence:
    """Evidence of an alignment that explains this share of the common walls."""
    return MatchEvidence(
        reading="changed",
        pieces=60.0,
        better=50.0,
        nearest="another pose",
        weight=1.0,
        share=share,
        common_m=40.0,
        rival_ratio=0.4,
        expected_wrong=0.001,
    )


def alignment(reference: str, moving: str, *, accepted: bool) -> Alignment:
    """An alignment with a profile of two peaks."""
    yaw_rad = np.linspace(-math.pi, math.pi, 181)
    score = 0.2 + 0.6 * np.exp(-(yaw_rad**2) / 0.01)
    return Alignment(
        reference=reference,
        moving=moving,
        transform=Pose2(0.1, -0.2, 0.01),
        accepted=accepted,
        reason="walls lie on walls" if accepted else REASON,
        score=0.81,
        overlap=0.9,
        error=12.5,
        runner_up=RunnerUp(Pose2(1.0, 1.0, 3.0), 0.4, 0.5),
        time_s=0.2,
        statistics={"walls": 123.0},
        yaw_profile=np.column_stack((yaw_rad, score)),
        evidence=explains(0.94),
    )


def trinary(grid: OccupancyGrid) -> npt.NDArray[np.int8]:
    return np.sign(grid.cells).astype(np.int8)


def fusion(*, rejected_name: str = NASTY, accepted: int = 3) -> FusionResult:
    """Fuse ``accepted`` rooms by their median; one more input is rejected."""
    grids = [room(f"room {index}", index) for index in range(accepted)]
    stack = np.stack([trinary(grid) for grid in grids])
    fused = np.median(stack, axis=0).astype(np.int8)
    records = []
    for index, grid in enumerate(grids):
        found = None if index == 0 else alignment("room 0", grid.name, accepted=True)
        aligned = trinary(grid)
        records.append(
            InputRecord(grid, found, True, "fits", GridLayer.of(aligned, aligned != fused))
        )
    lost = room(rejected_name, 99, height=50)
    found = alignment("room 0", rejected_name, accepted=False)
    records.append(InputRecord(lost, found, False, REASON))
    agreement = (100 * (stack == fused).mean(axis=0)).astype(np.int8)
    agreement[fused == -1] = -1
    origin = grids[0].origin
    cells = np.where(fused == 1, 100, fused).astype(np.int8)
    return FusionResult(
        reference="room 0",
        inputs=tuple(records),
        fused=OccupancyGrid(cells, 0.05, origin, "fused"),
        agreement=OccupancyGrid(agreement, 0.05, origin, "agreement"),
        pairs=tuple(record.alignment for record in records if record.alignment is not None),
        phantom_cells=0,
        weights={grid.name: 1.0 for grid in grids},
        device="numpy",
        time_s=0.5,
    )


def evaluation(grid: OccupancyGrid, found: Alignment | None = None) -> Evaluation:
    """The errors of a map against a room, where it lies, or as it was aligned."""
    error = compare_to_truth(grid, room("truth", 7))
    return Evaluation(**vars(error), aligned=found is None or found.accepted, alignment=found)


def evaluations(found: Alignment | None = None) -> list[Evaluation]:
    """The errors of an input and of the fused map, which has none."""
    return [evaluation(room("room 0", 0), found), evaluation(room("fused", 7))]


def colours_of(image: npt.NDArray[Any]) -> set[tuple[int, int, int]]:
    """The (red, green, blue) colours of an image as OpenCV reads it."""
    packed = image.astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
    return {
        (int(value) >> 16, (int(value) >> 8) & 255, int(value) & 255) for value in np.unique(packed)
    }


def run_of(name: str, grid: OccupancyGrid, trajectory: Trajectory, **more: Any) -> ProducerRun:
    """A producer's run that made this map and path, with no more than that."""
    run = run_producer(DeadReckoning(), room_drive(6))
    given: dict[str, Any] = {"odometry": None, "series": (), "other_paths": (), **more}
    return replace(run, name=name, grid=grid, trajectory=trajectory, **given)
