"""The error of a map against the truth: [F16]'s number and further measures.

[F16] is Fernandes and Alexandre, *SLAMfusion: Fusing SLAM Methods for Improved Robustness*,
ICARSC 2016.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from slamfusion.config import RunConfig
from slamfusion.errors import GridError
from slamfusion.evaluation import wall_faces
from slamfusion.evaluation.distances import sample_on_lattice, wall_centres
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.geometry import B8, F32, I8, I64, Pose2
from slamfusion.grid import FREE, IDENTITY, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid
from slamfusion.json_values import POSE

# Codes of ``MapError.difference``.
AGREE_UNKNOWN = 0
AGREE_FREE = 1
AGREE_WALL = 2
MISSING_WALL = 3  # occupied in the truth, not in the map
EXTRA_WALL = 4  # occupied in the map, not in the truth
MISSING_FREE = 5  # free in the truth, unknown in the map
EXTRA_FREE = 6  # free in the map, unknown in the truth

CLASS_NAMES = ("unknown", "free", "occupied")

# Rows: class of the truth, columns: class of the map, both unknown, free, occupied.
_DIFFERENCE = np.array(
    (
        (AGREE_UNKNOWN, EXTRA_FREE, EXTRA_WALL),
        (MISSING_FREE, AGREE_FREE, EXTRA_WALL),
        (MISSING_WALL, MISSING_WALL, AGREE_WALL),
    ),
    dtype=np.int8,
)


# Cell of the truth and of the map by code; unknown if the code does not determine it.
_TRUE_CELLS = np.array((UNKNOWN, FREE, OCCUPIED, OCCUPIED, UNKNOWN, FREE, UNKNOWN), np.int8)
_MAP_CELLS = np.array((UNKNOWN, FREE, OCCUPIED, UNKNOWN, OCCUPIED, UNKNOWN, FREE), np.int8)

_SSIM_SIGMA_CELLS = 1.5
_SSIM_WINDOW_CELLS = 11


def maps_of_differences(
    differences: Mapping[str, I8], resolution: float, origin: Pose2
) -> tuple[OccupancyGrid, list[OccupancyGrid]]:
    """Return the truth and the maps as far as their differences determine them.

    A true wall missing in a map is unknown in that map; a wall that all maps have in excess is
    unknown in the truth.

    Args:
        differences: at least one, by the name of the map (H, W) int8, codes of this module.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0].

    Raises:
        ValueError: they differ in shape.
    """
    # Another difference may determine what one leaves open.
    truth = np.max([_TRUE_CELLS[codes] for codes in differences.values()], axis=0)
    maps = [
        OccupancyGrid(_MAP_CELLS[codes], resolution, origin, name)
        for name, codes in differences.items()
    ]
    return OccupancyGrid(truth, resolution, origin, "truth"), maps


@dataclass(frozen=True, eq=False, kw_only=True)
class MapError:
    """How a map differs from the truth."""

    name: str
    """The map."""
    error: float
    """[F16]: root of the sum of squared differences of -1, 0, 1 over the truth's known box."""
    truth: str
    """The true map."""
    cells: int
    """Cells of the truth's known box."""
    coverage: float
    """Share of the truth's known cells that the map knows, 0 to 1."""
    tolerance_m: float
    """A wall this near counts as found, metres."""
    mapped: float | None
    """Share of a plan's walls that the map has seen, 0 to 1; null: the truth is no plan."""
    wall_precision: float | None
    """Share of the map's walls with a true wall within the tolerance; null without a wall."""
    wall_recall: float | None
    """Share of the true walls with a wall of the map within the tolerance; null without a wall."""
    wall_f1: float | None
    """Harmonic mean of the two; null when one of them is."""
    iou_occupied: float | None
    """Cells occupied in both over cells occupied in either; null when there are none."""
    iou_free: float | None
    """Cells free in both over cells free in either; null when there are none."""
    map_to_truth_m: wall_faces.WallDistance | None
    """From each wall of the map to the nearest true wall; null when a side has none."""
    truth_to_map_m: wall_faces.WallDistance | None
    """From each true wall to the nearest wall of the map; null when a side has none."""
    faces: wall_faces.WallFaces
    """The faces of the map's walls against the true ones."""
    wall_thickness_m: wall_faces.WallThickness | None
    """How thick the map's walls are; null when no wall is next to a free cell."""
    doubled_wall_share: float
    """Share of the map's wall cells that have a parallel wall close by, 0 to 1."""
    outside_m2: float
    """Area that the map knows outside of the truth's outline, square metres."""
    ssim: float
    """Mean structural similarity of the trinary images, at most 1."""
    confusion: Mapping[str, Mapping[str, int]]
    """Cells by the truth's class, then the map's: unknown, free, occupied."""
    transform: Pose2 = field(metadata=POSE)
    """Transform from the map's frame into the truth's."""
    difference: I8 = field(repr=False)
    """(H, W), read-only, one of the module's codes for each cell of the truth's known box."""
    resolution: float = field(repr=False)
    """Metres per cell of ``difference``."""
    origin: Pose2 = field(repr=False)
    """Pose of the lower-left corner of ``difference`` in the truth's map frame."""


def compare_to_truth(
    grid: OccupancyGrid,
    truth: OccupancyGrid,
    transform: Pose2 = IDENTITY,
    config: RunConfig | None = None,
    *,
    is_plan: bool = False,
) -> MapError:
    """Measure a map against the truth, with every measure at once.

    The map is read on the truth's lattice by nearest cell over the truth's known box. Wall
    distances lie between the centres of each map's own cells.

    Args:
        transform: maps a point of the map's frame into the truth's, metres.
        config: thresholds of both maps, and largest distance of a correct wall from a true one.
        is_plan: the truth is a floor plan; what is farther than the tolerance from all known cells
            of the map (rooms not entered) does not count.

    Raises:
        GridError: no cell of the truth is known.
    """
    config = config or RunConfig()
    tolerance_m = config.evaluate.tolerance_m
    grid, truth = (item.classified(config.fusion.normalize) for item in (grid, truth))
    box = known_truth(truth)

    # The cells, on the truth's lattice.
    expected = truth.cells[box.slices()]
    found = sample_on_lattice(grid, truth, box, transform)
    mapped = None
    if is_plan:
        is_seen = _within(found != UNKNOWN, tolerance_m / truth.resolution)
        is_wall = expected == 1
        mapped = float((is_wall & is_seen).sum() / max(1, int(is_wall.sum())))
        expected = np.where(is_seen, expected, np.int8(UNKNOWN))
        whole = CellBox(0, 0, *truth.cells.shape)
        truth = replace(truth, cells=whole.cut(expected, box, UNKNOWN))
    # The pairs of classes -1, 0, 1 of truth T and map M, counted; [F16]: sqrt(sum((T - M)^2)).
    codes = (expected + 1) * 3 + (found + 1)
    confusion = np.bincount(codes.ravel().view(np.uint8), minlength=9).reshape(3, 3)
    squares = np.square(np.subtract.outer(range(3), range(3)))
    difference = _DIFFERENCE[expected + 1, found + 1]
    difference.flags.writeable = False

    # The walls, as points of the truth's map frame.
    walls = wall_faces.Nearness.between(wall_centres(grid, transform), wall_centres(truth))
    agreement = walls.agreement(tolerance_m)

    known = max(1, int(confusion[1:].sum()))
    return MapError(
        name=grid.name,
        truth=truth.name,
        error=math.sqrt(int((confusion * squares).sum())),
        cells=difference.size,
        confusion={
            truth_class: dict(zip(CLASS_NAMES, row, strict=True))
            for truth_class, row in zip(CLASS_NAMES, confusion.tolist(), strict=True)
        },
        mapped=mapped,
        wall_precision=agreement.precision,
        wall_recall=agreement.recall,
        wall_f1=agreement.f1,
        iou_occupied=_intersection_over_union(confusion, 2),
        iou_free=_intersection_over_union(confusion, 1),
        map_to_truth_m=wall_faces.distance_summary(walls.map_to_truth),
        truth_to_map_m=wall_faces.distance_summary(walls.truth_to_map),
        faces=wall_faces.compare_faces(grid, truth, transform),
        wall_thickness_m=wall_faces.wall_thickness(grid),
        doubled_wall_share=doubled_wall_share(grid.cells == 1),
        outside_m2=wall_faces.outside_area(grid, truth, transform, margin_m=tolerance_m),
        ssim=_mean_ssim(expected, found),
        coverage=int(confusion[1:, 1:].sum()) / known,
        tolerance_m=tolerance_m,
        transform=transform,
        difference=difference,
        resolution=truth.resolution,
        origin=truth.crop(box).origin,
    )


def known_truth(truth: OccupancyGrid) -> CellBox:
    """Return the box of the truth's known cells; GridError if it has none."""
    if (box := truth.known_box) is None:
        advice = "give a map with known cells or other thresholds"
        raise GridError(f"{truth.name}: no cell is surely free or occupied; {advice}")
    return box


def _within(mask: B8, cells: float) -> B8:
    """Return the cells (H, W) whose centre is within a distance of a set cell."""
    if not mask.any():
        return mask
    away = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away <= cells + 1e-3)


def _intersection_over_union(confusion: I64, index: int) -> float | None:
    both = int(confusion[index, index])
    either = int(confusion[index].sum() + confusion[:, index].sum()) - both
    return both / either if either else None


def _mean_ssim(expected: I8, found: I8) -> float:
    """Return the mean structural similarity of two trinary images mapped to 0, 0.5, 1.

    The image is mirrored at its border, so that small maps have a value, too.

    Source: Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to
        structural similarity", IEEE TIP 13(4), 2004, eq. 13 with K1 = 0.01, K2 = 0.03, L = 1 and
        the Gaussian window of 11 x 11 cells, sigma 1.5. doi:10.1109/TIP.2003.819861
    """
    x = (expected.astype(np.float32) + 1.0) / 2.0
    y = (found.astype(np.float32) + 1.0) / 2.0
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x * mean_x
    variance_y = _window_mean(y * y) - mean_y * mean_y
    covariance = _window_mean(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2.0 * mean_x * mean_y + c1) * (2.0 * covariance + c2)) / (
        (mean_x * mean_x + mean_y * mean_y + c1) * (variance_x + variance_y + c2)
    )
    return float(similarity.mean(dtype=np.float64))


def _window_mean(image: F32) -> F32:
    window = (_SSIM_WINDOW_CELLS, _SSIM_WINDOW_CELLS)
    blurred = cv2.GaussianBlur(
        image, window, sigmaX=_SSIM_SIGMA_CELLS, borderType=cv2.BORDER_REFLECT
    )
    return np.asarray(blurred, dtype=np.float32)
