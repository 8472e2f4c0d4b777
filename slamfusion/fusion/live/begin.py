"""The first fusion of the live fusion: which maps can be brought together, and which agree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from slamfusion.align.normalize import common_resolution
from slamfusion.config import SMALLEST, NormalizeConfig
from slamfusion.errors import AlignmentError, MemoryBudgetError
from slamfusion.fusion.groups import AlignedGroup, align_group
from slamfusion.fusion.inputs import odd_resolution, odd_resolutions
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.limits import too_large
from slamfusion.fusion.live.track import Track
from slamfusion.vote.lattice import Lattice


def fusable(tracks: Sequence[Track], config: NormalizeConfig) -> list[Track]:
    """Return the inputs that can be brought to one resolution; refuse the others by name."""
    grids = {track.name: track.grid for track in tracks if track.grid is not None}
    reasons = odd_resolutions({name: grid.resolution for name, grid in grids.items()})
    rest = [grid for name, grid in grids.items() if name not in reasons]
    for grid in rest:
        reason = too_large(grid, common_resolution(rest, config))
        if reason is not None:
            reasons[grid.name] = reason
    for track in tracks:
        if track.name in reasons:
            track.refuse(reasons[track.name])
    return [track for track in tracks if track.name in grids and track.name not in reasons]


def align_first(
    tracks: Sequence[Track], least: int, aligner: Aligner
) -> tuple[AlignedGroup, Lattice]:
    """Return the inputs that agree, and the cells of the frame that their reference gives.

    Args:
        tracks: inputs that can be brought to one resolution.
        least: how many must agree.
        aligner: gives the settings and computes.

    Raises:
        SlamFusionError: too few agree, or memory cannot hold them; in one line.
    """
    config, device = aligner.config, aligner.device
    # The walls of the reference are what the others are compared with until it is lost.
    config = replace(config, reference=config.reference or SMALLEST)
    thresholds = config.normalize
    resolution = common_resolution([t.grid for t in tracks if t.grid is not None], thresholds)
    try:
        features = {t.name: t.features(resolution, thresholds, -1.0, device) for t in tracks}
        group = align_group(
            features,
            {},
            config,
            device,
            list(features),
            starts=aligner.starts,
        )
    except MemoryError:
        message = f"no memory is left to align {len(tracks)} maps at {resolution:g} m a cell"
        raise MemoryBudgetError(message) from None
    if len(group.alignments) < least:
        message = f"{len(group.alignments)} of the {least} inputs needed agree"
        raise AlignmentError(message)
    base = features[group.reference].grid.grid
    return group, Lattice(base.resolution, base.origin)


def believe_first(
    group: AlignedGroup, lattice: Lattice, tracks: Mapping[str, Track], aligner: Aligner
) -> None:
    """Fix the fused frame, and let the group vote.

    Args:
        group: the inputs that agree, and why others do not.
        lattice: of the fused frame.
        tracks: all inputs by name.
        aligner: keeps the frame, and what was found of each pair.
    """
    aligner.lattice = lattice
    _place_all(tracks.values(), aligner)
    for name, pair in group.alignments.items():
        aligner.believe(tracks[name], pair.transform, pair, is_tracked=False)
    for pair in group.pairs:
        if pair.accepted:
            aligner.note(pair)
    for name, (reason, shown) in group.left_out.items():
        track = tracks[name]
        track.refuse(reason)
        if shown is not None:
            track.score, track.overlap = shown.score, shown.overlap


def _place_all(tracks: Iterable[Track], aligner: Aligner) -> None:
    """Lay every input's map out on the fused lattice; one that cannot be begins with its next."""
    lattice, thresholds = aligner.fixed(), aligner.config.normalize
    for track in tracks:
        if track.grid is None:
            continue
        odd = odd_resolution(track.grid.resolution, lattice.resolution)
        reason = odd or too_large(track.grid, lattice.resolution)
        if reason is None:
            track.place(lattice.resolution, thresholds, aligner.device)
        elif track.is_live:
            track.is_live = False
            track.refuse(reason)
