"""``StateKeeper``: keeps the fusion's state in a file, for a restart in the same frame."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection
from datetime import datetime
from pathlib import Path

from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.fusion.live import LiveFusion
from slamfusion.fusion.live.session import FusionState
from slamfusion.fusion.live.state import LiveState, StateError, is_state
from slamfusion.io.files import check_memory, write_atomic
from slamfusion.ros.base import Level, NodeBase, Worker

# Shortest pause between writes, seconds, and their largest share of the time.
PAUSE_S, SHARE = 2.0, 0.1
# A problem with the found state is shown this long, seconds.
STATE_SHOWN_S = 60.0
# After a restart, wait this long for known inputs, seconds, so that the first fused map is not of
# the quickest alone.
RETURN_S = 2.0
UNUSABLE = ".unusable"
# Diagnostics key of a restart, until an input votes.
RESTORED = "restored"
# Bytes of a state in memory per byte of the compressed file.
GROWTH = 20


class StateKeeper:
    """Restores the state at the start, and writes the newest in its own thread.

    A file of another kind is never overwritten; an unusable state is moved aside. In the worker's
    thread, except the constructor.

    Args:
        live: restored and kept; still empty.
        path: ``~`` for the home folder; None or empty: nothing is read or kept.
        names: the inputs to wait for; places of others are kept until they come.

    Attributes:
        restored: the restored state, or None.

    Raises:
        ConfigError: the path's folder does not exist, or the path is a folder.
    """

    def __init__(
        self, base: NodeBase, live: LiveFusion, path: str | None, names: Collection[str]
    ) -> None:
        self.restored: LiveState | None = None
        self._base = base
        self._live = live
        self._path = Path(path).expanduser() if path else None
        self._next_s = float("-inf")
        # Last noted, and the stamp of the newest fused map that is not kept.
        self._resets = self._fused_maps = 0
        self._unkept_s: float | None = None
        self._began_s = time.monotonic()
        self._returning: set[str] = set()
        if self._path is not None:
            folder = Path(os.path.realpath(self._path)).parent
            if self._path.is_dir():
                raise ConfigError(f"state_path: {self._path} is a folder; name a file in it")
            if not folder.is_dir():
                message = f"state_path: there is no folder {folder}; make it, or name another path"
                raise ConfigError(message)
            self._read(self._path, names)
        self._writer: Worker[LiveState | None] = Worker(self._write, 1, self._failed, "state")

    def _read(self, path: Path, names: Collection[str]) -> None:
        if not path.exists():
            return
        diagnostics = self._base.diagnostics
        problem = f"{path} is no state of the fusion and is left as it is"
        try:
            check_memory(GROWTH * path.stat().st_size, "the fusion's state", str(path))
            data = path.read_bytes()
            when = datetime.fromtimestamp(path.stat().st_mtime).astimezone()
            if is_state(data):
                state = LiveState.from_bytes(data)
                self._live.restore(state)
                self.restored, problem = state, ""
        except StateError as error:
            aside = path.with_name(path.name + UNUSABLE)
            try:
                path.replace(aside)
            except OSError as failure:
                problem = f"{path}: {error}, and it cannot be moved aside ({failure.strerror})"
            else:
                text = f"{path}: {error}; it is {aside.name!r} now, and a new fused frame starts"
                diagnostics.say("state", text, Level.WARN, STATE_SHOWN_S)
                return
        except (OSError, SlamFusionError) as error:
            problem = f"{path}: the state cannot be read ({error})"
        if self.restored is None:
            self._path = None
            text = f"{problem}: no state is kept; start with another state_path"
            diagnostics.say("state", text)
            return
        self._returning = {*names} & {*self.restored.transforms}
        text = (
            f"restored from {str(path)!r} of {when.isoformat(' ', 'seconds')}, no input confirmed "
            "yet; reset starts a new fused frame"
        )
        diagnostics.say(RESTORED, text)

    def is_waiting(self, has_come: Callable[[str], bool]) -> bool:
        """Whether known inputs are awaited after a restart."""
        is_young = time.monotonic() - self._began_s < RETURN_S
        if not is_young or all(has_come(name) for name in self._returning):
            self._returning = set()
        return bool(self._returning)

    def note(self, state: FusionState) -> None:
        """Write changes now and then; a new frame deletes the kept state."""
        if state.resets != self._resets:
            self._resets, self._returning, self._unkept_s = state.resets, set(), None
            self._next_s = float("-inf")
            self._base.diagnostics.clear(RESTORED)
            self._put(None)
        if state.fused_maps != self._fused_maps:
            self._fused_maps, self._unkept_s = state.fused_maps, state.fused_stamp_s
        is_due = time.monotonic() >= self._next_s and self._writer.is_idle()
        if self._unkept_s is not None and is_due and self._path is not None:
            self._keep()

    def close(self, *, is_whole: bool) -> None:
        """Keep the last state if ``is_whole``: no other thread uses the fusion."""
        if is_whole and self._unkept_s is not None:
            self._keep()
        self._writer.is_idle(5.0)
        self._writer.close()

    def _keep(self) -> None:
        state, self._unkept_s = self._live.state(self._unkept_s or 0.0), None
        if state is not None:
            self._next_s = time.monotonic() + PAUSE_S
            self._put(state)

    def _put(self, state: LiveState | None) -> None:
        """Queue a state for writing; None removes the file."""
        if self._path is not None:
            self._writer.put(state)

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
        self._base.diagnostics.say("keep state", f"the state is not kept: {error}")
