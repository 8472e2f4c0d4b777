"""Align one input of the live fusion: track it, search it, confirm a jump."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from slamfusion.align.align import align_pair, track_pair
from slamfusion.align.decide import SAME_TIME_SHARE, DecisionKind, decide_mirrored
from slamfusion.align.features import GridFeatures
from slamfusion.align.hypotheses import mirror_gain
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.starts import StartPose, Starts
from slamfusion.fusion.live.inputs import Fit, Input, Jump, Reason
from slamfusion.fusion.live.voting import FusedLayers
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY

# Transforms with a greater turn between them are two places, as with ``live.jump_m``.
JUMP_RAD = 0.05
# A transform that moves every corner of an input by fewer cells is left as it was.
HOLD_CELLS = 0.6


class LastSearch(NamedTuple):
    """The result of the search, or the first fusion, for a pair.

    Attributes:
        score: of all walls of both maps; it falls where the maps grow apart.
        share: of the common walls that it explained; 1 if unknown.
    """

    score: float
    share: float = 1.0


def explained(pair: Alignment) -> float:
    """Return the share of the common walls that a pair explains."""
    return 0.0 if pair.evidence is None else pair.evidence.share


# New walls that fit worse than this share of the search's result may be mirrored.
MIRROR_SHARE = 0.9
# Further messages after which an unchanged map that jumped is examined again.
CONFIRM_MAPS = 2
# Decisions that a mirrored map may cause.
MAY_BE_IMAGE: tuple[DecisionKind, ...] = ("ambiguous", "different place", "bent")
# A longer search without a result is followed by a pause this many times as long, so that one bad
# map does not block the others.
LONG_S, REST = 1.0, 4.0


@dataclass(frozen=True, eq=False)
class AnchorMap:
    """What an input is aligned to: another input, or the last fused map."""

    name: str
    transform: Pose2
    features: GridFeatures

    @property
    def walls(self) -> int:
        """Wall cells of its map."""
        return len(self.features.wall_points)


class Aligner:
    """Aligns inputs, one at a time, and keeps the search results.

    Attributes:
        layers: the fused frame, with the settings.
        has_searched: whether this round searched an input everywhere.
        starts: where inputs are expected until they have a place in the fused frame.
    """

    def __init__(self, layers: FusedLayers, starts: Starts) -> None:
        self.layers, self.starts = layers, starts
        self.has_searched = False
        self.now_s = 0.0
        self._found: dict[frozenset[str], LastSearch] = {}

    # -- what is aligned --------------------------------------------------------------------------

    def features(self, track: Input) -> GridFeatures:
        """Return the features of an input's map."""
        return track.features(self.layers.fixed.resolution)

    def held(self, track: Input) -> AnchorMap:
        """Return an input as an anchor for others."""
        return AnchorMap(track.name, track.transform or IDENTITY, self.features(track))

    def note(self, pair: Alignment) -> None:
        """Keep the search result of a pair."""
        self._found[frozenset((pair.reference, pair.moving))] = LastSearch(
            pair.score, explained(pair)
        )

    @property
    def scores(self) -> dict[frozenset[str], float]:
        """The scores of the searches, by the names of the pair."""
        return {pair: found.score for pair, found in self._found.items()}

    def restore(self, scores: Mapping[frozenset[str], float]) -> None:
        """Restore the search scores of an earlier run; shares start at 1."""
        self._found = {pair: LastSearch(score) for pair, score in scores.items()}

    def remove(self, name: str) -> None:
        """Forget the search results of an input."""
        self._found = {pair: found for pair, found in self._found.items() if name not in pair}

    # -- tracking ---------------------------------------------------------------------------------

    def follow(self, track: Input, held: AnchorMap) -> bool:
        """Track an input from its last transform and accept it where it still fits."""
        fit = self.fit(track, held)
        if fit is None:
            return False
        pair, moved = fit
        names = frozenset((track.name, held.name))
        found = self._found.get(names)
        may_be_mirrored = found is None or pair.score < MIRROR_SHARE * found.score
        if may_be_mirrored and not track.stands and self._is_mirrored(track, held, pair):
            return False
        if found is not None:
            self._found[names] = found._replace(score=min(found.score, pair.score))
        self.accept(track, moved, pair, is_tracked=True)
        return True

    def fit(self, track: Input, held: AnchorMap) -> tuple[Alignment, Pose2] | None:
        """Track an input from its last transform; None (and ``fit.mismatch``) if it fails."""
        last = track.transform or IDENTITY
        start = held.transform.inverse().compose(last)
        pair = track_pair(Pair(held.features, self.features(track)), start)
        moved = held.transform.compose(pair.transform)
        found = self._found.get(frozenset((track.name, held.name)))
        # A map may bend as it grows, so it may explain much less than when it was searched.
        lasting = 0.0 if found is None else self.layers.live.search_share * found.share
        is_good = pair.accepted and explained(pair) >= lasting
        mismatch = "" if pair.accepted else _not_aligned(held, pair.reason)
        track.fit = Fit(
            pair.score, pair.overlap, track.fit.is_tracked, mismatch, pair.decision == "bent"
        )
        return (pair, moved) if is_good and not self.is_jump(track, last, moved) else None

    # -- searching --------------------------------------------------------------------------------

    def may_search(self, track: Input) -> bool:
        """Whether it may be searched everywhere now: one per update, each not too often."""
        pause = max(self.layers.live.search_pause_s, track.rest_s)
        return not self.has_searched and self.now_s - track.searched_s >= pause

    def search(self, track: Input, held: AnchorMap) -> None:
        """Search an input everywhere and accept, doubt or reject the result."""
        pair = self.searched(track, held)
        last, jump = track.transform, track.jump
        moved = held.transform.compose(pair.transform)
        track.fit = replace(track.fit, score=pair.score, overlap=pair.overlap)
        if not pair.accepted:
            track.fit = replace(track.fit, mismatch=_not_aligned(held, pair.reason))
            track.turn(Reason.NOT_ALIGNED, other=held.name, why=pair.reason)
            return
        is_again = jump is not None and not self.is_jump(track, jump.transform, moved)
        is_found_again = is_again and not track.awaits_confirmation
        if last is None or is_found_again or not self.is_jump(track, last, moved):
            self._accept_searched(track, held, pair, moved)
            return
        if jump is None or not is_again:
            jump = Jump(moved, track.version, self.now_s)
        track.jump = replace(jump, transform=moved, version=track.version, confirms=0)
        away_m, turn_rad, _ = track.apart(last, moved)
        wait_s = self.layers.live.confirm_s
        track.turn(Reason.JUMPED, away_m=away_m, turn_rad=turn_rad, seconds=wait_s)

    def _accept_searched(
        self, track: Input, held: AnchorMap, pair: Alignment, moved: Pose2
    ) -> None:
        """Accept what a search found, and keep what it gave."""
        self.note(replace(pair, reference=held.name, moving=track.name))
        self.accept(track, moved, pair, is_tracked=False)

    def may_confirm(self, track: Input) -> bool:
        """Whether an unchanged map that jumped has waited long enough."""
        jump = track.jump
        return (
            jump is not None
            and track.awaits_confirmation
            and (
                self.now_s - jump.found_s >= self.layers.live.confirm_s
                or jump.messages >= CONFIRM_MAPS
            )
        )

    def confirm(self, track: Input, candidates: Sequence[AnchorMap]) -> bool:
        """Search a jump of an unchanged map again in another way; return whether any is left.

        Against the first untried candidate; against the last, which found it, with the roles
        swapped, so that other points and another lattice of shifts and turns are used.
        """
        jump = track.jump
        if jump is None:
            return False
        index = min(jump.confirms, len(candidates) - 1)
        held, is_last = candidates[index], index == len(candidates) - 1
        pair = self.searched(track, held, is_swapped=is_last)
        moved = held.transform.compose(pair.transform)
        track.jump = replace(jump, confirms=jump.confirms + 1)
        if pair.accepted and not self.is_jump(track, jump.transform, moved):
            self._accept_searched(track, held, pair, moved)
        elif is_last:
            away_m, turn_rad, _ = track.apart(track.transform or IDENTITY, jump.transform)
            track.turn(Reason.NOT_CONFIRMED, away_m=away_m, turn_rad=turn_rad)
        return not is_last

    def searched(self, track: Input, held: AnchorMap, *, is_swapped: bool = False) -> Alignment:
        """Search an input everywhere."""
        self.has_searched = True
        track.searched_s = self.now_s
        start = self._expected(track, held)
        own, began_s = self.features(track), time.perf_counter()
        sides, where = Pair(held.features, own), start
        if is_swapped:
            sides = Pair(own, held.features)
            where = None if start is None else start.inverse()
        pair = align_pair(
            sides, self.layers.config.align, where, thorough=False, image_after=MAY_BE_IMAGE
        )
        track.searches += 1
        if is_swapped:
            pair = replace(pair, transform=pair.transform.inverse())
        spent_s = time.perf_counter() - began_s
        track.rest_s = 0.0 if pair.accepted or spent_s < LONG_S else REST * spent_s
        return pair

    def is_jump(self, track: Input, a: Pose2, b: Pose2) -> bool:
        """Whether two transforms of an input's map are too far apart to be one place."""
        centre, turn, _ = track.apart(a, b)
        return centre > self.layers.live.jump_m or turn > JUMP_RAD

    def is_worth_a_move(self, track: Input, a: Pose2, b: Pose2) -> bool:
        """Whether two transforms of an input's map differ enough to use the new one."""
        return track.apart(a, b)[2] >= HOLD_CELLS * self.layers.fixed.resolution

    def accept(self, track: Input, moved: Pose2, pair: Alignment, *, is_tracked: bool) -> None:
        """Let an input vote, at its old transform if the new one is nearly the same."""
        if track.transform is None or self.is_worth_a_move(track, track.transform, moved):
            track.transform = moved
        track.fit = Fit(pair.score, pair.overlap, is_tracked)
        track.accept(Reason.ALIGNED, why=pair.reason)

    def _expected(self, track: Input, held: AnchorMap) -> Pose2 | StartPose | None:
        """Return the expected place of an input in the frame of its anchor.

        An input without a place is searched around its start. One that had a place may have started
        a new map elsewhere, so it is searched everywhere; if the place is symmetric, the side of
        the last transform is accepted.
        """
        if track.transform is None:
            return self.starts.between(held.name, track.name)
        return held.transform.inverse().compose(track.transform)

    def _is_mirrored(self, track: Input, held: AnchorMap, pair: Alignment) -> bool:
        """Whether new walls, which fit much worse than the old ones, are mirrored."""
        if explained(pair) >= SAME_TIME_SHARE:
            return False
        maps = Pair(held.features, self.features(track))
        motion = maps.motion_of(pair.transform)
        refused = decide_mirrored(mirror_gain(maps, motion, self.layers.config.align))
        if refused is not None:
            track.fit = replace(track.fit, mismatch=_not_aligned(held, refused.reason))
        return refused is not None


def _not_aligned(held: AnchorMap, why: str) -> str:
    return Reason.NOT_ALIGNED.says(other=held.name, why=why)
