"""What walls say of a pair that was rejected, under the transform that other pairs imply for it.

Maps that share little may each fit a third: the pair is rejected, the group stands. But where the
implied transform lays much of both maps on one ground, their walls must bear it out there. Few
poses are left to chance then, so far less evidence does than a search would need.
"""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.align.align import track_pair
from slamfusion.align.decide import CLASH_MAX, EXPECTED_WRONG_MAX, SHARE_MIN, expected_wrong
from slamfusion.align.features import GridFeatures
from slamfusion.align.hypotheses import DISTINCT_CELLS, DISTINCT_YAW_RAD, is_distinct
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.search import prior_within
from slamfusion.geometry import Pose2

# Ground that both maps know, as a share of the smaller one's: on less their walls need not meet.
MUCH_GROUND = 0.3


@dataclass(frozen=True)
class Implied:
    """What came of a rejected pair under the transform that others imply.

    Attributes:
        alignment: refined from there.
        stands: whether the pair speaks against no group.
        words: why, in a few words.
        is_borne_out: whether walls on common ground, be it much or little, say that it lies there.
    """

    alignment: Alignment
    stands: bool
    words: str
    is_borne_out: bool = False


class ImpliedPairs:
    """Looks at rejected pairs under implied transforms, at each only once."""

    def __init__(self, features: dict[str, GridFeatures], pairs: int) -> None:
        """Keep the maps by name, and how many pairs the job has."""
        self.features, self.pairs = features, pairs
        self.seen: dict[tuple[str, str, Pose2], Implied] = {}

    def stands(self, pair: Alignment, transform: Pose2) -> bool:
        """Whether a rejected pair speaks against no group that implies the transform."""
        return self.look(pair, transform).stands

    def look(self, pair: Alignment, transform: Pose2) -> Implied:
        """Return what the walls of a rejected pair say of an implied transform.

        Args:
            pair: names the maps.
            transform: moving map frame to the reference's, metres.
        """
        return self.look_at(pair.reference, pair.moving, transform)

    def look_at(self, reference: str, moving: str, transform: Pose2) -> Implied:
        """Return what the walls of two maps say of an implied transform; see ``look``."""
        key = reference, moving, transform
        if key not in self.seen:
            self.seen[key] = self._look(reference, moving, transform)
        return self.seen[key]

    def words_against(self, pair: Alignment) -> str:
        """Return what walls say against a pair where others put it, to end a reason; or nothing."""
        for (reference, moving, _), found in self.seen.items():
            if (reference, moving) == (pair.reference, pair.moving) and not found.stands:
                return f"; where the others put it, it gives {found.words}"
        return ""

    def _look(self, still: str, moved: str, transform: Pose2) -> Implied:
        pair = Pair(self.features[still], self.features[moved])
        found = track_pair(pair, transform)
        little = ""
        if found.overlap < MUCH_GROUND:
            little = f"{found.overlap:.0%} of the ground in common"
        evidence = found.evidence
        if evidence is None:
            return Implied(found, bool(little), little or "no walls")
        prior = prior_within(pair, DISTINCT_CELLS, DISTINCT_YAW_RAD)
        wrong = expected_wrong(evidence.pieces, evidence.share, self.pairs, prior)
        fits = found.accepted or (
            evidence.share >= SHARE_MIN
            and wrong < EXPECTED_WRONG_MAX
            and found.statistics["wall_clash"] <= CLASH_MAX
        )
        went = is_distinct(
            pair.motion_of(found.transform),
            pair.motion_of(transform),
        )
        words = f"{evidence.share:.0%} of what {evidence.common_m:.0f} m of common walls could give"
        # On little ground a few walls meet in a wrong place, too.
        is_borne_out = fits and not went and (found.accepted or not little)
        return Implied(found, is_borne_out or bool(little), little or words, is_borne_out)


def words_over(name: str, found: Alignment) -> str:
    """Return why an input stands that no accepted pair joins to the reference, in one line.

    Args:
        name: of the input.
        found: its alignment to the reference where the pairs between imply it.
    """
    said = f"accepted over others: as a pair with {found.reference}, {name} was rejected"
    if found.evidence is None:
        return said
    share, metres = found.evidence.share, found.evidence.common_m
    return f"{said}; here they give {share:.0%} of what {metres:.0f} m of common walls could"
