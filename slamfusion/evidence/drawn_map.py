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
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from slamfusion.align.normalize import NormalizedGrid, normalize_grid
from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import OPEN, WALL
from slamfusion.config import FusionConfig
from slamfusion.errors import TrajectoryError
from slamfusion.evidence.beams import ScanHits, no_common_time
from slamfusion.fusion.lattice_vote import warp_onto
from slamfusion.geometry import B8, I8, I32, I64, U8, U32, Pose2, moved_poses
from slamfusion.grid import FREE, IDENTITY, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, known_box
from slamfusion.slam.common.beam_counts import BeamCounts, Beams
from slamfusion.trajectory import Trajectory
from slamfusion.vote.lattice import Lattice
from slamfusion.vote.tiles import GridLayer, TileVoter

Row = tuple[float, ...]

# Scans that are placed and counted at once.
PART = 256
# A cell is a wall if more than one in BEAMS_PER_HIT of the beams that reached it ended in it, and
# at least LEAST_HITS did. A free cell was crossed by at least LEAST_VISITS beams.
BEAMS_PER_HIT, LEAST_HITS, LEAST_VISITS = 4, 2, 3
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
    return MapDrawer(device, Lattice(resolution, origin)).draw(scans, path, name)


class MapDrawer:
    """Draws a drive again and again: only scans that are new or moved.

    The beams of the others stop where they met walls when they were drawn; if most scans have
    moved, all are drawn. Counts are whole numbers, so that a scan can be taken back.
    """

    def __init__(self, device: ComputeDevice, lattice: Lattice) -> None:
        """Start without scans; see ``draw_map``."""
        self.lattice = lattice
        self._device = device
        self._clear()

    def _clear(self) -> None:
        self._laid: dict[float, _LaidScan] = {}
        # By whole beams, and by beams that stop at walls.
        self._whole, self._stopped = BeamCounts(self._device), BeamCounts(self._device)

    def draw(self, scans: Sequence[ScanHits], path: Trajectory, name: str) -> OccupancyGrid:
        """Return the map of the scans that have a pose in the path."""
        resolution, origin = self.lattice.resolution, self.lattice.origin
        if not len(scans) or not len(path):
            message = (
                f"{path.name}: a map needs scans and poses, found {len(scans)} and {len(path)}"
            )
            raise TrajectoryError(message)
        stamps_s = np.array([scan.stamp_s for scan in scans])
        near, meets = path.matches(stamps_s)
        if not meets.any():
            raise no_common_time(path.name, path, stamps_s)
        placed = [scans[index] for index in np.flatnonzero(meets).tolist()]
        poses = moved_poses(origin.inverse(), path.poses[near[meets]])
        wanted = dict(zip((scan.stamp_s for scan in placed), map(tuple, poses), strict=True))
        moved = [own for own in self._laid.values() if wanted.get(own.scan.stamp_s) != own.pose]
        if 2 * len(moved) > len(self._laid):
            self._clear()
        elif moved:
            self._take_back(moved)
        fresh = [scan for scan in placed if scan.stamp_s not in self._laid]
        if fresh:
            self._lay(fresh, [wanted[scan.stamp_s] for scan in fresh])
        cells, corner = self._stopped.cells(_trinary, np.int8)
        _remove_specks(cells, LEAST_AREA_M2 / resolution**2)
        box = known_box(cells)
        if box is not None:
            # Not by ``OccupancyGrid.crop``, so that the origin is rounded only once.
            cells = cells[box.row0 : box.row1, box.col0 : box.col1]
            corner = corner + np.array((box.col0, box.row0))
        at = origin.compose(Pose2(*(float(value) for value in corner * resolution)))
        return OccupancyGrid(cells, resolution, at, name)

    def _lay(self, scans: Sequence[ScanHits], poses: Sequence[Row]) -> None:
        """Count scans that are not counted yet, some at a time."""
        resolution = self.lattice.resolution
        parts = [slice(first, first + PART) for first in range(0, len(scans), PART)]
        for part in parts:
            whole = Beams.of(scans[part], poses[part], resolution)
            self._whole.count(whole, self._whole.place(whole), 1)
        cells, corner = self._whole.cells(_walls, np.uint8)
        walls = self._device.upload(cells)
        for part in parts:  # placed again: all beams at once take more than their map
            whole = Beams.of(scans[part], poses[part], resolution)
            beams = _cut_off(whole, walls, corner, self._device, resolution)
            ends, stopped = self._stopped.place(beams), np.flatnonzero(~beams.is_hit)
            self._stopped.count(beams, ends, 1)
            firsts = beams.firsts[:-1]
            own = np.split(stopped, stopped.searchsorted(firsts[1:]))
            for scan, pose, first, at in zip(scans[part], poses[part], firsts, own, strict=True):
                self._laid[scan.stamp_s] = _LaidScan(scan, pose, at - first, ends[at])

    def _take_back(self, moved: Sequence[_LaidScan]) -> None:
        """Take scans back that were counted."""
        scans, poses, stopped, stops = zip(*moved, strict=True)
        beams = Beams.of(scans, poses, self.lattice.resolution)
        ends, is_hit = self._whole.ends(beams), beams.is_hit.copy()
        self._whole.count(beams, ends, -1)
        at = np.concatenate(stopped) + np.repeat(beams.firsts[:-1], [len(own) for own in stopped])
        ends[at], is_hit[at] = np.concatenate(stops), False
        self._stopped.count(replace(beams, is_hit=is_hit), ends, -1)
        for scan in scans:
            del self._laid[scan.stamp_s]


class _LaidScan(NamedTuple):
    """A scan that is drawn.

    Attributes:
        pose: on the lattice, metres and radians.
        stopped: (K,) int64, its beams that stop at walls; they hit nothing.
        stops: (K, 2) int32, where: see ``BeamCounts.place``.
    """

    scan: ScanHits
    pose: Row
    stopped: I64
    stops: I32


def _is_wall(hits: U32, visits: U32) -> B8:
    """Return which cells are walls."""
    return np.asarray((hits >= LEAST_HITS) & (BEAMS_PER_HIT * hits > visits))


def _walls(hits: U32, visits: U32) -> U8:
    """Return walls as rays meet them."""
    return np.where(_is_wall(hits, visits), np.uint8(WALL), np.uint8(OPEN))


def _trinary(hits: U32, visits: U32) -> I8:
    """Return the cells of a map."""
    cells = np.where(visits >= LEAST_VISITS, np.int8(FREE), np.int8(UNKNOWN))
    cells[_is_wall(hits, visits)] = OCCUPIED
    return cells


def _remove_specks(cells: I8, least_cells: float) -> None:
    """Remove small patches of known ones that touch no others from (H, W) cells."""
    known = (cells != UNKNOWN).view(np.uint8)
    _, of, figures, _ = cv2.connectedComponentsWithStats(known, connectivity=8)
    sizes = figures[:, cv2.CC_STAT_AREA]
    # The largest is the map, however small that is.
    is_small = sizes < min(least_cells, sizes[1:].max(initial=0))
    for row, numbers in zip(cells, of, strict=True):  # an index of all takes eight bytes a cell
        row[is_small[numbers]] = UNKNOWN


def _cut_off(
    beams: Beams,
    walls: DeviceArray[np.uint8],
    corner: I64,
    device: ComputeDevice,
    resolution: float,
) -> Beams:
    """Return the beams stopped at walls; those that stop there hit nothing."""
    starts = beams.lasers[beams.scans]
    along = beams.ends - starts
    length = np.hypot(along[:, 0], along[:, 1])
    direction = along / np.maximum(length, 1e-9)[:, None]
    rays = np.concatenate((starts - corner, direction), axis=1).astype(np.float32)
    reach = float(length.max()) + 1.0
    met = device.cast_rays(walls, rays, reach)[:, 0].astype(np.float64)
    goes_on = met + BEYOND_M / resolution < length
    # Half a cell before the wall: this beam does not cross its cell.
    stop = np.where(goes_on, np.maximum(met - 0.5, 0.0), length)
    ends = np.where(goes_on[:, None], starts + stop[:, None] * direction, beams.ends)
    is_hit = ~goes_on & (length > 0.0) & np.isfinite(length)
    return replace(beams, ends=ends, is_hit=is_hit)


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
    lattice, box = layer.lattice, layer.box
    for name in voters:
        grid, transform = inputs[name]
        box = box.hull(grid.on(lattice, transform))

    def placed(grid: NormalizedGrid, transform: Pose2) -> I8:
        return warp_onto(grid, transform, lattice, box, device)

    own = placed(layer, Pose2())
    aligned = {name: placed(*item) for name, item in inputs.items()}
    whole = CellBox(0, 0, *box.shape)
    vote = replace(config.vote, mode="consensus")
    layers = {drawn.name: own, **{name: aligned[name] for name in voters}}
    voter = TileVoter(whole, vote, drawn.resolution, tuple(layers))
    shown = {
        name: voter.prepare(whole, GridLayer(box.shape, whole, cells).on)
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
            record,
            # Where it knows a cell that the fused map knows otherwise.
            layer=GridLayer.of(laid, (laid >= 0) & (fused >= 0) & (laid != fused)),
        )
        if (laid := aligned.get(record.name)) is not None
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
