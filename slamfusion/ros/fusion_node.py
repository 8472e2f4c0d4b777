"""``FusionNode``: maps of any SLAMs in, one fused map out, live."""

from __future__ import annotations

import threading
import time
import traceback
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid

from slamfusion import grid as grids
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import (
    DeviceConfig,
    FusionConfig,
    FusionNodeConfig,
    LiveConfig,
    MapFileConfig,
    RunConfig,
)
from slamfusion.errors import SlamFusionError
from slamfusion.fusion.live import LiveFusion, LiveInput, LiveUpdate
from slamfusion.geometry import Pose2
from slamfusion.ros import messages
from slamfusion.ros.base import Level, NodeBase, Status
from slamfusion.ros.fused_frames import Believed, FusedFrames
from slamfusion.ros.fused_output import MAP_TOPIC, Fused, FusedOutput
from slamfusion.ros.fusion_services import FusionServices
from slamfusion.ros.fusion_status import fusion_status, input_status
from slamfusion.ros.map_source import MapSource, input_names, load_saved
from slamfusion.ros.parameters import declare, declare_names, parameter_names
from slamfusion.ros.stamps import Stamps
from slamfusion.ros.state_keeper import Memory
from slamfusion.ros.worker import Worker
from slamfusion.ros.writers import Writers
from slamfusion.slam.registry import BUILT_IN

__all__ = ["FusionNode", "make_node"]

DEFAULT_INPUTS = tuple(f"{name}/map" for name in BUILT_IN)
CHANGEABLE = ("max_publish_rate_hz", "publish_tf", "save_path", "lost_after_s")
# How often the node looks whether a fused map may go out, at frames, and who publishes its inputs.
TURN_S, LOOK_S, LOOK_AROUND_S = 0.02, 0.1, 1.0
SHOWN_S = 10.0
# Updates of one turn of the worker; it is woken again each second.
ROUNDS = 8


def make_node(_: str, **options: Any) -> NodeBase:
    """Return the fusion node; see ``FusionNode``."""
    return FusionNode(**options)


class _Wake:
    """Tells the worker to look what there is to do."""


@dataclass
class _Counts:
    """What happened so far; written by the worker."""

    updates: int = 0
    searches: int = 0
    resets: int = 0


class FusionNode(NodeBase):
    """Fuses the maps of several SLAMs while they grow; see ``slamfusion.fusion.live``.

    Reads the map topics of ``inputs`` and the poses beside them (``NAME/pose`` for ``NAME/map``);
    an entry ``file:PATH`` is a saved map. Writes ``fused/map`` and ``fused/agreement`` (reliable,
    transient local: who comes late gets the last ones; the agreement is sent only while somebody
    listens, and to the first who does), ``fused/pose``, ``/diagnostics`` and the transforms of
    ``FusedFrames``. Services: those of ``FusionServices``.

    With ``state_path`` the fused frame, the transforms and the last map are kept in a file. A node
    that finds one publishes that map at once and goes on in that frame; its inputs are tried where
    they lay, and those that fit nowhere do not vote until ``reset`` begins a new frame.

    The callbacks only keep the newest message. One worker converts, fuses and publishes: of maps
    that come while it works only the newest of each input counts, and a fused map waits a moment
    for those. When several fused maps fall into one period of ``max_publish_rate_hz`` only the last
    is published.

    Args:
        context: rclpy's; default: the one of ``rclpy.init``.
        arguments: ROS arguments of this node alone.

    Raises:
        ConfigError: a parameter is refused, or ``state_path`` cannot be a file.
        DeviceError: the device cannot be used.
        MapFileError: a saved map cannot be read.
    """

    def __init__(self, *, context: Any = None, arguments: Any = None) -> None:
        super().__init__("fusion", context=context, arguments=arguments)
        node = self.node
        self.settings = declare(
            node, FusionNodeConfig, changeable=CHANGEABLE, on_change=self._on_settings
        )
        text = "what is fused: map topics, and file:PATH for saved maps"
        entries = input_names(declare_names(node, "inputs", DEFAULT_INPUTS, text))
        live = LiveConfig(minimum_inputs=min(LiveConfig().minimum_inputs, len(entries)))
        live = declare(
            node,
            live,
            "live",
            changeable=[name for name in parameter_names(LiveConfig) if name != "extent"],
            on_change=self._on_live,
        )
        config = RunConfig(
            fusion=declare(node, FusionConfig, "fusion"),
            live=live,
            device=declare(node, DeviceConfig),
            map_files=declare(node, MapFileConfig),
        )
        self._saved = {
            name: grid
            for name, entry in entries.items()
            if (grid := load_saved(name, entry, config.map_files, self.log.warning)) is not None
        }
        self._device = open_device(config.device.device)
        _warm(config, self._device)
        self._live = LiveFusion(config, self._device)

        # Written by the worker's thread, read by the executor's: each is replaced as a whole.
        self._inputs: tuple[tuple[LiveInput, ...], float] = ((), time.monotonic())
        self._last: LiveUpdate | None = None
        self._arrived_s: float | None = None
        self._has_news = False
        self._counts = _Counts()
        # Written by the executor's thread, taken by the worker's.
        self._wanted_live: LiveConfig | None = None
        self._is_reset_wanted = threading.Event()
        self._lost: set[str] = set()

        self._output = FusedOutput(self, self.settings)
        self._frames = FusedFrames(self, self.settings)
        self._writers = Writers(self, MAP_TOPIC)
        self._stamps = Stamps(self.clock_s)
        self._memory = Memory(self, self._live, self.settings.state_path, entries)
        if (kept := self._memory.restored) is not None:
            self._output.waiting = Fused(*kept.grids(), kept.stamp_s, None)
        self._worker: Worker[_Wake] = Worker(self._work, 1, self._failed, "fusion")
        lost_after_s = self.settings.lost_after_s
        self._sources = {
            name: MapSource(
                self, name, entry, lost_after_s, self._stamps, self._wake, self._on_pose
            )
            for name, entry in entries.items()
            if name not in self._saved
        }
        self._frames.watch(self._sources)
        self._services = FusionServices(self, self)
        for name, grid in self._saved.items():
            self._live.put(name, grid, time.monotonic(), is_saved=True)
        self.timer(TURN_S, self._look_turn)
        self.timer(LOOK_S, self._look)
        self.timer(LOOK_AROUND_S, self._look_around)
        self.log.info(
            f"fuses {', '.join(entries.values())} on {self._device.name}; the fused map is on "
            f"{node.resolve_topic_name(MAP_TOPIC)!r} in frame {self.settings.fused_frame!r}"
        )
        self._wake()

    # --- callbacks, in the executor's thread -------------------------------------------------

    def _wake(self) -> None:
        self._worker.put(_Wake())

    def _on_pose(self, source: MapSource) -> None:
        """Let a pose be compared with the others', and send what it tells."""
        heard = source.pose
        if heard is not None:
            self._live.hear(source.name, messages.stamp_s(heard.stamp), heard.pose)
        self._frames.on_pose(source)

    def _look_turn(self) -> None:
        """Wake the worker for what had to wait for its turn, or for somebody who listens."""
        if self._output.is_wanted:
            self._wake()

    def _look(self) -> None:
        """See which inputs are lost or back, and send what is new of the frames and votes."""
        for name, source in self._sources.items():
            reason = source.lost
            if reason and source.frame:
                record = self._frames.believed.inputs.get(name)
                # Also where a map that waited was taken after all.
                if name not in self._lost or (record is not None and record.accepted):
                    self._live.drop(name, reason)
                    self._lost.add(name)
                    self._wake()
            elif name in self._lost:
                self._lost.remove(name)
                if source.is_back:
                    self._live.recall(name)
                    self._wake()
        self._frames.look()
        if self._has_news:  # who votes is said at once, not within the second
            self._has_news = False
            self.publish_diagnostics()

    def _look_around(self) -> None:
        """See who publishes the inputs and the fused map, and let ages be looked at."""
        for source in self._sources.values():
            source.look()
        self._writers.look({name: source.topic for name, source in self._sources.items()})
        self._frames.rival = self._writers.rival
        self._wake()

    def _on_settings(self, settings: FusionNodeConfig) -> None:
        self.settings = self._frames.settings = self._output.settings = settings
        for source in self._sources.values():
            source.ask(settings.lost_after_s)

    def _on_live(self, live: LiveConfig) -> None:
        self._wanted_live = live
        self._wake()

    def on_time_jump(self, delta_s: float) -> None:
        """Forget the odometry of a future that has not come; the maps speak for themselves."""
        if delta_s < 0.0:
            self._stamps.forget()
            self._frames.on_time_jump(self.clock_s())

    @property
    def published(self) -> tuple[OccupancyGrid, grids.OccupancyGrid] | None:
        """The last published map as message and as grid; None before the first."""
        return self._output.published

    def nothing_fused(self) -> str:
        """Say why no input votes."""
        problem = "no map yet" if self._last is None else self._last.problem
        return f"nothing is fused: {problem or 'no map yet'}"

    def ask_reset(self) -> None:
        """Let the worker begin a new fused frame."""
        self._is_reset_wanted.set()
        self._wake()

    # --- the worker's thread -----------------------------------------------------------------

    def _work(self, _wake: _Wake) -> None:
        """Take what came, fuse, publish; then do what could wait, until a map comes."""
        self._obey()
        output = self._output
        for _ in range(ROUNDS):
            took = [self._take(source) for source in self._sources.values()]
            if not any(took):
                output.send()
                if output.waiting is not None:
                    return  # what could wait is not begun while a fused map waits for its turn
            if self._memory.is_waiting(self._has_come):
                return
            update = self._live.update(time.monotonic(), self._has_maps)
            if update is not None:
                self._note(update)
            if output.waiting is not None and not output.may_gather(self._has_maps):
                output.send(with_agreement=not self._has_maps())
            if update is None and not self._has_maps():
                break
        output.send()  # however many maps come
        self._memory.keep()

    def _has_come(self, name: str) -> bool:
        """Whether an input has sent a map, or is a saved one."""
        return name in self._saved or bool(self._sources[name].frame)

    def _obey(self) -> None:
        """Do what was asked for since the last turn."""
        wanted, self._wanted_live = self._wanted_live, None
        if wanted is not None:
            self._live.configure(wanted)
        if self._is_reset_wanted.is_set():
            self._is_reset_wanted.clear()
            self._live.reset()
            self._counts.resets += 1
            self._memory.clear()

    def _has_maps(self) -> bool:
        """Whether a map waits to be taken."""
        return any(source.is_waiting for source in self._sources.values())

    def _take(self, source: MapSource) -> bool:
        """Convert the newest map of an input and hand it to the fusion; say if there was one."""
        frame = source.frame
        taken = source.take()
        if taken is None:
            return False
        message, arrived_s = taken
        if frame and source.frame != frame:
            text = f"the map of {source.name!r} was in {frame!r} and is in {source.frame!r} now"
            self.troubles.add(f"frame {source.name}", Level.WARN, text, SHOWN_S)
        if self._arrived_s is None:
            self._arrived_s = arrived_s
        try:
            grid = messages.grid_from_message(message, source.name)
        except SlamFusionError as error:
            self._live.reject(source.name, str(error), arrived_s)
        else:
            self._live.put(source.name, grid, arrived_s)
        return True

    def _note(self, update: LiveUpdate) -> None:
        """Keep what an update did; a fused map waits for its turn to be published."""
        records = {record.name: record for record in update.inputs}
        has_news = False
        for name, record in records.items():
            old = self._frames.believed.inputs.get(name)
            if old is not None and old.accepted == record.accepted:
                continue
            has_news = True
            # Two calls: rclpy ties a place in the code to one level.
            if record.accepted:
                self.log.info(f"{name} votes: {record.reason}")
            else:
                self.log.warning(f"{name} does not vote: {record.reason}")
        if any(record.accepted for record in update.inputs):
            self._memory.confirm()
        self._frames.believed = Believed(records, update.reference)
        self._inputs = (update.inputs, time.monotonic())
        self._has_news = self._has_news or has_news
        self._last = update
        self._counts.updates += 1
        self._counts.searches += update.is_full_search
        arrived_s, self._arrived_s = self._arrived_s, None
        if update.fused is None or update.agreement is None:
            return
        if self._output.waiting is not None:
            arrived_s = self._output.waiting.arrived_s
        stamp_s = self._newest_s(records)
        self._output.waiting = Fused(update.fused, update.agreement, stamp_s, arrived_s)
        self._memory.change(stamp_s)

    def _newest_s(self, records: dict[str, LiveInput]) -> float:
        """Return the stamp of a fused map: of the newest map in it, 0 where all were saved ones."""
        voters = [
            source
            for name, source in self._sources.items()
            if records.get(name) is not None and records[name].accepted
        ]
        stamps = [source.stamp_s for source in voters if source.stamp_s is not None]
        # None of their stamps can be right: then the node's time is.
        return max(stamps, default=self.clock_s() if voters else 0.0)

    def _failed(self, _: Any, error: Exception) -> None:
        """Name what the worker stumbled over."""
        if not self.troubles.is_on("worker"):
            self.log.error("".join(traceback.format_exception(error)))
        text = f"{type(error).__name__}: {error}"
        self.troubles.add("worker", Level.ERROR, text, SHOWN_S)

    # --- diagnostics -------------------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return a line for the fusion and one for each input."""
        records, noted_s = self._inputs
        by_name = {record.name: record for record in records}
        since_s = time.monotonic() - noted_s
        names = [*self._sources, *self._saved]
        lines = []
        for name in names:
            source = self._sources.get(name)
            topic = "" if source is None else self.node.resolve_topic_name(source.topic)
            lines.append(input_status(name, source, topic, by_name.get(name), since_s))
        is_worse = self.published is not None and not self._memory.is_unconfirmed
        worst = Level.ERROR if is_worse else Level.WARN
        troubles, nothing = self.troubles.worst(""), self.nothing_fused()
        return [fusion_status(lines, troubles, nothing, worst, self._figures()), *lines]

    def _figures(self) -> dict[str, object]:
        """Return the figures of the fusion's line."""
        update, published = self._last, self.published
        median_ms, high_ms = self._output.latencies_ms()
        values: dict[str, object] = {
            "reference": update.reference if update is not None else None,
            "pose from": self._frames.leader or None,
            "maps published": self._output.count,
            "updates": self._counts.updates,
            "full searches": self._counts.searches,
            "resets": self._counts.resets,
            "phantom cells": update.phantom_cells if update is not None else None,
            "map [cells]": "-"
            if published is None
            else f"{published[1].width} x {published[1].height}",
            "latency median [ms]": median_ms,
            "latency p95 [ms]": high_ms,
            "device": self._device.name,
        }
        if update is not None:
            values |= {f"{step} [ms]": 1e3 * spent for step, spent in update.time_s.items()}
        return values

    def close(self) -> None:
        """End the worker; the map that is being fused is fused to its end, and the state kept."""
        self._memory.close(is_whole=self._worker.close())


def _warm(config: RunConfig, device: ComputeDevice) -> None:
    """Fuse two small drawn maps, so that the kernels are compiled before the first real ones."""
    cells = np.zeros((48, 60), dtype=np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = cells[10:14, 20:40] = cells[30:40, 44:47] = 100
    trial = LiveFusion(replace(config, live=replace(config.live, minimum_inputs=2)), device)
    for number, name in enumerate("ab"):
        origin = Pose2(0.0, 0.0, 0.1 * number)
        trial.put(name, grids.OccupancyGrid(cells, 0.05, origin, name), 0.0)
    trial.update(0.0)
    moved = cells.copy()
    moved[20:24, 10:14] = 100
    trial.put("b", grids.OccupancyGrid(moved, 0.05, Pose2(0.0, 0.0, 0.1), "b"), 1.0)
    trial.update(1.0)
