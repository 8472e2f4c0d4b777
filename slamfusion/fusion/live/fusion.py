"""Fuse maps that arrive repeatedly; the fused frame never moves.

docs/concepts/live_fusion.md states the rules of frame, reference, search, doubt and evidence. A
transform belongs to an input's map frame, not to its map. A map in doubt takes no room in the fused
map, and the older map of its input does not vote either.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.align.normalize import common_resolution, odd_resolution
from slamfusion.align.starts import place_starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.inputs import Fit, Input, Reason, State, too_large, unusable
from slamfusion.fusion.live.poses import PoseWatch
from slamfusion.fusion.live.state import LiveState, StateError
from slamfusion.fusion.live.supervisor import InputSupervisor
from slamfusion.fusion.live.voting import FusedLayers
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import IDENTITY, CellBox, OccupancyGrid
from slamfusion.io.files import return_freed_memory
from slamfusion.vote.lattice import Lattice
from slamfusion.vote.tiles import check_votes

# Weight of the newest interval in the rate.
RATE_WEIGHT = 0.3


@dataclass(eq=False)
class InputMessage:
    """The messages of one input.

    Attributes:
        maps: messages that came, usable or not.
        rejected: those among them that contain too little or cannot be read.
        received_s: when the last one came; minus infinity before the first.
        rate_hz: messages a second, smoothed; 0 before the second.
        is_saved: read from a file: it never grows stale.
        is_new: whether anything came since the last ``Mailbox.take``.
        waits_since_s: when the first message came since then; None without.
        grid: the newest map that waits, or what reads it; None without.
        gone: why the input is lost; None: it is not.
    """

    maps: int = 0
    rejected: int = 0
    received_s: float = float("-inf")
    rate_hz: float = 0.0
    is_saved: bool = False
    is_new: bool = False
    waits_since_s: float | None = None
    grid: OccupancyGrid | Callable[[], OccupancyGrid] | None = None
    gone: str | None = None

    def count(self, received_s: float) -> None:
        """Count a message."""
        interval = received_s - self.received_s
        if self.maps and interval > 0.0:
            rate = 1.0 / interval
            first = self.maps == 1
            self.rate_hz = rate if first else self.rate_hz + RATE_WEIGHT * (rate - self.rate_hz)
        self.maps += 1
        self.received_s = received_s
        if self.waits_since_s is None:
            self.waits_since_s = received_s

    def read(self) -> OccupancyGrid | None:
        """Return the map that waits; raises a SlamFusionError where it cannot be read."""
        return self.grid() if callable(self.grid) else self.grid


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of the scans of a drive for its inputs.

    Attributes:
        transforms: of each input whose poses were scored on the scans: its map frame into the fused
            frame, as its poses say; metres, radians.
        doubts: why an input has no vote, by name, one line.
        lattice: of ``drawn``.
        drawn: the map drawn from the scans, in the fused frame; None: the maps of all inputs vote.
    """

    transforms: Mapping[str, Pose2]
    doubts: Mapping[str, str]
    lattice: Lattice
    drawn: OccupancyGrid | None = None


class Mailbox:
    """Keeps the newest map of each input, and the evidence, until taken; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._received: dict[str, InputMessage] = {}
        self._removed: list[str] = []
        self._evidence: Evidence | None = None

    def put_evidence(self, evidence: Evidence) -> None:
        """Take what the scans say now; what waits is replaced."""
        with self._lock:
            self._evidence = evidence

    def put(
        self,
        name: str,
        grid: OccupancyGrid | Callable[[], OccupancyGrid],
        received_s: float,
        *,
        is_saved: bool = False,
    ) -> None:
        """Take the newest map of an input; one that waits is replaced.

        ``grid`` may be a function that reads the map later; if it raises a SlamFusionError the
        input does not vote until one can be read. ``received_s`` is on the clock of
        ``LiveFusion.update``; a saved map never grows stale.
        """
        with self._lock:
            item = self._received.setdefault(name, InputMessage())
            item.count(received_s)
            item.grid, item.gone, item.is_saved, item.is_new = grid, None, is_saved, True

    def drop(self, name: str, reason: str) -> None:
        """Mark an input as lost; it does not vote, and comes back with its next map."""
        with self._lock:
            item = self._received.setdefault(name, InputMessage())
            item.grid, item.gone, item.is_new = None, reason, True

    def recall(self, name: str) -> None:
        """Mark a dropped input as present again, with its last map."""
        with self._lock:
            item = self._received.get(name)
            if item is not None and item.gone is not None:
                item.gone, item.is_new = None, True

    def remove(self, name: str) -> None:
        """Forget an input, its vote and its place; under its name a new one may come."""
        with self._lock:
            self._received.pop(name, None)
            self._removed.append(name)

    def refill(self, grids: Mapping[str, OccupancyGrid | None]) -> None:
        """Put taken maps back, unless a newer one waits or the input is lost."""
        with self._lock:
            for name, grid in grids.items():
                item = self._received.get(name)
                if item is not None and item.grid is None and item.gone is None:
                    item.grid, item.is_new = grid, True

    def count_rejected(self, name: str) -> None:
        """Count a map that was taken and cannot be used."""
        with self._lock:
            if name in self._received:
                self._received[name].rejected += 1

    @property
    def has_new(self) -> bool:
        """Whether anything waits to be taken; quick, so that it may be asked often."""
        with self._lock:
            is_waiting = bool(self._removed) or self._evidence is not None
            return is_waiting or any(item.is_new for item in self._received.values())

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a message."""
        with self._lock:
            return name in self._received and self._received[name].maps > 0

    def take(self) -> tuple[list[str], dict[str, InputMessage]]:
        """Return what came since the last call, as of one moment.

        Returns:
            The inputs that were removed, which is older than all else; and what is new, by name.
        """
        with self._lock:
            removed, self._removed = self._removed, []
            fresh = {name: replace(item) for name, item in self._received.items() if item.is_new}
            for item in self._received.values():
                item.is_new, item.grid, item.waits_since_s = False, None, None
        return removed, fresh

    def take_evidence(self) -> Evidence | None:
        """Return the evidence that came since the last call; None: none did."""
        with self._lock:
            evidence, self._evidence = self._evidence, None
        return evidence

    def counts(self) -> dict[str, InputMessage]:
        """Return a copy of what each input sent, by name."""
        with self._lock:
            return {name: replace(item) for name, item in self._received.items()}


# The input that is drawn from scans; no topic has a blank in its name.
DRAWN = "the scans"


@dataclass(frozen=True, eq=False)
class LiveInput:
    """One input after the last update.

    Attributes:
        messages: those that came; their ``grid`` is no result.
        reason, transform: see ``Input``.
        fit: its last alignment; score and overlap are 1 for the reference.
        wall_agreement: share of its walls that agree with the other maps'; None: it does not vote,
            or the vote weighs no map.
    """

    name: str
    messages: InputMessage
    state: State
    reason: str
    transform: Pose2 | None
    fit: Fit
    wall_agreement: float | None

    @property
    def accepted(self) -> bool:
        """Whether it votes."""
        return self.state is State.TRACKED


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """The outcome of an update.

    Attributes:
        fused: cells -1, 0, 100 in the fused frame; None when there is nothing new to publish.
        agreement: share of votes for the winner, 0..100, -1 without; None with ``fused``.
        inputs: every input so far, in the order of arrival.
        time_s: seconds by step: ``prepare``, ``align``, ``vote``.
        is_full_search: whether an input was searched everywhere.
        reference: name of the input that others are aligned to; empty without.
        problem: why nothing is fused, one line; empty while something is.
        arrived_s: when the first map came that the update took; None: none, or saved maps alone.
    """

    fused: OccupancyGrid | None
    agreement: OccupancyGrid | None
    inputs: tuple[LiveInput, ...]
    time_s: dict[str, float]
    is_full_search: bool
    reference: str
    problem: str = ""
    arrived_s: float | None = None


class LiveFusion(Mailbox):
    """Fuse maps that arrive repeatedly; the fused frame never moves.

    ``hear`` and what a ``Mailbox`` takes are quick and may be called from any thread; ``update``
    and the others from one, which does the work.
    """

    def __init__(
        self, config: RunConfig, device: ComputeDevice, inputs: Sequence[str] | None = None
    ) -> None:
        """Start without inputs.

        Args:
            config: ``fusion``, ``live`` and ``start`` count.
            inputs: names of those that are to come, which starts must name; None: any may come.

        Raises:
            StartError: a start names no input, or there is one alone that says nothing.
            ConfigError: the mode is no vote.
        """
        super().__init__()
        check_votes(config.fusion.vote)
        self._live = config.live
        self._config = config.fusion
        self._starts = place_starts(config.start, inputs, config.fusion.reference)
        self._device = device
        self._clear()

    def _clear(self) -> None:
        self._layers = FusedLayers(self._config, self._live, self._device)
        self._aligner = Aligner(self._layers, self._starts)
        self._supervisor = InputSupervisor(self._aligner)
        self._inputs = self._supervisor.inputs
        with self._lock:
            self._poses = PoseWatch()
        self._restored: dict[str, Pose2] = {}
        self._said: Evidence | None = None
        self._drawn = self._input(DRAWN, IDENTITY)

    def _input(self, name: str, transform: Pose2 | None) -> Input:
        return Input(name, self._config.normalize, self._device, transform=transform)

    # -- what comes, beside maps ------------------------------------------------------------------

    def hear(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Receive a pose of the robot in the input's map frame, for the scan at ``stamp_s``."""
        with self._lock:
            self._poses.hear(name, stamp_s, pose)

    def covariance(self, leader: str, voters: Collection[str], stamp_s: float) -> F64:
        """Return that of a voter's pose by the poses of others; see ``PoseWatch.covariance``."""
        with self._lock:
            return self._poses.covariance(leader, voters, stamp_s)

    def reset(self) -> None:
        """Forget the fused frame; every input's newest map starts the next one."""
        self.take_evidence()
        inputs = [
            self._input(one.name, None) if one.is_live else one.emptied()
            for one in self._inputs.values()
        ]
        self._refill()
        self._inputs.update({one.name: one for one in inputs})

    def _refill(self) -> None:
        """Forget all but the newest maps."""
        self.refill({t.name: t.grid for t in self._inputs.values() if t.is_live})
        self._clear()

    def configure(self, live: LiveConfig) -> None:
        """Change the settings; in the thread of updates."""
        self._live = self._layers.live = live

    # -- over a restart ---------------------------------------------------------------------------

    def state(self, stamp_s: float = 0.0) -> LiveState | None:
        """Return what a restarted fusion needs, None before the first fusion; in the update thread.

        ``stamp_s`` is the stamp of the newest map in the fused one.
        """
        layers = self._layers
        if layers.lattice is None or layers.box is None:
            return None
        placed = {t.name: t.transform for t in self._inputs.values() if t.transform is not None}
        return LiveState(
            layers.lattice,
            *layers.grids(),
            {**self._restored, **placed},
            self._supervisor.reference,
            self._aligner.scores,
            stamp_s,
        )

    def restore(self, state: LiveState) -> None:
        """Continue in the fused frame of a state; before the first update.

        Inputs are tried at their old places, against the last fused map, and searched if they do
        not fit there.

        Raises:
            StateError: its cell size differs from the settings.
        """
        wanted, found = self._config.normalize.resolution, state.lattice.resolution
        if wanted is not None and wanted != found:
            message = f"the state has cells of {found:g} m, and resolution asks for {wanted:g} m"
            raise StateError(message)
        self._refill()
        self._aligner.restore(state.scores)
        self._supervisor.problem = "no input has come yet"
        self._layers.restore(state)
        self._restored = dict(state.transforms)

    # -- update -----------------------------------------------------------------------------------

    def update(self, now_s: float) -> LiveUpdate | None:
        """Bring the fused map up to date; None if nothing came and nothing changed.

        Call it for every map, with the clock of ``put``, and again until it returns None: slow work
        (aligning large maps again) waits until no map does.
        """
        clock = [time.perf_counter()]
        before = self._state()
        has_evidence = self._weigh()
        has_news, arrived_s = self._collect(now_s)
        self._contradict()
        self._expect()
        clock.append(time.perf_counter())
        self._supervisor.align(now_s, is_idle=not has_news)
        if sum(one.release() for one in self._inputs.values()):
            return_freed_memory()  # at once: the holes of features are as large as all else
        self._place()
        clock.append(time.perf_counter())
        box = self._vote()
        fused, agreement = (None, None) if box is None else self._layers.grids()
        clock.append(time.perf_counter())
        if not (has_news or has_evidence) and box is None and self._state() == before:
            return None
        steps = zip(("prepare", "align", "vote"), clock, clock[1:], strict=False)
        return LiveUpdate(
            fused,
            agreement,
            self.inputs(),
            {step: end - begin for step, begin, end in steps},
            self._aligner.has_searched,
            self._supervisor.reference,
            "" if self._layers.names else self._supervisor.problem,
            arrived_s,
        )

    def _weigh(self) -> bool:
        """Apply the evidence of the scans; return whether anything came."""
        evidence = self.take_evidence()
        if evidence is None:
            return False
        drawn = evidence.drawn
        if drawn is not None and unusable(drawn, self._config.normalize):
            evidence, drawn = replace(evidence, drawn=None), None
        lattice = self._layers.lattice
        if drawn is not None and lattice is None:
            agreement = replace(drawn, cells=np.where(drawn.cells < 0, np.int8(-1), np.int8(100)))
            self.restore(LiveState(evidence.lattice, drawn, agreement, evidence.transforms))
            lattice = evidence.lattice
        self._said = evidence
        if drawn is not None and lattice == evidence.lattice:
            track = self._drawn
            change = track.follow(drawn.with_name(DRAWN), lattice.resolution)
            track.accept(Reason.DRAWN)
            if change is not None:
                self._layers.note(DRAWN, change.box)
        else:
            self._drawn = self._input(DRAWN, IDENTITY)
        return True

    def _vote(self) -> CellBox | None:
        """Let the map drawn from scans vote, and those whose poses it was not drawn by."""
        supervisor, drawn = self._supervisor, self._drawn
        voters, reference = supervisor.voters, supervisor.reference
        if drawn.votes:
            voters = [drawn, *(one for one in voters if not one.is_drawn)]
            reference = DRAWN
        return self._layers.update([*self._inputs.values(), drawn], voters, reference)

    def _collect(self, now_s: float) -> tuple[bool, float | None]:
        """Pass maps to the tracks; return whether there was any, and when the first came.

        An input is stale if its last map is older than that of another one with a usable map by
        ``live.stale_after_s``; if the robot stands still all become silent together.
        """
        removed, fresh = self.take()
        for name in removed:
            self._inputs.pop(name, None)
            self._aligner.remove(name)
            self._layers.lift(name)
            self._restored.pop(name, None)
            with self._lock:
                self._poses.remove(name)
        for name, item in fresh.items():
            track = self._inputs.setdefault(name, self._input(name, self._restored.get(name)))
            if item.gone is not None:
                track.turn(Reason.GONE, why=item.gone)
            elif why := self._take(track, item):
                self.count_rejected(name)
                track.refuse_map(why)
        came = {
            name: item
            for name, item in self.counts().items()
            if not item.is_saved and name in self._inputs and self._inputs[name].is_live
        }
        newest_s = max((item.received_s for item in came.values()), default=now_s)
        for name, item in came.items():
            if newest_s - item.received_s > self._live.stale_after_s:
                reason = Reason.STALE_ONE if item.maps == 1 else Reason.STALE
                self._inputs[name].turn(reason, seconds=self._live.stale_after_s)
        since_s = [
            item.waits_since_s
            for item in fresh.values()
            if item.waits_since_s is not None and not item.is_saved
        ]
        return bool(fresh or removed), min(since_s, default=None)

    def _take(self, track: Input, item: InputMessage) -> str | None:
        """Let an input take the waiting map; return why it cannot, in words."""
        resolution, thresholds = self._layers.resolution, self._config.normalize
        was_live = track.is_live
        try:
            # A dropped input that is back continues with its last map.
            grid = item.read() or track.grid
            if grid is None:
                return None
            grid = grid if grid.name == track.name else grid.with_name(track.name)
            if reason := (
                unusable(grid, thresholds)
                or (resolution and odd_resolution(grid.resolution, resolution))
                or too_large(grid, resolution or grid.resolution)
            ):
                return reason
            change = track.follow(grid, resolution)
        except SlamFusionError as error:
            return str(error).removeprefix(f"{track.name}: ")
        except MemoryError:
            return "no memory is left for its map"
        if not was_live:
            track.turn(Reason.NEW)
            track.tried = None
        if change is not None:
            self._layers.note(track.name, change.box)
            self._supervisor.note(track, change)
        return None

    @property
    def lattice(self) -> Lattice | None:
        """Of the fused frame; None before the first fusion."""
        return self._layers.lattice

    @property
    def resolution(self) -> float | None:
        """Metres per cell of the fused map; before the first fusion as the maps that came give."""
        grids = [track.grid for track in self._inputs.values() if track.grid is not None]
        if self.lattice is None and grids:
            return common_resolution(grids, self._config.normalize)
        return self._layers.resolution

    def _state(self) -> tuple[object, ...]:
        inputs = tuple((t.name, t.state, t.why) for t in self._inputs.values())
        return (self._supervisor.reference, self._layers.names, inputs)

    def inputs(self) -> tuple[LiveInput, ...]:
        """Return the inputs as they stand; from the thread of updates."""
        out = []
        counts = self.counts()
        for name, track in self._inputs.items():
            came = counts.get(name) or InputMessage()  # removed, and not yet noticed
            fit, reason = track.fit, track.why
            if name == self._supervisor.reference and track.votes:
                fit = replace(fit, score=1.0, overlap=1.0)
            if track.votes and name in self._layers.bent:
                reason += f"; {self._layers.bent[name].words}"
                reason += "; or the other map is" if len(self._layers.names) == 2 else ""
            if self._layers.names == (name,) and self._live.minimum_inputs > 1:
                reason = Reason.ALONE.says()
            out.append(
                LiveInput(
                    name,
                    came,
                    track.state,
                    reason,
                    track.transform,
                    fit,
                    self._layers.wall_agreement.get(name),
                )
            )
        return tuple(out)

    # -- poses ------------------------------------------------------------------------------------

    def _contradict(self) -> None:
        """Update the votes by contradicted poses.

        Scans decide for the inputs that were scored on them; for others the distances of poses do.
        """
        with self._lock:
            reasons = self._poses.contradictions()
        said = self._said
        if said is not None:
            apart = {name: why for name, why in reasons.items() if name not in said.transforms}
            reasons = {**apart, **said.doubts}
        for name, track in self._inputs.items():
            track.contradiction = reasons.get(name, "")
            track.is_drawn = self._drawn.votes and said is not None and name in said.transforms

    def _expect(self) -> None:
        """Set the expected places of inputs by poses of equal stamps."""
        unplaced = [t.name for t in self._inputs.values() if t.is_live and t.transform is None]
        if unplaced:
            with self._lock:
                pairs = self._poses.starts(unplaced)
            self._aligner.starts = replace(self._starts, pairs=pairs)

    def _place(self) -> None:
        """Compare the poses of the inputs whose maps are accepted."""
        placed = {
            name: track.transform
            for name, track in self._inputs.items()
            if track.stands and track.transform is not None
        }
        with self._lock:
            self._poses.place(placed)
