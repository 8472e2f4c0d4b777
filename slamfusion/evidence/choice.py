"""``choose_producer``: which SLAM's own path to take, where a path was fused of all of them.

By its score a path that is off by decimetres is known from one that is off by centimetres; between
two that are off by centimetres noise decides. The fused path, along which all scans were laid on
each other, is nearer to the truth than either: so it tells them apart by how far each is from it,
unless the scans say that it is worse than the one that they bear out best.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from slamfusion.evidence.predictive import PathEvidence
from slamfusion.geometry import fit_motion, moved_poses

__all__ = ["ProducerChoice", "choose_producer", "distance_m"]


@dataclass(frozen=True)
class ProducerChoice:
    """The SLAM's own path to take.

    Attributes:
        name: of the path.
        from_fused_m: root mean square distance of each SLAM's path from the fused one, metres, the
            nearest first; empty where there is none, or the scans speak against it.
    """

    name: str
    from_fused_m: Mapping[str, float] = field(default_factory=dict)


def choose_producer(
    evidence: PathEvidence, producers: Collection[str], fused: str | None = None
) -> ProducerChoice | None:
    """Return which SLAM's path to take; None where there is none.

    Args:
        evidence: of these paths and maybe of others.
        producers: names of paths that are a SLAM's own; others of which nothing is known are left
            out.
        fused: name of the path that was made of them; None, or unknown: there is none.
    """
    ranking = evidence.ranking()
    best = next((name for name in ranking if name in producers), None)
    if best is None:
        return None
    if fused is None or fused not in ranking or evidence.compare(best, fused).verdict == "better":
        return ProducerChoice(best)
    away_m = {name: distance_m(evidence, name, fused) for name in ranking if name in producers}
    away_m = dict(sorted(away_m.items(), key=lambda item: item[1]))
    return ProducerChoice(next(iter(away_m)), away_m)


def distance_m(evidence: PathEvidence, name: str, other: str) -> float:
    """Return the root mean square distance between two paths, laid on each other, in metres.

    Args:
        evidence: of both; judged are scans at which both have a pose.
        name, other: of the paths.
    """
    poses, still = (evidence.scores[one].path.poses[evidence.is_judged] for one in (name, other))
    laid = moved_poses(fit_motion(poses, still), poses)
    return float(np.sqrt(np.mean(np.sum((laid[:, :2] - still[:, :2]) ** 2, axis=1))))
