"""Fuse maps that arrive again and again; the fused frame never moves.

The rules, for a robot that drives by the fused map:

* **Frame.** The first fusion needs two inputs that agree (``live.minimum_inputs``); one map alone
  has nobody to check it, and its frame would bind all others. The reference of that fusion gives
  the frame, the lattice and its phase, which then stay until ``reset``, whatever becomes of it.
* **Held transforms.** An input's transform belongs to its map frame, not to its map: while most
  of its old walls still stand where they stood, it is held. Changed walls are tracked from the
  last transform against the reference. A better fit by less than ``live.hold_cells`` moves nothing.
* **Starts.** An input with a start is looked for around it until it has a place in the fused frame;
  from then on its last transform counts. ``reset`` lets starts count again.
* **Search.** An input is searched everywhere when it is new, or when its tracked score and what the
  ground in common says both fall below a share of what the search last gave: the maps of two robots
  may grow away from each other. A search that finds it elsewhere is believed when the next
  map's search finds the same. Where the map does not change (the robot stands) it is searched once
  more after ``live.confirm_s``, or at its second equal message, in another way: against another
  voter, or with the roles swapped. Until then the input does not vote.
* **Walls.** What votes matches: an input whose walls match the reference's no more loses its vote
  until a search, or a third, says which of the two is right. One that fits clearly better mirrored
  never votes (``fusion.mirror``).
* **Poses.** Inputs of one robot whose poses contradict the others' lose their vote while that lasts
  (``live.poses``); where nobody can say who is right, all of these do, and the last map stays.
* **Limits.** Numbers that no place has, noise and maps that are all occupied are refused before
  anything is done with them (``live.limits``); a map that is not believed takes no room in the
  fused one. A search in vain is followed by a long pause, and a long one is put off while maps of
  others wait, so that one bad map does not silence the others.
* **Leaving.** An input that is removed takes its vote, its place and its layer with it at once; one
  that comes under its name later is a new input.
* **Reference.** It is the input that others are aligned to. It hands over when it is lost or
  removed, when its walls moved, or when two others agree with each other and not with it; never
  because another looks better.
* **Growth.** Inputs that come back by the last fused map are young; while it knows more than they
  do the reference is laid onto it again as it grows, so that the frame stays (``live.anchor``).
  What a restarted map does not know yet is no vote, so that two of them take nothing from
  the robot's map that the third knows; ``unknown`` of the vote forces another rule.
* **Doubt.** A map that is not believed does not vote, and neither does the older one before it.
  One healthy input goes on alone and is called so. Where two inputs disagree, both steady, a third
  decides, or else the last fused map; where both still fit it, since both drew it, what the last
  majority decided: the one that still fits goes on. Where both do, or none, nobody can say who is
  right: both are named and nothing new is published, so that the robot keeps that last map, until
  a third has come back and agrees with one, or a search finds both to agree in another place.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slamfusion.align.starts import place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.fusion.inputs import odd_resolution
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.inputs import Event, Input, State
from slamfusion.fusion.live.limits import too_large, unusable
from slamfusion.fusion.live.mailbox import InputMessage, Mailbox
from slamfusion.fusion.live.poses import PoseWatch
from slamfusion.fusion.live.state import LiveState, StateError
from slamfusion.fusion.live.supervisor import InputSupervisor
from slamfusion.fusion.live.voting import FusedLayers
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.vote.tiles import check_votes

SAVED = "give a map that never changes as file:PATH, so that it keeps its vote"


@dataclass(frozen=True, eq=False)
class LiveInput:
    """One input after the last update.

    Attributes:
        name: as given to ``put``.
        age_s: time since its last message; infinite before the first.
        rate_hz: messages a second, smoothed; 0 before the second.
        state: see ``State``.
        reason: why it is in that state, one line.
        transform: its map frame into the fused frame, metres; the last that was accepted.
        score, overlap: of its last alignment, see ``Alignment``; 1 for the reference.
        maps: messages that came, usable or not.
        rejected: those among them that contain too little or cannot be read.
        is_tracked: whether the last alignment started from the last transform.
    """

    name: str
    age_s: float
    rate_hz: float
    state: State
    reason: str
    transform: Pose2 | None
    score: float
    overlap: float
    maps: int
    rejected: int
    is_tracked: bool

    @property
    def accepted(self) -> bool:
        """Whether it votes."""
        return self.state is State.TRACKED


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """What an update did.

    Attributes:
        fused: cells -1, 0, 100 in the fused frame; None when there is nothing new to publish.
        agreement: share of votes for the winner, 0..100, -1 without; None with ``fused``.
        inputs: every input that ever came, in the order in which they came.
        phantom_cells: occupied in the fused map, in no input.
        time_s: seconds by step: ``prepare``, ``align``, ``vote``.
        is_full_search: whether an input was searched everywhere.
        reference: name of the input that others are aligned to; empty without.
        changed_box: the cells of ``fused`` that were voted on; None with ``fused``.
        problem: why nothing is fused, one line; empty while something is.
        arrived_s: when the first map came that the update took; None: none, or saved maps alone.
    """

    fused: OccupancyGrid | None
    agreement: OccupancyGrid | None
    inputs: tuple[LiveInput, ...]
    phantom_cells: int
    time_s: dict[str, float]
    is_full_search: bool
    reference: str
    changed_box: CellBox | None
    problem: str = ""
    arrived_s: float | None = None


class LiveFusion:
    """Fuse maps that arrive again and again; the fused frame never moves.

    ``put``, ``drop``, ``recall``, ``remove`` and ``hear`` are quick and may be called from any
    thread; ``update`` and the others from one, which does the work.
    """

    def __init__(
        self, config: RunConfig, device: ComputeDevice, inputs: Sequence[str] | None = None
    ) -> None:
        """Start without inputs.

        Args:
            config: ``fusion``, ``live`` and ``start`` count.
            device: computes.
            inputs: names of those that are to come, which starts must name; None: any may come.

        Raises:
            StartError: a start names no input, or there is one alone that says nothing.
            ConfigError: the mode is no vote.
        """
        check_votes(config.fusion.vote)
        self._live = config.live
        self._config = config.fusion
        self._starts = place_starts(config.start, inputs, config.fusion.reference)
        self._device = device
        self._mailbox = Mailbox()
        # Poses come from any thread.
        self._poses_lock = threading.Lock()
        self._clear()

    def _clear(self) -> None:
        self._aligner = Aligner(
            self._config,
            self._live,
            self._device,
            self._starts,
            is_wanted=lambda: self._mailbox.has_new,
        )
        self._layers = FusedLayers(self._config, self._live, self._device)
        self._supervisor = InputSupervisor(self._aligner, self._layers)
        self._inputs = self._supervisor.inputs
        with self._poses_lock:
            self._poses = PoseWatch(self._live)
        self._restored: dict[str, Pose2] = {}

    # -- what comes -------------------------------------------------------------------------------

    def put(
        self,
        name: str,
        grid: OccupancyGrid | Callable[[], OccupancyGrid],
        received_s: float,
        *,
        is_saved: bool = False,
    ) -> None:
        """Take the newest map of an input; one that waits is replaced.

        Args:
            grid: its map, in its own frame; whatever it is called, it goes by the input's name. Or
                what reads it in the thread of updates; where that raises a SlamFusionError the
                input votes no more until one can be read.
            received_s: when it came, on the clock of ``update``.
            is_saved: read from a file: it never grows stale.
        """
        self._mailbox.put(name, grid, received_s, is_saved=is_saved)

    def drop(self, name: str, reason: str) -> None:
        """Take an input for lost; it votes no more and comes back with its next map."""
        self._mailbox.drop(name, reason)

    @property
    def has_news(self) -> bool:
        """Whether anything came that no update has seen; quick."""
        return self._mailbox.has_new

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a map."""
        return self._mailbox.has_come(name)

    def hear(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Take a pose that an input tells; see ``live.poses`` for what it is compared with.

        Args:
            stamp_s: of the scan that it is for, seconds.
            pose: of the robot in the input's map frame; metres, radians.
        """
        with self._poses_lock:
            self._poses.hear(name, stamp_s, pose)

    def recall(self, name: str) -> None:
        """Take an input that was dropped for present again, with the last map that it sent."""
        track = self._inputs.get(name)
        self._mailbox.recall(name, None if track is None else track.grid)

    def remove(self, name: str) -> None:
        """Forget an input, its vote and its place; under its name a new one may come."""
        self._mailbox.remove(name)

    def reset(self) -> None:
        """Forget the fused frame; every input's newest map starts the next one."""
        self._mailbox.refill({t.name: t.grid for t in self._inputs.values() if t.is_live})
        self._clear()

    def configure(self, live: LiveConfig) -> None:
        """Take other settings for what comes; from the thread of updates."""
        self._live = live
        self._aligner.live = live
        self._layers.live = live
        with self._poses_lock:
            self._poses.live = live

    # -- over a restart ---------------------------------------------------------------------------

    def state(self, stamp_s: float = 0.0) -> LiveState | None:
        """Return what another one needs to go on from here; from the thread of updates.

        Args:
            stamp_s: of the newest map in the fused one, to be kept beside it.

        Returns:
            None before the first fusion.
        """
        layers = self._layers
        if layers.lattice is None or layers.box is None:
            return None
        fused, agreement = layers.grids()
        placed = {t.name: t.transform for t in self._inputs.values() if t.transform is not None}
        return LiveState(
            layers.lattice,
            layers.box.row0,
            layers.box.col0,
            fused.cells,
            agreement.cells,
            {**self._restored, **placed},
            self._supervisor.reference,
            self._aligner.scores,
            stamp_s,
        )

    def restore(self, state: LiveState) -> None:
        """Go on in the fused frame of a state; before the first update.

        Inputs are tried where they lay, against the last fused map, and are searched when they fit
        there no more; none that fits nowhere votes.

        Raises:
            StateError: its cells are of another size than the settings ask for.
        """
        wanted, found = self._config.normalize.resolution, state.lattice.resolution
        if wanted is not None and wanted != found:
            message = f"the state has cells of {found:g} m, and resolution asks for {wanted:g} m"
            raise StateError(message)
        self._clear()
        self._aligner.restore(state.lattice, state.scores)
        self._supervisor.problem = "no input has come yet"
        self._layers.restore(state)
        self._restored = dict(state.transforms)

    # -- update -----------------------------------------------------------------------------------

    def update(self, now_s: float) -> LiveUpdate | None:
        """Bring the fused map up to date; None when nothing came and nothing changed.

        Call it for every map that comes, and again until it answers None: what can wait (aligning
        large maps again) is done while no map does, and given up for one that comes.

        Args:
            now_s: on the clock of ``put``.
        """
        clock = [time.perf_counter()]
        before = self._state()
        has_news, arrived_s = self._collect(now_s)
        self._contradict()
        clock.append(time.perf_counter())
        self._supervisor.align(now_s, is_idle=not has_news)
        self._place()
        self._layers.lattice = self._aligner.lattice
        clock.append(time.perf_counter())
        supervisor = self._supervisor
        box = self._layers.update(self._inputs.values(), supervisor.voters, supervisor.reference)
        fused, agreement = (None, None) if box is None else self._layers.grids()
        clock.append(time.perf_counter())
        if not has_news and box is None and self._state() == before:
            return None
        steps = zip(("prepare", "align", "vote"), clock, clock[1:], strict=False)
        return LiveUpdate(
            fused,
            agreement,
            self.inputs(now_s),
            self._layers.phantom_cells,
            {step: end - begin for step, begin, end in steps},
            self._aligner.has_searched,
            self._supervisor.reference,
            box,
            "" if self._layers.names else self._supervisor.problem,
            arrived_s,
        )

    def _collect(self, now_s: float) -> tuple[bool, float | None]:
        """Hand what came to the tracks; return whether there was any, and when the first map came.

        An input is stale when its last message is older than another's by ``live.stale_after_s``,
        and not older than now: when the robot stands still all fall silent together.
        """
        removed, fresh = self._mailbox.take()
        for name in removed:
            self._inputs.pop(name, None)
            self._aligner.remove(name)
            self._layers.lift(name)
            self._restored.pop(name, None)
            with self._poses_lock:
                self._poses.remove(name)
        for name, item in fresh.items():
            track = self._inputs.setdefault(name, Input(name, transform=self._restored.get(name)))
            if item.gone is not None:
                track.lose(item.gone)
            elif reason := self._take(track, item):
                self._mailbox.count_rejected(name)
                track.refuse_map(reason)
        came = {name: item for name, item in self._mailbox.counts().items() if not item.is_saved}
        newest_s = max((item.received_s for item in came.values()), default=now_s)
        for name, item in came.items():
            one = self._inputs.get(name)
            is_stale = newest_s - item.received_s > self._live.stale_after_s
            if one is not None and one.is_live and is_stale:
                only = f", and one ever; {SAVED}" if item.maps == 1 else ""
                one.lose(f"no map for {now_s - item.received_s:.0f} s{only}")
        since_s = [
            item.waits_since_s
            for item in fresh.values()
            if item.waits_since_s is not None and not item.is_saved
        ]
        return bool(fresh or removed), min(since_s, default=None)

    def _take(self, track: Input, item: InputMessage) -> str | None:
        """Let an input take the map that waits; return why it cannot, in words."""
        resolution, thresholds = self._layers.resolution, self._config.normalize
        was_live = track.is_live
        try:
            grid = item.read()
            if grid is None:
                return None
            grid = grid if grid.name == track.name else grid.with_name(track.name)
            if reason := (
                unusable(grid, thresholds)
                or (resolution and odd_resolution(grid.resolution, resolution))
                or too_large(grid, resolution or grid.resolution)
            ):
                return reason
            change = track.follow(grid, resolution, thresholds, self._live, self._device)
        except SlamFusionError as error:
            return str(error)
        except MemoryError:
            return "no memory is left for its map"
        if not was_live:
            track.turn(Event.MAP, "new; not aligned yet")
            track.tried = None
        if change is not None:
            self._layers.note(track.name, change.box)
            self._supervisor.note(track, change)
        return None

    def _state(self) -> tuple[object, ...]:
        inputs = tuple((t.name, t.state, t.why) for t in self._inputs.values())
        return (self._supervisor.reference, self._layers.names, inputs)

    def inputs(self, now_s: float) -> tuple[LiveInput, ...]:
        """Return the inputs as they stand; from the thread of updates."""
        out = []
        counts = self._mailbox.counts()
        for name, track in self._inputs.items():
            came = counts.get(name) or InputMessage()  # removed, and not yet noticed
            is_reference = name == self._supervisor.reference and track.votes
            reason = track.why
            if self._layers.names == (name,) and self._live.minimum_inputs > 1:
                reason = "goes on alone: no other input to agree with"
            out.append(
                LiveInput(
                    name,
                    now_s - came.received_s,
                    came.rate_hz,
                    track.state,
                    reason,
                    track.transform,
                    1.0 if is_reference else track.fit.score,
                    1.0 if is_reference else track.fit.overlap,
                    came.maps,
                    came.rejected,
                    track.fit.is_tracked,
                )
            )
        return tuple(out)

    # -- poses ------------------------------------------------------------------------------------

    def _contradict(self) -> None:
        """Take the vote of those whose poses contradict the others', and give it back."""
        with self._poses_lock:
            reasons = self._poses.contradictions()
        for name, track in self._inputs.items():
            track.contradiction = reasons.get(name, "")

    def _place(self) -> None:
        """Let the poses of those be compared whose maps are believed."""
        placed = {
            name: track.transform
            for name, track in self._inputs.items()
            if track.stands and track.transform is not None
        }
        with self._poses_lock:
            self._poses.place(placed)
