"""Hold the fused frame by the last fused map until the maps that took over have outgrown it.

Inputs that come back, or begin anew, are young, and a young map straightens while it grows: what it
draws far from where it began is then off by more and more. So where one is the reference it is laid
onto that fused map again as it grows, and all that stand with it are carried along.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.fusion.live.align import Aligner, Held
from slamfusion.fusion.live.limits import unusable
from slamfusion.fusion.live.track import GROWN_SHARE, Track
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid

LAST_FUSED = "the last fused map"

# The reference is laid onto the last fused map again when it has this many times the walls.
GROWTH = 1.2
CHANGED = "the place is not as it was in the last fused map"


class Anchor:
    """The last fused map from before inputs came back, for as long as it knows more than they do.

    Attributes:
        held: that map; None where there is none, or it is outgrown.
    """

    def __init__(self) -> None:
        """Start without one."""
        self.held: Held | None = None
        # The last fused map from before an input began anew.
        self._before: Held | None = None
        self._laid: tuple[str, int] = ("", 0)

    @property
    def walls(self) -> int:
        """Wall cells of the map."""
        return 0 if self.held is None else self.held.walls

    def keep(self, held: Held) -> None:
        """Take the last fused map that inputs came back by, unless a fuller one is held."""
        if held.walls > self.walls:
            self.held, self._laid = held, ("", 0)

    def note(
        self, tracks: Collection[Track], fused: Callable[[], OccupancyGrid | None], aligner: Aligner
    ) -> None:
        """Remember the last fused map when an input begins anew, until all have outgrown it.

        With it goes what it alone, or with one other, knew: a majority of young maps knows little.

        Args:
            tracks: all inputs.
            fused: gives the last fused map; asked for only where it is needed.
            aligner: knows what is a wall.
        """
        has_begun = any(track.has_begun_anew for track in tracks)
        for track in tracks:
            track.has_begun_anew = False
        if has_begun and self._before is None:
            self._before = hold_map(fused(), LAST_FUSED, aligner)
        elif self._before is not None:
            standing = [track.walls for track in tracks if track.stands]
            if standing and min(standing) >= GROWN_SHARE * self._before.walls:
                self._before = None

    def hand_over(self, reference: Track) -> None:
        """Hold that map while an input that knows less takes over.

        Args:
            reference: the input that others are aligned to from now on.
        """
        before = self._before
        if before is not None and reference.walls < GROWN_SHARE * before.walls:
            self.keep(before)

    def settle(self, reference: Track, tracks: Iterable[Track], aligner: Aligner) -> None:
        """Lay the reference onto the map again if it has grown, and carry along who stands with it.

        One that fits there no more is searched on the whole map, in two ways: a young map may have
        been believed in the wrong place, and others with it. Where it is not found it stays, since
        the place may have changed, and says so.

        Args:
            reference: the input that others are aligned to.
            tracks: all inputs.
            aligner: tracks and searches the reference.
        """
        name, walls = self._laid
        if self.held is None or (reference.name == name and reference.walls < GROWTH * walls):
            return
        last, told = reference.transform, (reference.score, reference.overlap)
        if last is None:
            return
        fit = aligner.fit(reference, self.held)
        if fit is None and not aligner.may_search(reference):
            return  # with one of its next maps
        moved, is_done = (fit[1], True) if fit else _found(reference, self.held, aligner)
        reference.mismatch, (reference.score, reference.overlap) = "", told
        if not is_done:
            return
        self._laid = (reference.name, reference.walls)
        reference.reason = "the reference" + ("" if moved else f"; {CHANGED}")
        if moved and aligner.is_worth_a_move(reference, last, moved):
            correction = moved.compose(last.inverse())
            for track in tracks:
                if track.stands and track.transform is not None:
                    track.transform = correction.compose(track.transform)
                    track.relay = True
        if reference.walls >= GROWN_SHARE * self.walls:
            self.held = None


def hold_map(fused: OccupancyGrid | None, name: str, aligner: Aligner) -> Held | None:
    """Return a fused map as something to align to; None without walls."""
    if fused is None or unusable(fused, aligner.config.normalize) is not None:
        return None
    thresholds, device = aligner.config.normalize, aligner.device
    normal = normalize_grid(fused, fused.resolution, thresholds, device)
    return Held(name, IDENTITY, GridFeatures(normal, device))


def _found(reference: Track, held: Held, aligner: Aligner) -> tuple[Pose2 | None, bool]:
    """Return where a whole map has an input, if anywhere, and whether the search ended."""
    moved: list[Pose2] = []
    for is_swapped in (False, True):
        pair = aligner.searched(reference, held, is_swapped=is_swapped)
        if pair is None:
            return None, False
        if not pair.accepted:
            return None, True
        moved.append(held.transform.compose(pair.transform))
    return (None if aligner.is_jump(reference, *moved) else moved[0]), True
