"""The fused map of one drive: the maps of several producers, with what their paths and scans say.

A map of a producer that was right for a part of the drive holds what it drew while it was wrong,
and nothing in the map says which cells these are. The producer's path and scans do: if it has no
vote for some time, its layer is redrawn from its scans at its own path without that time. What
was seen then is drawn at the fused path, where there is one: one of the votes would miss it, and of
two every difference is a wall. The producer's own map stays as it is.

Shared by ``run_log`` and the experiments, which so measure what a user gets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.records import Alignment, FusionResult, InputRecord
from slamfusion.align.starts import Starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError
from slamfusion.evidence import ExcludedSpan, Exclusions, UndecidedSpan
from slamfusion.evidence.drawn_map import DrawnScan, draw_map
from slamfusion.evidence.path_frames import fit_onto
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.path_check import (
    PathGap,
    PathsApartError,
    Votes,
    fallback_map,
    fuse_with_paths,
    moved_path,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.inputs import Progress
from slamfusion.slam.registry import loop_closers
from slamfusion.trajectory import Trajectory

B8 = npt.NDArray[np.bool_]
ScansOf = Callable[[str], Sequence[DrawnScan]]

# A layer of a smaller share of the drive is left out: it shows too little of what the others show
# to be laid on them by its walls. Of two maps none is left out: walls and paths decide.
LEAST_SHARE = 0.1


@dataclass(frozen=True)
class PartialVote:
    """A producer that has no vote for some of the drive."""

    name: str
    """The producer."""
    excluded_spans: Sequence[ExcludedSpan]
    """When it has none."""
    excluded_share: float
    """Share of the judged scans that lie in these times, 0 to 1."""
    left_out: str | None = None
    """Why it has no vote at all; null: its layer was drawn without these times and took part."""
    filled: bool = False
    """Whether its layer shows what was seen in these times, drawn at the fused path."""

    def sentence(self) -> str:
        """Return in words when and why the producer has no vote."""
        words = (
            f"{self.name} has no vote {_and([_span_words(span) for span in self.excluded_spans])}"
        )
        if self.left_out:
            return f"{words}; {self.left_out}."
        drawn = f"{words}; its layer is redrawn from its other scans"
        if self.filled:
            return f"{drawn}, and from those of that time at the fused path."
        return f"{drawn}."


@dataclass(frozen=True, eq=False)
class Layers:
    """What takes part in the vote on a drive.

    Attributes:
        maps: as they are: the producers', then the saved ones.
        grids: those that take part, some of them drawn again.
        paths: by producer, also of the times in which it has no vote.
        votes: of the producers whose layers were drawn again: at which of its poses it has a vote.
        partial: the producers that have no vote for some time.
        undecided: times in which producers have parted, and vote because nothing tells who is
            right.
    """

    maps: tuple[OccupancyGrid, ...]
    grids: tuple[OccupancyGrid, ...]
    paths: Mapping[str, Trajectory]
    votes: Votes = field(default_factory=dict)
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
            words.append(
                f"The paths have parted {times}; the scans of that time alone do not tell which is "
                "right, and all of them vote."
            )
        return tuple(words)


@dataclass(frozen=True, eq=False)
class Filling:
    """What layers show of the times in which their producers have no vote.

    Attributes:
        path: the fused path, in any frame.
        scans: returns the scans of the drive; called where there is something to fill.
    """

    path: Trajectory
    scans: Callable[[], Sequence[DrawnScan]]


def draw_layers(
    maps: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    exclusions: Exclusions | None,
    scans_of: ScansOf,
    device: ComputeDevice,
    filling: Filling | None = None,
) -> Layers:
    """Take out of the maps of a drive what their producers drew after they had left the others.

    Raises:
        TrajectoryError: the scans of a producer are not those of its path.
        OSError: they cannot be read.
    """
    if exclusions is None:
        return Layers.as_made(maps, paths)
    layers = {grid.name: grid for grid in maps}
    votes: dict[str, B8] = {}
    partial = []
    # The one that was with the others least goes first.
    for name in sorted(exclusions.names, key=exclusions.excluded_share, reverse=True):
        share, left_out, is_filled = exclusions.excluded_share(name), None, False
        if share > 1.0 - LEAST_SHARE:
            if len(layers) <= LEAST_FUSED:
                continue
            left_out = f"less than {LEAST_SHARE:.0%} of the drive is left, too little for a layer"
            del layers[name]
        else:
            kept = votes[name] = exclusions.votes_at(name, paths[name].stamps_s)
            path = Trajectory(paths[name].stamps_s[kept], paths[name].poses[kept], name)
            own, scans, drawn = layers[name], scans_of(name), path
            if filling is not None:
                filled = _filled(path, exclusions, filling)
                is_filled = len(filled) > len(path)
                if is_filled:
                    scans = _with_excluded(scans, filling.scans(), name, exclusions)
                    drawn = filled
            layers[name] = draw_map(
                scans, drawn, device, resolution=own.resolution, origin=own.origin, name=name
            )
        partial.append(PartialVote(name, exclusions.spans[name], share, left_out, is_filled))
    return Layers(
        tuple(maps), tuple(layers.values()), paths, votes, tuple(partial), exclusions.undecided
    )


def _filled(path: Trajectory, exclusions: Exclusions, filling: Filling) -> Trajectory:
    """Return a path with the poses of the filling, laid on it, where its producer has no vote."""
    motion = fit_onto(filling.path, [path])
    if motion is None:
        return path
    laid = moved_path(filling.path, motion)
    _, meets = path.matches(laid.stamps_s)
    excluded = ~exclusions.votes_at(path.name, laid.stamps_s) & ~meets
    stamps_s = np.concatenate((path.stamps_s, laid.stamps_s[excluded]))
    poses = np.concatenate((path.poses, laid.poses[excluded]))
    order = np.argsort(stamps_s, kind="stable")
    return Trajectory(stamps_s[order], poses[order], path.name)


def _with_excluded(
    own: Sequence[DrawnScan], recorded: Sequence[DrawnScan], name: str, exclusions: Exclusions
) -> list[DrawnScan]:
    """Return the scans that a producer was fed where it has a vote, and elsewhere the recorded."""

    def votes(scans: Sequence[DrawnScan]) -> B8:
        return exclusions.votes_at(name, np.array([scan.stamp_s for scan in scans]))

    kept = [scan for scan, has_vote in zip(own, votes(own), strict=True) if has_vote]
    kept += [scan for scan, has_vote in zip(recorded, votes(recorded), strict=True) if not has_vote]
    return sorted(kept, key=lambda scan: scan.stamp_s)


def _span_words(span: ExcludedSpan) -> str:
    """Return when a producer has no vote, how far it was from the others then, and why."""
    why = {
        "outvoted": "where the others agree",
        "contradicted by the scans": "where the scans contradict it",
    }
    return f"{_times(span)}, up to {span.gap_m:.1f} m away, {why[span.ground]}"


def _times(span: ExcludedSpan | UndecidedSpan) -> str:
    """Return when a part of the drive begins and ends."""
    return f"from {span.from_s:.0f} to {span.to_s:.0f} s"


def _and(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else f"{'; '.join(words[:-1])}, and {words[-1]}"


# --- the fusion -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DriveFusion:
    """The result of fusing the maps of one drive.

    Attributes:
        result: the fusion; None where nothing was fused.
        gaps: between the producers' paths in the fused frame.
        fallback: where nothing was fused, the map to go on with: whose walls the others' fit
            best, or the only one; None where there is a fusion, or no map.
        failure: why nothing was fused; None where it was.
    """

    result: FusionResult | None = None
    gaps: tuple[PathGap, ...] = ()
    pairs: tuple[Alignment, ...] = ()
    fallback: OccupancyGrid | None = None
    failure: AlignmentError | None = None


def fuse_layers(
    layers: Layers,
    config: RunConfig,
    device: ComputeDevice,
    *,
    shared_frame: bool,
    progress: Progress | None = None,
    starts: Starts | None = None,
) -> DriveFusion:
    """Fuse the layers of the vote, and compare the producers' paths in the fused frame.

    All producers begin in one frame, the odometry's. The search is full all the same: a lost
    producer must not be pulled into place. The common frame only decides between answers that fit
    equally well, in places that look alike under two turns. Saved maps may have any frame, so with
    them the settings decide.

    Returns:
        The fusion; where there are too few maps, or too few fit, why there is none.
    """
    grids = layers.grids
    if len(grids) < LEAST_FUSED:
        count = len(grids) or "none"
        failure = AlignmentError(f"{count} of at least {LEAST_FUSED} maps that a vote needs")
        return DriveFusion(fallback=grids[0] if grids else None, failure=failure)
    fusion = config.fusion
    if shared_frame:
        fusion = replace(fusion, align=replace(fusion.align, shared_frame=True))
    limit_m = config.run.path_gap_m
    try:
        result, gaps = fuse_with_paths(
            grids, layers.paths, fusion, limit_m, device, progress, starts, layers.votes
        )
    except AlignmentError as error:
        return DriveFusion(
            gaps=error.gaps if isinstance(error, PathsApartError) else (),
            pairs=error.pairs,
            fallback=fallback_map(grids, error.pairs, loop_closers(layers.paths)),
            failure=error,
        )
    records = {record.name: record for record in result.inputs}
    for vote in layers.partial:
        if vote.left_out:
            (grid,) = (grid for grid in layers.maps if grid.name == vote.name)
            records[vote.name] = InputRecord(grid, None, False, vote.left_out)
    inputs = tuple(records[grid.name] for grid in layers.maps)
    return DriveFusion(replace(result, inputs=inputs), gaps)
