"""One input of the live fusion: its newest map, what that changed, and what is believed of it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken, watched_by
from slamfusion.align.decide import WALLS_MIN
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, NormalizeConfig
from slamfusion.fusion.live.layers import Layer, carry, lay_out
from slamfusion.fusion.live.limits import bands
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import CellBox, OccupancyGrid, known_box
from slamfusion.vote.boxes import hull, moved, overlap, padded

I8 = npt.NDArray[np.int8]

# Share of the old walls.
STANDING_MIN = 0.4
# A map with less than the first share of the walls of the one before was begun anew, and is young
# until it has the second.
ANEW_SHARE, GROWN_SHARE = 0.5, 0.75
YOUNG = "its map began anew: what it does not know yet is no vote"
# Cells in which nothing lies, that a box of changes may hold for each cell of the two maps.
SPARE_SHARE = 4
NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)


@dataclass(frozen=True)
class Change:
    """What a new map changed.

    Attributes:
        box: cells of the lattice that hold every cell that differs; None where none does.
        walls: cells that became or ceased to be a wall.
        standing: old wall cells with a wall within one cell.
        contradicted: old wall cells that are free now, no wall within one cell.
        before: all old wall cells.
        after: all new wall cells; None where not all of them were looked at.
        is_lost: whether a known cell became unknown.
    """

    box: CellBox | None
    walls: int
    standing: int
    contradicted: int
    before: int
    after: int | None = None
    is_lost: bool = True

    def is_steady(self, share: float) -> bool:
        """Whether enough old walls still stand to believe that the map's frame did not move.

        Args:
            share: of those that can be judged, wall or free now. A few that stand by chance tell
                nothing where most have gone into the unknown.
        """
        judged = self.standing + self.contradicted
        is_enough = self.standing >= max(WALLS_MIN, STANDING_MIN * self.before)
        return is_enough and self.standing >= share * judged


def compare(
    old: Layer, new: Layer, walls: int, thresholds: NormalizeConfig, device: ComputeDevice
) -> Change:
    """Compare two maps of one input, cell by cell where both lie in its frame.

    Args:
        old: the map before.
        new: the map now; on another lattice it is resampled first, and all of it counts as changed.
        walls: wall cells of ``old``.
        thresholds: what is a wall, and what is free.
    """
    if new.lattice == old.lattice:
        box = _changed_box(old, new)
        if box is None:
            return Change(None, 0, walls, 0, walls, walls, is_lost=False)
        near = padded(box, 1)
        if near.area > SPARE_SHARE * (old.box.area + new.box.area):
            return _replaced(new, box, walls, thresholds)
        before, after = old.window(near), new.window(near)
        is_lost = bool(((before >= 0) & (after < 0)).any())
    else:
        box = old.box
        before = old.cells
        after = carry(new, Pose2(), old.lattice, box, device)
        is_lost = True
    occupied = math.ceil(thresholds.occupied_percent)
    was, now = (before >= occupied).view(np.uint8), (after >= occupied).view(np.uint8)
    near_now = cv2.dilate(now, NEIGHBOURS)
    free = (after >= 0) & (after <= thresholds.free_percent)
    gone = (was != 0) & (near_now == 0)
    lost = int(np.count_nonzero(gone))
    differ = int(np.count_nonzero(was != now))
    total = None
    if new.lattice == old.lattice:
        total = walls - int(np.count_nonzero(was)) + int(np.count_nonzero(now))
    contradicted = int(np.count_nonzero(gone & free))
    return Change(box, differ, walls - lost, contradicted, walls, total, is_lost)


def _replaced(new: Layer, box: CellBox, walls: int, thresholds: NormalizeConfig) -> Change:
    """Return what a map changed that lies far from the one before: nothing stands.

    No array of the cells between both is made: for maps 10 km apart it would take gigabytes.
    """
    occupied = math.ceil(thresholds.occupied_percent)
    after = int(np.count_nonzero(new.cells >= occupied))
    return Change(box, walls + after, 0, 0, walls, after)


def _changed_box(old: Layer, new: Layer) -> CellBox | None:
    """Return the box of cells that differ; outside of a layer all is unknown."""
    common = overlap(old.box, new.box)
    boxes = []
    if common is None:
        boxes = [_known(old, old.box), _known(new, new.box)]
    else:
        found = _differing(old.window(common), new.window(common))
        if found is not None:
            boxes.append(moved(found, common.row0, common.col0))
        for layer in (old, new):
            boxes += [_known(layer, strip) for strip in _around(layer.box, common)]
    out: CellBox | None = None
    for box in boxes:
        if box is not None:
            out = box if out is None else hull(out, box)
    return out


def _differing(a: I8, b: I8) -> CellBox | None:
    """Return the box of cells that differ, None without any; two arrays of one shape."""
    out: CellBox | None = None
    for band in bands(*a.shape):
        differs = a[band] != b[band]
        if not differs.any():
            continue
        rows, cols = (np.flatnonzero(differs.any(axis=axis)) for axis in (1, 0))
        top = band.start
        found = CellBox(
            top + int(rows[0]), int(cols[0]), top + int(rows[-1]) + 1, int(cols[-1]) + 1
        )
        out = found if out is None else hull(out, found)
    return out


def _known_after(old: CellBox | None, new: Layer, change: Change) -> CellBox | None:
    """Return the box of a layer's known cells, from that of the one before on its lattice."""
    box = change.box
    if box is None:
        return old
    is_inside = (
        old is not None
        and old.row0 < box.row0
        and box.row1 < old.row1
        and old.col0 < box.col0
        and box.col1 < old.col1
    )
    if is_inside:
        return old  # the cells that bound it did not change
    if change.is_lost:
        return _known(new, new.box)
    found = _known(new, overlap(box, new.box) or box)
    return found if old is None else old if found is None else hull(old, found)


def _around(outer: CellBox, inner: CellBox) -> list[CellBox]:
    """Return the strips of a box around one inside of it."""
    strips = [
        CellBox(outer.row0, outer.col0, inner.row0, outer.col1),
        CellBox(inner.row1, outer.col0, outer.row1, outer.col1),
        CellBox(inner.row0, outer.col0, inner.row1, inner.col0),
        CellBox(inner.row0, inner.col1, inner.row1, outer.col1),
    ]
    return [strip for strip in strips if strip.height > 0 and strip.width > 0]


def _known(layer: Layer, box: CellBox) -> CellBox | None:
    """Return the box of known cells inside a box of the layer's lattice."""
    found = known_box(layer.window(box))
    return None if found is None else moved(found, box.row0, box.col0)


def _is_same(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    """Whether two maps are equal in all that counts."""
    return (
        a.origin == b.origin and a.resolution == b.resolution and np.array_equal(a.cells, b.cells)
    )


@dataclass(eq=False)
class Track:
    """What the fusion keeps of one input.

    Attributes:
        grid: its newest usable map.
        version: counts the maps that differed from the one before.
        layer: ``grid`` at the fused resolution; None before the first fusion.
        known: cells of the layer's lattice that hold every known one.
        walls: wall cells of the layer.
        is_live: whether its newest message was a usable map, and recent.
        has_begun_anew: whether a new map took the place of a fuller one, until that is noted.
        young_below: wall cells below which such a map knows less than the one before did; 0: none.
        is_steady: whether the newest map stands where ``transform`` belongs.
        accepted: whether its last alignment was believed; it votes while it is steady too.
        reason: why (not), one line.
        transform: its map frame into the fused frame, metres; the last that was believed.
        score, overlap, is_tracked: of the last alignment; see ``Alignment``.
        drift: wall cells that came or went, here and in the reference, since that alignment.
        key: the map at that alignment, its wall cells, and how many came or went since: what walls
            that creep a cell at a time are held against.
        jump: a transform that waits to be found again; ``jump_version`` the map that gave it,
            ``jump_s`` and ``jump_maps`` when it was first found and how many messages had come.
        confirms: how often it was searched again on the same map.
        mismatch: why its walls do not match those that it was last aligned to; empty: they do.
        contradiction: why its poses contradict those of others, which takes its vote; empty: none.
        tried: own version, the reference's name and version when it was last aligned in vain; see
            ``recovery`` for those of the last fused map.
        searched_s: when it was last searched everywhere.
        searches: how often.
        rest_s: the least pause after that search.
        patience_s: how long maps of others wait for its next search.
        maps: usable messages that came.
        unlaid: cells of the layer's lattice that the fused layers have not seen.
        relay: whether the fused layers have to take all of the layer again.
    """

    name: str
    grid: OccupancyGrid | None = None
    version: int = 0
    layer: Layer | None = None
    known: CellBox | None = None
    walls: int = 0
    is_live: bool = False
    has_begun_anew: bool = False
    young_below: float = 0.0
    is_steady: bool = False
    accepted: bool = False
    reason: str = "no map yet"
    transform: Pose2 | None = None
    score: float = 0.0
    overlap: float = 0.0
    is_tracked: bool = False
    drift: int = 0
    key: tuple[Layer, int] | None = None
    key_drift: int = 0
    jump: Pose2 | None = None
    jump_version: int = -1
    jump_s: float = -math.inf
    jump_maps: int = 0
    confirms: int = 0
    mismatch: str = ""
    contradiction: str = ""
    tried: tuple[int, str, int] | None = None
    searched_s: float = -math.inf
    searches: int = 0
    rest_s: float = 0.0
    patience_s: float = 1.0
    maps: int = 0
    unlaid: CellBox | None = None
    relay: bool = True
    _features: GridFeatures | None = field(default=None, repr=False)
    _features_drift: int = 0

    @property
    def stands(self) -> bool:
        """Whether its walls stand where its transform carries them."""
        return self.accepted and self.is_steady

    @property
    def votes(self) -> bool:
        """Whether it votes."""
        return self.stands and not self.contradiction

    @property
    def is_young(self) -> bool:
        """Whether its map was begun anew and knows less than the one before did."""
        return self.walls < self.young_below

    @property
    def why(self) -> str:
        """Why it votes, or why not, one line."""
        if self.stands and self.contradiction:
            return self.contradiction
        return self.reason + (f"; {YOUNG}" if self.votes and self.is_young else "")

    def place(self, resolution: float, thresholds: NormalizeConfig, device: ComputeDevice) -> None:
        """Lay the map out at the fused resolution; before the first fusion there is none."""
        if self.grid is not None:
            self._take(lay_out(self.grid, None, resolution, thresholds, device), thresholds)
            self.relay = True

    def _take(
        self, layer: Layer, thresholds: NormalizeConfig, change: Change | None = None
    ) -> None:
        """Keep a layer; ``change`` is what it changed, so that only that is looked at."""
        self.layer = layer
        if change is not None and change.after is not None:
            self.known, self.walls = _known_after(self.known, layer, change), change.after
            return
        self.known = _known(layer, layer.box)
        occupied = math.ceil(thresholds.occupied_percent)
        self.walls = int(np.count_nonzero(layer.cells >= occupied))

    def follow(
        self,
        grid: OccupancyGrid,
        resolution: float | None,
        thresholds: NormalizeConfig,
        live: LiveConfig,
        device: ComputeDevice,
    ) -> Change | None:
        """Take a new map; return what it changed, None where that cannot be told.

        Args:
            grid: the map.
            resolution: of the fused map; None before the first fusion.
            thresholds: what is a wall, and what is free.
            live: the share of the old walls that must stand for the transform to hold.
        """
        before, walls, last = self.layer, self.walls, self.grid
        self.grid = grid
        self.maps += 1
        if resolution is None or before is None:
            if last is not None and _is_same(last, grid):
                return None
            self.version += 1
            self._features = None
            if resolution is not None:
                self.place(resolution, thresholds, device)
            return None
        layer = lay_out(grid, before.lattice, resolution, thresholds, device)
        change = compare(before, layer, walls, thresholds, device)
        if change.box is None:
            self.layer = layer
            return change
        self.version += 1
        self._take(layer, thresholds, change)
        if self.walls < ANEW_SHARE * walls:
            self.has_begun_anew = True
            self.young_below = max(self.young_below, GROWN_SHARE * walls)
        elif not self.is_young:
            self.young_below = 0.0
        self.drift += change.walls
        self._features_drift += change.walls
        self.key_drift += change.walls
        if not (change.is_steady(live.steady_share) and self._stands(thresholds, live, device)):
            self.is_steady = False
            self._features = None
        if layer.lattice != before.lattice:
            self.relay = True
        else:
            self.unlaid = change.box if self.unlaid is None else hull(self.unlaid, change.box)
        return change

    def _stands(self, thresholds: NormalizeConfig, live: LiveConfig, device: ComputeDevice) -> bool:
        """Whether the walls still stand as in the map that was last aligned."""
        if self.key is None or self.layer is None:
            return True
        if self.key_drift <= live.track_share * self.walls:
            return True
        self.key_drift = 0
        before, walls = self.key
        change = compare(before, self.layer, walls, thresholds, device)
        return change.is_steady(live.steady_share)

    def pin(self) -> None:
        """Note that the newest map was aligned."""
        self.drift = self.key_drift = 0
        self.jump = None
        self.tried = None
        if self.layer is not None:
            self.key = self.layer, self.walls

    def features(
        self,
        resolution: float,
        thresholds: NormalizeConfig,
        stale_share: float,
        device: ComputeDevice,
        cancel: CancelToken | None = None,
    ) -> GridFeatures:
        """Return what alignment looks at; that of an older map while few walls have changed.

        Raises:
            CancelledSearchError: ``cancel`` says so.
        """
        if self._features is None or self._features_drift > stale_share * self.walls:
            if self.grid is None:
                message = f"{self.name} has no map"
                raise ValueError(message)
            with watched_by(cancel):
                normalized = normalize_grid(self.grid, resolution, thresholds, device)
            self._features = GridFeatures(normalized, device)
            self._features_drift = 0
        return self._features

    def centre(self) -> tuple[float, float]:
        """Return the centre of the known box in the input's frame, metres."""
        corners = self.corners()
        x, y = corners.mean(axis=0)
        return float(x), float(y)

    def corners(self) -> npt.NDArray[np.float64]:
        """Return the corners of the known box in the input's frame, (4, 2) metres."""
        if self.layer is None or self.known is None:
            return np.zeros((4, 2))
        box, lattice = self.known, self.layer.lattice
        cells = [(x, y) for x in (box.col0, box.col1) for y in (box.row0, box.row1)]
        return lattice.origin.transform(np.array(cells, dtype=np.float64) * lattice.resolution)

    def apart(self, a: Pose2, b: Pose2) -> tuple[float, float, float]:
        """Return how far two transforms carry this map apart: centre m, turn rad, corners m."""
        turn = abs(wrap_angle(a.yaw_rad - b.yaw_rad))
        centre = math.dist(a.transform(self.centre()), b.transform(self.centre()))
        corners = a.transform(self.corners()) - b.transform(self.corners())
        return centre, turn, float(np.hypot(corners[:, 0], corners[:, 1]).max())

    def refuse(self, reason: str) -> None:
        """Let it vote no more."""
        self.accepted = False
        self.reason = reason


def refuse_all(tracks: Iterable[Track], reason: str) -> None:
    """Let none of these vote any more, for one reason."""
    for track in tracks:
        track.refuse(reason)
