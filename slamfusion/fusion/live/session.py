"""``FusionSession``: a live fusion in a worker thread, without ROS.

Requests and poses come from one thread, maps are fused in another. The worker's results are one
frozen ``FusionState``, replaced as a whole, so that the other thread reads it without a lock.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from queue import Empty, SimpleQueue

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.fusion.live.fusion import LiveFusion, LiveInput, LiveUpdate
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.vote.lattice import Lattice

# Updates per turn of the worker, which is woken each second.
ROUNDS = 8
# Updates after which a lost input is noticed: one may be running.
NOTICED = 2
# Number of fused maps in the latency statistics.
LATENCIES = 300
# A fused map waits at most this long for maps that came while it was made, seconds: sending one of
# 16 MB blocks them longer than fusing them.
GATHER_S = 0.25


@dataclass(frozen=True, eq=False)
class FusionState:
    """The results of the worker so far.

    Attributes:
        inputs: by name, after the last update.
        update: the last one; None before the first.
        votes: how often an input got or lost its vote, or came, or left with its vote.
        fused_stamp_s: stamp of the newest of them, seconds.
        sent_maps: fused maps that were published.
        median_ms, high_ms: median and 95th percentile from the arrival of a map to the publication
            of its fused map.
        lattice, resolution: see ``LiveFusion``.
    """

    inputs: Mapping[str, LiveInput] = field(default_factory=dict)
    reference: str = ""
    update: LiveUpdate | None = None
    updates: int = 0
    searches: int = 0
    resets: int = 0
    votes: int = 0
    fused_maps: int = 0
    fused_stamp_s: float = 0.0
    sent_maps: int = 0
    median_ms: float = 0.0
    high_ms: float = 0.0
    lattice: Lattice | None = None
    resolution: float | None = None

    @property
    def nothing_fused(self) -> str:
        """Why there is no fused map or no vote, one line."""
        if any(record.accepted for record in self.inputs.values()):
            return "the first fused map is not published yet"
        problem = "no map yet" if self.update is None else self.update.problem
        if not problem:
            return "no input votes: the fused map is drawn from the scans alone"
        return f"nothing is fused: {problem}"

    def transform(self, name: str) -> Pose2 | None:
        """Return an input's map frame in the fused frame; None while it does not vote."""
        record = self.inputs.get(name)
        return None if record is None or not record.accepted else record.transform


@dataclass(frozen=True, eq=False)
class FusedMap:
    """A fused map that is to be published.

    Attributes:
        grid, agreement: of one update; the agreement goes out after it, when somebody listens.
        stamp_s: of the newest map in it; 0 where all were saved maps.
        arrived_s: when the first map came that it shows and none before it did.
    """

    grid: OccupancyGrid
    agreement: OccupancyGrid
    stamp_s: float
    arrived_s: float | None = None


class FusionSession:
    """Fuses what comes and publishes it; then does what could wait, until a map comes.

    Of several fused maps within one period of ``rate_hz`` only the last goes out.

    Args:
        live: fuses; maps are put there.
        rate_hz: maps a second that may go out at most.
        publish: sends a fused map; in the worker's thread, as the next two.
        publish_agreement: sends the agreement of the map that went out last.
        stamp_s: returns the stamp of a fused map of these voters, seconds.
        on_vote: called with an input that got or lost its vote.
        is_heard: whether somebody listens to the agreement; from any thread.
        clock: seconds, growing; of the maps too.

    Attributes:
        snapshot: what the worker made so far; any thread may read it.
        rate_hz: may be replaced.
        waiting: the fused map that waits for its turn; None without.
    """

    def __init__(
        self,
        live: LiveFusion,
        rate_hz: float,
        *,
        publish: Callable[[FusedMap], None],
        publish_agreement: Callable[[FusedMap], None],
        stamp_s: Callable[[Sequence[str]], float],
        on_vote: Callable[[LiveInput], None],
        is_heard: Callable[[], bool] = lambda: True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.snapshot = FusionState()
        self.rate_hz = rate_hz
        self.waiting: FusedMap | None = None
        self._live = live
        self._publish, self._publish_agreement = publish, publish_agreement
        self._stamp_s, self._on_vote, self._is_heard = stamp_s, on_vote, is_heard
        self._clock = clock
        # Requests of other threads, for the worker's.
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        # The map that went out last, until its agreement does.
        self._unagreed: FusedMap | None = None
        self._sent_s = float("-inf")
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)
        # Inputs that are lost, and how many updates there were before; of the thread of ``look``.
        self._lost: dict[str, int] = {}

    # -- from other threads -----------------------------------------------------------------------

    def ask_reset(self) -> None:
        """Let a new fused frame begin with the worker's next turn."""
        self._asked.put(self._reset)

    def ask_settings(self, live: LiveConfig) -> None:
        """Let other settings hold from the worker's next turn on."""
        self._asked.put(partial(self._live.configure, live))

    def look(self, name: str, lost: str, *, has_map: bool, is_back: bool) -> bool:
        """Receive the state of an input, from one thread; return whether the worker has work.

        ``lost`` is the reason of a loss, or empty; ``is_back``: the lost process is alive again.
        """
        record = self.snapshot.inputs.get(name)
        is_accepted = record is not None and record.accepted
        if lost and has_map:
            # Also where a map that waited was taken after all.
            if name not in self._lost or is_accepted:
                self._live.drop(name, lost)
                self._lost[name] = self.snapshot.updates
                return True
        elif name in self._lost and is_back:
            del self._lost[name]
            self._live.recall(name)
            return True
        elif is_accepted and self.snapshot.updates - self._lost.get(name, 0) >= NOTICED:
            # By a map of its own. Until then it may yet turn out to be the one that was lost: its
            # first message may come ahead of the news of its process.
            self._lost.pop(name, None)
        return False

    def remove(self, name: str) -> None:
        """Let an input be none any more; from the thread of ``look``."""
        self._lost.pop(name, None)
        self._live.remove(name)

    @property
    def is_due(self) -> bool:
        """Whether a fused map could go out now, or an agreement to somebody who listens."""
        is_map_due = self.waiting is not None and self._is_turn
        return is_map_due or (self._unagreed is not None and self._is_heard())

    # -- in the worker's thread -------------------------------------------------------------------

    def turn(self) -> None:
        """Do what there is to do."""
        while True:
            try:
                self._asked.get_nowait()()
            except Empty:
                break
        for _ in range(ROUNDS):
            now_s = self._clock()
            if not self._live.has_new:
                self.send()
                if self.waiting is not None:
                    return  # what could wait is not begun while a fused map waits for its turn
            update = self._live.update(now_s)
            if update is not None:
                self._note(update)
            arrived_s = None if self.waiting is None else self.waiting.arrived_s
            is_young = arrived_s is not None and self._clock() - arrived_s < GATHER_S
            # It goes on waiting for maps that came while it was made.
            if self.waiting is not None and not (is_young and self._live.has_new):
                self.send(with_agreement=not self._live.has_new)
            if update is None and not self._live.has_new:
                break
        self.send()  # however many maps come

    def offer(self, fused: FusedMap) -> None:
        """Let a fused map wait in the place of an older one; what came first for that counts."""
        before = self.waiting
        self.waiting = fused if before is None else replace(fused, arrived_s=before.arrived_s)

    def send(self, *, with_agreement: bool = True) -> None:
        """Publish the map that waits, if its turn has come, and the agreement where it is heard."""
        fused = self.waiting
        # After a request it may be of a frame that ends.
        if fused is not None and self._is_turn and self._asked.empty():
            self.waiting, self._unagreed, self._sent_s = None, fused, self._clock()
            self._publish(fused)
            if fused.arrived_s is not None:
                self._latencies_s.append(self._clock() - fused.arrived_s)
            median, high = 1e3 * np.percentile([*self._latencies_s] or [0.0], (50.0, 95.0))
            self.snapshot = replace(
                self.snapshot,
                sent_maps=self.snapshot.sent_maps + 1,
                median_ms=float(median),
                high_ms=float(high),
            )
        if with_agreement and self._unagreed is not None and self._is_heard():
            fused, self._unagreed = self._unagreed, None
            self._publish_agreement(fused)

    @property
    def _is_turn(self) -> bool:
        """Whether the last map that was sent is old enough for another one."""
        return self._clock() - self._sent_s >= 1.0 / self.rate_hz

    def _reset(self) -> None:
        self._live.reset()
        self.waiting = self._unagreed = None
        self.snapshot = replace(self.snapshot, resets=self.snapshot.resets + 1)

    def _note(self, update: LiveUpdate) -> None:
        """Keep what an update did; a fused map waits for its turn to be published."""
        before = self.snapshot
        records = {record.name: record for record in update.inputs}
        votes = 0
        for name, record in records.items():
            old = before.inputs.get(name)
            if old is None or old.accepted != record.accepted:
                votes += 1
                self._on_vote(record)
        left = before.inputs.keys() - records.keys()
        votes += sum(before.inputs[name].accepted for name in left)
        state = replace(
            before,
            inputs=records,
            reference=update.reference,
            update=update,
            updates=before.updates + 1,
            searches=before.searches + update.is_full_search,
            votes=before.votes + votes,
            lattice=self._live.lattice,
            resolution=self._live.resolution,
        )
        if update.fused is not None and update.agreement is not None:
            stamp_s = self._stamp_s([name for name, item in records.items() if item.accepted])
            self.offer(FusedMap(update.fused, update.agreement, stamp_s, update.arrived_s))
            state = replace(state, fused_maps=before.fused_maps + 1, fused_stamp_s=stamp_s)
        self.snapshot = state


def warm_up(config: RunConfig, device: ComputeDevice) -> None:
    """Fuse two small drawn maps, so that the kernels are compiled before the first real ones.

    Close the device then: until that PoCL's compiler keeps 80 MB.
    """
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
