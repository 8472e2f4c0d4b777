"""``FusionSession``: a live fusion at work beside whoever receives maps and publishes; no ROS.

Requests and poses come from one thread, maps are fused in another. What the worker made is one
frozen ``Snapshot``, replaced as a whole, so that the other thread reads it without a lock.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.fusion.live.fusion import LiveFusion
from slamfusion.fusion.live.outbox import Fused, Outbox
from slamfusion.fusion.live.records import LiveInput, LiveUpdate
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid

__all__ = ["Arrived", "Believed", "FusionSession", "Memory", "Ports", "Snapshot", "warm_up"]

# Updates of one turn of the worker; it is to be woken again each second.
ROUNDS = 8
# Updates after which what is known of an input has seen that it was lost: one may be under way.
NOTICED = 2


@dataclass(frozen=True, eq=False)
class Arrived:
    """The newest message of an input, or the news that it is no input any more.

    Attributes:
        name: of the input.
        grid: its map; None where it cannot be read.
        problem: why not, one line; empty with ``grid``.
        arrived_s: when it came, on the clock of the session.
        is_saved: read from a file: it never grows stale.
        is_removed: it is no input any more; there is no map.
    """

    name: str
    grid: OccupancyGrid | None
    problem: str
    arrived_s: float
    is_saved: bool = False
    is_removed: bool = False


@dataclass(frozen=True, eq=False)
class Believed:
    """What the last fusion believes.

    Attributes:
        inputs: by name.
        reference: name of the input that others are aligned to.
    """

    inputs: Mapping[str, LiveInput] = field(default_factory=dict)
    reference: str = ""

    def transform(self, name: str) -> Pose2 | None:
        """Return an input's map frame in the fused frame; None while it does not vote."""
        record = self.inputs.get(name)
        return None if record is None or not record.accepted else record.transform


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What the worker made so far.

    Attributes:
        believed: by the last update.
        noted_s: when that was, on the clock of the session.
        update: the last one; None before the first.
        updates, searches, resets: how often.
        votes: how often an input got or lost its vote, or came, or left with its vote.
    """

    believed: Believed = field(default_factory=Believed)
    noted_s: float = 0.0
    update: LiveUpdate | None = None
    updates: int = 0
    searches: int = 0
    resets: int = 0
    votes: int = 0

    @property
    def nothing_fused(self) -> str:
        """Why no input votes, one line."""
        problem = "" if self.update is None else self.update.problem
        return f"nothing is fused: {problem or 'no map yet'}"


class Ports(Protocol):
    """What a session asks of whoever receives maps and publishes; in the worker's thread."""

    def take(self) -> Sequence[Arrived]:
        """Return what came since the last call: who was removed, then each one's newest message.

        After an input was removed no message of it comes, but of a new one that has its name.
        """

    def has_maps(self) -> bool:
        """Whether anything waits to be taken; asked often, so it must be quick."""

    def has_come(self, name: str) -> bool:
        """Whether an input has sent a map, or is a saved one."""

    def send(self, *, with_agreement: bool = True) -> None:
        """Publish what is due of the outbox."""

    def stamp_s(self, voters: Collection[str]) -> float:
        """Return the stamp of a fused map of these voters, seconds."""

    def say_vote(self, record: LiveInput) -> None:
        """Say that an input got or lost its vote, and why."""


class Memory(Protocol):
    """What a session remembers over a restart; in the worker's thread."""

    def is_waiting(self, has_come: Callable[[str], bool]) -> bool:
        """Whether inputs that had a place before the restart are waited for."""

    def confirm(self) -> None:
        """Take note that an input votes."""

    def change(self, stamp_s: float) -> None:
        """Take note of a new fused map and its stamp."""

    def keep(self) -> None:
        """Write what has changed, now and then."""

    def clear(self) -> None:
        """Forget it all: a new fused frame begins."""


class FusionSession:
    """Takes what came, fuses and lets be published; then does what could wait, until a map comes.

    Args:
        live: fuses; the session feeds it.
        outbox: where fused maps wait.
        memory: what is kept over a restart.
        clock: seconds, growing; of the maps too.

    Attributes:
        snapshot: what the worker made so far; any thread may read it.
        outbox: as given.
    """

    def __init__(
        self,
        live: LiveFusion,
        outbox: Outbox,
        memory: Memory,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.outbox = outbox
        self.snapshot = Snapshot(noted_s=clock())
        self._live = live
        self._memory = memory
        self._clock = clock
        self._arrived_s: float | None = None
        # Requests of any thread, taken by the worker's.
        self._lock = threading.Lock()
        self._wanted_live: LiveConfig | None = None
        self._is_reset_wanted = False
        # Of the thread that looks after the inputs.
        # Inputs that are lost, and how many updates there were before.
        self._lost: dict[str, int] = {}

    # -- from other threads -----------------------------------------------------------------------

    def ask_reset(self) -> None:
        """Let a new fused frame begin with the worker's next turn."""
        with self._lock:
            self._is_reset_wanted = True

    def ask_settings(self, live: LiveConfig) -> None:
        """Let other settings hold from the worker's next turn on."""
        with self._lock:
            self._wanted_live = live

    def hear(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Take a pose that an input tells; see ``LiveFusion.hear``."""
        self._live.hear(name, stamp_s, pose)

    def look(self, name: str, lost: str, *, has_map: bool, is_back: bool) -> bool:
        """Take how an input is; from one thread.

        Args:
            name: of the input.
            lost: why it is lost, one line; empty while it is not.
            has_map: whether it ever sent a map; one that did not cannot be lost.
            is_back: whether the process that was lost is the one that lives again.

        Returns:
            Whether the worker has something to do.
        """
        record = self.snapshot.believed.inputs.get(name)
        is_believed = record is not None and record.accepted
        if lost and has_map:
            # Also where a map that waited was taken after all.
            if name not in self._lost or is_believed:
                self._live.drop(name, lost)
                self._lost[name] = self.snapshot.updates
                return True
        elif name in self._lost and is_back:
            del self._lost[name]
            self._live.recall(name)
            return True
        elif is_believed and self.snapshot.updates - self._lost.get(name, 0) >= NOTICED:
            # By a map of its own. Until then it may yet turn out to be the one that was lost: its
            # first message may come ahead of the news of its process.
            self._lost.pop(name, None)
        return False

    def forget(self, name: str) -> None:
        """Forget how an input was that is none any more; from the thread of ``look``."""
        self._lost.pop(name, None)

    # -- in the worker's thread -------------------------------------------------------------------

    def turn(self, ports: Ports) -> None:
        """Do what there is to do."""
        self._apply_requests()
        outbox = self.outbox
        for _ in range(ROUNDS):
            if not self._take(ports.take()):
                ports.send()
                if outbox.waiting is not None:
                    return  # what could wait is not begun while a fused map waits for its turn
            if self._memory.is_waiting(ports.has_come):
                return
            update = self._live.update(self._clock(), ports.has_maps)
            if update is not None:
                self._note(update, ports)
            if outbox.waiting is not None and not outbox.may_gather(ports.has_maps):
                ports.send(with_agreement=not ports.has_maps())
            if update is None and not ports.has_maps():
                break
        ports.send()  # however many maps come
        self._memory.keep()

    def _apply_requests(self) -> None:
        """Do what was asked for since the last turn."""
        with self._lock:
            wanted, self._wanted_live = self._wanted_live, None
            is_reset, self._is_reset_wanted = self._is_reset_wanted, False
        if wanted is not None:
            self._live.configure(wanted)
        if is_reset:
            self._live.reset()
            self.snapshot = replace(self.snapshot, resets=self.snapshot.resets + 1)
            self._memory.clear()

    def _take(self, arrived: Sequence[Arrived]) -> bool:
        """Hand what came to the fusion; return whether there was any."""
        for item in arrived:
            if item.is_removed:
                self._live.remove(item.name)
                continue
            if self._arrived_s is None and not item.is_saved:
                self._arrived_s = item.arrived_s
            if item.grid is None:
                self._live.reject(item.name, item.problem, item.arrived_s)
            else:
                self._live.put(item.name, item.grid, item.arrived_s, is_saved=item.is_saved)
        return bool(arrived)

    def _note(self, update: LiveUpdate, ports: Ports) -> None:
        """Keep what an update did; a fused map waits for its turn to be published."""
        before = self.snapshot
        records = {record.name: record for record in update.inputs}
        votes = 0
        for name, record in records.items():
            old = before.believed.inputs.get(name)
            if old is None or old.accepted != record.accepted:
                votes += 1
                ports.say_vote(record)
        left = before.believed.inputs.keys() - records.keys()
        votes += sum(before.believed.inputs[name].accepted for name in left)
        voters = [name for name, record in records.items() if record.accepted]
        if voters:
            self._memory.confirm()
        self.snapshot = Snapshot(
            Believed(records, update.reference),
            self._clock(),
            update,
            before.updates + 1,
            before.searches + update.is_full_search,
            before.resets,
            before.votes + votes,
        )
        arrived_s, self._arrived_s = self._arrived_s, None
        if update.fused is None or update.agreement is None:
            return
        stamp_s = ports.stamp_s(voters)
        self.outbox.offer(Fused(update.fused, update.agreement, stamp_s, arrived_s))
        self._memory.change(stamp_s)


def warm_up(config: RunConfig, device: ComputeDevice) -> None:
    """Fuse two small drawn maps, so that the kernels are compiled before the first real ones."""
    cells = np.zeros((48, 60), dtype=np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = cells[10:14, 20:40] = cells[30:40, 44:47] = 100
    live = replace(config.live, minimum_inputs=2)
    trial = LiveFusion(replace(config, live=live, start={}), device)
    for number, name in enumerate("ab"):
        origin = Pose2(0.0, 0.0, 0.1 * number)
        trial.put(name, OccupancyGrid(cells, 0.05, origin, name), 0.0)
    trial.update(0.0)
    moved = cells.copy()
    moved[20:24, 10:14] = 100
    trial.put("b", OccupancyGrid(moved, 0.05, Pose2(0.0, 0.0, 0.1), "b"), 1.0)
    trial.update(1.0)
