"""Go by the last fused map when no input is left to align to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.live.align import Aligner, Held
from slamfusion.fusion.live.limits import unusable
from slamfusion.fusion.live.track import Track
from slamfusion.fusion.normalize import normalize_grid
from slamfusion.grid import IDENTITY, OccupancyGrid

__all__ = ["Recovered", "recover"]

LAST_FUSED = "the last fused map"


@dataclass(frozen=True, eq=False)
class Recovered:
    """What a recovery gave.

    Attributes:
        reference: the input that others are aligned to from now on; None without.
        problem: why nobody votes, one line; None: as before.
    """

    reference: Track | None = None
    problem: str | None = None


def recover(
    tracks: Sequence[Track], aligner: Aligner, fused: Callable[[], OccupancyGrid | None]
) -> Recovered:
    """Let inputs vote again that fit the last fused map.

    Inputs that fit it and each other come back together; one that fits it, when no other does.
    Those that fit it and not each other stay in doubt. One that does not is searched.

    Args:
        tracks: inputs whose newest message is a usable map.
        aligner: aligns, and knows the time.
        fused: gives the last fused map; asked for only when it is needed.
    """
    names = "/".join(track.name for track in tracks)
    if not tracks:
        return Recovered(problem="no input is left")
    is_tried = all(track.tried == (track.version, names, -1) for track in tracks)
    if is_tried and not any(aligner.may_confirm(track) for track in tracks):
        return Recovered()
    last = _hold(fused(), aligner)
    if last is None:
        return _doubt(tracks, f"{LAST_FUSED} has too few walls to go by")
    for track in tracks:
        track.tried = (track.version, names, -1)
        track.accepted = False
    found = {
        track.name: (track, *fit)
        for track in tracks
        if track.transform is not None and (fit := aligner.fit(track, last)) is not None
    }
    group = _largest_group([track for track, _, _ in found.values()], aligner)
    if len(group) == 1 and len(found) > 1:
        return _doubt(tracks, f"{', '.join(found)} disagree and nobody can say who is right")
    for track in group:
        _, pair, moved = found[track.name]
        aligner.believe(track, moved, pair, is_tracked=True)
    for track in tracks:
        if group and track not in group:
            track.refuse(f"does not fit {LAST_FUSED}")
    if group:
        return Recovered(max(group, key=lambda track: track.walls))
    return _search(last, tracks, aligner)


def _doubt(tracks: Sequence[Track], problem: str) -> Recovered:
    """Let none of these vote, for one reason."""
    for track in tracks:
        track.refuse(problem)
    return Recovered(problem=problem)


def _search(last: Held, tracks: Sequence[Track], aligner: Aligner) -> Recovered:
    """Search the input that waited longest on the last fused map."""
    jumped = [track for track in tracks if aligner.may_confirm(track)]
    chosen = min(jumped or tracks, key=lambda track: track.searched_s)
    for track in tracks:
        if track.jump is None:
            track.refuse(f"does not fit {LAST_FUSED}")
    if aligner.may_search(chosen):
        if jumped:
            aligner.confirm(chosen, [last])
        else:
            aligner.search(chosen, last)
    if any(aligner.now_s - t.searched_s >= aligner.live.search_pause_s for t in tracks):
        for track in tracks:
            track.tried = None
    return Recovered(problem=f"no input fits {LAST_FUSED}")


def _largest_group(tracks: Sequence[Track], aligner: Aligner) -> list[Track]:
    """Return the most inputs that fit one of them where they stand, that one first."""
    best: list[Track] = []
    for seed in tracks:
        others = [t for t in tracks if t is not seed and aligner.fit(t, aligner.held(seed))]
        if len(others) >= len(best):
            best = [seed, *others]
    return best


def _hold(fused: OccupancyGrid | None, aligner: Aligner) -> Held | None:
    """Return the last fused map as something to align to; None without walls."""
    if fused is None or unusable(fused, aligner.config.normalize) is not None:
        return None
    thresholds, device = aligner.config.normalize, aligner.device
    normal = normalize_grid(fused, fused.resolution, thresholds, device)
    return Held(LAST_FUSED, IDENTITY, GridFeatures(normal, device))
