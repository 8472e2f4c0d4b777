"""``drive_conditions``: problems of a drive so far, one line each; ``judge`` checks the same."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias, get_args

from slamfusion.evidence.displacement import CONTRADICTED, REACH_M, find_contradiction
from slamfusion.evidence.parting import path_spans
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import undecided
from slamfusion.slam.common.odometry_check import LEAST_STEPS, contradictions

Condition: TypeAlias = Literal["odometry", "new place", "doubled walls", "undecided"]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)


def drive_conditions(evidence: PathEvidence, name: str) -> Mapping[Condition, str]:
    """Return what is wrong with a drive so far, in words, by the path called ``name``."""
    scans, path = evidence.scans, evidence.own_path(name)
    found: dict[Condition, str] = {}
    # However long ago they were, the newest steps are the evidence.
    wheels, newest = scans.driven, 2 * LEAST_STEPS
    if wheels is not None and (text := "; ".join(contradictions(wheels, path, newest=newest))):
        found["odometry"] = text
    # If no scan contradicts the path, the robot is on it.
    others = [other for other in evidence.scores if other != name]
    broken = find_contradiction(evidence, name)
    if broken is not None and all(find_contradiction(evidence, other) for other in others):
        seen = (
            f"since stamp {scans.stamps_s[0] + broken.since_s:.0f} s {broken.share:.0%} of what "
            "the robot sees was free space before"
        )
        if broken.moved_share > CONTRADICTED:  # nothing near it fits
            found["new place"] = f"{seen}: it was carried away, or is on another floor"
        else:  # another floor may have walls so close
            found["doubled walls"] = (
                f"{seen}, and half or more fits if moved by up to {REACH_M:g} m: every input has "
                "drifted, or the robot is on another floor"
            )
    spans = {other: path_spans(evidence, other, name) for other in others}
    if all(own[-1].agrees for own in spans.values()):
        return found
    now = [
        f"since stamp {scans.stamps_s[0] + span.from_s:.0f} s {rival} is up to {span.gap_m:.1f} m "
        f"from the {name} path, and no scan shows which is right"
        for rival, span in undecided(evidence, spans, name)
        if span is spans[rival][-1]
    ]
    if now:
        found["undecided"] = "; ".join(now)
    return found
