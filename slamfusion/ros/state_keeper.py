"""The fusion's state in a file, so that a restart goes on in the same frame."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection
from datetime import datetime
from pathlib import Path

from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.fusion.live import LiveFusion
from slamfusion.fusion.live.state import LiveState, StateError, is_state
from slamfusion.io.atomic import write_atomic
from slamfusion.io.memory import check_memory
from slamfusion.ros.base import Level, NodeBase
from slamfusion.ros.worker import Worker

# A state is written at most this often, seconds, and so that writing takes a tenth of the time.
PAUSE_S, SHARE = 2.0, 0.1
# What was wrong with the state that was found is shown this long, seconds.
SHOWN_S = 60.0
# After a restart the inputs that had a place are waited for this long, seconds, so that the first
# map that is fused again is not that of the quickest alone.
RETURN_S = 2.0
UNUSABLE = ".unusable"
# Bytes of a state in memory for each of the file: most maps compress well.
GROWTH = 20


class StateKeeper:
    """Reads the state at the start, and writes the newest in a thread of its own.

    What is not a state is never written over; one that cannot be used is moved aside. Without a
    path nothing is read or kept.

    Args:
        base: the node, whose diagnostics name what goes wrong.
        path: of the file, ``~`` for the home folder; None or empty: nothing is kept.

    Raises:
        ConfigError: the path's folder does not exist, or the path is a folder.
    """

    def __init__(self, base: NodeBase, path: str | None) -> None:
        self._base = base
        self._path = Path(path).expanduser() if path else None
        self._next_s = float("-inf")
        if self._path is not None:
            _check_place(self._path)
        self._writer: Worker[LiveState | None] = Worker(self._write, 1, self._failed, "state")

    @property
    def is_due(self) -> bool:
        """Whether a state would be written now, and the last one has been."""
        is_time = self._path is not None and time.monotonic() >= self._next_s
        return is_time and self._writer.is_idle

    def read(self) -> tuple[LiveState, str] | None:
        """Return the kept state and, in words, from where and when; None without a usable one."""
        path = self._path
        if path is None or not path.exists():
            return None
        try:
            check_memory(GROWTH * path.stat().st_size, "the fusion's state", str(path))
            data = path.read_bytes()
            written_s = path.stat().st_mtime
        except (OSError, SlamFusionError) as error:
            self._give_up(f"{path}: the state cannot be read ({error})")
            return None
        if not is_state(data):
            self._give_up(f"{path} is no state of the fusion and is left as it is")
            return None
        try:
            state = LiveState.from_bytes(data)
        except StateError as error:
            self.refuse(error)
            return None
        when = datetime.fromtimestamp(written_s).astimezone().isoformat(" ", "seconds")
        return state, f"{str(path)!r} of {when}"

    def refuse(self, error: StateError) -> None:
        """Move a state that cannot be used aside, and say so."""
        path = self._path
        if path is None:
            return
        aside = path.with_name(path.name + UNUSABLE)
        try:
            path.replace(aside)
        except OSError as failure:
            self._give_up(f"{path}: {error}, and it cannot be moved aside ({failure.strerror})")
            return
        text = f"{path}: {error}; it is {aside.name!r} now, and a new fused frame begins"
        self._base.diagnostics.add("state", Level.WARN, text, SHOWN_S)

    def keep(self, state: LiveState) -> None:
        """Let a state be written; returns at once."""
        if self._path is not None:
            self._next_s = time.monotonic() + PAUSE_S
            self._writer.put(state)

    def clear(self) -> None:
        """Let the kept state be removed: a new fused frame begins; returns at once."""
        if self._path is not None:
            self._next_s = float("-inf")
            self._writer.put(None)

    def close(self, state: LiveState | None) -> None:
        """Write the last state, if there is one, and end the thread."""
        if state is not None:
            self.keep(state)
        self._writer.wait_idle(5.0)
        self._writer.close()

    def _give_up(self, problem: str) -> None:
        """Keep nothing, and say why for as long as the node runs."""
        self._path = None
        text = f"{problem}: no state is kept; start with another state_path"
        self._base.diagnostics.add("state", Level.WARN, text)

    # --- the writer's thread -----------------------------------------------------------------

    def _write(self, state: LiveState | None) -> None:
        path = self._path
        if path is None:
            return
        began_s = time.monotonic()
        if state is None:
            path.unlink(missing_ok=True)
        else:
            write_atomic(path, state.to_bytes())
        spent_s = time.monotonic() - began_s
        self._next_s = max(self._next_s, time.monotonic() + spent_s / SHARE)
        self._base.diagnostics.clear("keep state")

    def _failed(self, _: LiveState | None, error: Exception) -> None:
        text = f"the state is not kept: {error}"
        self._base.diagnostics.add("keep state", Level.WARN, text)


class Memory:
    """What a fusion remembers over a restart: restored at the start, kept as it changes.

    In the worker's thread, apart from the constructor.

    Args:
        base: the node.
        live: what is restored and kept; nothing was put there yet.
        path: of the file; None or empty for none.
        names: the inputs, which are waited for; places of others are kept until these come.

    Attributes:
        restored: the state that the node went on from; None where it started empty.

    Raises:
        ConfigError: the path cannot be that of a file.
    """

    def __init__(
        self, base: NodeBase, live: LiveFusion, path: str | None, names: Collection[str]
    ) -> None:
        self.restored: LiveState | None = None
        self._base = base
        self._live = live
        self._keeper = StateKeeper(base, path)
        # The stamp of the newest fused map, as long as it was not kept.
        self._unkept_s: float | None = None
        self._began_s = time.monotonic()
        self._returning: set[str] = set()
        kept = self._keeper.read()
        if kept is not None:
            self._restore(*kept, names)

    def _restore(self, state: LiveState, words: str, names: Collection[str]) -> None:
        try:
            self._live.restore(state)
        except StateError as error:
            self._keeper.refuse(error)
            return
        self.restored = state
        self._returning = {*names} & {*state.transforms}
        text = f"restored from {words}, no input confirmed yet; reset begins a new fused frame"
        self._base.diagnostics.add("restored", Level.WARN, text)

    @property
    def is_unconfirmed(self) -> bool:
        """Whether no input has voted since the restart."""
        return self._base.diagnostics.is_on("restored")

    def confirm(self) -> None:
        """Take note that an input votes."""
        self._base.diagnostics.clear("restored")

    def is_waiting(self, has_come: Callable[[str], bool]) -> bool:
        """Whether inputs that had a place before the restart are waited for."""
        if not self._returning:
            return False
        is_young = time.monotonic() - self._began_s < RETURN_S
        if is_young and not all(has_come(name) for name in self._returning):
            return True
        self._returning = set()
        return False

    def change(self, stamp_s: float) -> None:
        """Take note of a new fused map and its stamp."""
        self._unkept_s = stamp_s

    def keep(self) -> None:
        """Let the state be written where it has changed, now and then."""
        if self._unkept_s is not None and self._keeper.is_due:
            state, self._unkept_s = self._live.state(self._unkept_s), None
            if state is not None:
                self._keeper.keep(state)

    def clear(self) -> None:
        """Forget it all: a new fused frame begins."""
        self._returning = set()
        self._unkept_s = None
        self._keeper.clear()
        self.confirm()

    def close(self, *, is_whole: bool) -> None:
        """Keep the last state; ``is_whole``: no other thread is at work on the fusion."""
        is_newer = is_whole and self._unkept_s is not None
        self._keeper.close(self._live.state(self._unkept_s or 0.0) if is_newer else None)


def _check_place(path: Path) -> None:
    """Refuse a path that no file can have; folders are not made."""
    if path.is_dir():
        message = f"state_path: {path} is a folder; name a file in it"
        raise ConfigError(message)
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        message = f"state_path: there is no folder {folder}; make it, or name another path"
        raise ConfigError(message)
