"""Keep the fused frame when inputs leave, return or restart their maps.

If no input is left to align to, inputs return by the last fused map. Such inputs, and those whose
maps restarted, are young: a young map straightens while it grows, so its far parts are inaccurate.
A young reference is therefore aligned with that fused map again as it grows, and all inputs that
agree with it move along, until it knows more than that map.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.records import Alignment
from slamfusion.fusion.live.align import Aligner, AnchorMap, explained
from slamfusion.fusion.live.inputs import GROWN_SHARE, Input, Reason, unusable
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid

LAST_FUSED, LAST_AGREED = "the last fused map", "the last map that a majority decided"
# The reference is aligned with the last fused map again when its walls grew by this factor.
GROWTH = 1.2
# What ``Input.tried`` has in the place of a reference's version: all was tried in vain on the last
# fused map; or the input was only compared with it where it lay, and waits for its search.
IN_VAIN, WAITING = -1, -2
# An input, its alignment, and its map frame in the fused frame.
Placed = tuple[Input, Alignment, Pose2]


def hold_map(fused: OccupancyGrid | None, name: str, aligner: Aligner) -> AnchorMap | None:
    """Return a fused map as something to align to; None without walls."""
    thresholds, device = aligner.layers.config.normalize, aligner.layers.device
    if fused is None or unusable(fused, thresholds) is not None:
        return None
    normal = normalize_grid(fused, fused.resolution, thresholds, device)
    return AnchorMap(name, IDENTITY, GridFeatures(normal, device))


class Anchor:
    """The last fused map from before inputs came back, for as long as it knows more than they do.

    Attributes:
        held: that map; None where there is none, or it is outgrown.
    """

    def __init__(self, aligner: Aligner) -> None:
        self.held: AnchorMap | None = None
        # The last fused map from before an input's map restarted.
        self._before: AnchorMap | None = None
        # The reference that was laid onto the map last, and its walls then.
        self._settled: tuple[str, int] = ("", 0)
        self._aligner = aligner

    @property
    def walls(self) -> int:
        """Wall cells of the map."""
        return 0 if self.held is None else self.held.walls

    def keep(self, held: AnchorMap) -> None:
        """Take the last fused map that inputs came back by, unless a fuller one is held."""
        if held.walls > self.walls:
            self.held, self._settled = held, ("", 0)

    def note_restart(self) -> None:
        """Remember the last fused map, since the map of an input has restarted and knows less."""
        if self._before is None:
            self._before = hold_map(self._aligner.layers.last_fused(), LAST_FUSED, self._aligner)

    def look(self, inputs: Collection[Input]) -> None:
        """Forget that map when all know more."""
        standing = [one.walls for one in inputs if one.stands]
        if self._before and standing and min(standing) >= GROWN_SHARE * self._before.walls:
            self._before = None

    def hand_over(self, reference: Input) -> None:
        """Hold that map while an input that knows less takes over as the reference."""
        before = self._before
        if before is not None and reference.walls < GROWN_SHARE * before.walls:
            self.keep(before)

    def settle(self, reference: Input, inputs: Iterable[Input]) -> None:
        """Align a grown reference with the map again; inputs that agree with it move along.

        If it does not fit there it is searched on the whole map, in two ways: a young map may have
        been accepted in the wrong place. If it is not found it stays, with a note, since the place
        may have changed.
        """
        name, walls = self._settled
        if self.held is None or (reference.name == name and reference.walls < GROWTH * walls):
            return
        aligner, last, shown = self._aligner, reference.transform, reference.fit
        if last is None:
            return
        fit = aligner.fit(reference, self.held)
        if fit is None and not aligner.may_search(reference):
            return  # with one of its next maps
        moved = fit[1] if fit else self._found(reference, self.held)
        reference.fit = replace(shown, mismatch="")
        self._settled = (reference.name, reference.walls)
        reference.reason = (Reason.REFERENCE if moved else Reason.CHANGED).says()
        if moved and aligner.is_worth_a_move(reference, last, moved):
            correction = moved.compose(last.inverse())
            for one in inputs:
                if one.stands and one.transform is not None:
                    one.transform = correction.compose(one.transform)
        if reference.walls >= GROWN_SHARE * self.walls:
            self.held = None

    def _found(self, reference: Input, held: AnchorMap) -> Pose2 | None:
        """Return where a whole map has an input, if anywhere."""
        moved: list[Pose2] = []
        for is_swapped in (False, True):
            pair = self._aligner.searched(reference, held, is_swapped=is_swapped)
            if not pair.accepted:
                return None
            moved.append(held.transform.compose(pair.transform))
        return None if self._aligner.is_jump(reference, *moved) else moved[0]

    # -- when no input is left to align to ---------------------------------------------------------

    def recover(self, inputs: Sequence[Input]) -> tuple[Input | None, str | None]:
        """Let inputs vote again that fit the last fused map.

        Inputs that fit it and each other come back together; one that fits it, when no other does.
        Where several fit it, be it as bent ones, and not each other, it may be wrong as they are.
        Then the one goes on that alone fits what a majority last decided, or of which it explains
        much more; else all stay in doubt until a search finds two that agree. One that fits nowhere
        is searched, once with each of its maps, as soon as it may be.

        Args:
            inputs: those that are not LOST.

        Returns:
            The input that others are aligned to from now on, None without; and why no input votes,
            None where nothing new could be tried.
        """
        aligner = self._aligner
        names = "/".join(one.name for one in inputs)
        if not self._is_due(inputs, names):
            return None, None
        last = hold_map(aligner.layers.last_fused(), LAST_FUSED, aligner)
        if last is None:
            return None, turn_all(inputs, Reason.FEW_WALLS, other=LAST_FUSED)
        turn_all(inputs, Reason.NO_FIT, other=LAST_FUSED)
        for one in inputs:
            if not _is_in_vain(one, names):
                one.tried = (one.version, names, WAITING)
        placed = [one for one in inputs if one.transform is not None]
        found = self._fitting(placed, last)
        rivals = [one for one in placed if one.name in found or one.fit.may_be_bent]
        group = self._largest_group([one for one, _, _ in found.values()])
        if len(group) == 1 and len(rivals) > 1:
            kept = hold_map(aligner.layers.agreed, LAST_AGREED, aligner)
            fits = {} if kept is None else self._fitting(rivals, kept)
            enough = aligner.layers.live.search_share * max(map(_share, fits.values()), default=0.0)
            fits = {name: fit for name, fit in fits.items() if _share(fit) >= enough}
            if kept is None or len(fits) != 1:
                return self._dispute(inputs, names, rivals)
            last, found, group = kept, fits, [one for one, _, _ in fits.values()]
        for one in group:
            _, pair, moved = found[one.name]
            aligner.accept(one, moved, pair, is_tracked=True)
        if not group and self._search_one(inputs, lambda _: last, names) is None:
            return None, f"no input fits {LAST_FUSED}"
        self.keep(last)
        if not group:
            return None, None
        others = [one for one in inputs if one not in group]
        turn_all(others, Reason.NO_FIT, other=last.name)
        return max(group, key=lambda one: one.walls), None

    def _fitting(self, inputs: Sequence[Input], held: AnchorMap) -> dict[str, Placed]:
        """Return the inputs that fit a map where they stand, by name."""
        fits = {one.name: (one, self._aligner.fit(one, held)) for one in inputs}
        return {name: (one, *fit) for name, (one, fit) in fits.items() if fit is not None}

    def _is_due(self, inputs: Sequence[Input], names: str) -> bool:
        """Whether anything can be tried that was not: drawing the last fused map takes time."""
        aligner = self._aligner
        return any(
            one.tried not in {(one.version, names, mark) for mark in (IN_VAIN, WAITING)}
            or (
                aligner.may_search(one)
                and (aligner.may_confirm(one) or not _is_in_vain(one, names))
            )
            for one in inputs
        )

    def _dispute(
        self, inputs: Sequence[Input], names: str, rivals: Sequence[Input]
    ) -> tuple[Input | None, str | None]:
        """Look for two that agree where those that fit the last fused map do not fit each other.

        An input that fits nowhere, as one that has come back, is searched on one of them; without
        any, the one whose place was looked for last. Where it is found both go on.
        """
        own = ", ".join(one.name for one in rivals)
        problem = turn_all(inputs, Reason.DISPUTE, names=own)
        absent = [one for one in inputs if one not in rivals]
        wanted = absent or [max(rivals, key=lambda one: one.searched_s)]

        def rival(one: Input) -> Input:
            others = [other for other in rivals if other is not one]
            # Twice on each: where it jumped there its next map must confirm it.
            return others[one.searches // 2 % len(others)]

        partners = {one.name: rival(one) for one in wanted}
        chosen = self._search_one(wanted, lambda one: self._aligner.held(partners[one.name]), names)
        for one in inputs:
            if one not in wanted:
                one.tried = (one.version, names, IN_VAIN)
        if chosen is None:
            return None, problem
        partner = partners[chosen.name]
        partner.accept(Reason.AGREES, other=chosen.name)
        return partner, None

    def _search_one(
        self, inputs: Sequence[Input], held: Callable[[Input], AnchorMap], names: str
    ) -> Input | None:
        """Search the input that waited longest, before all one that jumped; return a voter."""
        aligner = self._aligner
        able = [one for one in inputs if aligner.may_search(one)]
        jumped = [one for one in able if aligner.may_confirm(one)]
        waiting = [one for one in able if not _is_in_vain(one, names)]
        chosen = min(jumped or waiting, key=lambda one: one.searched_s, default=None)
        if chosen is None:
            return None
        where = held(chosen)
        if jumped:
            aligner.confirm(chosen, [where])
        else:
            aligner.search(chosen, where)
        if not chosen.votes:
            chosen.tried = (chosen.version, names, IN_VAIN)
        return chosen if chosen.votes else None

    def _largest_group(self, inputs: Sequence[Input]) -> list[Input]:
        """Return the most inputs that fit one of them where they stand, that one first."""
        best: list[Input] = []
        for seed in inputs:
            others = [one for one in inputs if one is not seed]
            fit = [one for one in others if self._aligner.fit(one, self._aligner.held(seed))]
            if len(fit) >= len(best):
                best = [seed, *fit]
        return best


def _share(placed: Placed) -> float:
    return explained(placed[1])


def turn_all(inputs: Iterable[Input], reason: Reason, **words: object) -> str:
    """Turn inputs for a reason; return its sentence."""
    for one in inputs:
        one.turn(reason, **words)
    return reason.says(**words)


def _is_in_vain(one: Input, names: str) -> bool:
    """Whether all was tried in vain with an input's newest map, among the same inputs."""
    return one.tried == (one.version, names, IN_VAIN)
