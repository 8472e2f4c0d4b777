"""``Voting``: keeps the fused layers as the voters want them, and votes on what changed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.fusion.live.layers import FusedLayers
from slamfusion.fusion.live.state import LiveState
from slamfusion.fusion.live.track import Track
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.vote.boxes import hull, joined, moved
from slamfusion.vote.lattice import Lattice

# Voters of which two overrule one: what they say is on the fused map is agreed on by more than one.
MAJORITY = 3


class Voting:
    """Lays what changed of each voter and votes on it.

    Attributes:
        live: its ``extent`` counts; may be replaced.
        layers: None before the first fusion.
        names: who voted last.
        has_young: whether a map that began anew was among them.
        agreed: the fused map when a majority last decided, before all but two or fewer lost their
            vote; None while a majority decides, and before one ever did.
    """

    def __init__(self, config: FusionConfig, live: LiveConfig, device: ComputeDevice) -> None:
        """Start without layers; ``config`` gives the vote."""
        self.live = live
        self.layers: FusedLayers | None = None
        self.names: tuple[str, ...] = ()
        self.has_young = False
        self.agreed: OccupancyGrid | None = None
        self._config = config
        self._device = device

    @property
    def resolution(self) -> float | None:
        """Metres per fused cell; None before the first fusion."""
        return None if self.layers is None else self.layers.lattice.resolution

    @property
    def phantom_cells(self) -> int:
        """Fused walls that no voter has."""
        return 0 if self.layers is None else self.layers.phantom_cells

    def begin(self, lattice: Lattice) -> FusedLayers:
        """Begin with empty layers on a lattice."""
        self.layers = FusedLayers(lattice, self._config, self._device)
        return self.layers

    def restore(self, state: LiveState) -> None:
        """Begin with the last fused map of an earlier run, which no layer is under yet."""
        self.begin(state.lattice).restore(state.box, state.fused, state.agreement)

    def remove(self, name: str) -> None:
        """Take an input's layer away; the next vote goes without it."""
        if self.layers is not None:
            self.layers.lift(name)

    def last_fused(self) -> OccupancyGrid | None:
        """Return the last fused map; None before the first."""
        if self.layers is None or self.layers.box is None:
            return None
        return self.layers.grids()[0]

    def grids(self) -> tuple[OccupancyGrid, OccupancyGrid]:
        """Return the fused map and the agreement.

        Raises:
            ValueError: nothing was fused yet.
        """
        if self.layers is None:
            message = "nothing was fused yet"
            raise ValueError(message)
        return self.layers.grids()

    def vote(
        self, tracks: Iterable[Track], voters: Sequence[Track], reference: str
    ) -> CellBox | None:
        """Lay what changed and vote on it.

        While a map that began anew is among the voters unknown abstains by the rule ``auto``: two
        young maps know little, and would take from the robot's map what the third knows.

        Args:
            tracks: all inputs; the layers of those that do not vote are lifted.
            voters: the inputs that vote, in order; one that finds no room is refused.
            reference: name of the input that others are aligned to.

        Returns:
            Those cells of the fused map, counted from its first cell; None without any.
        """
        layers = self.layers
        if layers is None:
            return None
        grown = [self._make_room(layers, track, reference) for track in voters]
        voters = [track for track in voters if track.votes]
        names = tuple(track.name for track in voters)
        self._keep_agreed(names)
        for track in tracks:
            if track.name not in names:
                layers.lift(track.name)
                track.relay = True
        if layers.box is None or not names:
            self.names = names
            return None
        has_shrunk = self._shrink(layers, voters, reference)
        parts = [_lay(layers, track) for track in voters]
        boxes = [part for part in parts if part is not None]
        before, now = (self.names, self.has_young), (names, any(t.is_young for t in voters))
        if has_shrunk or any(grown) or now != before:
            boxes = [layers.box]
        self.names, self.has_young = now
        if not boxes:
            return None
        box, *others = (
            layers.vote(names, part, has_young=self.has_young) for part in joined(boxes)
        )
        for other in others:
            box = hull(box, other)
        return moved(box, -layers.box.row0, -layers.box.col0)

    def _keep_agreed(self, names: Sequence[str]) -> None:
        """Keep what a majority decided while fewer voters are left than make one."""
        if len(names) >= MAJORITY:
            self.agreed = None
        elif len(self.names) >= MAJORITY:
            self.agreed = self.last_fused()

    def _make_room(self, layers: FusedLayers, track: Track, reference: str) -> bool:
        """Grow the layers to hold an input's new cells; return whether they grew."""
        needed = self._needed(layers, track, reference)
        if needed is None:
            return False
        try:
            return layers.grow(needed, track.name) is not None
        except MemoryBudgetError as error:
            track.refuse(str(error))
            return False

    def _shrink(self, layers: FusedLayers, voters: Sequence[Track], reference: str) -> bool:
        """Give back what the layers hold for no voter; return whether there was any."""
        found = [self._needed(layers, track, reference) for track in voters]
        boxes = [box for box in found if box is not None]
        if not boxes:
            return False
        needed = boxes[0]
        for box in boxes[1:]:
            needed = hull(needed, box)
        return layers.shrink(needed) is not None

    def _needed(self, layers: FusedLayers, track: Track, reference: str) -> CellBox | None:
        """Return the cells of the lattice that an input needs; None where it gives no extent."""
        if track.layer is None or track.known is None or track.transform is None:
            return None
        if self.live.extent == "reference" and track.name != reference:
            return None
        return layers.lattice.box_of(track.known, track.layer.lattice, track.transform)


def _lay(layers: FusedLayers, track: Track) -> CellBox | None:
    """Lay what the layers have not seen of an input; return the cells of the lattice."""
    if track.layer is None or track.known is None or track.transform is None:
        return None
    if not track.relay and track.unlaid is None:
        return None
    changed = None if track.relay else track.unlaid
    track.relay, track.unlaid = False, None
    return layers.lay(track.name, track.layer, track.known, track.transform, changed)
