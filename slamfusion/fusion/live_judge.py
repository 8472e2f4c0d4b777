"""Which inputs of the live fusion are believed, and where: the rules that ``live`` states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

from slamfusion.compute import Backend
from slamfusion.config import FusionConfig, LiveConfig
from slamfusion.errors import SlamFusionError
from slamfusion.fusion.align import align_features, track_features
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.live_canvas import Lattice
from slamfusion.fusion.live_input import Track, unusable
from slamfusion.fusion.live_pause import Pausable, PausedError
from slamfusion.fusion.normalize import common_resolution, normalize_grid
from slamfusion.fusion.pipeline import AlignedGroup, align_group
from slamfusion.fusion.records import Alignment
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid

__all__ = ["Judge"]

LAST_FUSED = "the last fused map"
NEVER = float("-inf")
# A steady voter is aligned again, whatever waits, when so many times the usual share has changed.
LATE = 20.0


@dataclass(frozen=True, eq=False)
class _Held:
    """What an input is aligned to: another input, or the last fused map."""

    name: str
    transform: Pose2
    features: GridFeatures


class Judge:
    """Aligns what changed and decides who votes.

    Attributes:
        tracks: the inputs by name, in the order in which they came; the owner adds and feeds them.
        lattice: of the fused frame; None before the first fusion.
        reference: name of the input that others are aligned to; empty without.
        problem: why nobody votes, one line.
        has_searched: whether the last round searched an input everywhere.
    """

    def __init__(self, config: FusionConfig, live: LiveConfig, backend: Backend) -> None:
        """Start without inputs; proofs are left out, they take seconds."""
        self.tracks: dict[str, Track] = {}
        self.lattice: Lattice | None = None
        self.reference = ""
        self.problem = "no map yet"
        self.has_searched = False
        self._config = replace(config, align=replace(config.align, prove=False))
        self._live = live
        self._pausable = Pausable(backend)
        self._backend = cast("Backend", self._pausable)
        # What the search, or the first fusion, gave for a pair.
        self._scores: dict[frozenset[str], float] = {}
        self._began: tuple[float, tuple[tuple[str, int], ...]] = (NEVER, ())
        self._now_s = 0.0
        self._fused: Callable[[], OccupancyGrid | None] | None = None
        self._is_wanted: Callable[[], bool] | None = None

    def configure(self, live: LiveConfig) -> None:
        """Take other settings for what comes."""
        self._live = live

    @property
    def voters(self) -> list[Track]:
        """The inputs that vote, in order."""
        return [track for track in self.tracks.values() if track.votes]

    def judge(
        self,
        now_s: float,
        fused: Callable[[], OccupancyGrid | None],
        *,
        is_idle: bool,
        is_wanted: Callable[[], bool] | None = None,
    ) -> None:
        """Align what is new, came back or changed.

        Args:
            now_s: paces the searches.
            is_idle: whether no new map waits for the answer.
            fused: gives the last fused map; asked for only when no input is left to align to.
            is_wanted: asked while steady voters are aligned that no map waits for; True: give up.
        """
        self._now_s, self._fused, self._is_wanted = now_s, fused, is_wanted
        self.has_searched = False
        if self.lattice is None:
            self._begin()
        elif self._choose_reference():
            self._realign(is_idle=is_idle)
        else:
            self._recover()

    # -- the first fusion -------------------------------------------------------------------------

    def _begin(self) -> None:
        """Try the first fusion, once for every new map and not too often."""
        usable = [track for track in self.tracks.values() if track.is_live]
        least = self._live.minimum_inputs
        if len(usable) < least:
            self._doubt(usable, f"waits for {least} inputs that agree, has {len(usable)}")
            return
        versions = tuple((track.name, track.version) for track in usable)
        last_s, tried = self._began
        if versions == tried or self._now_s - last_s < self._live.search_pause_s:
            return
        self._began = (self._now_s, versions)
        self.has_searched = len(usable) > 1
        thresholds = self._config.normalize
        resolution = common_resolution([t.grid for t in usable if t.grid is not None], thresholds)
        features = {t.name: t.features(resolution, thresholds, -1.0, self._backend) for t in usable}
        try:
            group = align_group(features, {}, self._config, self._backend, list(features))
        except SlamFusionError as error:
            self._doubt(usable, str(error))
            return
        if len(group.alignments) < least:
            self._doubt(usable, f"{len(group.alignments)} of the {least} inputs needed agree")
            return
        base = features[group.reference].grid.grid
        self._fix(group, Lattice(base.resolution, base.origin))

    def _fix(self, group: AlignedGroup, lattice: Lattice) -> None:
        """Fix the fused frame, and let the group vote."""
        self.lattice, self.reference = lattice, group.reference
        for track in self.tracks.values():
            track.place(lattice.resolution, self._config.normalize, self._backend)
        for name, pair in group.alignments.items():
            self._believe(self.tracks[name], pair.transform, pair, is_tracked=False)
        for pair in group.pairs:
            if pair.accepted:
                self._scores[frozenset((pair.reference, pair.moving))] = pair.score
        for name, (reason, shown) in group.left_out.items():
            track = self.tracks[name]
            track.refuse(reason)
            if shown is not None:
                track.score, track.overlap = shown.score, shown.overlap

    # -- every round after it ---------------------------------------------------------------------

    def _choose_reference(self) -> bool:
        """Keep the reference, or hand over when it must; return whether there is one."""
        voters = self.voters
        if not any(track.name == self.reference for track in voters):
            if not voters:
                self.reference = ""
                return False
            self._hand_over(max(voters, key=lambda track: track.walls))
        return True

    def _hand_over(self, track: Track) -> None:
        self.reference = track.name
        track.reason = "the reference"
        track.pin()

    def _realign(self, *, is_idle: bool) -> None:
        """Align what is due: doubtful inputs always, steady voters as far as time allows.

        A steady voter's transform holds meanwhile, so a large one waits until no new map does, and
        is given up for one that comes.
        """
        due = [track for track in self.tracks.values() if self._is_due(track)]
        due.sort(key=lambda track: (track.votes, -track.drift))
        cells = 0
        for track in due:
            reference = self.tracks.get(self.reference)
            if reference is None or not reference.accepted:
                return
            if track is reference:
                continue
            own = 0 if track.sheet is None else track.sheet.box.area
            may_wait = track.votes and cells + own > self._live.track_cells
            if may_wait and track.drift <= LATE * self._few(track, reference):
                if not (is_idle and cells == 0):
                    continue
                try:
                    self._align(track, reference, self._is_wanted)
                except PausedError:
                    return
            else:
                self._align(track, reference)
            cells += own

    def _few(self, track: Track, reference: Track) -> float:
        """Return the changed wall cells below which nothing needs to be aligned again."""
        return self._live.track_share * min(track.walls, reference.walls)

    def _is_due(self, track: Track) -> bool:
        """Whether an input has to be aligned in this round."""
        reference = self.tracks[self.reference]
        if track is reference or not track.is_live:
            return False
        if not track.accepted:
            return track.tried != (track.version, reference.name, reference.version)
        return not track.is_steady or track.drift > self._few(track, reference)

    def _align(
        self, track: Track, reference: Track, is_wanted: Callable[[], bool] | None = None
    ) -> None:
        """Align an input to the reference: tracked, or else searched everywhere.

        Raises:
            PausedError: ``is_wanted`` answered True while it was tracked; nothing was changed.
        """
        was_voting = track.votes
        if track.transform is not None:
            with self._pausable.until(is_wanted):
                is_followed = self._follow(track, self._held(reference))
            if is_followed:
                return
        if not self._may_search(track):
            if not was_voting:
                track.refuse("waits for a full search")
            return
        # The reference may share no ground with it where another input does.
        others = [other for other in self.voters if other is not reference and other is not track]
        held = [reference] if was_voting else [reference, *others]
        is_last = track.searches % len(held) == len(held) - 1
        self._search(track, self._held(held[track.searches % len(held)]))
        if track.votes:
            return
        track.tried = (track.version, reference.name, reference.version) if is_last else None
        if was_voting:
            self._arbitrate(track, reference, others)

    def _arbitrate(self, track: Track, reference: Track, others: list[Track]) -> None:
        """Find who is wrong when an input that voted fits the reference no more.

        A third decides; without one the last fused map, on which both had agreed.
        """
        if not others:
            reference.accepted = track.accepted = False
            self._recover()
            return
        for third in others:
            if self._follow(track, self._held(third)):
                if self._fit(reference, self._held(third)) is None:
                    names = f"{third.name} and {track.name}"
                    reference.refuse(f"{names} agree with each other and not with it")
                    self._hand_over(third)
                return

    def _doubt(self, tracks: list[Track], problem: str) -> None:
        """Let none of these vote, for one reason."""
        self.problem = problem
        for track in tracks:
            track.refuse(problem)

    # -- when no input is left to align to --------------------------------------------------------

    def _recover(self) -> None:
        """Go by the last fused map.

        Inputs that fit it and each other come back together; one that fits it, when no other
        does. Those that fit it and not each other stay in doubt. One that does not is searched.
        """
        live = [track for track in self.tracks.values() if track.is_live]
        names = "/".join(track.name for track in live)
        if not live:
            self.problem = "no input is left"
            return
        if all(track.tried == (track.version, names, -1) for track in live):
            return
        last = self._last_fused()
        if last is None:
            self._doubt(live, f"{LAST_FUSED} has too few walls to go by")
            return
        for track in live:
            track.tried = (track.version, names, -1)
            track.accepted = False
        found = {
            track.name: fit
            for track in live
            if track.transform is not None and (fit := self._fit(track, last)) is not None
        }
        group = self._largest_group([self.tracks[name] for name in found])
        if len(group) == 1 and len(found) > 1:
            self._doubt(live, f"{', '.join(found)} disagree and nobody can say who is right")
            return
        for track in group:
            pair, moved = found[track.name]
            self._believe(track, moved, pair, is_tracked=True)
        for track in live:
            if group and track not in group:
                track.refuse(f"does not fit {LAST_FUSED}")
        if group:
            self._hand_over(max(group, key=lambda track: track.walls))
        else:
            self._search_by(last, live)

    def _search_by(self, last: _Held, live: list[Track]) -> None:
        """Search the input that waited longest on the last fused map."""
        chosen = min(live, key=lambda track: track.searched_s)
        for track in live:
            if track.jump is None:
                track.refuse(f"does not fit {LAST_FUSED}")
        self.problem = f"no input fits {LAST_FUSED}"
        if self._may_search(chosen):
            self._search(chosen, last)
        if any(self._now_s - t.searched_s >= self._live.search_pause_s for t in live):
            for track in live:
                track.tried = None

    def _largest_group(self, tracks: list[Track]) -> list[Track]:
        """Return the most inputs that fit one of them where they stand, that one first."""
        best: list[Track] = []
        for seed in tracks:
            others = [t for t in tracks if t is not seed and self._fit(t, self._held(seed))]
            if len(others) >= len(best):
                best = [seed, *others]
        return best

    # -- one input --------------------------------------------------------------------------------

    def _features(self, track: Track) -> GridFeatures:
        return track.features(
            self._fixed().resolution, self._config.normalize, self._live.track_share, self._backend
        )

    def _held(self, track: Track) -> _Held:
        return _Held(track.name, track.transform or IDENTITY, self._features(track))

    def _fixed(self) -> Lattice:
        if self.lattice is None:
            message = "nothing was fused yet"
            raise ValueError(message)
        return self.lattice

    def _last_fused(self) -> _Held | None:
        """Return the last fused map as something to align to; None without walls."""
        fused = None if self._fused is None else self._fused()
        if fused is None or unusable(fused, self._config.normalize) is not None:
            return None
        normal = normalize_grid(fused, fused.resolution, self._config.normalize, self._backend)
        return _Held(LAST_FUSED, IDENTITY, GridFeatures(normal, self._backend))

    def _follow(self, track: Track, held: _Held) -> bool:
        """Track an input from its last transform and believe it where it still fits."""
        fit = self._fit(track, held)
        if fit is not None:
            self._believe(track, fit[1], fit[0], is_tracked=True)
        return fit is not None

    def _fit(self, track: Track, held: _Held) -> tuple[Alignment, Pose2] | None:
        """Track an input from its last transform; None where it fits there no more."""
        last = track.transform or IDENTITY
        start = held.transform.inverse().compose(last)
        pair = track_features(held.features, self._features(track), self._backend, start)
        track.score, track.overlap = pair.score, pair.overlap
        moved = held.transform.compose(pair.transform)
        searched = self._scores.get(frozenset((track.name, held.name)))
        is_good = pair.accepted
        if searched is not None:
            is_good = pair.score >= self._live.search_share * searched
        return (pair, moved) if is_good and not self._is_jump(track, last, moved) else None

    def _may_search(self, track: Track) -> bool:
        """Whether it may be searched everywhere now: one an update, each not too often."""
        pause = self._live.search_pause_s
        return not self.has_searched and self._now_s - track.searched_s >= pause

    def _search(self, track: Track, held: _Held) -> None:
        """Search an input everywhere and believe, doubt or refuse what is found."""
        self.has_searched = True
        track.searched_s = self._now_s
        track.searches += 1
        last, jump = track.transform, track.jump
        # Where a place looks alike from two sides, the side of the last transform is believed.
        start = None if last is None else held.transform.inverse().compose(last)
        config = self._config.align
        pair = align_features(held.features, self._features(track), config, self._backend, start)
        moved = held.transform.compose(pair.transform)
        track.score, track.overlap = pair.score, pair.overlap
        if not pair.accepted:
            track.jump = None
            track.refuse(f"to {held.name}: {pair.reason}")
        elif (
            last is None
            or not self._is_jump(track, last, moved)
            or (
                jump is not None
                and track.jump_version != track.version
                and not self._is_jump(track, jump, moved)
            )
        ):
            self._scores[frozenset((track.name, held.name))] = pair.score
            self._believe(track, moved, pair, is_tracked=False)
        else:
            away, turn, _ = track.apart(last, moved)
            track.jump, track.jump_version = moved, track.version
            track.refuse(f"jumped by {away:.2f} m and {turn:.2f} rad; its next map must confirm it")

    def _is_jump(self, track: Track, a: Pose2, b: Pose2) -> bool:
        centre, turn, _ = track.apart(a, b)
        return centre > self._live.jump_m or turn > self._live.jump_rad

    def _believe(self, track: Track, moved: Pose2, pair: Alignment, *, is_tracked: bool) -> None:
        """Let an input vote, at its old transform where the new one is nearly the same."""
        hold_m = self._live.hold_cells * self._fixed().resolution
        if track.transform is None or track.apart(track.transform, moved)[2] >= hold_m:
            track.transform = moved
            track.relay = True
        track.score, track.overlap = pair.score, pair.overlap
        track.is_tracked = is_tracked
        track.reason = "the reference" if track.name == self.reference else pair.reason
        track.accepted = track.is_steady = True
        track.pin()
