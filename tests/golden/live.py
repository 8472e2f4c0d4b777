"""Plays a script to a live fusion and writes down all that it publishes and says.

A script is a list of lines, each of which is one or several events with ``;`` between them, after
which 1000 s pass and the session has its turn. Events:

    maps A B ...     these maps come: a name with changes, ``a:left60:mirrored``
    bad A            a message of A that cannot be read
    lost A, back A   the process of A dies, or lives again
    removed A        A is no input any more
    pose A X Y YAW   a pose of the robot in the map frame of A
    reset            a new fused frame begins
    set KEY VALUE    another setting of ``live``
    restart          another session goes on with the kept state
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple
from unittest import mock

import numpy as np

from slamfusion.compute import open_device
from slamfusion.config import LiveConfig, RunConfig
from slamfusion.errors import GridError
from slamfusion.fusion.live import LiveFusion, LiveInput
from slamfusion.fusion.live.session import FusedMap, FusionSession
from slamfusion.fusion.live.state import LiveState
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, OccupancyGrid
from tests.fusion.live.maps import AWAY, littered, mirrored, moved_frame, noise, three, touched

# Between two lines; longer than any pause of the fusion.
STEP_S = 1000.0
LIVE = LiveConfig(search_pause_s=0.0, stale_after_s=2.5 * STEP_S, confirm_s=STEP_S)


def play(events: Iterable[str]) -> str:
    """Return a text with what came of each line of a script."""
    player = Player()
    out = []
    # A search in vain is followed by a pause where it took long, which a busy machine would show.
    with mock.patch("time.perf_counter", return_value=0.0):
        for line in events:
            player.said.clear()
            for event in line.split(";"):
                what, *words = event.split()
                getattr(player, f"_{what}")(*words)
            player.turn()
            out += [f"> {line}", *player.said]
    return "\n".join(out) + "\n"


class Arrived(NamedTuple):
    """What waits until the next turn: a map, one that cannot be read, or that an input is gone."""

    name: str
    grid: OccupancyGrid | None
    problem: str
    arrived_s: float
    is_removed: bool = False


class Player:
    """A session with all that it asks of its surroundings, and its clock.

    Attributes:
        said: lines since the last event.
    """

    def __init__(self) -> None:
        self.said: list[str] = []
        self._device = open_device()
        self._live = LIVE
        self._now_s = 0.0
        self._waiting: list[Arrived] = []
        self._begin()

    def _begin(self) -> None:
        self._fusion = LiveFusion(RunConfig(live=self._live), self._device)
        self._session = FusionSession(
            self._fusion,
            1.0,
            publish=lambda fused: self._publish("fused map", fused.grid, fused),
            publish_agreement=lambda fused: self._publish("agreement", fused.agreement, fused),
            stamp_s=self.stamp_s,
            on_vote=self.on_vote,
            clock=lambda: self._now_s,
        )

    def turn(self) -> None:
        """Let the session work, and write down what it believes."""
        self._now_s += STEP_S
        self._deliver()
        resets, told = self._session.snapshot.resets, len(self.said)
        self._session.turn()
        now = self._session.snapshot
        if now.resets > resets:
            self.said.insert(told, "the kept state is forgotten")
        counts = f"{now.updates} updates, {now.searches} searches, {now.resets} resets"
        self.said.append(f"{counts}, {now.votes} votes, reference {now.reference or '-'}")
        if not any(record.accepted for record in now.inputs.values()):
            self.said.append(now.nothing_fused)
        for record in now.inputs.values():
            fit, came = record.fit, record.messages
            place = "nowhere" if record.transform is None else _pose(record.transform)
            self.said.append(
                f"{record.name} {'votes' if record.accepted else 'no vote'}: {record.reason}; "
                f"{place}; score {fit.score!r}, overlap {fit.overlap!r}, {came.maps} maps, "
                f"{came.rejected} rejected{', tracked' if fit.is_tracked else ''}"
            )

    # -- events -----------------------------------------------------------------------------------

    def _maps(self, *words: str) -> None:
        self._waiting += [
            Arrived(word.partition(":")[0], _message(word), "", self._now_s) for word in words
        ]

    def _bad(self, name: str) -> None:
        self._waiting.append(Arrived(name, None, "a size of 0 cells", self._now_s))

    def _lost(self, name: str) -> None:
        self._session.look(name, "its process has ended", has_map=True, is_back=False)

    def _back(self, name: str) -> None:
        self._session.look(name, "", has_map=True, is_back=True)

    def _removed(self, name: str) -> None:
        self._waiting.append(Arrived(name, None, "", self._now_s, is_removed=True))

    def _pose(self, name: str, *numbers: str) -> None:
        self._fusion.hear(name, self._now_s, Pose2(*map(float, numbers)))

    def _reset(self) -> None:
        self._session.ask_reset()

    def _set(self, key: str, value: str) -> None:
        kind = type(getattr(self._live, key))
        self._live = replace(self._live, **{key: kind(value)})
        self._session.ask_settings(self._live)

    def _restart(self) -> None:
        state = self._fusion.state()
        kept = state.to_bytes()
        self.said.append(f"kept {len(state.transforms)} transforms, {_cells(state.fused.cells)}")
        self._begin()
        self._fusion.restore(LiveState.from_bytes(kept))

    # -- what a session asks ----------------------------------------------------------------------

    def _deliver(self) -> None:
        """Hand over what came: first the inputs that are gone."""
        for item in self._waiting:
            if item.is_removed:
                self._session.remove(item.name)
            elif item.grid is not None:
                self._fusion.put(item.name, item.grid, item.arrived_s)
            else:
                self._fusion.put(item.name, partial(_refuse, item.problem), item.arrived_s)
        self._waiting = []

    def _publish(self, what: str, grid: OccupancyGrid, fused: FusedMap) -> None:
        place = f"origin {_pose(grid.origin)}, cells of {grid.resolution:g} m"
        self.said.append(f"{what}: {_cells(grid.cells)}, {place}, stamp {fused.stamp_s:g}")

    def stamp_s(self, voters: Sequence[str]) -> float:
        """Return a stamp that shows how many vote."""
        return self._now_s + len(voters)

    def on_vote(self, record: LiveInput) -> None:
        """Write down that an input got or lost its vote."""
        self.said.append(f"{record.name} {'got' if record.accepted else 'has no'} vote")


def _refuse(problem: str) -> OccupancyGrid:
    raise GridError(problem)


def _message(word: str) -> OccupancyGrid:
    """Return a map with changes, by its word."""
    name, *changes = word.split(":")
    grid = noise() if name == "noise" else three()[name if name in "abc" else "c"]
    for change in changes:
        if change.startswith("left"):
            cells = grid.cells.copy()
            cells[:, int(change[4:]) * grid.width // 100 :] = UNKNOWN
            grid = replace(grid, cells=cells)
        elif change.startswith("touched"):
            grid = touched(grid, int(change[7:]))
        else:
            grid = {
                "mirrored": mirrored,
                "littered": lambda one: littered(one, 1),
                "moved": lambda one: moved_frame(one, AWAY),
            }[change](grid)
    return grid.with_name(name)


def _pose(pose: Pose2) -> str:
    return f"({pose.x!r}, {pose.y!r}, {pose.yaw_rad!r})"


def _cells(cells: np.ndarray) -> str:
    height, width = cells.shape
    counts = ", ".join(f"{(cells == value).sum()} of {value}" for value in (-1, 0, 100))
    digest = hashlib.sha256(np.ascontiguousarray(cells).tobytes()).hexdigest()[:16]
    return f"{width} x {height} cells, {counts}, sha256 {digest}"
