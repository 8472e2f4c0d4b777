"""One input of the live fusion: its state, the ``Layer`` of its newest map, and its transform.

``TRANSITIONS`` is the whole state machine: the next state by event and state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np

from slamfusion.align.decide import WALLS_MIN
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid, pool_cells
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.config import NormalizeConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.fusion.inputs import is_same
from slamfusion.geometry import I8, Pose2, wrap_angle
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid, implausible, known_box, row_parts
from slamfusion.io.files import check_memory
from slamfusion.vote.lattice import SAME_RESOLUTION, Lattice

# Least shares of the old walls that still stand: of all, and of those that are wall or free now.
STANDING_MIN, STEADY_SHARE = 0.4, 0.75
# Cells in which nothing lies, that a box of changes may hold for each cell of the two maps.
SPARE_SHARE = 4
NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Layer:
    """Cells on a lattice of their own frame.

    Attributes:
        cells: (H, W) int8, -1 unknown, 0..100 percent.
        lattice: on which they lie.
        box: the cells of the lattice that they are.
        known: cells of the lattice that hold every known one; None: none.
        walls: wall cells.
    """

    cells: I8
    lattice: Lattice
    box: CellBox
    known: CellBox | None
    walls: int

    @classmethod
    def of(
        cls, cells: I8, lattice: Lattice, thresholds: NormalizeConfig, row: int = 0, col: int = 0
    ) -> Layer:
        """Measure cells whose first has these indices on the lattice."""
        own = known_box(cells)
        known = None if own is None else own.moved(row, col)
        walls = int(np.count_nonzero(cells >= math.ceil(thresholds.occupied_percent)))
        return cls(cells, lattice, CellBox(0, 0, *cells.shape).moved(row, col), known, walls)

    def window(self, box: CellBox) -> I8:
        """Return the cells of a box of the lattice; unknown outside of the layer."""
        if box.overlap(self.box) == box:
            return self.cells[box.slices(self.box)]
        return box.cut(self.cells, self.box, UNKNOWN)


def lay_out(
    grid: OccupancyGrid,
    lattice: Lattice | None,
    resolution: float,
    thresholds: NormalizeConfig,
    device: ComputeDevice,
) -> Layer:
    """Return a grid as a layer of cells of the given size.

    Args:
        lattice: where this input's cells lay before; None for a new input. A grid that lies on
            none of its cells starts a lattice of its own.
        resolution: metres per cell of the layer.
        device: resamples. The nearest cell, or where the layer is coarser any wall in a cell.
    """
    own = Lattice(grid.resolution, grid.origin)
    if lattice is not None:
        before = Lattice(grid.resolution, lattice.origin)
        own = before if before.cell_of(grid) is not None else own
    row, col = own.cell_of(grid) or (0, 0)
    fused = Lattice(resolution, own.origin)
    ratio = resolution / grid.resolution
    if abs(ratio - 1.0) < SAME_RESOLUTION:
        return Layer.of(grid.cells, fused, thresholds, row, col)
    parts = max(1, int(np.ceil(ratio - 1e-9)))
    box = fused.box_of(CellBox(row, col, row + grid.height, col + grid.width), own, Pose2())
    scale = round(ratio / parts * FIXED_ONE)
    shift_x = 2 * (scale * box.col0 * parts - FIXED_ONE * col)
    shift_y = 2 * (scale * box.row0 * parts - FIXED_ONE * row)
    poses = np.array([[scale, 0, shift_x, shift_y]], dtype=np.int64)
    shape = (box.height * parts, box.width * parts)
    fine = device.download(device.warp(device.upload(grid.cells), poses, shape, UNKNOWN))[0]
    if parts > 1:
        fine = pool_cells(fine.reshape(box.height, parts, box.width, parts), thresholds)
    return Layer.of(np.ascontiguousarray(fine), fused, thresholds, box.row0, box.col0)


def carry(
    layer: Layer, transform: Pose2, lattice: Lattice, box: CellBox, device: ComputeDevice
) -> I8:
    """Return a box of a lattice from a layer, (height, width) int8, unknown outside.

    The motion, in metres, is rounded once for cell [0, 0] of both lattices and then moved by whole
    cells: a cell does not depend on the requested box, nor on how the layer grew.
    """
    away = transform.inverse()
    into = layer.lattice.origin.inverse().compose(away).compose(lattice.origin)
    size = lattice.resolution
    pose = fixed_poses((into.x / size, into.y / size, into.yaw_rad))[0]
    cos, sin = int(pose[0]), int(pose[1])
    source = layer.lattice.box_of(box, lattice, away)
    needed = source.padded(2).overlap(layer.box)
    if needed is None:
        return np.full(box.shape, UNKNOWN, dtype=np.int8)
    pose[2] += 2 * (cos * box.col0 - sin * box.row0 - FIXED_ONE * needed.col0)
    pose[3] += 2 * (sin * box.col0 + cos * box.row0 - FIXED_ONE * needed.row0)
    cells = device.upload(np.ascontiguousarray(layer.window(needed)))
    warped = device.warp(cells, pose[None], box.shape, UNKNOWN)
    return np.asarray(device.download(warped)[0])


@dataclass(frozen=True)
class Change:
    """What a new map changed.

    Attributes:
        box: cells of the lattice that hold every cell that differs; None where none does.
        walls: cells that became or ceased to be a wall.
        standing: old wall cells with a wall within one cell.
        contradicted: old wall cells that are free now, no wall within one cell.
        before: all old wall cells.
    """

    box: CellBox | None
    walls: int
    standing: int
    contradicted: int
    before: int

    def is_steady(self) -> bool:
        """Whether enough old walls still stand that the map's frame did not move."""
        # A few that stand by chance do not count if most became unknown.
        is_enough = self.standing >= max(WALLS_MIN, STANDING_MIN * self.before)
        return is_enough and self.standing >= STEADY_SHARE * (self.standing + self.contradicted)


def compare(old: Layer, new: Layer, thresholds: NormalizeConfig, device: ComputeDevice) -> Change:
    """Compare two maps of one input; one on another lattice is resampled and counts as changed."""
    walls = old.walls
    occupied = math.ceil(thresholds.occupied_percent)
    box = old.box
    if new.lattice == old.lattice:
        box = old.box.hull(new.box)
        # Of maps 10 km apart the cells between them would take gigabytes.
        if box.area <= SPARE_SHARE * (old.box.area + new.box.area):
            differs = known_box((old.window(box) != new.window(box)).view(np.int8) - np.int8(1))
            if differs is None:
                return Change(None, 0, walls, 0, walls)
            box = differs.moved(box.row0, box.col0)
        near = box.padded(1)
        if near.area > SPARE_SHARE * (old.box.area + new.box.area):
            return Change(box, walls + new.walls, 0, 0, walls)  # nothing stands
        before, after = old.window(near), new.window(near)
    else:
        before, after = old.cells, carry(new, Pose2(), old.lattice, old.box, device)
    was, now = (before >= occupied).view(np.uint8), (after >= occupied).view(np.uint8)
    gone = (was != 0) & (cv2.dilate(now, NEIGHBOURS) == 0)
    free = (after >= 0) & (after <= thresholds.free_percent)
    return Change(
        box,
        int(np.count_nonzero(was != now)),
        walls - int(np.count_nonzero(gone)),
        int(np.count_nonzero(gone & free)),
        walls,
    )


# A map with less than the first share of the previous one's walls has restarted, and is young until
# it has the second.
RESTARTED_SHARE, GROWN_SHARE = 0.5, 0.75
# An input is aligned again once this share of its wall cells has changed.
CHANGED_SHARE = 0.01


class State(Enum):
    """The state of an input; only ``TRACKED`` votes."""

    NEW = "new"  # its map, or the first since it was lost, waits to be aligned
    TRACKED = "tracked"  # its walls stand where its transform puts them
    DOUBTED = "doubted"  # scans, walls or poses contradict it, or its map cannot be used
    JUMPED = "jumped"  # a search found it elsewhere, and a second one must confirm that
    LOST = "lost"  # it is silent: no process, or no recent map


class Event(Enum):
    """What happens to an input."""

    MAP = "a usable map comes, the first or after a loss or an unusable map"
    LOSS = "its process ends, or its maps stop"
    DOUBT = "its walls moved, it does not fit where it stood, or it waits for others or a search"
    REJECTION = "it is found nowhere, contradicts two others, or its map cannot be used"
    JUMP = "a search finds it elsewhere"
    ACCEPTANCE = "its alignment is accepted"


# The next state by event and state; events that are not listed change nothing. A TRACKED input that
# scans, or without scans the poses of others, contradict is DOUBTED, see ``Input.state``.
TRANSITIONS: Mapping[Event, Mapping[State, State]] = {
    Event.MAP: dict.fromkeys((State.NEW, State.DOUBTED, State.LOST), State.NEW),
    Event.LOSS: dict.fromkeys(State, State.LOST),
    Event.DOUBT: {State.NEW: State.NEW, State.TRACKED: State.DOUBTED, State.DOUBTED: State.DOUBTED},
    Event.REJECTION: dict.fromkeys(State, State.DOUBTED),
    Event.JUMP: dict.fromkeys(State, State.JUMPED),
    Event.ACCEPTANCE: dict.fromkeys(State, State.TRACKED),
}


_JUMP = "jumped by {away_m:.2f} m and {turn_rad:.2f} rad"


class Reason(Enum):
    """Why an input is in its state: the event, and the sentence for diagnostics and page.

    ``{why}`` is the sentence of the part that decided: ``slamfusion.align`` for an alignment,
    ``unusable`` for a map, ``slamfusion.fusion.groups`` for the first fusion.
    """

    NEW = Event.MAP, "new; not aligned yet"
    GONE = Event.LOSS, "{why}"  # one of the next two
    SILENT = (
        Event.LOSS,
        "lost: its process gave no sign of life for {seconds:g} s (killed, frozen or cut off)",
    )
    UNPUBLISHED = Event.LOSS, "lost: no node publishes {topic!r} any more"
    STALE = Event.LOSS, "no map for more than {seconds:g} s"
    STALE_ONE = (
        Event.LOSS,
        f"{STALE[1]} since its only one; name a map that never changes as file:PATH in inputs",
    )
    MOVED = Event.DOUBT, "its walls moved; not aligned again yet"
    TOO_FEW = Event.DOUBT, "waits for {least} inputs that agree, has {found}"
    NO_START = Event.DOUBT, "{why}"
    WAITS = Event.DOUBT, "waits for a full search"
    MISMATCH = Event.DOUBT, "{why}; waits for a full search"
    NO_FIT = Event.DOUBT, "does not fit {other}"
    FEW_WALLS = Event.DOUBT, "{other} has too few walls to go by"
    DISPUTE = Event.DOUBT, "{names} disagree and no majority decides"
    REJECTED = Event.REJECTION, "{why}"
    NOT_ALIGNED = Event.REJECTION, "to {other}: {why}"
    FAILED = Event.REJECTION, "cannot be aligned: {why}"
    OUTVOTED = Event.REJECTION, "{names} agree with each other and not with it"
    NOT_CONFIRMED = (
        Event.REJECTION,
        f"{_JUMP}, and a second search does not find it there; waits for its next map",
    )
    JUMPED = (
        Event.JUMP,
        _JUMP + "; its next map must confirm it, or a second search after {seconds:g} s",
    )
    ALIGNED = Event.ACCEPTANCE, "{why}"
    AGREES = Event.ACCEPTANCE, "agrees with {other}"
    REFERENCE = Event.ACCEPTANCE, "the reference"
    CHANGED = Event.ACCEPTANCE, "the reference; the place is not as it was in the last fused map"
    DRAWN = Event.ACCEPTANCE, "drawn from the scans"
    # In place of those, or after them, while it votes. One whose poses contradict the scans or
    # others' has the sentence of ``jobs.live_drive`` or of ``live.poses``.
    YOUNG = Event.ACCEPTANCE, "its map restarted: what it does not know yet is no vote"
    ALONE = Event.ACCEPTANCE, "goes on alone: no other input to agree with"

    def says(self, **words: object) -> str:
        """Return the sentence, filled in."""
        return self.value[1].format(**words)


@dataclass(frozen=True)
class Fit:
    """The last alignment of an input.

    Attributes:
        is_tracked: whether the last accepted one started from the previous transform.
        mismatch: why its walls do not match; else empty.
        may_be_bent: whether it is aligned, but too much of it does not fit for a vote.
    """

    score: float = 0.0
    overlap: float = 0.0
    is_tracked: bool = False
    mismatch: str = ""
    may_be_bent: bool = False


@dataclass(frozen=True)
class Jump:
    """A search result away from the input's transform.

    Attributes:
        transform: its map frame into the fused frame there, metres.
        found_s: time of the first such result.
    """

    transform: Pose2
    version: int
    found_s: float
    messages: int = 0
    confirms: int = 0


@dataclass(eq=False)
class Input:
    """The state of one input.

    Attributes:
        thresholds, device: for its map.
        grid: its newest map; None before the first, and while that cannot be used.
        version: counts the maps that differed from the previous one.
        layer: ``grid`` at the fused resolution; None before the first fusion.
        young_below: wall cells below which a restarted map is young; 0: it is not.
        reason: why it is in its state, one line.
        transform: its map frame into the fused frame, metres; the last accepted one.
        contradiction: how scans or poses of others contradict its own; else empty.
        is_drawn: whether the map drawn from scans votes in its place.
        tried: own version, and name and version of the last failed alignment; see ``recovery`` for
            those of the last fused map.
        searched_s, searches: time and number of its searches everywhere.
        rest_s: least time after the last one before the next, seconds.
        drift: wall cells that changed, here and in the reference, since it was accepted.
    """

    name: str
    thresholds: NormalizeConfig
    device: ComputeDevice
    grid: OccupancyGrid | None = None
    version: int = 0
    layer: Layer | None = None
    young_below: float = 0.0
    reason: str = "no map yet"
    transform: Pose2 | None = None
    fit: Fit = Fit()
    contradiction: str = ""
    is_drawn: bool = False
    jump: Jump | None = None
    tried: tuple[int, str, int] | None = None
    searched_s: float = -math.inf
    searches: int = 0
    rest_s: float = 0.0
    drift: int = 0
    _state: State = State.NEW
    # Wall cells that came or went so far; the layer that was accepted last, with which walls that
    # creep a cell at a time are compared, and that count when it was; the same of the features.
    _changed: int = 0
    _key: tuple[Layer, int] | None = None
    _features: tuple[GridFeatures, int] | None = None

    # -- its state --------------------------------------------------------------------------------

    def turn(self, reason: Reason, **words: object) -> None:
        """Apply an event for a reason: the next state by ``TRANSITIONS``, and why in one line."""
        state = TRANSITIONS[reason.value[0]].get(self._state)
        if state is None:
            return
        self._state, self.reason = state, reason.says(**words)
        if state is not State.JUMPED:
            self.jump = None

    @property
    def state(self) -> State:
        """The state; DOUBTED while its poses are contradicted, although its walls stand."""
        return State.DOUBTED if self.stands and self.contradiction else self._state

    @property
    def is_live(self) -> bool:
        """Whether its newest message was a usable map, and recent."""
        return self.grid is not None and self._state is not State.LOST

    @property
    def stands(self) -> bool:
        """Whether its walls stand where its transform puts them."""
        return self._state is State.TRACKED

    @property
    def votes(self) -> bool:
        """Whether it votes."""
        return self.state is State.TRACKED

    @property
    def is_young(self) -> bool:
        """Whether its map restarted and knows less than the one before."""
        return self.walls < self.young_below

    @property
    def walls(self) -> int:
        """Wall cells of the layer."""
        return 0 if self.layer is None else self.layer.walls

    @property
    def why(self) -> str:
        """Why it votes, or why not, one line."""
        if self.stands and self.contradiction:
            return self.contradiction
        return self.reason + (f"; {Reason.YOUNG.says()}" if self.votes and self.is_young else "")

    def emptied(self) -> Input:
        """Return it without a map and a place, in the state that it has."""
        place = self.name, self.thresholds, self.device
        return Input(*place, reason=self.reason, _state=self._state)

    def refuse_map(self, why: str) -> None:
        """Stop its vote: its newest map cannot be used, and no older one counts."""
        self.grid = None
        self.turn(Reason.REJECTED, why=why)

    def accept(self, reason: Reason, **words: object) -> None:
        """Accept its newest map at its transform."""
        self.turn(reason, **words)
        self.drift, self.tried = 0, None
        if self.layer is not None:
            self._key = self.layer, self._changed

    @property
    def awaits_confirmation(self) -> bool:
        """Whether its map has not changed since a search found it elsewhere."""
        return self.jump is not None and self.jump.version == self.version

    # -- its map ----------------------------------------------------------------------------------

    def place(self, resolution: float) -> None:
        """Compute the layer at the fused resolution."""
        if self.grid is not None:
            self.layer = lay_out(self.grid, None, resolution, self.thresholds, self.device)

    def follow(self, grid: OccupancyGrid, resolution: float | None) -> Change | None:
        """Set a new map; return its changes, None if unknown.

        ``resolution`` is that of the fused map; None before the first fusion.
        """
        before, last = self.layer, self.grid
        self.grid = grid
        if self.jump is not None:
            self.jump = replace(self.jump, messages=self.jump.messages + 1)
        if resolution is None or before is None:
            if last is not None and is_same(last, grid):
                return None
            self.version += 1
            self._features = None
            if resolution is not None:
                self.place(resolution)
            return None
        layer = lay_out(grid, before.lattice, resolution, self.thresholds, self.device)
        change = compare(before, layer, self.thresholds, self.device)
        self.layer = layer
        if change.box is None:
            return change
        self.version += 1
        if self.walls < RESTARTED_SHARE * before.walls:
            self.young_below = max(self.young_below, GROWN_SHARE * before.walls)
        elif not self.is_young:
            self.young_below = 0.0
        self.drift += change.walls
        self._changed += change.walls
        if not (change.is_steady() and self._is_steady()):
            self.turn(Reason.MOVED)
            self._features = None
        return change

    def _is_steady(self) -> bool:
        """Whether the walls remain as in the map that was accepted last."""
        if self._key is None or self.layer is None:
            return True
        before, compared = self._key
        if self._changed - compared <= CHANGED_SHARE * self.walls:
            return True
        self._key = before, self._changed
        return compare(before, self.layer, self.thresholds, self.device).is_steady()

    def features(self, resolution: float) -> GridFeatures:
        """Return the alignment's features, of an older map while few walls have changed."""
        if self._features is not None:
            features, changed = self._features
            is_like = features.grid.grid.resolution == resolution
            if is_like and self._changed - changed <= CHANGED_SHARE * self.walls:
                return features
        if self.grid is None:
            raise ValueError(f"{self.name} has no map")
        normalized = normalize_grid(self.grid, resolution, self.thresholds, self.device)
        features = GridFeatures(normalized, self.device)
        self._features = features, self._changed
        return features

    def release(self) -> bool:
        """Release the features if the next alignment is likely to need those of another map.

        Returns whether there were any.
        """
        is_released = self.is_drawn and self._features is not None
        if is_released:
            self._features = None
        return is_released

    def apart(self, a: Pose2, b: Pose2) -> tuple[float, float, float]:
        """Return the difference of two transforms of this map: centre m, turn rad, corners m."""
        own = np.zeros((4, 2))  # corners of the known box in the input's frame
        if self.layer is not None and (box := self.layer.known) is not None:
            cells = [(x, y) for x in (box.col0, box.col1) for y in (box.row0, box.row1)]
            lattice = self.layer.lattice
            own = lattice.origin.transform(np.array(cells, dtype=np.float64) * lattice.resolution)
        corners = a.transform(own) - b.transform(own)
        centre = own.mean(axis=0)
        away_m = math.dist(a.transform(centre), b.transform(centre))
        turn_rad = abs(wrap_angle(a.yaw_rad - b.yaw_rad))
        return away_m, turn_rad, float(np.hypot(corners[:, 0], corners[:, 1]).max())


# Most steps from free to wall between neighbouring cells, per known cell: recorded and drawn maps
# have 0.21 at most, noise 0.50 or more.
STEPS_MAX = 0.4
# Least share of such steps per wall cell; a map that is all occupied has none.
EDGE_MIN = 0.001
# Free cells per wall cell below which a map has walls only; unknown then counts as free.
FREE_MIN = 0.01
# Metres from corner to corner.
LENGTH_MAX_M = 1e6
# Memory of the working copies of one map, bytes per cell, and the cells from which it is checked.
INPUT_BYTES = 12
CHECKED_CELLS = 1 << 22


def unusable(grid: OccupancyGrid, thresholds: NormalizeConfig) -> str | None:
    """Return why a map cannot take part, or None.

    Reasons are implausible numbers (``grid.implausible``), too few walls, noise (free and wall
    cells alternate), or a map that is all occupied.
    """
    reason = implausible(grid.resolution, grid.origin)
    if reason is not None:
        return reason
    length = math.hypot(grid.height, grid.width) * grid.resolution
    if length > LENGTH_MAX_M:
        return f"a map must be at most {LENGTH_MAX_M:g} m long, found {length:g} m"
    occupied = math.ceil(thresholds.occupied_percent)
    # Steps are pairs of neighbours, one a wall and one not, or one free.
    walls = free = steps = to_free = 0
    for rows in row_parts(grid.cells.shape):
        part = grid.cells[rows]
        is_wall, is_free = part >= occupied, (part >= 0) & (part <= thresholds.free_percent)
        walls += int(np.count_nonzero(is_wall))
        free += int(np.count_nonzero(is_free))
        for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            steps += int(np.count_nonzero(is_wall[a] != is_wall[b]))
            both = (is_wall[a] & is_free[b]) | (is_free[a] & is_wall[b])
            to_free += int(np.count_nonzero(both))
    if walls < WALLS_MIN:
        size = f"{grid.height} x {grid.width}"
        if int(grid.cells.max()) < 0:
            return f"all {size} cells are unknown"
        return f"too few walls to judge: {walls} of the {WALLS_MIN} needed, on {size} cells"
    known = walls + free
    if free < FREE_MIN * walls:
        known, to_free = grid.cells.size, steps
    if to_free < max(WALLS_MIN, EDGE_MIN * walls):
        return (
            f"says nothing of a place: only {to_free} sides of its {walls} occupied cells border "
            "on other cells; too few walls yet, or is it all occupied?"
        )
    if to_free > STEPS_MAX * known:
        return (
            f"says nothing of a place: {to_free / known:.2f} steps from free to wall per known "
            f"cell, where maps have {STEPS_MAX:g} at most; is it noise?"
        )
    return None


def too_large(grid: OccupancyGrid, resolution: float) -> str | None:
    """Return why memory cannot hold a map at a resolution (m per cell), or None."""
    cells = int(grid.height * grid.width * max(1.0, (grid.resolution / resolution) ** 2))
    if cells <= CHECKED_CELLS:
        return None
    try:
        what = f"a map of {grid.height} x {grid.width} cells"
        check_memory(INPUT_BYTES * cells, what, grid.name)
    except MemoryBudgetError as error:
        return str(error)
    return None
