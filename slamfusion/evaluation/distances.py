"""Compare distances measured in the building with those in the map.

Source: [B16] Balasuriya et al., *Outdoor Robot Navigation Using Gmapping Based SLAM*, 2016.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from slamfusion.compute.lattice import cells_at
from slamfusion.config import NormalizeConfig
from slamfusion.errors import MapFileError, shown
from slamfusion.geometry import F64, I8, Pose2
from slamfusion.grid import IDENTITY, UNKNOWN, CellBox, ClassifiedGrid, OccupancyGrid
from slamfusion.io.files import read_small
from slamfusion.io.yaml_file import read_yaml

_ROWS_PER_BLOCK = 256

# A wall farther than this from a measured point does not count, metres.
SEARCH_RADIUS_M = 0.5

# A centre on the border of two cells belongs to the upper one, so that rounding does not decide.
_BORDER_CELLS = 1e-6


def sample_on_lattice(
    grid: OccupancyGrid, lattice: OccupancyGrid, box: CellBox, transform: Pose2
) -> I8:
    """Read a map at the cell centres of another map's lattice, by nearest cell.

    Args:
        grid: its cells may be of any meaning; origin yaw is honoured.
        transform: maps a point of ``grid``'s map frame into ``lattice``'s, metres.

    Returns:
        (box.height, box.width) int8; -1 where the centre lies outside ``grid``.
    """
    pose_grid_lattice = grid.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    scale = lattice.resolution / grid.resolution
    step_x = math.cos(pose_grid_lattice.yaw_rad) * scale
    step_y = math.sin(pose_grid_lattice.yaw_rad) * scale
    shift_x = pose_grid_lattice.x / grid.resolution + _BORDER_CELLS
    shift_y = pose_grid_lattice.y / grid.resolution + _BORDER_CELLS

    sampled = np.empty(box.shape, dtype=np.int8)
    col_centres = np.arange(box.col0, box.col1) + 0.5
    for first in range(0, box.height, _ROWS_PER_BLOCK):
        block = sampled[first : first + _ROWS_PER_BLOCK]
        row_centres = (np.arange(first, first + block.shape[0]) + box.row0 + 0.5)[:, None]
        cols = np.floor(step_x * col_centres - step_y * row_centres + shift_x)
        rows = np.floor(step_y * col_centres + step_x * row_centres + shift_y)
        block[:] = cells_at(grid.cells, rows.astype(np.int64), cols.astype(np.int64), UNKNOWN)
    return sampled


def wall_centres(grid: ClassifiedGrid, transform: Pose2 = IDENTITY) -> F64:
    """Return the centres (N, 2) of the walls of a classified map, moved by a motion, metres."""
    rows, cols = np.nonzero(grid.cells == 1)
    return transform.transform(grid.cell_centres(rows, cols))


_COLUMNS = ("name", "x1", "y1", "x2", "y2", "distance_m")
_NUMBERS = _COLUMNS[1:]


@dataclass(frozen=True)
class MeasuredDistance:
    """One distance between two walls, measured in the building.

    Attributes:
        point1, point2: x and y in the map's frame, metres, near the two walls.
        distance_m: as measured, positive.
    """

    name: str
    point1: tuple[float, float]
    point2: tuple[float, float]
    distance_m: float


@dataclass(frozen=True)
class DistanceRow:
    """A distance that was measured in the building, and the map's."""

    name: str
    """What was measured."""
    distance_m: float
    """As measured, metres."""
    map_m: float | None
    """The map's, metres; null when a point has no wall nearby."""
    error_m: float | None
    """The map's minus the measured one, metres."""
    error_percent: float | None
    """The same in percent of the measured one."""
    reason: str
    """Why the map has none; else empty."""


@dataclass(frozen=True)
class DistanceComparison:
    """All measured distances against one map."""

    name: str
    """The map."""
    search_radius_m: float
    """How far from its point a wall was looked for, metres."""
    rows: Sequence[DistanceRow]
    """The distances, in the order given."""
    rows_used: int
    """Of these, the ones whose walls were found."""
    rows_total: int
    """All of them."""
    mean_absolute_error_m: float | None
    """Mean of the absolute errors, metres; null when no walls were found."""
    mean_absolute_error_percent: float | None
    """The same in percent of the measured distances."""


def compare_distances(
    grid: OccupancyGrid, distances: Sequence[MeasuredDistance], normalize: NormalizeConfig
) -> DistanceComparison:
    """Compare measured distances with those between the walls of a map, in the points' frame."""
    walls = wall_centres(grid.classified(normalize))
    tree = scipy.spatial.KDTree(walls) if walls.shape[0] else None
    compared = []
    for row in distances:
        ends = []
        reason = ""
        for index, point in enumerate((row.point1, row.point2), start=1):
            distance, nearest = tree.query(point) if tree is not None else (math.inf, 0)
            if float(distance) > SEARCH_RADIUS_M:
                reason = reason or f"no wall within {SEARCH_RADIUS_M:g} m of point {index}"
            else:
                ends.append(walls[int(nearest)])
        map_m = None if reason else float(np.hypot(*(ends[1] - ends[0])))
        error_m = None if map_m is None else map_m - row.distance_m
        percent = None if error_m is None else 100.0 * error_m / row.distance_m
        compared.append(DistanceRow(row.name, row.distance_m, map_m, error_m, percent, reason))
    errors_m = [abs(row.error_m) for row in compared if row.error_m is not None]
    percents = [abs(row.error_percent) for row in compared if row.error_percent is not None]
    return DistanceComparison(
        grid.name,
        SEARCH_RADIUS_M,
        compared,
        len(errors_m),
        len(compared),
        _mean(errors_m),
        _mean(percents),
    )


def load_distances(path: str | Path) -> tuple[MeasuredDistance, ...]:
    """Read measured distances from a CSV or YAML file.

    CSV (``.csv``): a header and rows of ``name, x1, y1, x2, y2, distance_m``. YAML (``.yaml``,
    ``.yml``): a list of mappings with these keys, or a mapping with such a list under
    ``distances``. Points in the map's frame, metres; ``name`` is optional.

    Raises:
        MapFileError: another file; the message names the row and what was wanted.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".yaml": _read_yaml, ".yml": _read_yaml}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        message = f"{path}: measured distances come as .csv, .yaml or .yml; rename the file"
        raise MapFileError(message)
    rows = reader(path)
    if not rows:
        raise MapFileError(f"{path}: no distance in the file; add rows of {', '.join(_COLUMNS)}")
    return tuple(_distance(row, f"{path}: {where}", where) for where, row in rows)


def _read_csv(path: Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        text = read_small(path, MapFileError, "a file of distances").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise MapFileError(f"{path}: not UTF-8 text; save the distances as UTF-8") from None
    reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True, strict=True)
    try:
        reader.fieldnames = [column.strip() for column in reader.fieldnames or _COLUMNS]
        # A spreadsheet may end in rows of empty cells.
        rows = [(f"row {reader.line_num}", row) for row in reader if any(row.values())]
    except csv.Error as error:
        message = f"{path}: not a CSV file ({error}); wanted a header {','.join(_COLUMNS)}"
        raise MapFileError(message) from None
    missing = [column for column in _NUMBERS if column not in reader.fieldnames]
    if missing:
        raise MapFileError(
            f"{path}: the header lacks {', '.join(missing)}; the first line must be "
            f"{','.join(_COLUMNS)}"
        )
    wanted = len(reader.fieldnames)
    for where, row in rows:
        # The reader puts values without a column under None, and None where a value is missing.
        found = wanted + len(row.pop(None, ())) - list(row.values()).count(None)
        if found != wanted:
            raise MapFileError(f"{path}: {where}: wanted {wanted} values, found {found}")
    return rows


def _read_yaml(path: Path) -> list[tuple[str, dict[str, Any]]]:
    values = read_yaml(path, MapFileError, "a YAML file of distances")
    if isinstance(values, dict):
        values = values.get("distances")
    if values is None:
        return []
    if not isinstance(values, list):
        raise MapFileError(f"{path}: wanted a list of distances, found {type(values).__name__}")
    rows = []
    for number, entry in enumerate(values, start=1):
        if not isinstance(entry, dict):
            raise MapFileError(
                f"{path}: entry {number}: wanted a mapping with {', '.join(_COLUMNS)}, "
                f"found {type(entry).__name__}"
            )
        rows.append((f"entry {number}", entry))
    return rows


def _distance(values: dict[str, Any], where: str, default_name: str) -> MeasuredDistance:
    numbers = {}
    for column in _NUMBERS:
        raw = values.get(column)
        try:
            number = math.nan if raw is None or isinstance(raw, bool) else float(raw)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            found = "nothing" if raw is None else shown(raw)
            raise MapFileError(f"{where}: {column} must be a number of metres, found {found}")
        numbers[column] = number
    if numbers["distance_m"] <= 0:
        raise MapFileError(f"{where}: distance_m must be above 0, found {numbers['distance_m']:g}")
    name = values.get("name")
    if name is not None and not isinstance(name, str):
        name = shown(name)
    return MeasuredDistance(
        name.strip() if name else default_name,
        (numbers["x1"], numbers["y1"]),
        (numbers["x2"], numbers["y2"]),
        numbers["distance_m"],
    )


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
