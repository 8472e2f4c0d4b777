"""Which inputs of the live fusion are believed, and where: the rules that ``fusion`` states."""

from __future__ import annotations

from collections.abc import Callable

from slamfusion.align.cancel import CancelledSearchError
from slamfusion.errors import SlamFusionError
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.recovery import Anchor, align_first, believe_first, fusable, recover
from slamfusion.fusion.live.track import Track, refuse_all
from slamfusion.fusion.live.voting import FusedLayers

NEVER = float("-inf")
# A steady voter is late when the usual share has changed this many times; then it waits for others
# that are late alone, whatever comes.
LATE = 20.0


class InputSupervisor:
    """Aligns what changed and decides who votes.

    Attributes:
        tracks: the inputs by name, in the order in which they came; the owner adds and feeds them.
        reference: name of the input that others are aligned to; empty without.
        problem: why nobody votes, one line.
    """

    def __init__(self, aligner: Aligner, layers: FusedLayers) -> None:
        """Start without inputs; ``layers`` have the last fused map."""
        self.tracks: dict[str, Track] = {}
        self.reference = ""
        self.problem = "no map yet"
        self._aligner = aligner
        self._anchor = Anchor()
        self._began: tuple[float, tuple[tuple[str, int], ...]] = (NEVER, ())
        self._layers = layers

    @property
    def voters(self) -> list[Track]:
        """The inputs that vote, in order."""
        return [track for track in self.tracks.values() if track.votes]

    def align(self, now_s: float, *, is_idle: bool) -> None:
        """Align what is new, came back or changed.

        Args:
            now_s: paces the searches.
            is_idle: whether no new map waits for the answer.
        """
        self._aligner.now_s = now_s
        self._aligner.has_searched = False
        if self._aligner.lattice is None:
            self._begin()
            return
        self._anchor.note(self.tracks.values(), self._layers, self._aligner)
        if self._choose_reference():
            self._anchor.settle(self.tracks[self.reference], self.tracks.values(), self._aligner)
            self._realign(is_idle=is_idle)
        else:
            self._recover()

    # -- the first fusion -------------------------------------------------------------------------

    def _begin(self) -> None:
        """Try the first fusion, once for every new map and not too often."""
        usable = fusable(
            [t for t in self.tracks.values() if t.is_live], self._aligner.config.normalize
        )
        least = self._aligner.live.minimum_inputs
        if len(usable) < least:
            self.problem = f"waits for {least} inputs that agree, has {len(usable)}"
            refuse_all(usable, self.problem)
            return
        versions = tuple((track.name, track.version) for track in usable)
        last_s, tried = self._began
        if versions == tried or self._aligner.now_s - last_s < self._aligner.live.search_pause_s:
            return
        self._began = (self._aligner.now_s, versions)
        self._aligner.has_searched = len(usable) > 1
        try:
            group, lattice = align_first(usable, least, self._aligner)
        except SlamFusionError as error:
            self.problem = str(error)
            refuse_all(usable, self.problem)
        else:
            self.reference = group.reference
            believe_first(group, lattice, self.tracks, self._aligner)

    # -- every round after it ---------------------------------------------------------------------

    def _choose_reference(self) -> bool:
        """Keep the reference, or hand over when it must; return whether there is one."""
        # Where the poses of all contradict each other, their walls still stand: the frame holds.
        able = self.voters or [track for track in self.tracks.values() if track.stands]
        if not any(track.name == self.reference for track in able):
            if not able:
                self.reference = ""
                return False
            self._hand_over(max(able, key=lambda track: track.walls))
        reasons = [track.contradiction for track in able if track.contradiction]
        if reasons and not self.voters:
            self.problem = f"{reasons[0]}, and nobody can say who is right"
        return True

    def _hand_over(self, track: Track) -> None:
        self._anchor.hand_over(track)
        self.reference = track.name
        track.reason = "the reference"
        track.pin()

    def _realign(self, *, is_idle: bool) -> None:
        """Align what is due: doubtful inputs always, steady voters as far as time allows.

        A steady voter's transform holds meanwhile, so a large one, or one of many, waits until no
        new map does, and is given up for one that comes. Of those that are late the one that
        changed most is aligned whatever waits, one a round, so that each has its turn.
        """
        first = self.tracks[self.reference]
        due = [track for track in self.tracks.values() if self._is_due(track, first)]
        due.sort(key=lambda track: (track.votes, -track.drift))
        cells, has_late = 0, False
        for track in due:
            reference = self.tracks.get(self.reference)
            if reference is None or not reference.accepted:
                return
            if track is reference:
                continue
            own = 0 if track.layer is None else track.layer.box.area
            may_wait = track.votes and cells + own > self._aligner.live.track_cells
            is_late = track.drift > LATE * self._few(track, reference)
            if may_wait and (has_late or not is_late):
                if not (is_idle and cells == 0):
                    continue
                try:
                    self._align(track, reference, self._aligner.is_wanted)
                except CancelledSearchError:
                    return
            else:
                has_late = has_late or may_wait
                self._align_or_refuse(track, reference)
            cells += own

    def _align_or_refuse(self, track: Track, reference: Track) -> None:
        """Align an input; one that cannot be is refused by name, and the others go on."""
        try:
            self._align(track, reference)
        except (SlamFusionError, MemoryError) as error:
            track.tried = (track.version, reference.name, reference.version)
            track.refuse(f"cannot be aligned: {str(error) or type(error).__name__}")

    def _align(
        self, track: Track, reference: Track, is_wanted: Callable[[], bool] | None = None
    ) -> None:
        """Align an input to the reference: tracked, or else searched everywhere.

        Raises:
            CancelledSearchError: ``is_wanted`` answered True meanwhile; nothing was changed.
        """
        aligner, was_voting = self._aligner, track.votes
        if track.transform is not None and aligner.follow(
            track, aligner.held(reference), is_wanted
        ):
            return
        others = [other for other in self.voters if other is not reference and other is not track]
        now = (track.version, reference.name, reference.version)
        if not aligner.may_search(track):
            if not was_voting:
                track.refuse(_waits(track))
            elif track.mismatch:
                # Its walls and the reference's contradict each other: it has no vote until a
                # search, or a third, says which of them is right.
                track.refuse(_waits(track))
                self._arbitrate(track, reference, others)
            return
        if aligner.may_confirm(track):
            is_left = aligner.confirm(track, [aligner.held(one) for one in (*others, reference)])
            track.tried = None if is_left else now
            return
        # The reference may share no ground with it where another input does.
        held = [reference] if was_voting else [reference, *others]
        is_last = track.searches % len(held) == len(held) - 1
        is_done = aligner.search(track, aligner.held(held[track.searches % len(held)]))
        if not is_done:
            track.tried = None
        if track.votes or not is_done:
            return
        track.tried = now if is_last else None
        if was_voting:
            self._arbitrate(track, reference, others)

    def _arbitrate(self, track: Track, reference: Track, others: list[Track]) -> None:
        """Find who is wrong when an input that voted fits the reference no more.

        A third decides; without one what a majority or both had agreed on, see ``recovery``.
        """
        if not others:
            reference.accepted = track.accepted = False
            self._recover()
            return
        for third in others:
            if self._aligner.follow(track, self._aligner.held(third)):
                if self._aligner.fit(reference, self._aligner.held(third)) is None:
                    names = f"{third.name} and {track.name}"
                    reference.refuse(f"{names} agree with each other and not with it")
                    self._hand_over(third)
                return

    def _recover(self) -> None:
        """Go by the last fused map: no input is left to align to."""
        live = [track for track in self.tracks.values() if track.is_live]
        found = recover(live, self._aligner, self._layers)
        self.problem = self.problem if found.problem is None else found.problem
        if found.held is not None:
            self._anchor.keep(found.held)
        if found.reference is not None:
            self._hand_over(found.reference)

    def _is_due(self, track: Track, reference: Track) -> bool:
        """Whether an input has to be aligned in this round."""
        if track is reference or not track.is_live:
            return False
        if not track.accepted:
            if track.jump is not None and track.jump_version == track.version:
                return self._aligner.may_confirm(track)
            return track.tried != (track.version, reference.name, reference.version)
        return not track.is_steady or track.drift > self._few(track, reference)

    def _few(self, track: Track, reference: Track) -> float:
        """Return the changed wall cells below which nothing needs to be aligned again."""
        return self._aligner.live.track_share * min(track.walls, reference.walls)


def _waits(track: Track) -> str:
    """Return the reason of an input that has to be searched and may not be yet."""
    return "; ".join(filter(None, (track.mismatch, "waits for a full search")))
