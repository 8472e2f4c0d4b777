"""The fused layers: a fixed lattice, the cells of each input on it, and the vote.

Each input's layer is kept on the fused lattice, so a new map costs what it changed: only changed
cells are resampled and voted on again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import cv2
import numpy as np

from slamfusion.align.records import Bent
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.fusion.lattice_vote import bent_maps
from slamfusion.fusion.live.inputs import Input, Layer, Reason, carry
from slamfusion.fusion.live.state import LiveState
from slamfusion.geometry import I8, U8, Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, trinary_cells
from slamfusion.io.files import check_memory
from slamfusion.vote.lattice import Lattice
from slamfusion.vote.tiles import TileVoter, Trust, WallCounts, count_walls, trust_of
from slamfusion.vote.walls import codes_on, margin_cells

# Bytes of a fused cell with its copies, and of a cell of a layer.
CELL_BYTES, LAYER_BYTES = 6, 2
# Fused layers of at least this number of cells shrink if this share of them is enough.
SHRUNK_CELLS, SHRUNK_SHARE = 1 << 22, 0.25
# Cells between two boxes that are sooner voted on again than left out.
SPARE_CELLS = 1 << 16
# Number of voters from which a majority is more than one input.
MAJORITY = 3


@dataclass(eq=False)
class LaidInput:
    """The cells of one input on the lattice.

    Attributes:
        cells: the whole fused box, in {-1, 0, 1}.
        walls: wall codes of each cell, see ``vote.walls``.
        covered: cells of the lattice that contain every known one; None: none.
        place: lattice and transform of the layer; None: copy all of it again.
        changed: cells of the layer's lattice that changed since; None: none.
    """

    cells: I8
    walls: U8
    covered: CellBox | None = None
    place: tuple[Lattice, Pose2] | None = None
    changed: CellBox | None = None


class FusedLayers:
    """The fused cells, the layer of every input, and the vote.

    They grow by whole cells of their lattice and never move. They shrink only to a quarter or less,
    so that an input which leaves for a while does not change the published size.

    Attributes:
        config: gives the vote and its thresholds.
        live: may be replaced.
        lattice: of the fused frame; None before the first fusion.
        box: cells of the lattice that are kept; None before the first ``grow``.
        names: the last voters; ``wall_agreement`` and ``bent`` are theirs, see ``Fusion``.
        has_young: whether a map that restarted was among them.
        agreed: the fused map of the last majority, kept while fewer voters are left.
    """

    def __init__(self, config: FusionConfig, live: LiveConfig, device: ComputeDevice) -> None:
        self.config, self.live, self.device = config, live, device
        self.lattice: Lattice | None = None
        self.box: CellBox | None = None
        self.names: tuple[str, ...] = ()
        self.wall_agreement: dict[str, float] = {}
        self.bent: dict[str, Bent] = {}
        self.has_young = False
        self.agreed: OccupancyGrid | None = None
        self._laid: dict[str, LaidInput] = {}
        self._trust: Trust | None = None
        # Agreeing walls of the voters and the cells of the last vote.
        self._counts: WallCounts | None = None
        self._counted: tuple[tuple[str, ...], CellBox] | None = None
        self._fused = np.zeros((0, 0), dtype=np.int8)
        self._agreement = self._fused
        self._trinary = trinary_cells(
            np.arange(256, dtype=np.uint8).view(np.int8), config.normalize
        ).view(np.uint8)

    @property
    def fixed(self) -> Lattice:
        """The lattice, which must be fixed."""
        if self.lattice is None:
            raise ValueError("nothing was fused yet")
        return self.lattice

    @property
    def resolution(self) -> float | None:
        """Metres per fused cell; None before the first fusion."""
        return None if self.lattice is None else self.lattice.resolution

    def update(
        self, inputs: Iterable[Input], voters: Sequence[Input], reference: str
    ) -> CellBox | None:
        """Update the layers and vote on what changed; return those cells of the fused map.

        While a map that restarted is among the voters, unknown abstains by the rule ``auto``: two
        young maps know little, and would erase what the third knows. Layers of inputs that do not
        vote are removed; a voter without enough memory is rejected.
        """
        if self.lattice is None:
            return None
        grown = [self._make_room(track, reference) for track in voters]
        voters = [track for track in voters if track.votes]
        names = tuple(track.name for track in voters)
        # The fused map of a majority is kept while there are too few voters for one.
        if len(names) >= MAJORITY:
            self.agreed = None
        elif len(self.names) >= MAJORITY:
            self.agreed = self.last_fused()
        for track in inputs:
            if track.name not in names:
                self.lift(track.name)
        if self.box is None or not names:
            self.names = names
            return None
        has_shrunk = self._give_back(voters, reference)
        boxes = [part for track in voters if (part := self._lay(track)) is not None]
        before, now = (self.names, self.has_young), (names, any(t.is_young for t in voters))
        if has_shrunk or any(grown) or now != before:
            boxes = [self.box]
        self.names, self.has_young = now
        if not boxes:
            return None
        parts = [self.vote(names, part) for part in joined(boxes)]
        return reduce(CellBox.hull, parts).moved(-self.box.row0, -self.box.col0)

    def _make_room(self, track: Input, reference: str) -> bool:
        """Grow the layers to hold an input's new cells; return whether they grew."""
        needed = self._needed(track, reference)
        try:
            return needed is not None and self.grow(needed, track.name)
        except MemoryBudgetError as error:
            track.turn(Reason.REJECTED, why=error)
            return False

    def _give_back(self, voters: Sequence[Input], reference: str) -> bool:
        """Free the cells that no voter needs; return whether there were any."""
        found = [self._needed(track, reference) for track in voters]
        boxes = [box for box in found if box is not None]
        if self.box is None or self.box.area < SHRUNK_CELLS or not boxes:
            return False
        needed = reduce(CellBox.hull, boxes)
        if needed.area > SHRUNK_SHARE * self.box.area or self.box.hull(needed) != self.box:
            return False
        self._resize(needed)
        return True

    def _needed(self, track: Input, reference: str) -> CellBox | None:
        """Return the cells of the lattice that an input needs; None if it gives no extent."""
        if track.layer is None or track.layer.known is None or track.transform is None:
            return None
        if self.live.extent == "reference" and track.name != reference:
            return None
        return self.fixed.box_of(track.layer.known, track.layer.lattice, track.transform)

    def note(self, name: str, changed: CellBox | None) -> None:
        """Record the cells of an input's lattice that its new map changed."""
        laid = self._laid.get(name)
        if laid is not None and changed is not None:
            laid.changed = changed if laid.changed is None else laid.changed.hull(changed)

    def _lay(self, track: Input) -> CellBox | None:
        """Update an input's layer; return the changed cells of the lattice."""
        layer, transform, laid = track.layer, track.transform, self._laid.get(track.name)
        if layer is None or layer.known is None or transform is None:
            return None
        changed = None
        if laid is not None and laid.place == (layer.lattice, transform):
            if laid.changed is None:
                return None
            changed = laid.changed
        return self.lay(track.name, layer, transform, changed)

    def grow(self, box: CellBox, name: str) -> bool:
        """Extend the layers to a box of the lattice; return whether they grew.

        Raises:
            MemoryBudgetError: the grown layers would not fit; nothing was changed.
        """
        if self.box is not None and self.box.hull(box) == self.box:
            return False
        grown = box if self.box is None else self.box.hull(box)
        room = grown.area * (CELL_BYTES + LAYER_BYTES * len(self._laid))
        check_memory(room, f"a fused map of {grown.height} x {grown.width} cells", name)
        self._resize(grown)
        return True

    def _resize(self, box: CellBox) -> None:
        """Change the box; new cells are unknown."""
        before, self.box = self.box or CellBox(0, 0, 0, 0), box
        self._fused = box.cut(self._fused, before, UNKNOWN)
        self._agreement = box.cut(self._agreement, before, UNKNOWN)
        for laid in self._laid.values():
            laid.cells = box.cut(laid.cells, before, UNKNOWN)
            laid.walls = box.cut(laid.walls, before, 0)
            laid.covered = None if laid.covered is None else laid.covered.overlap(box)

    def restore(self, state: LiveState) -> None:
        """Start with the last fused map of an earlier run, which has no layers yet."""
        fused = cv2.LUT(state.fused.cells.view(np.uint8), self._trinary)
        self._fused = np.asarray(fused).view(np.int8)
        self._agreement = state.agreement.cells.copy()
        self.lattice, self.box = state.lattice, state.box

    def lay(
        self, name: str, layer: Layer, transform: Pose2, changed: CellBox | None
    ) -> CellBox | None:
        """Copy an input's cells onto its layer; return the cells of the lattice that it touched.

        Args:
            transform: maps the layer's frame into the fused frame, metres.
            changed: cells of the layer's lattice that changed since the last call with the same
                transform and lattice; None for all.
        """
        box = self.box
        if box is None or layer.known is None:
            raise ValueError("grow the layers before a map with known cells is laid on them")
        if name not in self._laid:
            shape = box.shape
            unknown = np.full(shape, UNKNOWN, dtype=np.int8)
            self._laid[name] = LaidInput(unknown, np.zeros(shape, dtype=np.uint8))
        laid = self._laid[name]
        before = laid.covered
        laid.place, laid.changed = (layer.lattice, transform), None
        now = self.fixed.box_of(layer.known, layer.lattice, transform).overlap(box)
        if changed is None:
            target = now
            if before is not None:
                laid.cells[before.slices(box)] = UNKNOWN
            touched = now if before is None or now is None else before.hull(now)
            touched = touched or before
        else:
            near = self.fixed.box_of(changed, layer.lattice, transform)
            target = touched = near.padded(1).overlap(box)
        laid.covered = now
        if before is not None and now is not None and changed is not None:
            laid.covered = before.hull(now)
        if target is not None:
            cells = carry(layer, transform, self.fixed, target, self.device)
            classes = np.asarray(cv2.LUT(cells.view(np.uint8), self._trinary)).view(np.int8)
            laid.cells[target.slices(box)] = classes
        if touched is not None and self.config.vote.mode == "consensus":

            def read(part: CellBox) -> I8:
                return np.ascontiguousarray(laid.cells[part.slices(box)])

            size = self.fixed.resolution
            near = touched.grown_inside(margin_cells(size), box)
            laid.walls[near.slices(box)] = codes_on(near, box, size, read)
        return touched

    def lift(self, name: str) -> None:
        """Remove an input's layer."""
        if self._laid.pop(name, None) is not None:
            self._counted = None

    def vote(self, names: Sequence[str], box: CellBox) -> CellBox:
        """Vote again on a box of the lattice inside ``box``; return the cells that were voted on.

        These are all cells if the trust in the inputs has changed.
        """
        whole = self.box
        if whole is None:
            raise ValueError("grow the layers before their cells are voted on")
        config = self.config.vote
        if self.has_young and config.unknown == "auto":
            config = replace(config, unknown="abstain")
        voter = TileVoter(whole, config, self.fixed.resolution, tuple(names))
        counts = None
        self.wall_agreement, self.bent = {}, {}
        if voter.weighs:
            all_counts = self._count(voter, box)
            trust = trust_of(voter.names, all_counts.total())
            voter = replace(voter, trust=trust)
            self.wall_agreement = voter.wall_agreement
            self.bent = bent_maps(trust, [voter.worst(whole, all_counts, trust)], self.fixed)
            is_same = trust.decides_like(self._trust)
            reach = margin_cells(voter.resolution) + (1 << voter.shift)
            box = voter.aligned(box.grown_inside(reach, whole)) if is_same else whole
            counts = all_counts.part(voter.blocks(voter.around(box), whole))
        self._trust = voter.trust
        window = voter.around(box).slices(whole)
        laid = {name: self._laid[name] for name in names}
        shown = {
            name: (own.walls if voter.weighs else own.cells)[window] for name, own in laid.items()
        }
        decided = voter.decide(box, shown, self.device, counts)
        if decided is None:
            return box
        window = box.slices(whole)
        self._fused[window] = decided.fused
        self._agreement[window] = decided.agreement
        return box

    def _count(self, voter: TileVoter, changed: CellBox) -> WallCounts:
        """Recount the walls of the blocks that changed; return the counts of all blocks."""
        whole, key = voter.whole, (voter.names, voter.whole)
        if self._counts is None or key != self._counted:
            changed = whole
        box = voter.aligned(changed.grown_inside(margin_cells(voter.resolution), whole))
        window = box.slices(whole)
        codes = [self._laid[name].walls[window] for name in voter.names]
        found = count_walls(codes, voter.shift, voter.phase(box))
        if self._counts is None or box == whole:
            self._counts = found
        else:
            kept = self._counts.part(voter.blocks(box, whole))
            for table, new in zip(kept, found, strict=True):
                table[:] = new
        self._counted = key
        return self._counts

    def last_fused(self) -> OccupancyGrid | None:
        """Return the last fused map; None before the first."""
        return None if self.box is None else self.grids()[0]

    def grids(self) -> tuple[OccupancyGrid, OccupancyGrid]:
        """Return the fused map (cells -1, 0, 100) and the agreement (0..100, -1 without votes)."""
        if self.box is None:
            raise ValueError("nothing was fused yet")
        values = np.array([FREE, OCCUPIED] + [UNKNOWN] * 254, dtype=np.int8).view(np.uint8)
        cells = np.asarray(cv2.LUT(self._fused.view(np.uint8), values)).view(np.int8)
        cells.flags.writeable = False  # a grid copies others, as the agreement
        origin = self.fixed.corner(self.box.row0, self.box.col0)
        size = self.fixed.resolution
        return (
            OccupancyGrid(cells, size, origin, "fused"),
            OccupancyGrid(self._agreement, size, origin, "agreement"),
        )


def joined(boxes: Sequence[CellBox]) -> list[CellBox]:
    """Return boxes that hold all the cells of some, joined where hardly any cell lies between."""
    out: list[CellBox] = []
    for box in boxes:
        grown = box
        # A box that took another in may reach a third one.
        while near := [
            other
            for other in out
            if grown.hull(other).area <= grown.area + other.area + SPARE_CELLS
        ]:
            for other in near:
                out.remove(other)
                grown = grown.hull(other)
        out.append(grown)
    return out
