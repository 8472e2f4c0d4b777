"""Features of one grid: wall points, distance and score fields, coarser levels.

They are computed once for a grid and device, and shared by all pairs of the grid.
"""

from __future__ import annotations

import math
import pickle
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.align.likelihood import ScoreTable, evidence_table, likeness, score_table
from slamfusion.align.lines import PieceLines, relate_pieces
from slamfusion.align.normalize import LEAST_KEPT, NormalizedGrid
from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.lattice import PointPlanes, point_planes
from slamfusion.compute.layout import DISTANCE_ONE, DISTANCE_UNSEEN, FACES, FACING_PARTS, FIELD_ONE
from slamfusion.compute.wall_pieces import PointPieces, piece_points
from slamfusion.geometry import F64, I8, I32, I64, U8, U16
from slamfusion.io.files import available_memory, return_freed_memory

P = ParamSpec("P")
R = TypeVar("R")

# Unknown cells farther than this from walls contribute nothing, metres, and the least in cells.
SEEN_M, SEEN_CELLS_MIN = 0.4, 3.0
# Some maps fade from walls to free space (Cartographer, plans with smoothed lines). Their rims are
# taken as free if that multiplies the walls next to free space by at least this.
SOFT_GAIN = 1.25
# The last fit is narrow: it needs no greater distances, in cells.
SOLID_REACH = 24
# Small results, which ``release`` keeps.
SMALL = ("known_at_distance", "directions")
# The greatest worth of a wall.
FIELD_TOP = 255
# The reported score: a byte serves single lookups.
FINE_TABLE = score_table(3.0, base=64, span=191)
# Range in which free space is searched, metres: more than the rim of free cells behind drawn walls
# and the gap of a doubled wall, less than half a door; and the number of squares in it.
FACING_REACH_M, REACH_SQUARES = 0.4, 4
# A wall seen from one side: one half of the ground has at least this much more free space, as a
# share of the half.
CLEARER = 0.3
# Bytes of the fields of a cell, the share of the free memory that all may take, and the limit in
# bytes if memory is to be spared.
FIELD_BYTES, FREE_SHARE = 40, 0.5
SPARING_BYTES = 2**28
# Largest grid whose features are kept for its next alignment, cells; each takes ``FIELD_BYTES``.
KEPT_CELLS = 1 << 20
# Directions of walls, degrees; a wall has none beyond 180. Histogram of one degree.
DIRECTIONS = 180
# Cells on the longest side of the picture whose gradients are the directions, its blur, and the
# range over which gradients of a wall are one direction, both cells.
DIRECTION_CELLS, DIRECTION_BLUR, DIRECTION_REACH = 768, 2.0, 3.0
SMOOTHING = np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0])


def spread_sample(points: I32, most: int) -> I32:
    """Return at most ``most`` of the points, evenly strided through their raster order."""
    if len(points) <= most:
        return points
    return points.take(_spread_rows(len(points), most), axis=0)


@lru_cache(maxsize=64)
def _spread_rows(count: int, most: int) -> npt.NDArray[np.intp]:
    """Return ``most`` row numbers, evenly strided."""
    rows = (np.arange(most, dtype=np.intp) * count) // most
    rows.flags.writeable = False
    return rows


@dataclass(frozen=True, eq=False)
class Level:
    """One grid at one cell size.

    Attributes:
        step: fine cells per cell of this level.
        shape: rows and columns.
        wall: (H, W) uint8 on the device, 1 at a surface wall.
        free: (H, W) uint8 on the device, free share 0..255.
        distance2: (H, W) uint16 on the device, squared, cells.
        points: (N, 2) int32, surface walls as lattice positions x, y in half cells.
    """

    step: int
    shape: tuple[int, int]
    wall: DeviceArray[Any]
    free: DeviceArray[Any]
    distance2: DeviceArray[Any]
    points: I32
    device: ComputeDevice

    @property
    def host_distance2(self) -> U16:
        """(H, W) ``distance2`` on the host."""
        return self.device.download(self.distance2)


def _kept(
    make: Callable[Concatenate[GridFeatures, P], R],
) -> Callable[Concatenate[GridFeatures, P], R]:
    """Keep what a method made of its arguments until the map is released."""

    @wraps(make)
    def get(features: GridFeatures, /, *given: P.args, **named: P.kwargs) -> R:
        key = (make.__name__, *given, *named.values())
        with features.making:
            made = features._made  # noqa: SLF001 - of the class below
            if key not in made:
                made[key] = make(features, *given, **named)
            found: R = made[key]
        return found

    return get


class GridFeatures:
    """The levels and fields of one normalised grid on one device."""

    def __init__(
        self, grid: NormalizedGrid, device: ComputeDevice, memory: FieldMemory | None = None
    ) -> None:
        """Prepare a map; fields are computed at first use; ``memory`` may release them."""
        self.given, self.grid = grid, _without_rims(grid)
        self.device, self._memory = device, memory
        # Held while something is made, since two threads may align a map with others.
        self.making = RLock()
        self._made: dict[tuple[Any, ...], Any] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the map alone, compressed to about a tenth; its fields are computed again."""
        make = _unpacked_once if math.prod(self.shape) <= KEPT_CELLS else _unpacked
        return make, (self._packed, self.device)

    @cached_property
    def _packed(self) -> bytes:
        return zlib.compress(pickle.dumps(self.given, pickle.HIGHEST_PROTOCOL), 1)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.shape

    def release(self) -> None:
        """Release what takes memory; it is computed again at next use."""
        # A copy, since another thread may be making more of this map.
        self._made = {key: made for key, made in self._made.copy().items() if key[0] in SMALL}
        self.__dict__.pop("cells", None)
        if self._memory is not None:
            self._memory.forget(self)

    @cached_property
    def cells(self) -> DeviceArray[Any]:
        """(H, W) int8 on the device, see ``NormalizedGrid``."""
        return self.device.wrap_host(self.grid.cells)

    @cached_property
    def centre(self) -> tuple[float, float]:
        """Centre of the known box, x and y in cells: the point whose displacement counts."""
        return self.shape[1] / 2.0, self.shape[0] / 2.0

    @cached_property
    def middle(self) -> tuple[float, float]:
        """The centre in the map frame, metres."""
        grid = self.grid.grid
        x, y = grid.origin.transform(np.array(self.centre) * grid.resolution)
        return float(x), float(y)

    @cached_property
    def known_cells(self) -> int:
        """Known cells."""
        return int(np.count_nonzero(self.grid.cells >= 0))

    @cached_property
    def wall_points(self) -> I32:
        """The solid wall cells, surface or not: lattice positions (N, 2) int32 in half cells."""
        return _lattice_points(self._wall_cells(), self.shape[1])

    @_kept
    def _wall_cells(self) -> npt.NDArray[np.intp]:
        return _set_cells(self.grid.solid)

    @_kept
    def _solid(self) -> DeviceArray[Any]:
        return self.device.wrap_host(self.grid.solid)

    @_kept
    def _surface(self) -> tuple[DeviceArray[Any], I32]:
        """Return the surface walls, and their points; all solid walls where none is next to free.

        See ``Level``.
        """
        solid = self._solid()
        surface = self.device.surface_walls(self.cells, solid)
        walls = self._wall_cells()
        cells = walls[self.device.download(surface).take(walls).view(np.bool_)]
        points = _lattice_points(cells, self.shape[1])
        return (surface, points) if len(points) else (solid, self.wall_points)

    def level(self, step: int) -> Level:
        """Return the grid at ``step`` fine cells a cell."""
        with self.making:
            if self._memory is not None:
                self._memory.use(self, is_more=("_level", step) not in self._made)
            return self._level(step)

    @_kept
    def _level(self, step: int) -> Level:
        wall, points = self._surface()
        if step == 1:
            free = self.device.upload((self.grid.cells == 0).view(np.uint8) * np.uint8(FIELD_ONE))
        else:
            wall, free = self.device.shrink(wall, self.cells, step)
            points = _lattice_points(_set_cells(self.device.download(wall)), wall.shape[1])
        distance2 = self.device.distance_squared(wall)
        height, width = wall.shape
        return Level(step, (height, width), wall, free, distance2, points, self.device)

    @_kept
    def distances(self, step: int, *, solid: bool, everywhere: bool) -> DeviceArray[Any]:
        """Return (H, W) uint16, the distance of a level's cells to a surface wall in 1/256 cell.

        Args:
            solid: to any solid wall cell, up to ``SOLID_REACH``; only at step 1.
            everywhere: in unseen cells too, which otherwise are ``DISTANCE_UNSEEN``.
        """
        level = self.level(step)
        seen = max(SEEN_CELLS_MIN, SEEN_M / (self.grid.grid.resolution * step))
        most = DISTANCE_UNSEEN if everywhere else int(seen * DISTANCE_ONE)
        distance2 = level.distance2
        if solid:
            distance2 = self.device.distance_squared(self._solid(), SOLID_REACH)
        return self.device.wall_distances(distance2, level.free, most)

    @_kept
    def chance(self, step: int, sigma: float) -> float:
        """Return the mean of ``likelihood.likeness`` over the known cells of a level, 0..1.

        ``sigma`` is the width of a wall in cells of the level.
        """
        known = self.known_at_distance(step)
        total = float(known.sum())
        return float(likeness(sigma) @ known) / total if total > 0 else 1.0

    @_kept
    def known_at_distance(self, step: int) -> F64:
        """Return (4097,) the known cells of a level by squared distance to a wall.

        Of occupied cells those of surface walls.
        """
        return np.asarray(self.start_known(step)() / FIELD_ONE)

    @_kept
    def start_known(self, step: int) -> Callable[[], I64]:
        """Let the device start on ``known_at_distance``."""
        level = self.level(step)
        return self.device.start_known_by_distance(level.distance2, level.wall, level.free)

    @_kept
    def wall_planes(self, step: int, most: int) -> PointPlanes:
        """Return at most ``most`` sampled surface walls of a level on the device."""
        return point_planes(spread_sample(self.level(step).points, most), self.device)

    @_kept
    def wall_sample(self, most: int, *, solid: bool = False) -> DeviceArray[np.int32]:
        """Return at most ``most`` sampled surface walls, or walls if ``solid``, on the device."""
        points = self.wall_points if solid else self.level(1).points
        return self.device.upload(spread_sample(points, most))

    @_kept
    def wall_places(self, step: int, most: int, *, solid: bool = False) -> DeviceArray[Any]:
        """Return the same as (N, 2) float32 x and y in cells, of all wall cells if ``solid``."""
        points = self.wall_points if solid else self.level(step).points
        return self.device.upload((spread_sample(points, most) / 2.0).astype(np.float32))

    @_kept
    def _cut(self, per_half_cell: float, most: int) -> tuple[I32, I32, I64]:
        """Return what ``pieces`` has, on the host, and (B, 2) the column and row of each piece."""
        points = spread_sample(self.level(1).points, most)
        col, row = np.floor(points * per_half_cell).astype(np.int64).T
        squares = col * (row.max(initial=0) + 1) + row
        order = np.argsort(squares, kind="stable")
        first = np.flatnonzero(np.diff(squares[order], prepend=-1))
        starts = np.append(first, len(points)).astype(np.int32)
        return points.take(order, axis=0), starts, np.stack((col, row), axis=1)[order[first]]

    @_kept
    def pieces(self, per_half_cell: float, most: int) -> PointPieces:
        """Return at most ``most`` sampled surface walls by piece; half a cell in piece sides."""
        points, starts, _ = self._cut(per_half_cell, most)
        sides = self._facings()[points[:, 1] // 2, points[:, 0] // 2]
        return piece_points(points, sides, starts, self.device)

    @_kept
    def piece_lines(self, per_half_cell: float, most: int, width: float, apart: int) -> PieceLines:
        """Return how the ``pieces`` depend on each other."""
        points, starts, places = self._cut(per_half_cell, most)
        return relate_pieces(points, starts[:-1], places, width, apart)

    @_kept
    def piece_words(self, sigma: float) -> tuple[ScoreTable, DeviceArray[Any]]:
        """Return the evidence of walls of a width in cells, and what their pieces look up."""
        table = evidence_table(self.chance(1, sigma), sigma, FIELD_TOP)
        words = self.device.piece_words(
            self.level(1).distance2, self.cells, self.device.upload(self._facings()),
            table.worths, base=table.base, span=table.span,
            near2=int((2.0 * sigma) ** 2),
        )  # fmt: skip
        return table, words

    @_kept
    def _facings(self) -> U8:
        """Return (H, W) uint8 where free space lies, see ``facings``."""
        return facings(self.grid.cells, self.grid.grid.resolution)

    @_kept
    def directions(self) -> F64:
        """Return how many walls run which way, see ``wall_directions``."""
        return wall_directions(self.grid.solid)

    @_kept
    def field(
        self, step: int, sigma: float, top: int, doubt: float
    ) -> tuple[ScoreTable, DeviceArray[Any]]:
        """Return the evidence of a wall of the other map, and in each cell of a level, uint8."""
        table = evidence_table(self.chance(step, sigma), sigma, top, doubt)
        level = self.level(step)
        return table, self.device.score_field(level.distance2, level.free, table.worths, table.base)


def _unpacked(packed: bytes, device: ComputeDevice) -> GridFeatures:
    """Return a map in another process."""
    grid: NormalizedGrid = pickle.loads(zlib.decompress(packed))  # noqa: S301 - our own
    for array in (grid.cells, grid.solid):
        array.flags.writeable = False
    return GridFeatures(grid, device)


@lru_cache(maxsize=16)
def _unpacked_once(packed: bytes, device: ComputeDevice) -> GridFeatures:
    """Return a small map in another process, where it is kept for its next pairs."""
    return _unpacked(packed, device)


def _set_cells(mask: U8) -> npt.NDArray[np.intp]:
    """Return which cells of a mask are 1, in raster order."""
    # Of booleans NumPy finds the set ones eight at once.
    return np.flatnonzero(mask.view(np.bool_))


def _lattice_points(cells: npt.NDArray[np.intp], width: int) -> I32:
    """Return the centres of cells of a map, x and y in half cells."""
    rows = cells.astype(np.int32) // np.int32(width)
    points = np.empty((len(cells), 2), dtype=np.int32)
    points[:, 0], points[:, 1] = cells - rows * np.int32(width), rows
    points *= 2
    points += 1
    return points


def _without_rims(grid: NormalizedGrid) -> NormalizedGrid:
    """Return a map with free cells in place of unknown ones between wall and free space.

    Only of a map that fades from its walls to free space; other maps are returned as they are.
    """
    around = np.ones((3, 3), dtype=np.uint8)

    def grown(mask: U8) -> U8:
        return np.asarray(cv2.dilate(mask, around), dtype=np.uint8)

    free, unknown = (grid.cells == 0).view(np.uint8), (grid.cells < 0).view(np.uint8)
    beside_free = grown(free)
    rims = unknown & beside_free & grown(grid.solid)
    before = np.count_nonzero(grid.solid & beside_free)
    # A cell has eight neighbours: few rims cannot matter.
    if 8 * np.count_nonzero(rims) <= (SOFT_GAIN - 1.0) * before:
        return grid
    if np.count_nonzero(grid.solid & grown(free | rims)) <= SOFT_GAIN * before:
        return grid
    return replace(grid, cells=np.where(rims != 0, np.int8(0), grid.cells))


def facings(cells: I8, resolution: float) -> U8:
    """Return where free space lies from each cell.

    ``cells`` are (H, W) int8 in {-1, 0, 1}; ``resolution`` is in metres per cell.

    Returns:
        (H, W) uint8: ``FACES`` and the direction, 0 along +x, counter-clockwise, in parts of a
        whole turn, of which there are ``FACING_PARTS``; 0 where free space lies on several sides,
        or on none: a map that saw a wall from both sides contradicts none of those that saw one.
    """
    side = max(1, round(FACING_REACH_M / resolution / REACH_SQUARES))
    height, width = cells.shape
    free = cv2.copyMakeBorder(
        (cells == 0).view(np.uint8) * np.uint8(255), 0, -height % side, 0, -width % side,
        cv2.BORDER_CONSTANT, value=(0,),
    )  # fmt: skip
    size = free.shape[1] // side, free.shape[0] // side
    share = cv2.resize(free, size, interpolation=cv2.INTER_AREA) * np.float32(1 / 255)
    # How much more free space lies to the right and above, as a share of half of the ground.
    half = REACH_SQUARES * (2 * REACH_SQUARES + 1)
    sign = np.repeat(np.array([-1, 0, 1], dtype=np.float32), [REACH_SQUARES, 1, REACH_SQUARES])
    one = np.ones_like(sign) / half
    x, y = (
        cv2.sepFilter2D(share, -1, across, along, borderType=cv2.BORDER_CONSTANT)
        for across, along in ((sign, one), (one, sign))
    )
    much, angle = (np.asarray(part, dtype=np.float32) for part in cv2.cartToPolar(x, y))
    parts = (angle * np.float32(FACING_PARTS / (2.0 * np.pi)) + np.float32(0.5)).astype(np.uint8)
    way = parts & np.uint8(FACING_PARTS - 1) | np.uint8(FACES)
    faces = way * (much >= CLEARER)
    # Channels are cells of a row: that is five times as fast as to repeat single bytes.
    wide = cv2.merge([faces] * side).reshape(size[1], -1)
    return np.ascontiguousarray(np.repeat(wide, side, axis=0)[:height, :width])


def wall_directions(solid: U8) -> F64:
    """Return the histogram (180,) of directions across walls, mean 0 and length 1."""
    shrink = min(1.0, DIRECTION_CELLS / max(solid.shape))
    size = (max(1, round(solid.shape[1] * shrink)), max(1, round(solid.shape[0] * shrink)))
    # Shrunk as integers, since floats of a large map take much memory.
    small = cv2.resize(solid * np.uint8(255), size, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(small.astype(np.float32), (0, 0), DIRECTION_BLUR)
    along_x = cv2.Scharr(picture, cv2.CV_32F, 1, 0)
    along_y = cv2.Scharr(picture, cv2.CV_32F, 0, 1)
    xx, yy, xy = (
        cv2.GaussianBlur(product, (0, 0), DIRECTION_REACH)
        for product in (along_x * along_x, along_y * along_y, along_x * along_y)
    )
    # The structure tensor's main axis, and its anisotropy.
    weight = np.hypot(xx - yy, 2.0 * xy)
    strong = weight > 0.01 * weight.max()
    degrees = np.degrees(np.arctan2(2.0 * xy[strong], (xx - yy)[strong]) / 2.0) % DIRECTIONS
    # Shared by the two nearest whole degrees.
    below = np.floor(degrees)
    above = (degrees - below) * weight[strong]
    counts: F64 = np.zeros(DIRECTIONS)
    for more, part in enumerate((weight[strong] - above, above)):
        counts += np.bincount((below.astype(np.int64) + more) % DIRECTIONS, part, DIRECTIONS)
    reach = len(SMOOTHING) // 2
    wrapped = np.concatenate((counts[-reach:], counts, counts[:reach]))
    smooth = np.convolve(wrapped, SMOOTHING, "valid")
    smooth -= smooth.mean()
    length = float(np.linalg.norm(smooth))
    return np.asarray(smooth / length if length > 0.0 else smooth)


class FieldMemory:
    """Releases the fields of the least recently used maps of a job."""

    def __init__(self, cells: int | None = None, *, is_sparing: bool = False) -> None:
        """Start empty, with a limit on cells of maps with fields; None: by the free memory."""
        if cells is None:
            room = int(FREE_SHARE * available_memory())
            cells = (min(room, SPARING_BYTES) if is_sparing else room) // FIELD_BYTES
        self._most = cells
        self._used: dict[int, GridFeatures] = {}
        self._lock = RLock()

    def use(self, fields: GridFeatures, *, is_more: bool) -> None:
        """Mark a map as used, and make room if it will hold more."""
        with self._lock:
            self._used.pop(id(fields), None)
            self._used[id(fields)] = fields
            if not is_more:
                return
            before, held = len(self._used), sum(math.prod(one.shape) for one in self._used.values())
            while held > self._most and len(self._used) > LEAST_KEPT:
                oldest = self._used.pop(next(iter(self._used)))
                held -= math.prod(oldest.shape)
                oldest.release()
            is_less = len(self._used) < before
        if is_less:
            return_freed_memory()

    def forget(self, fields: GridFeatures) -> None:
        """Note that a map holds nothing."""
        with self._lock:
            self._used.pop(id(fields), None)

    def clear(self) -> None:
        """Release everything."""
        while self._used:
            self._used.popitem()[1].release()
