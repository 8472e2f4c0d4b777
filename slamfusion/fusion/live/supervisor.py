"""Which inputs of the live fusion vote, and where they lie: the rules that ``fusion`` states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from slamfusion.align.normalize import common_resolution, odd_resolution
from slamfusion.config import SMALLEST
from slamfusion.errors import AlignmentError, MemoryBudgetError, SlamFusionError
from slamfusion.fusion.grouping import FusionSetup
from slamfusion.fusion.groups import AlignedGroup, align_group
from slamfusion.fusion.inputs import odd_resolutions
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.inputs import (
    CHANGED_SHARE,
    RESTARTED_SHARE,
    Change,
    Input,
    Reason,
    too_large,
)
from slamfusion.fusion.live.recovery import Anchor, turn_all
from slamfusion.geometry import Pose2
from slamfusion.vote.lattice import Lattice

NEVER = float("-inf")
# Cells aligned again while a new map waits; what comes on top of these waits for a pause.
TRACK_CELLS = 2_000_000
# A steady voter is late when this many times the usual share has changed; then it only waits for
# other late ones. One in whose place the map drawn from scans votes is aligned again only then: its
# path is checked by each solution of the drive.
LATE = 20.0


class InputSupervisor:
    """Aligns changed inputs and decides who votes.

    Attributes:
        inputs: by name, in the order in which they came; the owner adds and feeds them.
        reference: name of the input that others are aligned to; empty without.
        problem: why no input votes, one line.
        anchor: the last fused map, while it knows more than the inputs do.
    """

    def __init__(self, aligner: Aligner) -> None:
        self.inputs: dict[str, Input] = {}
        self.reference = ""
        self.problem = "no map yet"
        self.anchor = Anchor(aligner)
        self._aligner = aligner
        self._tried: tuple[float, tuple[tuple[str, int], ...]] = (NEVER, ())

    @property
    def voters(self) -> list[Input]:
        """The inputs that vote, in order."""
        return [one for one in self.inputs.values() if one.votes]

    @property
    def _live(self) -> list[Input]:
        return [one for one in self.inputs.values() if one.is_live]

    def note(self, one: Input, change: Change) -> None:
        """Take note of what the new map of an input changed."""
        if one.walls < RESTARTED_SHARE * change.before:
            self.anchor.note_restart()
        if one.name == self.reference:
            for other in self.inputs.values():
                if other is not one:
                    other.drift += change.walls

    def align(self, now_s: float, *, is_idle: bool) -> None:
        """Align new, returned and changed inputs; ``is_idle``: no new map waits for the result."""
        self._aligner.now_s = now_s
        self._aligner.has_searched = False
        if self._aligner.layers.lattice is None:
            self._start()
            return
        self.anchor.look(self.inputs.values())
        if self._choose_reference():
            self.anchor.settle(self.inputs[self.reference], self.inputs.values())
            self._realign(is_idle=is_idle)
        else:
            self._recover()

    # -- the first fusion -------------------------------------------------------------------------

    def _start(self) -> None:
        """Try the first fusion, once for every new map and not too often."""
        aligner = self._aligner
        usable, least = self._usable(), aligner.layers.live.minimum_inputs
        if len(usable) < least:
            self.problem = turn_all(usable, Reason.TOO_FEW, least=least, found=len(usable))
            return
        versions = tuple((one.name, one.version) for one in usable)
        last_s, tried = self._tried
        if versions == tried or aligner.now_s - last_s < aligner.layers.live.search_pause_s:
            return
        self._tried = (aligner.now_s, versions)
        aligner.has_searched = len(usable) > 1
        try:
            group, lattice = self._first_group(usable, least)
        except SlamFusionError as error:
            self.problem = turn_all(usable, Reason.NO_START, why=error)
        else:
            self._accept_first(group, lattice)

    def _usable(self) -> list[Input]:
        """Return the inputs that can be brought to one resolution; reject the others by name."""
        grids = {one.name: one.grid for one in self._live if one.grid is not None}
        reasons = odd_resolutions({name: grid.resolution for name, grid in grids.items()})
        rest = [grid for name, grid in grids.items() if name not in reasons]
        for grid in rest:
            reason = too_large(grid, common_resolution(rest, self._aligner.layers.config.normalize))
            if reason is not None:
                reasons[grid.name] = reason
        for name, why in reasons.items():
            self.inputs[name].turn(Reason.REJECTED, why=why)
        return [self.inputs[name] for name in grids if name not in reasons]

    def _first_group(self, usable: Sequence[Input], least: int) -> tuple[AlignedGroup, Lattice]:
        """Return the inputs that agree, and the cells of the frame that their reference gives.

        Raises:
            SlamFusionError: too few agree, or memory cannot hold them; in one line.
        """
        aligner = self._aligner
        # The walls of the reference are what the others are compared with until it is lost.
        config = aligner.layers.config
        config = replace(config, reference=config.reference or SMALLEST)
        grids = [one.grid for one in usable if one.grid is not None]
        resolution = common_resolution(grids, config.normalize)
        try:
            features = {one.name: one.features(resolution) for one in usable}
            setup = FusionSetup(config, aligner.layers.device, starts=aligner.starts)
            group = align_group(features, {}, setup, list(features))
        except MemoryError:
            message = f"no memory is left to align {len(usable)} maps at {resolution:g} m a cell"
            raise MemoryBudgetError(message) from None
        if len(group.alignments) < least:
            raise AlignmentError(f"{len(group.alignments)} of the {least} inputs needed agree")
        base = features[group.reference].grid.grid
        return group, Lattice(base.resolution, base.origin)

    def _accept_first(self, group: AlignedGroup, lattice: Lattice) -> None:
        """Fix the fused frame, lay every map out on its lattice, and let the group vote."""
        aligner = self._aligner
        aligner.layers.lattice, self.reference = lattice, group.reference
        size = lattice.resolution
        for one in self.inputs.values():
            if one.grid is None:
                continue
            reason = odd_resolution(one.grid.resolution, size) or too_large(one.grid, size)
            if reason is None:
                one.place(size)
            elif one.is_live:
                one.refuse_map(reason)
        for name, pair in group.alignments.items():
            aligner.accept(self.inputs[name], pair.transform, pair, is_tracked=False)
        for pair in group.pairs:
            if pair.accepted:
                aligner.note(pair)
        for name, (reason, shown) in group.left_out.items():
            one = self.inputs[name]
            one.turn(Reason.REJECTED, why=reason)
            if shown is not None:
                one.fit = replace(one.fit, score=shown.score, overlap=shown.overlap)

    # -- every round after it ---------------------------------------------------------------------

    def _choose_reference(self) -> bool:
        """Keep the reference, or hand over when it must; return whether there is one."""
        # Where the poses of all contradict each other, their walls still stand: the frame holds.
        able = self.voters or [one for one in self.inputs.values() if one.stands]
        if not any(one.name == self.reference for one in able):
            if not able:
                self.reference = ""
                return False
            self._hand_over(max(able, key=lambda one: one.walls))
        reasons = [one.contradiction for one in able if one.contradiction]
        if reasons and not self.voters:
            self.problem = f"{reasons[0]}, and no majority decides"
        return True

    def _hand_over(self, one: Input) -> None:
        self.anchor.hand_over(one)
        self.reference = one.name
        one.accept(Reason.REFERENCE)

    def _realign(self, *, is_idle: bool) -> None:
        """Align what is due: doubtful inputs always, steady voters as far as time allows.

        A steady voter's transform holds meanwhile, so a large one, or one of many, waits until no
        new map does. The late one that changed most is aligned in any case, one a round.
        """
        first = self.inputs[self.reference]
        before = {one.name: one.transform for one in self.voters}
        due = [one for one in self.inputs.values() if self._is_due(one, first)]
        due.sort(key=lambda one: (one.votes, -one.drift))
        cells, has_late = 0, False
        for one in due:
            reference = self.inputs.get(self.reference)
            if reference is None or not reference.stands:
                return
            if one is reference:
                continue
            own = 0 if one.layer is None else one.layer.box.area
            may_wait = one.votes and cells + own > TRACK_CELLS
            is_late = one.drift > LATE * self._few(one, reference)
            if may_wait and (has_late or not is_late):
                if not (is_idle and cells == 0):
                    continue
            else:
                has_late = has_late or may_wait
            try:
                self._align(one, reference)
            except (SlamFusionError, MemoryError) as error:
                one.tried = (one.version, reference.name, reference.version)
                one.turn(Reason.FAILED, why=str(error) or type(error).__name__)
            one.release()  # before those of the next one
            cells += own
        self._hold_frame(before)

    def _hold_frame(self, before: Mapping[str, Pose2 | None]) -> None:
        """Move the reference instead of the others, if at least two others all moved alike.

        The walls moved in its map then. Of two inputs, neither is known to be still.
        ``before``: transforms of the voters before they were aligned.
        """
        reference, is_moved = self.inputs[self.reference], self._aligner.is_worth_a_move
        others = [one for one in self.voters if one is not reference]
        moves = [
            (one, was, now)
            for one in others
            if (was := before.get(one.name)) is not None and (now := one.transform) is not None
        ]
        if len(others) < 2 or len(moves) < len(others) or reference.transform is None:
            return
        _, was, now = moves[0]
        back = was.compose(now.inverse())
        moved = back.compose(reference.transform)
        if is_moved(reference, reference.transform, moved) and not any(
            is_moved(one, was, back.compose(now)) for one, was, now in moves
        ):
            reference.transform = moved
            for one, was, _ in moves:
                one.transform = was

    def _align(self, one: Input, reference: Input) -> None:
        """Align an input to the reference: tracked, or else searched everywhere."""
        aligner, had_vote = self._aligner, one.votes
        if one.transform is not None and aligner.follow(one, aligner.held(reference)):
            return
        others = [other for other in self.voters if other is not reference and other is not one]
        now = (one.version, reference.name, reference.version)
        if not aligner.may_search(one):
            # A voter whose walls and the reference's contradict each other has no vote until a
            # search, or a third, says which of them is right; one that jumped waits on.
            if not had_vote or one.fit.mismatch:
                reason = Reason.MISMATCH if one.fit.mismatch else Reason.WAITS
                one.turn(reason, why=one.fit.mismatch)
            if had_vote and one.fit.mismatch:
                self._arbitrate(one, reference, others)
            return
        if aligner.may_confirm(one):
            is_left = aligner.confirm(one, [aligner.held(other) for other in (*others, reference)])
            one.tried = None if is_left else now
            return
        # The reference may share no ground with it where another input does.
        held = [reference] if had_vote else [reference, *others]
        turn = one.searches % len(held)
        aligner.search(one, aligner.held(held[turn]))
        if one.votes:
            return
        one.tried = now if turn == len(held) - 1 else None
        if had_vote:
            self._arbitrate(one, reference, others)

    def _arbitrate(self, one: Input, reference: Input, others: list[Input]) -> None:
        """Find who is wrong when an input that voted does not fit the reference any more.

        A third input decides; without one the last fused map of a majority does, see ``recovery``.
        """
        if not others:
            self._recover()
            return
        for third in others:
            if self._aligner.follow(one, self._aligner.held(third)):
                if self._aligner.fit(reference, self._aligner.held(third)) is None:
                    names = f"{third.name} and {one.name}"
                    reference.turn(Reason.OUTVOTED, names=names)
                    self._hand_over(third)
                return

    def _recover(self) -> None:
        """Go by the last fused map: no input is left to align to."""
        if not self._live:
            self.problem = "no input is left"
            return
        reference, problem = self.anchor.recover(self._live)
        self.problem = problem or self.problem
        if reference is not None:
            self._hand_over(reference)

    def _is_due(self, one: Input, reference: Input) -> bool:
        """Whether an input has to be aligned in this round."""
        if one is reference or not one.is_live:
            return False
        if one.stands:
            return one.drift > (LATE if one.is_drawn else 1.0) * self._few(one, reference)
        if one.awaits_confirmation:
            return self._aligner.may_confirm(one)
        return one.tried != (one.version, reference.name, reference.version)

    def _few(self, one: Input, reference: Input) -> float:
        """Return the changed wall cells below which nothing needs to be aligned again."""
        return CHANGED_SHARE * min(one.walls, reference.walls)
