"""Go by the last fused map when no input is left to align to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from slamfusion.align.records import Alignment
from slamfusion.fusion.live.align import Aligner, Held
from slamfusion.fusion.live.anchor import LAST_FUSED, hold_map
from slamfusion.fusion.live.track import Track, refuse_all
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid

LAST_AGREED = "the last map that a majority decided"
# What ``Track.tried`` has in the place of a reference's version: all was tried in vain on the last
# fused map; or the input was only held against it where it lay, and waits for its search.
IN_VAIN, WAITING = -1, -2
# An input, how it fits a map, and its map frame in the fused frame there.
Fit = tuple[Track, Alignment, Pose2]


@dataclass(frozen=True, eq=False)
class Recovered:
    """What a recovery gave.

    Attributes:
        reference: the input that others are aligned to from now on; None without.
        held: the fused map that it fits; None without.
        problem: why nobody votes, one line; None: as before.
    """

    reference: Track | None = None
    held: Held | None = None
    problem: str | None = None


def recover(
    tracks: Sequence[Track],
    aligner: Aligner,
    fused: Callable[[], OccupancyGrid | None],
    agreed: Callable[[], OccupancyGrid | None] = lambda: None,
) -> Recovered:
    """Let inputs vote again that fit the last fused map.

    Inputs that fit it and each other come back together; one that fits it, when no other does.
    Where several fit it and not each other, it may be wrong as they are: they drew it. Then the
    one goes on that alone fits what a majority last decided; else all stay in doubt until a search
    finds two that agree. One that fits nowhere is searched, once with each of its maps, as soon as
    it may be.

    Args:
        tracks: inputs whose newest message is a usable map.
        aligner: aligns, and knows the time.
        fused: gives the last fused map; asked for only when it is needed.
        agreed: gives what a majority last decided, if anything; the same.
    """
    names = "/".join(track.name for track in tracks)
    if not tracks:
        return Recovered(problem="no input is left")
    if not _is_due(tracks, names, aligner):
        return Recovered()
    last = hold_map(fused(), LAST_FUSED, aligner)
    if last is None:
        problem = f"{LAST_FUSED} has too few walls to go by"
        refuse_all(tracks, problem)
        return Recovered(problem=problem)
    _begin(tracks, names)
    found = _fitting([track for track in tracks if track.transform is not None], last, aligner)
    group = _largest_group([track for track, _, _ in found.values()], aligner)
    if len(group) == 1 and len(found) > 1:
        kept = hold_map(agreed(), LAST_AGREED, aligner)
        rivals = [track for track, _, _ in found.values()]
        fits = {} if kept is None else _fitting(rivals, kept, aligner)
        if kept is None or len(fits) != 1:
            return _dispute(tracks, names, found, aligner)
        last, found, group = kept, fits, [track for track, _, _ in fits.values()]
    for track in group:
        _, pair, moved = found[track.name]
        aligner.believe(track, moved, pair, is_tracked=True)
    for track in tracks:
        if group and track not in group:
            track.refuse(f"does not fit {last.name}")
    if group:
        return Recovered(max(group, key=lambda track: track.walls), last)
    return _search(last, tracks, names, aligner)


def _fitting(tracks: Sequence[Track], held: Held, aligner: Aligner) -> dict[str, Fit]:
    """Return the inputs that fit a map where they stand, by name."""
    return {
        track.name: (track, *fit)
        for track in tracks
        if (fit := aligner.fit(track, held)) is not None
    }


def _is_in_vain(track: Track, names: str) -> bool:
    """Whether all was tried in vain with an input's newest map, among the same inputs."""
    return track.tried == (track.version, names, IN_VAIN)


def _is_due(tracks: Sequence[Track], names: str, aligner: Aligner) -> bool:
    """Whether anything can be tried that was not: drawing the last fused map takes time."""
    return any(
        track.tried not in {(track.version, names, mark) for mark in (IN_VAIN, WAITING)}
        or (
            aligner.may_search(track)
            and (aligner.may_confirm(track) or not _is_in_vain(track, names))
        )
        for track in tracks
    )


def _begin(tracks: Sequence[Track], names: str) -> None:
    """Let none vote until it fits, and note that each is held against the last fused map."""
    for track in tracks:
        track.accepted = False
        if not _is_in_vain(track, names):
            track.tried = (track.version, names, WAITING)


def _dispute(
    tracks: Sequence[Track], names: str, found: Mapping[str, Fit], aligner: Aligner
) -> Recovered:
    """Look for two that agree where those that fit the last fused map do not fit each other.

    An input that fits nowhere, as one that has come back, is searched on one of them; without any,
    the one whose place was looked for last. Where it is found both go on.
    """
    problem = f"{', '.join(found)} disagree and nobody can say who is right"
    rivals = [track for track, _, _ in found.values()]
    absent = [track for track in tracks if track not in rivals]
    wanted = absent or [max(rivals, key=lambda track: track.searched_s)]

    def rival(track: Track) -> Track:
        others = [other for other in rivals if other is not track]
        # Twice on each: where it jumped there its next map must confirm it.
        return others[track.searches // 2 % len(others)]

    partners = {track.name: rival(track) for track in wanted}
    chosen = _search_one(wanted, lambda track: aligner.held(partners[track.name]), names, aligner)
    for track in tracks:
        if track is chosen:
            continue
        if track not in wanted:
            track.tried = (track.version, names, IN_VAIN)
        if track not in wanted or track.jump is None:
            track.refuse(problem)
    if chosen is None:
        return Recovered(problem=problem)
    partner, pair, moved = found[partners[chosen.name].name]
    aligner.believe(partner, moved, pair, is_tracked=True)
    return Recovered(partner)


def _search(last: Held, tracks: Sequence[Track], names: str, aligner: Aligner) -> Recovered:
    """Search one input on the last fused map."""
    for track in tracks:
        if track.jump is None:
            track.refuse(f"does not fit {LAST_FUSED}")
    if _search_one(tracks, lambda _: last, names, aligner) is not None:
        return Recovered(held=last)
    return Recovered(problem=f"no input fits {LAST_FUSED}")


def _search_one(
    tracks: Sequence[Track], held: Callable[[Track], Held], names: str, aligner: Aligner
) -> Track | None:
    """Search the input that waited longest, before all one that jumped; return it if it votes."""
    able = [track for track in tracks if aligner.may_search(track)]
    jumped = [track for track in able if aligner.may_confirm(track)]
    waiting = [track for track in able if not _is_in_vain(track, names)]
    chosen = min(jumped or waiting, key=lambda track: track.searched_s, default=None)
    if chosen is None:
        return None
    where = held(chosen)
    is_done = not aligner.confirm(chosen, [where]) if jumped else aligner.search(chosen, where)
    if is_done and not chosen.votes:
        chosen.tried = (chosen.version, names, IN_VAIN)
    return chosen if chosen.votes else None


def _largest_group(tracks: Sequence[Track], aligner: Aligner) -> list[Track]:
    """Return the most inputs that fit one of them where they stand, that one first."""
    best: list[Track] = []
    for seed in tracks:
        others = [t for t in tracks if t is not seed and aligner.fit(t, aligner.held(seed))]
        if len(others) >= len(best):
            best = [seed, *others]
    return best
