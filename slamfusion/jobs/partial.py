"""Producers that were right for a part of the drive: what they vote with, drawn without the rest.

A producer's map holds what it drew while it was wrong, and nothing in it says which cells these
are. Its path and its scans do: where it has no vote for some time, its layer of the vote is drawn
anew from its scans at its own path without that time. Its own map stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evidence import (
    ExcludedSpan,
    PathEvidence,
    UndecidedSpan,
    find_exclusions,
    judged_scans,
    score_paths,
)
from slamfusion.evidence.drawn_map import draw_map, drawn_scans
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.records import InputRecord
from slamfusion.fusion.start import Starts
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.fuse_drive import DriveFusion, fuse_drive
from slamfusion.jobs.inputs import Progress
from slamfusion.jobs.run_records import PartialVoteJson
from slamfusion.trajectory import Trajectory

__all__ = [
    "LEAST_SHARE",
    "Layers",
    "PartialVote",
    "draw_layers",
    "draw_layers_of_scans",
    "fuse_layers",
]

# A layer of a smaller share of the drive is left out: it shows too little of what the others show
# to be laid on them by its walls. Of two maps none is left out: walls and paths decide.
LEAST_SHARE = 0.1


@dataclass(frozen=True)
class PartialVote:
    """A producer that has no vote for some of the drive.

    Attributes:
        name: of the producer.
        spans: the times in which it has none.
        excluded_share: share of the judged scans that lie in them, 0 to 1.
        left_out: why it has no vote at all; empty: its layer was drawn anew and takes part.
    """

    name: str
    spans: tuple[ExcludedSpan, ...]
    excluded_share: float
    left_out: str = ""

    def sentence(self) -> str:
        """Return in words when and why the producer has no vote."""
        words = f"{self.name} has no vote {_and([_span_words(span) for span in self.spans])}"
        if self.left_out:
            return f"{words}; {self.left_out}."
        return f"{words}; its layer is drawn anew from its other scans."

    def to_json(self) -> PartialVoteJson:
        """Return it for a JSON document."""
        return {
            "name": self.name,
            "excluded_spans": [
                {
                    "from_s": span.from_s,
                    "to_s": span.to_s,
                    "gap_m": span.gap_m,
                    "ground": span.ground,
                }
                for span in self.spans
            ],
            "excluded_share": self.excluded_share,
            "left_out": self.left_out or None,
        }


@dataclass(frozen=True, eq=False)
class Layers:
    """What takes part in the vote on a drive.

    Attributes:
        maps: as they are: the producers', then the saved ones.
        grids: those that take part, some of them drawn anew.
        paths: by producer, without the times in which it has no vote.
        partial: the producers that have no vote for some time.
        undecided: times in which producers have parted, and vote because nothing tells who is
            right.
    """

    maps: tuple[OccupancyGrid, ...]
    grids: tuple[OccupancyGrid, ...]
    paths: Mapping[str, Trajectory]
    partial: tuple[PartialVote, ...] = ()
    undecided: tuple[UndecidedSpan, ...] = ()

    @classmethod
    def as_made(cls, maps: Sequence[OccupancyGrid], paths: Mapping[str, Trajectory]) -> Layers:
        """Let every map take part as it is."""
        return cls(tuple(maps), tuple(maps), paths)

    def sentences(self) -> tuple[str, ...]:
        """Return in words who has no vote when, and where that could not be told."""
        words = [vote.sentence() for vote in self.partial]
        if self.undecided:
            times = _and([_times(span) for span in self.undecided])
            words.append(f"The paths have parted {times}; nothing tells who is right: all vote.")
        return tuple(words)


def draw_layers(
    maps: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    evidence: PathEvidence | None,
    scans_of: Callable[[str], Iterable[LogScan]],
    device: ComputeDevice,
) -> Layers:
    """Take out of the maps of a drive what their producers drew after they had left the others.

    Args:
        maps: of distinct names; those that have no path, the saved ones, stay as they are.
        paths: found with the producers' maps, by name.
        evidence: what the scans say of these paths; None: nothing, and all vote.
        scans_of: returns the scans that a producer was fed; asked for those that are drawn anew.
        device: draws.

    Raises:
        TrajectoryError: the scans of a producer are not those of its path.
        OSError: they cannot be read.
    """
    layers = {grid.name: grid for grid in maps}
    scores = {
        name: evidence.scores[name] for name in layers if evidence and name in evidence.scores
    }
    if evidence is None or not scores:
        return Layers.as_made(maps, paths)
    found = find_exclusions(replace(evidence, scores=scores))
    kept, partial = dict(paths), []
    # Whoever was with the others least goes first.
    for name in sorted(found.names, key=found.excluded_share, reverse=True):
        share, left_out = found.excluded_share(name), ""
        if share > 1.0 - LEAST_SHARE:
            if len(layers) <= LEAST_FUSED:
                continue
            left_out = f"less than {LEAST_SHARE:.0%} of the drive is left, too little for a layer"
            del layers[name]
        else:
            votes = found.votes_at(name, paths[name].stamps_s)
            path = Trajectory(paths[name].stamps_s[votes], paths[name].poses[votes], name)
            own = layers[name]
            layers[name] = draw_map(
                drawn_scans(scans_of(name)), path, device,
                resolution=own.resolution, origin=own.origin, name=name,
            )  # fmt: skip
            kept[name] = path
        partial.append(PartialVote(name, found.spans[name], share, left_out))
    return Layers(tuple(maps), tuple(layers.values()), kept, tuple(partial), found.undecided)


def draw_layers_of_scans(
    maps: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    recorded: Sequence[LogScan],
    fed: Mapping[str, Sequence[LogScan]],
    device: ComputeDevice,
) -> Layers:
    """Do what ``draw_layers`` does for a drive in memory; where scans cannot be asked, all vote.

    Args:
        maps, paths: see ``draw_layers``; every map has a path.
        recorded: scans of the drive, which say who is right.
        fed: what each producer was fed, by name.
        device: scores and draws.

    Raises:
        TrajectoryError: the scans of a producer are not those of its path.
    """
    kept = {grid.name: paths[grid.name] for grid in maps}
    try:
        evidence = score_paths(judged_scans(recorded), kept, device)
    except SlamFusionError:
        return Layers.as_made(maps, kept)
    return draw_layers(maps, kept, evidence, fed.__getitem__, device)


def fuse_layers(
    layers: Layers,
    config: RunConfig,
    device: ComputeDevice,
    *,
    shared_frame: bool,
    progress: Progress | None = None,
    starts: Starts | None = None,
) -> DriveFusion:
    """Fuse what takes part in the vote; whoever was left out stands among the inputs with why.

    Args:
        layers: of ``draw_layers``.
        config, device, shared_frame, progress, starts: see ``fuse_drive``.
    """
    fusion = fuse_drive(
        layers.grids,
        layers.paths,
        config,
        device,
        shared_frame=shared_frame,
        progress=progress,
        starts=starts,
        in_part=[vote.name for vote in layers.partial],
    )
    reasons = {vote.name: vote.left_out for vote in layers.partial if vote.left_out}
    if fusion.result is None or not reasons:
        return fusion
    records = {record.name: record for record in fusion.result.inputs}
    inputs = tuple(
        InputRecord(grid, None, False, reasons[grid.name])
        if grid.name in reasons
        else records[grid.name]
        for grid in layers.maps
    )
    return replace(fusion, result=replace(fusion.result, inputs=inputs))


def _span_words(span: ExcludedSpan) -> str:
    """Return when a producer has no vote, how far it was from the others then, and why."""
    why = {
        "outvoted": "where the others agree",
        "contradicted by the scans": "where the scans speak against it",
    }
    return f"{_times(span)}, up to {span.gap_m:.1f} m away, {why[span.ground]}"


def _times(span: ExcludedSpan | UndecidedSpan) -> str:
    """Return when a part of the drive begins and ends."""
    return f"from {span.from_s:.0f} to {span.to_s:.0f} s"


def _and(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else f"{'; '.join(words[:-1])}, and {words[-1]}"
