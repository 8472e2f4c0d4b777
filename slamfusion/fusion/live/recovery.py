"""How the fused frame begins, and how it is kept when inputs leave, return or start a new map.

The first fusion aligns the maps that can be brought to one resolution. When no input is left to
align to, inputs return by the last fused map. Such inputs, and those that start a new map, are
young: a young map straightens while it grows, so what it draws far from its start is off by more
and more. Where one is the reference it is therefore aligned with that fused map again as it grows,
and all inputs that stand with it move along, until it knows more than that map did.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import common_resolution, normalize_grid
from slamfusion.align.records import Alignment
from slamfusion.config import SMALLEST, NormalizeConfig
from slamfusion.errors import AlignmentError, MemoryBudgetError
from slamfusion.fusion.groups import AlignedGroup, align_group
from slamfusion.fusion.inputs import odd_resolution, odd_resolutions
from slamfusion.fusion.live.align import Aligner, AnchorMap
from slamfusion.fusion.live.limits import too_large, unusable
from slamfusion.fusion.live.track import GROWN_SHARE, Track, refuse_all
from slamfusion.fusion.live.voting import FusedLayers
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid
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


LAST_FUSED = "the last fused map"

# The reference is laid onto the last fused map again when it has this many times the walls.
GROWTH = 1.2
CHANGED = "the place is not as it was in the last fused map"


class Anchor:
    """The last fused map from before inputs came back, for as long as it knows more than they do.

    Attributes:
        held: that map; None where there is none, or it is outgrown.
    """

    def __init__(self) -> None:
        """Start without one."""
        self.held: AnchorMap | None = None
        # The last fused map from before an input began anew.
        self._before: AnchorMap | None = None
        self._laid: tuple[str, int] = ("", 0)

    @property
    def walls(self) -> int:
        """Wall cells of the map."""
        return 0 if self.held is None else self.held.walls

    def keep(self, held: AnchorMap) -> None:
        """Take the last fused map that inputs came back by, unless a fuller one is held."""
        if held.walls > self.walls:
            self.held, self._laid = held, ("", 0)

    def note(self, tracks: Collection[Track], layers: FusedLayers, aligner: Aligner) -> None:
        """Remember the last fused map when an input begins anew, until all have outgrown it.

        With it goes what it alone, or with one other, knew: a majority of young maps knows little.

        Args:
            layers: have the last fused map, which is drawn only where it is needed.
            aligner: knows what is a wall.
        """
        has_begun = any(track.has_begun_anew for track in tracks)
        for track in tracks:
            track.has_begun_anew = False
        if has_begun and self._before is None:
            self._before = hold_map(layers.last_fused(), LAST_FUSED, aligner)
        elif self._before is not None:
            standing = [track.walls for track in tracks if track.stands]
            if standing and min(standing) >= GROWN_SHARE * self._before.walls:
                self._before = None

    def hand_over(self, reference: Track) -> None:
        """Hold that map while an input that knows less takes over.

        Args:
            reference: the input that others are aligned to from now on.
        """
        before = self._before
        if before is not None and reference.walls < GROWN_SHARE * before.walls:
            self.keep(before)

    def settle(self, reference: Track, tracks: Iterable[Track], aligner: Aligner) -> None:
        """Lay the reference onto the map again if it has grown, and carry along who stands with it.

        One that fits there no more is searched on the whole map, in two ways: a young map may have
        been believed in the wrong place, and others with it. Where it is not found it stays, since
        the place may have changed, and says so.

        Args:
            reference: the input that others are aligned to.
            aligner: tracks and searches the reference.
        """
        name, walls = self._laid
        if self.held is None or (reference.name == name and reference.walls < GROWTH * walls):
            return
        last, told = reference.transform, (reference.score, reference.overlap)
        if last is None:
            return
        fit = aligner.fit(reference, self.held)
        if fit is None and not aligner.may_search(reference):
            return  # with one of its next maps
        moved, is_done = (fit[1], True) if fit else _found(reference, self.held, aligner)
        reference.mismatch, (reference.score, reference.overlap) = "", told
        if not is_done:
            return
        self._laid = (reference.name, reference.walls)
        reference.reason = "the reference" + ("" if moved else f"; {CHANGED}")
        if moved and aligner.is_worth_a_move(reference, last, moved):
            correction = moved.compose(last.inverse())
            for track in tracks:
                if track.stands and track.transform is not None:
                    track.transform = correction.compose(track.transform)
                    track.relay = True
        if reference.walls >= GROWN_SHARE * self.walls:
            self.held = None


def hold_map(fused: OccupancyGrid | None, name: str, aligner: Aligner) -> AnchorMap | None:
    """Return a fused map as something to align to; None without walls."""
    if fused is None or unusable(fused, aligner.config.normalize) is not None:
        return None
    thresholds, device = aligner.config.normalize, aligner.device
    normal = normalize_grid(fused, fused.resolution, thresholds, device)
    return AnchorMap(name, IDENTITY, GridFeatures(normal, device))


def _found(reference: Track, held: AnchorMap, aligner: Aligner) -> tuple[Pose2 | None, bool]:
    """Return where a whole map has an input, if anywhere, and whether the search ended."""
    moved: list[Pose2] = []
    for is_swapped in (False, True):
        pair = aligner.searched(reference, held, is_swapped=is_swapped)
        if pair is None:
            return None, False
        if not pair.accepted:
            return None, True
        moved.append(held.transform.compose(pair.transform))
    return (None if aligner.is_jump(reference, *moved) else moved[0]), True


LAST_AGREED = "the last map that a majority decided"
# What ``Track.tried`` has in the place of a reference's version: all was tried in vain on the last
# fused map; or the input was only held against it where it lay, and waits for its search.
IN_VAIN, WAITING = -1, -2
# An input, how it fits a map, and its map frame in the fused frame there.
Fit = tuple[Track, Alignment, Pose2]


@dataclass(frozen=True, eq=False)
class Recovery:
    """What a recovery gave.

    Attributes:
        reference: the input that others are aligned to from now on; None without.
        held: the fused map that it fits; None without.
        problem: why nobody votes, one line; None: as before.
    """

    reference: Track | None = None
    held: AnchorMap | None = None
    problem: str | None = None


def recover(tracks: Sequence[Track], aligner: Aligner, layers: FusedLayers) -> Recovery:
    """Let inputs vote again that fit the last fused map.

    Inputs that fit it and each other come back together; one that fits it, when no other does.
    Where several fit it and not each other, it may be wrong as they are: they drew it. Then the
    one goes on that alone fits what a majority last decided; else all stay in doubt until a search
    finds two that agree. One that fits nowhere is searched, once with each of its maps, as soon as
    it may be.

    Args:
        tracks: inputs whose newest message is a usable map.
        aligner: aligns, and knows the time.
        layers: have the last fused map, and what a majority last decided.
    """
    names = "/".join(track.name for track in tracks)
    if not tracks:
        return Recovery(problem="no input is left")
    if not _is_due(tracks, names, aligner):
        return Recovery()
    last = hold_map(layers.last_fused(), LAST_FUSED, aligner)
    if last is None:
        problem = f"{LAST_FUSED} has too few walls to go by"
        refuse_all(tracks, problem)
        return Recovery(problem=problem)
    _begin(tracks, names)
    found = _fitting([track for track in tracks if track.transform is not None], last, aligner)
    group = _largest_group([track for track, _, _ in found.values()], aligner)
    if len(group) == 1 and len(found) > 1:
        kept = hold_map(layers.agreed, LAST_AGREED, aligner)
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
        return Recovery(max(group, key=lambda track: track.walls), last)
    return _search(last, tracks, names, aligner)


def _fitting(tracks: Sequence[Track], held: AnchorMap, aligner: Aligner) -> dict[str, Fit]:
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
) -> Recovery:
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
        return Recovery(problem=problem)
    partner, pair, moved = found[partners[chosen.name].name]
    aligner.believe(partner, moved, pair, is_tracked=True)
    return Recovery(partner)


def _search(last: AnchorMap, tracks: Sequence[Track], names: str, aligner: Aligner) -> Recovery:
    """Search one input on the last fused map."""
    for track in tracks:
        if track.jump is None:
            track.refuse(f"does not fit {LAST_FUSED}")
    if _search_one(tracks, lambda _: last, names, aligner) is not None:
        return Recovery(held=last)
    return Recovery(problem=f"no input fits {LAST_FUSED}")


def _search_one(
    tracks: Sequence[Track], held: Callable[[Track], AnchorMap], names: str, aligner: Aligner
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
