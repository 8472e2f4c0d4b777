"""The verdict: which path the scans bear out best, by how much, how sure, and where one left."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from slamfusion.evidence.choice import ProducerChoice, choose_producer
from slamfusion.evidence.parting import Span, path_spans
from slamfusion.evidence.predictive import Comparison, PathEvidence
from slamfusion.evidence.records import PathEvidenceJson, PathVerdictJson

__all__ = ["PathVerdict", "Verdict", "reach_verdict"]

# Of a part of the drive with a smaller share of hits that other parts have seen nothing is told.
LITTLE_SEEN = 0.25
# Parts that are named; of more, their share of the drive.
MOST_NAMED = 4
# Where the best path's mean log-likelihood of a hit in places seen at other times is below this,
# the scans contradict all of them. In 82 simulated drives (people, glass, three lasers) that of the
# true path is -0.46 and more, of 105 paths that were off by less than 0.1 m -0.54 and more.
CONTRADICTED = -0.6
# Less of the scans than this share was judged: worth a word.
MOST_JUDGED = 0.95


@dataclass(frozen=True)
class PathVerdict:
    """What is said of one path.

    Attributes:
        name: of the path.
        consistency: its score, mean log-likelihood of a hit.
        tied: whether it is the best, or cannot be told from it.
        against_best: how the best compares with it; None for the best.
        spans: where it agrees with the best path, and where not.
    """

    name: str
    consistency: float
    tied: bool
    against_best: Comparison | None
    spans: tuple[Span, ...]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the scans say of all paths of a drive.

    Attributes:
        evidence: what it rests on.
        best: the path that the scans bear out best.
        fused: the path that was made of the others; None where there is none.
        producer: which SLAM's own path to take; None where there is none.
        sure: whether no other path is tied with the best.
        contradicted: whether the scans contradict even the best path.
        sentence: all of it in words.
        paths: of each path, the best first.
        untold: (from, to) seconds since the first scan, where nothing can be told: parts of the
            drive that hardly saw what any other part saw.
    """

    evidence: PathEvidence
    best: str
    fused: str | None
    producer: ProducerChoice | None
    sure: bool
    contradicted: bool
    sentence: str
    paths: tuple[PathVerdict, ...]
    untold: tuple[tuple[float, float], ...]

    @property
    def best_producer(self) -> str | None:
        """The SLAM whose own path to take; None where there is none."""
        return None if self.producer is None else self.producer.name

    def from_fused_m(self, name: str) -> float | None:
        """Return how far a SLAM's path is from the fused one; None where that tells nothing."""
        return None if self.producer is None else self.producer.from_fused_m.get(name)

    def to_json(self) -> PathVerdictJson:
        """Return the verdict for a JSON document."""
        return {
            "best": self.best,
            "best_producer": self.best_producer,
            "sentence": self.sentence,
            "sure": self.sure,
            "contradicted": self.contradicted,
            "untold": [{"from_s": from_s, "to_s": to_s} for from_s, to_s in self.untold],
        }

    def paths_to_json(self) -> list[PathEvidenceJson]:
        """Return what is said of each path for a JSON document, the best first."""
        return [
            _path_to_json(self.evidence, path, self.from_fused_m(path.name)) for path in self.paths
        ]


def reach_verdict(
    evidence: PathEvidence, producers: Collection[str] = (), fused: str | None = None
) -> Verdict:
    """Say which path the scans bear out best, and which SLAM's own.

    Args:
        evidence: of one path or more.
        producers: names of paths that are a SLAM's own, and not made of others.
        fused: name of the path that was made of them, see ``choose_producer``.
    """
    ranking, tied = evidence.ranking(), evidence.tied()
    best = ranking[0]
    paths = tuple(
        PathVerdict(
            name,
            evidence.scores[name].consistency,
            name in tied,
            None if name == best else evidence.compare(best, name),
            path_spans(evidence, name, best),
        )
        for name in ranking
    )
    untold = _untold(evidence, best)
    producer = choose_producer(evidence, producers, fused)
    contradicted = _is_contradicted(evidence, best)
    return Verdict(
        evidence=evidence,
        best=best,
        fused=fused if fused in ranking else None,
        producer=producer,
        sure=len(ranking) > 1 and len(tied) == 1,
        contradicted=contradicted,
        sentence=" ".join(
            _sentences(evidence, paths, untold, producer, is_contradicted=contradicted)
        ),
        paths=paths,
        untold=untold,
    )


def _is_contradicted(evidence: PathEvidence, best: str) -> bool:
    """Whether what the best path draws of other times contradicts what is seen there."""
    # Not so where nothing was seen twice.
    return evidence.scores[best].seen_consistency < CONTRADICTED


def _untold(evidence: PathEvidence, best: str) -> tuple[tuple[float, float], ...]:
    """Return the spans of a drive of which the scans tell nothing, seconds since the first one."""
    stamps_s = evidence.scans.stamps_s - evidence.scans.stamps_s[0]
    seen = evidence.seen_over_time(best)
    bounds = -(-np.arange(len(seen) + 1) * len(stamps_s) // len(seen))
    ends_s = stamps_s[np.minimum(bounds, len(stamps_s) - 1)]
    spans: list[tuple[float, float]] = []
    for part in np.flatnonzero(~(seen >= LITTLE_SEEN)).tolist():
        from_s, to_s = float(ends_s[part]), float(ends_s[part + 1])
        if spans and spans[-1][1] == from_s:
            from_s = spans.pop()[0]
        spans.append((from_s, to_s))
    return tuple(spans)


# --- in words ---------------------------------------------------------------------------------


def _sentences(
    evidence: PathEvidence,
    paths: tuple[PathVerdict, ...],
    untold: tuple[tuple[float, float], ...],
    producer: ProducerChoice | None,
    *,
    is_contradicted: bool,
) -> list[str]:
    """Return the sentences of the verdict, the ranking first."""
    sentences = [_ranking_words(paths)]
    if producer is not None and len(producer.from_fused_m) > 1:
        sentences.append(_nearest_words(producer))
    sentences += [words for path in paths[1:] if (words := _parting_words(path, paths[0].name))]
    if is_contradicted:
        sentences.append(_contradicted_words(evidence, paths[0].name))
    if untold:
        sentences.append(_untold_words(untold, evidence))
    if evidence.judged_share < MOST_JUDGED:
        sentences.append(
            f"{evidence.judged_share:.0%} of the scans were judged: where every path has a pose."
        )
    return sentences


def _ranking_words(paths: tuple[PathVerdict, ...]) -> str:
    """Say which path is best, and by how much."""
    best, *others = paths
    if not others:
        return (
            f"{best.name} is the only path (log-likelihood of a hit {best.consistency:.3f}): there "
            "is none to compare it with."
        )
    tied = [path.name for path in others if path.tied]
    worse = [path for path in others if not path.tied]
    if tied:
        words = f"The scans cannot tell {_and([best.name, *tied])} apart"
        if not worse:
            return f"{words}."
        return f"{words}; {_and([_worse_words(path) for path in worse])}."
    return f"The scans bear out {best.name} best: {_and([_worse_words(path) for path in worse])}."


def _worse_words(path: PathVerdict) -> str:
    """Say how much less likely what was seen is by a path than by the best one."""
    found = path.against_best
    if found is None:
        return path.name
    less, low, high = (1.0 - math.exp(-gap) for gap in (found.difference, found.low, found.high))
    return f"by {path.name} a hit is {less:.1%} less likely ({low:.1%} to {high:.1%})"


def _nearest_words(producer: ProducerChoice) -> str:
    """Say which SLAM's own path is nearest to the fused one."""
    (nearest, near_m), *others = producer.from_fused_m.items()
    away = _and([f"{name} {away_m:.3f} m" for name, away_m in others])
    return f"Of the SLAM paths {nearest} is nearest to the fused one, {near_m:.3f} m ({away})."


def _parting_words(path: PathVerdict, best: str) -> str:
    """Say where a path leaves the best one, and what the scans say there; empty: nowhere."""
    apart = [span for span in path.spans if not span.agrees]
    if not apart:
        return ""
    longest = max(apart, key=lambda span: span.to_s - span.from_s)
    words = (
        f"{path.name} leaves {best} from {longest.from_s:.0f} to {longest.to_s:.0f} s, by up to "
        f"{longest.gap_m:.1f} m"
    )
    if len(apart) > 1:
        others_s = sum(span.to_s - span.from_s for span in apart) - (longest.to_s - longest.from_s)
        words += f", and elsewhere for {others_s:.0f} s"
    there = {
        "worse": f"there the scans speak for {best}",
        "better": f"there the scans speak for {path.name}",
        "cannot tell": "which of the two is right there the scans do not tell",
    }
    return f"{words}: {there[longest.verdict or 'cannot tell']}."


def _contradicted_words(evidence: PathEvidence, best: str) -> str:
    """Say that no path can be right."""
    likely = math.exp(evidence.scores[best].seen_consistency)
    return (
        f"The scans contradict even {best}: of places seen twice, a hit is {likely:.0%} as likely "
        f"as one on a wall, by right paths {math.exp(CONTRADICTED):.0%} or more; the map is not "
        "what is there."
    )


def _untold_words(untold: tuple[tuple[float, float], ...], evidence: PathEvidence) -> str:
    """Say of which parts of the drive nothing can be told."""
    if len(untold) <= MOST_NAMED:
        parts = _and([f"{from_s:.0f} to {to_s:.0f} s" for from_s, to_s in untold])
    else:
        drive_s = float(evidence.scans.stamps_s[-1] - evidence.scans.stamps_s[0])
        parts = f"{sum(to_s - from_s for from_s, to_s in untold) / drive_s:.0%} of the drive"
    return f"Nothing can be told of {parts}: what was seen then was hardly seen at other times."


def _and(words: list[str]) -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


# --- for JSON ---------------------------------------------------------------------------------


def _path_to_json(
    evidence: PathEvidence, path: PathVerdict, from_fused_m: float | None
) -> PathEvidenceJson:
    score, found = evidence.scores[path.name], path.against_best
    times_s, mean, beams = evidence.over_time(path.name)
    seen = evidence.seen_over_time(path.name)
    start_s = float(evidence.scans.stamps_s[0])
    return {
        "name": path.name,
        "consistency": path.consistency,
        "tied": path.tied,
        "behind_best": 0.0 if found is None else found.difference,
        "behind_best_95": None if found is None else (found.low, found.high),
        "p_value": None if found is None else found.p_value,
        "from_fused_m": from_fused_m,
        "beams_judged": score.beams_judged,
        "scans_judged": int(evidence.is_judged.sum()),
        "seen_share": score.seen_share,
        "seen_consistency": score.seen_consistency if score.seen.any() else None,
        "own_poses_share": score.path.own_share,
        "covered_share": score.path.covered_share,
        "over_time": [
            {
                "time_s": float(time_s) - start_s,
                "consistency": float(value) if count else None,
                "beams": int(count),
                "seen_share": float(share) if count else None,
            }
            for time_s, value, count, share in zip(times_s, mean, beams, seen, strict=True)
        ],
        "spans": [
            {
                "from_s": span.from_s,
                "to_s": span.to_s,
                "agrees": span.agrees,
                "gap_m": span.gap_m,
                "verdict": span.verdict,
            }
            for span in path.spans
        ],
    }
