"""``FusionNode``: fuses the maps of several SLAMs live."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from nav_msgs.msg import OccupancyGrid

from slamfusion import grid as grids
from slamfusion.config import (
    DeviceConfig,
    FusionConfig,
    FusionNodeConfig,
    LiveConfig,
    MapFileConfig,
    RunConfig,
    config_fields,
)
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.evidence.conditions import CONDITIONS, Condition
from slamfusion.fusion.live import LiveFusion, LiveInput, State
from slamfusion.fusion.live.session import FusedMap, FusionSession, FusionState, warm_up
from slamfusion.fusion.live.state import LiveState, StateError, is_state
from slamfusion.io.files import check_memory, user_path, write_atomic
from slamfusion.io.map_server import load_map
from slamfusion.jobs.live_drive import DriveSolution
from slamfusion.ros import messages, qos
from slamfusion.ros.base import FINAL, Level, NodeBase, Status, Worker
from slamfusion.ros.fused_frames import DriveInput, FusedFrames
from slamfusion.ros.fusion_inputs import ENTRY, FUSION, PREFIX, FusionInputs
from slamfusion.ros.fusion_services import MAP_TOPIC, FusionServices
from slamfusion.ros.input_health import Clocks, HeardPose, MapSource, name_writers
from slamfusion.ros.live_page import LivePage
from slamfusion.ros.parameters import declare, declare_starts

AGREEMENT_TOPIC = "fused/agreement"
CHANGEABLE = (
    *("discover", "discovery_rate_hz"),
    *("max_publish_rate_hz", "publish_tf", "save_path", "lost_after_s"),
    *("correction_speed", "correction_turn", "on_new_place"),
)
# Timer periods: publishing and the odometry frame; frames and inputs; publishers of the inputs; the
# page.
TURN_S, LOOK_S, LOOK_AROUND_S, SHOW_S = 0.05, 0.1, 1.0, 0.5
# Advice in a new place, by ``on_new_place``.
NEW_PLACE = {
    "ask": "; start a new map: slamfusion live reset",
    "reset": "; a new map starts",
    "keep": "; the map is kept (on_new_place)",
}
# Diagnostics level of an input's state; else WARN.
LEVELS = {State.TRACKED: Level.OK, State.LOST: Level.STALE}

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
        self._diagnostics, self._live = base.diagnostics, live
        self._path = user_path(path) if path else None
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
            if self._path.exists():
                self._read(self._path, names)
        self._writer: Worker[LiveState | None] = Worker(self._write, 1, self._failed, "state")

    def _read(self, path: Path, names: Collection[str]) -> None:
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
                self._diagnostics.say("state", text, Level.WARN, STATE_SHOWN_S)
                return
        except (OSError, SlamFusionError) as error:
            problem = f"{path}: the state cannot be read ({error})"
        if self.restored is None:
            self._path = None
            text = f"{problem}: no state is kept; start with another state_path"
            self._diagnostics.say("state", text)
            return
        self._returning = {*names} & {*self.restored.transforms}
        text = (
            f"restored from {str(path)!r} of {when.isoformat(' ', 'seconds')}, no input confirmed "
            "yet; reset starts a new fused frame"
        )
        self._diagnostics.say(RESTORED, text)

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
            self._diagnostics.clear(RESTORED)
            self._writer.put(None)
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
            self._writer.put(state)

    # --- the writer's thread -----------------------------------------------------------------

    def _write(self, state: LiveState | None) -> None:
        """Write a state; None removes the file."""
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
        self._diagnostics.clear("keep state")

    def _failed(self, _: LiveState | None, error: Exception) -> None:
        self._diagnostics.say("keep state", f"the state is not kept: {error}")


class FusionNode(NodeBase):
    """Fuses the maps of several SLAMs while they grow; see ``slamfusion.fusion.live``.

    Topics, services and parameters: ``slamfusion.ros.interface``. With ``state_path`` the fused
    frame, the transforms and the last map are kept in a file. A restarted node publishes that map
    at once and continues in that frame; inputs are tried at their old places, and those that do
    not fit have no vote until ``reset`` starts a new frame.

    Callbacks only keep the newest message. One worker converts, fuses and publishes: only the
    newest map of each input counts, and of several fused maps within one period of
    ``max_publish_rate_hz`` only the last is published.

    Raises:
        ConfigError: a parameter is refused, or ``state_path`` cannot be a file.
        DeviceError: the device cannot be used.
        MapFileError: a saved map cannot be read.
    """

    def __init__(self, name: str = "fusion", *, context: Any = None, arguments: Any = None) -> None:
        super().__init__(name, context=context, arguments=arguments)
        node = self.node
        self.settings = declare(
            node, FusionNodeConfig(), changeable=CHANGEABLE, on_change=self._on_settings
        )
        is_open = bool(self.settings.discover)
        self.inputs = FusionInputs(
            self,
            (MAP_TOPIC, AGREEMENT_TOPIC),
            is_open=is_open,
            load=self._load,
            listen=self._listen,
            on_change=self._on_inputs,
        )
        names = tuple(self.inputs.entries)
        least = LiveConfig().minimum_inputs
        live = LiveConfig(minimum_inputs=least if is_open else min(least, len(names)))
        self.live = declare(
            node,
            live,
            "live",
            changeable={item.key for item in config_fields(live, "live")} - {"live.extent"},
            on_change=self._on_live,
        )
        self._config = RunConfig(
            fusion=declare(node, FusionConfig(), "fusion"),
            live=self.live,
            device=declare(node, DeviceConfig()),
            map_files=declare(node, MapFileConfig()),
            start=declare_starts(node, names, may_come=is_open),
        )
        # Of what may fail first, so that a wrong token or a taken port fails early.
        carry_out = FusionServices(self).carry_out
        self._page = LivePage(self, self.settings, carry_out) if self.settings.page else None
        self._clocks = Clocks(self.clock_s, self.diagnostics)
        # Before the inputs: odometry is received first, then poses.
        device = self._config.device.device
        warm_up(self._config, self.open_device(device))
        self._device = self.open_device(device)
        self.drive = DriveInput(self, device, self._on_solution)
        self._frames = FusedFrames(self, self.drive.scans.odometry)
        self.inputs.begin()
        self.fusion = LiveFusion(self._config, self._device, None if is_open else names)

        # The last published map as message and grid; None before the first of a frame.
        self.published: tuple[OccupancyGrid, grids.OccupancyGrid] | None = None
        # Another node that publishes the fused map; empty without.
        self.rival = ""
        self._map_topic = node.create_publisher(OccupancyGrid, MAP_TOPIC, qos.MAP)
        updates = messages.MapUpdate, f"{MAP_TOPIC}_updates", qos.STREAM
        self._updates_topic = None if updates[0] is None else node.create_publisher(*updates)
        self._agreement_topic = node.create_publisher(OccupancyGrid, AGREEMENT_TOPIC, qos.MAP)
        self.session = FusionSession(
            self.fusion,
            self.settings.max_publish_rate_hz,
            publish=self._publish,
            publish_agreement=self._publish_agreement,
            stamp_s=self._stamp_s,
            on_vote=self._on_vote,
            is_heard=lambda: self._agreement_topic.get_subscription_count() > 0,
        )
        self._keeper = StateKeeper(self, self.fusion, self.settings.state_path, names)
        if (kept := self._keeper.restored) is not None:
            self.session.offer(FusedMap(kept.fused, kept.agreement, kept.stamp_s))
        self._shown_votes = 0
        # Stamp of the last scan of the last published final solution; 0 before the first.
        self._final_s = 0.0
        self._worker: Worker[None] = Worker(self._turn, 1, self.failed, "fusion")
        self._on_inputs([], self.inputs.saved.values())
        self.timer(TURN_S, self._look_turn)
        self.timer(LOOK_S, self._look)
        if self._page is not None:
            self.timer(SHOW_S, self._show)
        self.timer(LOOK_AROUND_S, self._look_around)
        self.log.info(
            f"fuses {', '.join(self.inputs.entries.values()) or self.settings.discover} on "
            f"{self._device.name}; the fused map is on {self.resolved(MAP_TOPIC)!r} in frame "
            f"{self.settings.fused_frame!r}"
        )

    # --- callbacks, in the executor's thread -------------------------------------------------

    def _load(self, name: str, path: Path) -> grids.OccupancyGrid:
        legacy_unknown = self._config.map_files.legacy_unknown
        return load_map(path, name=name, legacy_unknown=legacy_unknown, warn=self.log.warning)

    def _listen(self, name: str, topic: str) -> MapSource:
        lost_after_s = self.settings.lost_after_s
        return MapSource(self, name, topic, lost_after_s, self._clocks, self._on_map, self._on_pose)

    def _on_inputs(self, removed: Sequence[str], saved: Iterable[grids.OccupancyGrid]) -> None:
        for name in removed:
            self.session.remove(name)
            self._clocks.remove(name)
            self.drive.memory.remove(name)
            self.diagnostics.clear(f"writers {name}")
        for grid in saved:
            read = partial(self._on_page, grid.name, grid)
            self.fusion.put(grid.name, read, time.monotonic(), is_saved=True)
        self._wake()

    def _wake(self) -> None:
        self._worker.put(None)

    def _on_map(self, source: MapSource, message: Any) -> None:
        """Keep a map for the worker; None: the input's process fell silent, or is back."""
        if message is not None:
            read = partial(self._read, source, message)
            self.fusion.put(source.name, read, time.monotonic())
        self._wake()

    def _on_pose(self, source: MapSource, heard: HeardPose) -> None:
        self.fusion.hear(source.name, heard.stamp_s, heard.pose)
        self.drive.memory.add_pose(source.name, heard.stamp_s, heard.pose)
        self._frames.on_pose(source, heard)
        if self._page is not None:
            self._page.put_pose(source.name, heard.pose)

    def _look_turn(self) -> None:
        self._frames.drive()
        if self.session.is_due:
            self._wake()

    def _look(self) -> None:
        """Check which inputs are lost or back, and send new frames and votes."""
        self.inputs.discover(self.settings)
        for name, source in self.inputs.sources.items():
            if self.session.look(
                name, source.lost, has_map=bool(source.frame), is_back=source.liveliness.is_back
            ):
                self._wake()
        snapshot = self.session.snapshot
        self._frames.look()
        if snapshot.votes != self._shown_votes:  # votes are shown at once
            self._shown_votes = snapshot.votes
            self.publish_diagnostics()
            self._show()

    def _show(self) -> None:
        if self._page is not None:
            self._page.show(self.statuses(), self.session.snapshot, self.inputs.sources.values())

    def _look_around(self) -> None:
        """Check the publishers of the inputs and the fused map, clocks and paths."""
        sources = self.inputs.sources
        for source in sources.values():
            source.look()
        self.rival = name_writers(self, sources, MAP_TOPIC)
        self._clocks.look(sources)
        self.drive.look(sources)
        self._wake()

    def _on_settings(self, settings: FusionNodeConfig) -> None:
        self.settings = settings
        self.session.rate_hz = settings.max_publish_rate_hz
        for source in self.inputs.sources.values():
            source.ask(settings.lost_after_s)

    def _on_live(self, live: LiveConfig) -> None:
        self.live = live
        self.session.ask_settings(live)
        self._wake()

    def on_time_jump(self, delta_s: float) -> None:
        """Forget odometry and poses of later times; the maps stay."""
        if delta_s < 0.0:
            self._clocks.forget()
            self.drive.scans.forget_after(self.clock_s())
            self._frames.on_time_jump()

    def ask_reset(self) -> None:
        """Start a new fused frame; from any thread."""
        self.drive.memory.forget()
        self._name_conditions({})
        self.session.ask_reset()
        self.published = None
        self._wake()

    # --- the thread of the drive -------------------------------------------------------------

    def _on_solution(self, solution: DriveSolution) -> None:
        self.fusion.put_evidence(solution.evidence)
        if self.drive.locator.solution is not solution:  # the drive was forgotten meanwhile
            self.fusion.take_evidence()
            return
        conditions = solution.judgement.conditions
        self._name_conditions(conditions)
        if "new place" in conditions and self.settings.on_new_place == "reset":
            self.ask_reset()
        self._wake()

    def _name_conditions(self, found: Mapping[Condition, str]) -> None:
        for condition in CONDITIONS:
            text = found.get(condition)
            if text is not None and condition == "new place":
                text += NEW_PLACE[self.settings.on_new_place]
            level = Level.ERROR if condition == "new place" else Level.WARN
            self.diagnostics.say(f"drive {condition}", text, level)

    # --- the worker's thread -----------------------------------------------------------------

    def _turn(self, _: None) -> None:
        if self._keeper.is_waiting(self.fusion.has_come):
            self.session.send()
            return
        solution = self.drive.locator.solution
        self.session.turn()
        if solution is not None and solution.is_final and self.session.waiting is None:
            self._final_s = float(solution.path.stamps_s[-1])
        self._keeper.note(self.session.snapshot)

    def _read(self, source: MapSource, message: Any) -> grids.OccupancyGrid:
        return self._on_page(source.name, source.read(message))

    def _on_page(self, name: str, grid: grids.OccupancyGrid) -> grids.OccupancyGrid:
        if self._page is not None:
            self._page.put_input(name, grid)
        return grid

    def _publish(self, fused: FusedMap) -> None:
        message, before = self._message(fused, fused.grid), self.published
        self.published = message, fused.grid
        if before is None:  # there is something to save now
            self.diagnostics.clear("not saved")
        self._map_topic.publish(message)
        topic = self._updates_topic
        if before is not None and topic is not None and topic.get_subscription_count():
            update = messages.update_to_message(before[1], fused.grid, message.header)
            if update is not None:
                topic.publish(update)
        if self._page is not None:
            self._page.put_fused(fused)

    def _publish_agreement(self, fused: FusedMap) -> None:
        self._agreement_topic.publish(self._message(fused, fused.agreement))

    def _message(self, fused: FusedMap, grid: grids.OccupancyGrid) -> OccupancyGrid:
        stamp = messages.to_stamp(fused.stamp_s)
        return messages.grid_to_message(grid, self.settings.fused_frame, stamp)

    def _stamp_s(self, voters: Sequence[str]) -> float:
        """Return the stamp of the newest map in a fused map; 0 if all were saved ones."""
        sources = [source for name, source in self.inputs.sources.items() if name in voters]
        stamps = [source.stamp_s for source in sources if source.stamp_s is not None]
        # Without a plausible stamp: the node's time.
        return max(stamps, default=self.clock_s() if sources else 0.0)

    def _on_vote(self, record: LiveInput) -> None:
        # Two calls: rclpy ties a line of code to one level.
        if record.accepted:
            self.diagnostics.clear(RESTORED)
            self.log.info(f"{record.name} votes: {record.reason}")
        else:
            self.log.warning(f"{record.name} does not vote: {record.reason}")

    def statuses(self) -> list[Status]:
        """Return one line for the fusion and one for each input."""
        lines = [self._input_status(name, entry) for name, entry in self.inputs.entries.items()]
        return [self._fusion_status(lines), *lines]

    def _fusion_status(self, lines: Sequence[Status]) -> Status:
        level, wrong = self.diagnostics.worst("")
        out = [line.name.removeprefix(PREFIX) for line in lines if line.level != Level.OK]
        voters = len(lines) - len(out)
        snapshot, published = self.session.snapshot, self.published
        if not voters:
            words = snapshot.nothing_fused
            is_worse = published is not None and not self.diagnostics.is_on(RESTORED)
            level = max(level, Level.ERROR if is_worse else Level.WARN)
        elif out:
            votes = "votes" if voters == 1 else "vote"
            words = f"{voters} of {len(lines)} inputs {votes}; not: {', '.join(out)}"
            level = max(level, Level.WARN)
        else:
            words = f"all {voters} inputs vote" if voters > 1 else "1 input votes"
        if voters == 1 and self.live.minimum_inputs > 1:
            words += "; it goes on alone, and no other confirms it"
            level = max(level, Level.WARN)
        update, solution = snapshot.update, self.drive.locator.solution
        grid, memory = None if published is None else published[1], self.drive.memory
        values: dict[str, object] = {
            "inputs": len(lines),
            "voters": voters,
            "reference": None if update is None else update.reference,
            "pose from": self._frames.leader or None,
            "maps published": snapshot.sent_maps,
            "updates": snapshot.updates,
            "full searches": snapshot.searches,
            "resets": snapshot.resets,
            "scans": None if solution is None else len(solution.path),
            "scans dropped": self.drive.scans.dropped,
            FINAL: f"{self._final_s:.3f}" if memory.scans and memory.poses else None,
            "map [cells]": None if grid is None else f"{grid.width} x {grid.height}",
            "latency median [ms]": snapshot.median_ms,
            "latency p95 [ms]": snapshot.high_ms,
            "device": self._device.name,
        }
        if update is not None:
            values |= {f"{step} [ms]": 1e3 * spent for step, spent in update.time_s.items()}
        return Status(FUSION, level, "; ".join(filter(None, (words, wrong))), values)

    def _input_status(self, name: str, entry: str) -> Status:
        snapshot, source = self.session.snapshot, self.inputs.sources.get(name)
        record = snapshot.inputs.get(name)
        if record is None:
            text = "no map yet"
            if source is not None:
                topic, who = self.resolved(source.topic), self.senders(source.topic, OccupancyGrid)
                text = f"no map on {topic!r} yet; {who}"
            return Status(PREFIX + name, Level.STALE, text, {ENTRY: entry})
        place = record.transform
        values: dict[str, object] = {
            ENTRY: entry,
            "state": record.state.value,
            "accepted": record.accepted,
            "score": record.fit.score,
            "overlap": record.fit.overlap,
            "tracked": record.fit.is_tracked,
            "walls that agree": record.wall_agreement,
            "age [s]": time.monotonic() - record.messages.received_s,
            "rate [Hz]": record.messages.rate_hz,
            "maps": record.messages.maps,
            "maps refused": record.messages.rejected,
            "x [m]": place and place.x,
            "y [m]": place and place.y,
            "yaw [rad]": place and place.yaw_rad,
            "frame": source and (self._frames.child_frame(source) or source.frame),
        }
        level = LEVELS.get(record.state, Level.WARN)
        return Status(PREFIX + name, level, record.reason, values)

    def close(self) -> None:
        """Finish the current fusion, end the threads, and keep the state."""
        if self._page is not None:
            self._page.close()
        self.drive.close()
        self._keeper.close(is_whole=self._worker.close())
