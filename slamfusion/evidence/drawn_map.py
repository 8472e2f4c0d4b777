"""``draw_map``: the map of all scans of a drive at the poses of one path, by one sensor model.

A vote on maps keeps what each SLAM's sensor model left of people, glass and stray readings. Here
every beam is counted once, at the best path. A cell is a wall if enough of the beams that reached
it ended in it, so people leave nothing. The map is drawn twice: what a beam adds beyond a wall of
the first drawing (through glass, or by a pose error) does not count in the second. Cells seen by
too few beams stay unknown.

``fuse_with_drawn``: that map becomes the fused map of a drive. The producers' own maps add nothing
to their paths and do not vote; they are compared with the drawn map to show differences. A map that
another SLAM saved contains scans outside of this log, so it votes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.align.normalize import NormalizedGrid, normalize_grid
from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice
from slamfusion.compute.hit_counts import BeamScan, halve_counts
from slamfusion.compute.layout import MOST_BEAMS, OPEN, TILE, WALL
from slamfusion.config import FusionConfig
from slamfusion.errors import TrajectoryError
from slamfusion.evidence.beams import ScanHits, no_common_time
from slamfusion.fusion.lattice_vote import warp_onto
from slamfusion.geometry import F64, Pose2, moved_poses, transform_points
from slamfusion.grid import FREE, IDENTITY, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, known_box
from slamfusion.slam.common.tile_map import SharedTileMaps
from slamfusion.trajectory import Trajectory
from slamfusion.vote.boxes import hull
from slamfusion.vote.tiles import GridLayer, TileVoter

F32 = npt.NDArray[np.float32]

# Parts of a cell that points are rounded to, as the kernel sees them.
POINT_PARTS = 1024.0
# Rays of one launch.
RAYS = 1 << 18
# A cell is a wall if more than this share of the beams that reached it ended in it, and this number
# at least; a free one was crossed by at least the third number of beams.
WALL_SHARE, LEAST_HITS, LEAST_VISITS = 0.25, 2, 3
# A beam that continues beyond a wall for more than this is cut off there, metres.
BEYOND_M = 0.2
# Smaller isolated patches of known cells are removed, square metres.
LEAST_AREA_M2 = 0.2


def draw_map(
    scans: Sequence[ScanHits],
    path: Trajectory,
    device: ComputeDevice,
    *,
    resolution: float,
    origin: Pose2 = IDENTITY,
    name: str = "drawn",
) -> OccupancyGrid:
    """Draw the map of a drive.

    Args:
        resolution: metres per cell.
        origin: of the lattice: a corner of a cell, and the direction of the rows, in the frame of
            the path.

    Returns:
        Cells in {-1, 0, 100}, cropped to what is known, in the frame of the path.
    """
    placed, poses = _with_poses(scans, path, origin)
    beams = _Beams.of(placed, poses, resolution)
    everything = np.ones(len(beams.ends), dtype=np.bool_)
    counts, corner = _count(beams, beams.ends, everything, device)
    ends, is_hit = _cut_off(beams, _is_wall(counts), corner, device, resolution)
    counts, corner = _count(beams, ends, is_hit, device)
    walls = _is_wall(counts)
    visits = counts & 0xFFFF
    cells = np.where(walls, OCCUPIED, np.where(visits >= LEAST_VISITS, FREE, UNKNOWN))
    cells = _without_specks(cells.astype(np.int8), LEAST_AREA_M2 / resolution**2)
    box = known_box(cells)
    if box is not None:
        # Not by ``OccupancyGrid.crop``, so that the origin is rounded only once.
        cells = cells[box.row0 : box.row1, box.col0 : box.col1]
        corner = corner + np.array((box.col0, box.row0))
    at = origin.compose(Pose2(*(float(value) for value in corner * resolution)))
    return OccupancyGrid(cells, resolution, at, name)


@dataclass(frozen=True, eq=False)
class _Beams:
    """All beams of a drive on the lattice, in cells.

    Attributes:
        lasers: (N, 2) float64, of each scan.
        ends: (B, 2) float64.
        firsts: (N + 1,) int64, the beams of scan i are firsts[i] to firsts[i + 1] - 1.
    """

    lasers: F64
    ends: F64
    firsts: npt.NDArray[np.int64]

    @classmethod
    def of(cls, scans: Sequence[ScanHits], poses: F64, resolution: float) -> _Beams:
        """Place scans at (N, 3) poses on the lattice."""
        hits = [scan.ends[:: -(-len(scan.ends) // MOST_BEAMS)] for scan in scans]
        sizes = np.array([len(own) for own in hits])
        of = np.repeat(np.arange(len(scans)), sizes)
        lasers = np.array([scan.laser for scan in scans])

        def in_cells(points: F64) -> F64:
            return np.asarray(np.rint(points / resolution * POINT_PARTS) / POINT_PARTS)

        return cls(
            in_cells(transform_points(poses, lasers)),
            in_cells(transform_points(poses, np.concatenate(hits), of)),
            np.concatenate(([0], np.cumsum(sizes))).astype(np.int64),
        )


def _with_poses(
    scans: Sequence[ScanHits], path: Trajectory, origin: Pose2
) -> tuple[list[ScanHits], F64]:
    """Return the scans that have a pose, and these poses on the lattice, (N, 3)."""
    stamps_s = np.array([scan.stamp_s for scan in scans])
    if not len(scans) or not len(path):
        message = f"{path.name}: {len(scans)} scans and {len(path)} poses; a map needs both"
        raise TrajectoryError(message)
    near, meets = path.matches(stamps_s)
    if not meets.any():
        raise no_common_time(path.name, path, stamps_s)
    poses = moved_poses(origin.inverse(), path.poses[near[meets]])
    return [scans[index] for index in np.flatnonzero(meets).tolist()], poses


def _count(
    beams: _Beams, ends: F64, is_hit: npt.NDArray[np.bool_], device: ComputeDevice
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.int64]]:
    """Count hits and visits of every cell."""
    maps = SharedTileMaps(device, 1, {"counts": np.uint32, "sums": np.uint32})
    here = np.array([[0.0, 0.0, 1.0, 0.0]], dtype=np.float32)
    low = np.minimum(ends.min(axis=0), beams.lasers.min(axis=0))
    high = np.maximum(ends.max(axis=0), beams.lasers.max(axis=0))
    maps.cover(low - 1.0, high + 1.0)
    lasers, inside = beams.lasers - maps.origin, ends - maps.origin
    maps.make_writable(_pages_crossed(lasers, inside, beams.firsts, maps.pages.shape[1:])[None])
    laser_cells, end_cells = lasers.astype(np.float32), inside.astype(np.float32)
    marks = is_hit.astype(np.uint8)
    pools, pages = maps.pools, maps.page_tables
    for laser, first, last in zip(laser_cells, beams.firsts[:-1], beams.firsts[1:], strict=True):
        scan = BeamScan(end_cells[first:last], marks[first:last], laser, here)
        if device.count_beams(pools["counts"], pools["sums"], pages, scan):
            halve_counts(device, pools)
    counts, corner = maps.cells("counts", 0)
    return counts.astype(np.uint32), np.asarray(corner, dtype=np.int64)


def _pages_crossed(
    lasers: F64, ends: F64, firsts: npt.NDArray[np.int64], shape: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Return which pages beams may cross, (PH, PW) bool, with some neighbours.

    One beam of a scan is followed to the middle of each end page; the others stay within a page.
    """
    crossed = np.zeros(shape, dtype=np.bool_)
    of = np.repeat(np.arange(len(lasers)), np.diff(firsts))
    col, row = np.floor(ends / TILE).astype(np.int64).T
    _, one = np.unique((of * shape[0] + row) * shape[1] + col, return_index=True)
    start = lasers[of[one]]
    middle = np.stack((col[one], row[one]), axis=1) * TILE + 0.5 * TILE
    steps = np.ceil(np.abs(middle - start).max(axis=1, initial=0.0) / (0.5 * TILE)).astype(np.int64)
    for step in range(int(steps.max(initial=0)) + 1):
        going = steps >= step
        share = step / np.maximum(steps[going], 1)
        at = start[going] + share[:, None] * (middle[going] - start[going])
        at_col, at_row = np.floor(at / TILE).astype(np.int64).T
        crossed[at_row, at_col] = True
    return np.asarray(scipy.ndimage.binary_dilation(crossed, np.ones((3, 3), dtype=np.bool_)))


def _is_wall(counts: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
    """Return which cells are walls, (H, W) bool."""
    hits, visits = counts >> 16, counts & 0xFFFF
    return np.asarray((hits >= LEAST_HITS) & (hits > WALL_SHARE * visits))


def _without_specks(cells: npt.NDArray[np.int8], least_cells: float) -> npt.NDArray[np.int8]:
    """Return (H, W) cells without small patches of known ones that touch no others."""
    of, count = scipy.ndimage.label(cells != UNKNOWN, np.ones((3, 3)))
    sizes = np.bincount(of.ravel(), minlength=count + 1)
    # The largest is the map, however small that is.
    least = min(least_cells, sizes[1:].max(initial=0))
    return np.where((sizes < least)[of], UNKNOWN, cells).astype(np.int8)


def _cut_off(
    beams: _Beams,
    walls: npt.NDArray[np.bool_],
    corner: npt.NDArray[np.int64],
    device: ComputeDevice,
    resolution: float,
) -> tuple[F64, npt.NDArray[np.bool_]]:
    """Return (B, 2) ends of beams that stop at walls, and which of them still hit something."""
    of = np.repeat(np.arange(len(beams.lasers)), np.diff(beams.firsts))
    starts = beams.lasers[of]
    along = beams.ends - starts
    length = np.hypot(along[:, 0], along[:, 1])
    direction = along / np.maximum(length, 1e-9)[:, None]
    rays = np.concatenate((starts - corner, direction), axis=1).astype(np.float32)
    cells = device.upload(np.where(walls, WALL, OPEN).astype(np.uint8))
    reach = float(length.max()) + 1.0
    met = np.concatenate(
        [
            device.cast_rays(cells, rays[first : first + RAYS], reach)[:, 0]
            for first in range(0, len(rays), RAYS)
        ]
    ).astype(np.float64)
    goes_on = met + BEYOND_M / resolution < length
    # Half a cell before the wall: this beam does not cross its cell.
    stop = np.where(goes_on, np.maximum(met - 0.5, 0.0), length)
    ends = np.where(goes_on[:, None], starts + stop[:, None] * direction, beams.ends)
    return ends, ~goes_on & (length > 0.0) & np.isfinite(length)


I8 = npt.NDArray[np.int8]
B8 = npt.NDArray[np.bool_]


def fuse_with_drawn(
    result: FusionResult,
    drawn: OccupancyGrid,
    saved: Collection[str],
    config: FusionConfig,
    device: ComputeDevice,
) -> FusionResult:
    """Return the fusion with the drawn map in place of the producers' votes.

    The drawn map and the saved maps that fit vote as in ``consensus``. Without saved maps the drawn
    map is the fused one.

    Args:
        drawn: in the map frame of its fused map, cells in {-1, 0, 100}.

    Returns:
        On the lattice of ``drawn``, over all that it and the voting saved maps know. The agreement
        of a cell is the share of the maps that know it, the drawn one among them, which say what
        the fused one says; an input dissents where it knows a cell and says otherwise. ``weights``
        has those that voted.
    """
    layer = normalize_grid(drawn, drawn.resolution, config.normalize, device)
    inputs = {
        record.name: (
            normalize_grid(record.grid, drawn.resolution, config.normalize, device),
            record.alignment.transform,
        )
        for record in result.accepted
        if record.alignment is not None
    }
    voters = [name for name in inputs if name in saved]
    lattice, box = layer.extent.lattice, layer.extent.box
    for name in voters:
        grid, transform = inputs[name]
        box = hull(box, grid.extent.on(lattice, transform))

    def placed(grid: NormalizedGrid, transform: Pose2) -> I8:
        return warp_onto(grid, transform, lattice, box, device)

    own = placed(layer, Pose2())
    aligned = {name: placed(*item) for name, item in inputs.items()}
    whole = CellBox(0, 0, box.height, box.width)
    vote = replace(config.vote, mode="consensus")
    layers = {drawn.name: own, **{name: aligned[name] for name in voters}}
    voter = TileVoter(whole, vote, drawn.resolution, tuple(layers))
    shape = (box.height, box.width)
    shown = {
        name: voter.prepare(whole, GridLayer(shape, whole, cells).on)
        for name, cells in layers.items()
    }
    if voter.weighs:
        voter = voter.trusting(voter.count(whole, shown))
    voted = voter.decide(whole, shown, device)
    fused = own if voted is None else voted.fused
    frame = layer.grid.crop(box)
    cells = np.array([UNKNOWN, FREE, OCCUPIED], dtype=np.int8)[fused + 1]
    agreement = _agreement(fused, [own, *aligned.values()])
    records = tuple(
        replace(
            record, layer=GridLayer.of(aligned[record.name], _dissent(fused, aligned[record.name]))
        )
        if record.name in aligned
        else record
        for record in result.inputs
    )
    return replace(
        result,
        inputs=records,
        fused=OccupancyGrid(cells, frame.resolution, frame.origin, result.fused.name),
        agreement=OccupancyGrid(agreement, frame.resolution, frame.origin, result.agreement.name),
        phantom_cells=0,
        weights=voter.weights,
        wall_agreement=result.wall_agreement | voter.wall_agreement,
        left_out_m2={},
    )


def _agreement(fused: I8, maps: list[I8]) -> I8:
    """Return the share of the maps that know a cell which say what the fused one says."""
    known = np.zeros(fused.shape, dtype=np.int16)
    same = np.zeros(fused.shape, dtype=np.int16)
    for cells in maps:
        known += cells >= 0
        same += (cells >= 0) & (cells == fused)
    percent = np.floor(100.0 * same / np.maximum(known, 1) + 0.5).astype(np.int8)
    return np.where(fused >= 0, percent, np.int8(-1))


def _dissent(fused: I8, cells: I8) -> B8:
    """Return where a map knows a cell that the fused one knows otherwise, (H, W) bool."""
    return np.asarray((cells >= 0) & (fused >= 0) & (cells != fused))
