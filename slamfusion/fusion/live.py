"""Fuse maps that arrive again and again; the fused frame never moves.

The rules, for a robot that drives by the fused map:

* **Frame.** The first fusion needs two inputs that agree (``live.minimum_inputs``); one map alone
  has nobody to check it, and its frame would bind all others. The reference of that fusion gives
  the frame, the lattice and its phase, which then stay until ``reset``, whatever becomes of it.
* **Held transforms.** An input's transform belongs to its map frame, not to its map: while most
  of its old walls still stand where they stood, it is held. Changed walls are tracked from the
  last transform against the reference. A better fit by less than ``live.hold_cells`` moves nothing.
* **Search.** An input is searched everywhere when it is new, or when its tracked score falls below
  a share of what the search last gave. A search that finds it elsewhere is believed when the next
  map's search finds the same. Where the map does not change (the robot stands) it is searched once
  more after ``live.confirm_s``, or at its second equal message, in another way: against another
  voter, or with the roles swapped. Until then the input does not vote.
* **Walls.** What votes matches: an input whose walls match the reference's no more loses its vote
  until a search, or a third, says which of the two is right. One that fits clearly better mirrored
  never votes (``live_mirror``).
* **Poses.** Inputs of one robot whose poses contradict the others' lose their vote while that lasts
  (``live_poses``); where nobody can say who is right, all of these do, and the last map stays.
* **Limits.** Numbers that no place has, noise and maps that are all occupied are refused before
  anything is done with them (``live_limits``); a map that is not believed takes no room in the
  fused one. A search in vain is followed by a long pause, and a long one is put off while maps of
  others wait, so that one bad map does not silence the others.
* **Reference.** It is the input that others are aligned to. It hands over when it is lost, when its
  walls moved, or when two others agree with each other and not with it; never because another
  looks better.
* **Doubt.** A map that is not believed does not vote, and neither does the older one before it.
  One healthy input goes on alone and is called so. Where two inputs disagree, both steady, a third
  decides, or else the last map that was agreed on: the one that still fits it goes on. Where both
  do, or none, nobody can say who is right: both are named and nothing new is published, so that
  the robot keeps that last map.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.errors import GridError, MemoryBudgetError
from slamfusion.fusion.live_canvas import Canvas, hull, joined
from slamfusion.fusion.live_input import Track
from slamfusion.fusion.live_judge import Judge
from slamfusion.fusion.live_limits import odd_resolution, too_large, unusable
from slamfusion.fusion.live_poses import PoseWatch
from slamfusion.fusion.live_state import LiveState, StateError
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid

__all__ = ["LiveFusion", "LiveInput", "LiveUpdate"]

# How much the newest interval counts in the rate.
RATE_WEIGHT = 0.3


@dataclass(frozen=True, eq=False)
class LiveInput:
    """One input as the last update left it.

    Attributes:
        name: as given to ``put``.
        age_s: time since its last message; infinite before the first.
        rate_hz: messages a second, smoothed; 0 before the second.
        accepted: whether it votes.
        reason: why (not), one line.
        transform: its map frame into the fused frame, metres; the last that was believed.
        score, overlap: of its last alignment, see ``Alignment``; 1 for the reference.
        maps: messages that came, usable or not.
        rejected: those among them that said too little or could not be read.
        is_tracked: whether the last alignment started from the last transform.
    """

    name: str
    age_s: float
    rate_hz: float
    accepted: bool
    reason: str
    transform: Pose2 | None
    score: float
    overlap: float
    maps: int
    rejected: int
    is_tracked: bool


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
        changed_box: holds the cells of ``fused`` that were voted on; None with ``fused``.
        problem: why nothing is fused, one line; empty while something is.
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


@dataclass(eq=False)
class _Mail:
    """What came of one input, written by any thread under the lock."""

    maps: int = 0
    rejected: int = 0
    received_s: float = float("-inf")
    rate_hz: float = 0.0
    is_saved: bool = False
    is_new: bool = False
    grid: OccupancyGrid | None = None
    refused: str | None = None
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
        self.is_new = True
        self.gone = None


class LiveFusion:
    """Fuse maps that arrive again and again; the fused frame never moves.

    ``put``, ``reject`` and ``drop`` are quick and may be called from any thread; ``update`` and
    ``reset`` from one, which does the work.
    """

    def __init__(self, config: RunConfig, device: ComputeDevice) -> None:
        """Start without inputs.

        Args:
            config: ``fusion`` and ``live`` count; proofs are left out, they take seconds.
            device: computes.
        """
        self._live = config.live
        self._config = config.fusion
        self._device = device
        self._lock = threading.Lock()
        self._mail: dict[str, _Mail] = {}
        self._clear()

    def _clear(self) -> None:
        self._judge = Judge(self._config, self._live, self._device)
        self._tracks = self._judge.tracks
        self._canvas: Canvas | None = None
        self._voters: tuple[str, ...] = ()
        self._poses = PoseWatch(self._live)
        self._restored: dict[str, Pose2] = {}

    # -- mail -------------------------------------------------------------------------------------

    def put(
        self, name: str, grid: OccupancyGrid, received_s: float, *, is_saved: bool = False
    ) -> None:
        """Take the newest map of an input; one that waits is replaced.

        Args:
            name: of the input.
            grid: its map, in its own frame; whatever it is called, it goes by the input's name.
            received_s: when it came, on the clock of ``update``.
            is_saved: read from a file: it never grows stale.
        """
        with self._lock:
            mail = self._mail.setdefault(name, _Mail())
            mail.count(received_s)
            mail.grid = grid if grid.name == name else grid.with_name(name)
            mail.refused, mail.is_saved = None, is_saved

    def reject(self, name: str, reason: str, received_s: float) -> None:
        """Count a message that could not be read; the input votes no more until one can."""
        with self._lock:
            mail = self._mail.setdefault(name, _Mail())
            mail.count(received_s)
            mail.rejected += 1
            mail.grid, mail.refused = None, reason

    def drop(self, name: str, reason: str) -> None:
        """Take an input for lost; it votes no more and comes back with its next map."""
        with self._lock:
            mail = self._mail.setdefault(name, _Mail())
            mail.is_new = True
            mail.grid, mail.gone = None, reason

    def hear(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Take a pose that an input tells; see ``live_poses`` for what it is compared with.

        Args:
            name: of the input.
            stamp_s: of the scan that it is for, seconds.
            pose: of the robot in the input's map frame; metres, radians.
        """
        with self._lock:
            self._poses.hear(name, stamp_s, pose)

    def recall(self, name: str) -> None:
        """Take an input that was dropped for present again, with the last map that it sent."""
        with self._lock:
            mail, track = self._mail.get(name), self._tracks.get(name)
            if mail is None or mail.gone is None:
                return
            mail.gone, mail.is_new = None, True
            mail.grid = None if track is None else track.grid

    def reset(self) -> None:
        """Forget the fused frame; every input's newest map starts the next one."""
        with self._lock:
            for name, track in self._tracks.items():
                mail = self._mail[name]
                if track.is_live and mail.grid is None and mail.gone is None:
                    mail.grid, mail.is_new = track.grid, True
        self._clear()

    def configure(self, live: LiveConfig) -> None:
        """Take other settings for what comes; from the thread of updates."""
        self._live = live
        self._judge.configure(live)
        with self._lock:
            self._poses.live = live

    # -- over a restart ---------------------------------------------------------------------------

    def state(self, stamp_s: float = 0.0) -> LiveState | None:
        """Return what another one needs to go on from here; from the thread of updates.

        Args:
            stamp_s: of the newest map in the fused one, to be kept beside it.

        Returns:
            None before the first fusion.
        """
        canvas = self._canvas
        if canvas is None or canvas.box is None:
            return None
        fused, agreement = canvas.grids()
        placed = {t.name: t.transform for t in self._tracks.values() if t.transform is not None}
        return LiveState(
            canvas.lattice,
            canvas.box.row0,
            canvas.box.col0,
            fused.cells,
            agreement.cells,
            {**self._restored, **placed},
            self._judge.reference,
            self._judge.scores,
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
        self._judge.restore(state.lattice, state.scores)
        self._canvas = Canvas(state.lattice, self._config, self._device)
        self._canvas.restore(state.box, state.fused, state.agreement)
        self._restored = dict(state.transforms)

    # -- update -----------------------------------------------------------------------------------

    def update(
        self, now_s: float, is_wanted: Callable[[], bool] | None = None
    ) -> LiveUpdate | None:
        """Bring the fused map up to date; None when nothing came and nothing changed.

        Call it for every map that comes, and again until it answers None: what can wait (aligning
        large maps again) is done while no map does, and given up for one that comes.

        Args:
            now_s: on the clock of ``put``.
            is_wanted: whether maps wait that were not put yet; asked often, so it must be quick.
        """
        clock = [time.perf_counter()]
        before = self._state()
        has_mail = self._collect(now_s)
        self._contradict()
        clock.append(time.perf_counter())
        self._judge.judge(
            now_s,
            self._last_fused,
            is_idle=not has_mail,
            is_wanted=lambda: self._has_mail() or (is_wanted is not None and is_wanted()),
        )
        self._place()
        if self._canvas is None and self._judge.lattice is not None:
            self._canvas = Canvas(self._judge.lattice, self._config, self._device)
        clock.append(time.perf_counter())
        box = self._vote()
        fused = agreement = None
        if box is not None:
            fused, agreement = self._fixed().grids()
        clock.append(time.perf_counter())
        if not has_mail and box is None and self._state() == before:
            return None
        steps = zip(("prepare", "align", "vote"), clock, clock[1:], strict=False)
        return LiveUpdate(
            fused,
            agreement,
            self.inputs(now_s),
            0 if self._canvas is None else self._canvas.phantom_cells,
            {step: end - begin for step, begin, end in steps},
            self._judge.has_searched,
            self._judge.reference,
            box,
            "" if self._voters else self._judge.problem,
        )

    def _has_mail(self) -> bool:
        with self._lock:
            return any(mail.is_new for mail in self._mail.values())

    def _last_fused(self) -> OccupancyGrid | None:
        if self._canvas is None or self._canvas.box is None:
            return None
        return self._canvas.grids()[0]

    def _fixed(self) -> Canvas:
        if self._canvas is None:
            message = "nothing was fused yet"
            raise ValueError(message)
        return self._canvas

    def _state(self) -> tuple[object, ...]:
        inputs = tuple((t.name, t.votes, t.why) for t in self._tracks.values())
        return (self._judge.reference, self._voters, inputs)

    def inputs(self, now_s: float) -> tuple[LiveInput, ...]:
        """Return the inputs as they stand; from the thread of updates."""
        out = []
        with self._lock:
            mails = {name: replace(mail) for name, mail in self._mail.items()}
        for name, track in self._tracks.items():
            mail = mails[name]
            is_reference = name == self._judge.reference and track.votes
            reason = track.why
            if self._voters == (name,) and self._live.minimum_inputs > 1:
                reason = "goes on alone: no other input to agree with"
            out.append(
                LiveInput(
                    name,
                    now_s - mail.received_s,
                    mail.rate_hz,
                    track.votes,
                    reason,
                    track.transform,
                    1.0 if is_reference else track.score,
                    1.0 if is_reference else track.overlap,
                    mail.maps,
                    mail.rejected,
                    track.is_tracked,
                )
            )
        return tuple(out)

    # -- prepare ----------------------------------------------------------------------------------

    def _collect(self, now_s: float) -> bool:
        """Hand the mail to the tracks; return whether there was any."""
        with self._lock:
            fresh = {name: replace(mail) for name, mail in self._mail.items() if mail.is_new}
            for mail in self._mail.values():
                mail.is_new, mail.grid = False, None
            received = {
                name: mail.received_s for name, mail in self._mail.items() if not mail.is_saved
            }
        for name, mail in fresh.items():
            track = self._tracks.setdefault(name, Track(name, transform=self._restored.get(name)))
            reason = mail.gone or mail.refused
            if reason is None and mail.grid is not None:
                reason = self._take(track, mail.grid)
                if reason is not None:
                    with self._lock:
                        self._mail[name].rejected += 1
            if reason is not None:
                track.is_live = False
                track.refuse(reason)
        # Older than another's, not than now: when the robot stands still all fall silent together.
        newest = max(received.values(), default=now_s)
        for name, came in received.items():
            stale = self._tracks.get(name)
            if stale is not None and stale.is_live and newest - came > self._live.stale_after_s:
                stale.is_live = False
                stale.refuse(f"no map for {now_s - came:.0f} s")
        return bool(fresh)

    def _take(self, track: Track, grid: OccupancyGrid) -> str | None:
        """Let a track follow its new map; return why it cannot, in words."""
        thresholds = self._config.normalize
        reason = unusable(grid, thresholds)
        if reason is not None:
            return reason
        resolution = None if self._canvas is None else self._canvas.lattice.resolution
        if resolution is not None:
            reason = odd_resolution(grid.resolution, resolution)
        reason = reason or too_large(grid, resolution or grid.resolution)
        if reason is not None:
            return reason
        try:
            change = track.follow(grid, resolution, thresholds, self._live, self._device)
        except (GridError, MemoryBudgetError) as error:
            return str(error)
        except MemoryError:
            return f"no memory is left for a map of {grid.height} x {grid.width} cells"
        if not track.is_live:
            track.is_live = True
            track.tried = None
            track.refuse("new; not aligned yet")
        if change is not None and track.name == self._judge.reference:
            for other in self._tracks.values():
                if other is not track:
                    other.drift += change.walls
        return None

    def _contradict(self) -> None:
        """Take the vote of those whose poses contradict the others', and give it back."""
        with self._lock:
            reasons = self._poses.contradictions()
        for name, track in self._tracks.items():
            track.contradiction = reasons.get(name, "")

    def _place(self) -> None:
        """Let the poses of those be compared whose maps are believed."""
        placed = {
            name: track.transform
            for name, track in self._tracks.items()
            if track.stands and track.transform is not None
        }
        with self._lock:
            self._poses.place(placed)

    # -- vote -------------------------------------------------------------------------------------

    def _vote(self) -> CellBox | None:
        """Lay what changed and vote on it; return those cells of the canvas, None without any."""
        canvas = self._canvas
        if canvas is None:
            return None
        grown = [self._make_room(canvas, track) for track in self._judge.voters]
        voters = self._judge.voters
        names = tuple(track.name for track in voters)
        for track in self._tracks.values():
            if track.name not in names:
                canvas.lift(track.name)
                track.relay = True
        if canvas.box is None or not names:
            self._voters = names
            return None
        has_shrunk = self._shrink(canvas, voters)
        parts = [self._lay(canvas, track) for track in voters]
        boxes = [part for part in parts if part is not None]
        if has_shrunk or any(grown) or names != self._voters or (boxes and self._is_weighted):
            boxes = [canvas.box]
        self._voters = names
        if not boxes:
            return None
        box, *others = (canvas.vote(names, part) for part in joined(boxes))
        for other in others:
            box = hull(box, other)
        whole = canvas.box
        rows, cols = (box.row0 - whole.row0, box.row1 - whole.row0), box.col0 - whole.col0
        return CellBox(rows[0], cols, rows[1], cols + box.width)

    @property
    def _is_weighted(self) -> bool:
        """Whether what changed in one place weighs in all others."""
        return self._config.vote.mode == "weighted"

    def _make_room(self, canvas: Canvas, track: Track) -> bool:
        """Grow the canvas to hold an input's new cells; return whether it grew."""
        if track.sheet is None or track.known is None or track.transform is None:
            return False
        if self._live.extent == "reference" and track.name != self._judge.reference:
            return False
        needed = canvas.lattice.box_of(track.known, track.sheet.lattice, track.transform)
        try:
            return canvas.grow(needed, track.name) is not None
        except MemoryBudgetError as error:
            track.refuse(str(error))
            return False

    def _shrink(self, canvas: Canvas, voters: list[Track]) -> bool:
        """Give back what the canvas holds for no voter; return whether there was any."""
        boxes = [
            canvas.lattice.box_of(track.known, track.sheet.lattice, track.transform)
            for track in voters
            if track.sheet is not None and track.known is not None and track.transform is not None
            if self._live.extent != "reference" or track.name == self._judge.reference
        ]
        if not boxes:
            return False
        needed = boxes[0]
        for box in boxes[1:]:
            needed = hull(needed, box)
        return canvas.shrink(needed) is not None

    @staticmethod
    def _lay(canvas: Canvas, track: Track) -> CellBox | None:
        """Lay what the canvas has not seen of an input; return the cells of the lattice."""
        if track.sheet is None or track.known is None or track.transform is None:
            return None
        if not track.relay and track.unlaid is None:
            return None
        changed = None if track.relay else track.unlaid
        track.relay, track.unlaid = False, None
        return canvas.lay(track.name, track.sheet, track.known, track.transform, changed)
