"""``FusionNode``: maps of any SLAMs in, one fused map out, live."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from std_srvs.srv import Trigger

from slamfusion import grid as grids
from slamfusion.compute import Backend, open_backend
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
from slamfusion.io.map_server import save_map
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Level, NodeBase, Status
from slamfusion.ros.fused_frames import Believed, FusedFrames
from slamfusion.ros.map_source import MapSource, input_names, load_saved
from slamfusion.ros.parameters import declare, declare_names, parameter_names
from slamfusion.ros.worker import Worker

__all__ = ["FusionNode", "make_node"]

DEFAULT_INPUTS = ("tinyslam/map", "gmapping/map", "graph/map")
MAP_TOPIC, AGREEMENT_TOPIC = "fused/map", "fused/agreement"
CHANGEABLE = ("max_publish_rate_hz", "publish_tf", "save_path", "lost_after_s")
# How often the node looks whether a fused map may go out, at frames, and who publishes its inputs.
TURN_S, LOOK_S, LOOK_AROUND_S = 0.02, 0.1, 1.0
SHOWN_S = 10.0
LATENCIES = 300
# Updates of one turn of the worker; it is woken again each second.
ROUNDS = 8
# A fused map waits no longer than this for maps that came while it was made: sending one of 16 MB
# keeps them waiting longer than fusing them does.
GATHER_S = 0.25


def make_node(_: str, **options: Any) -> NodeBase:
    """Return the fusion node; see ``FusionNode``."""
    return FusionNode(**options)


class _Wake:
    """Tells the worker to look what there is to do."""


@dataclass(frozen=True, eq=False)
class _Fused:
    """A fused map on its way out.

    Attributes:
        grid, agreement: of one update; the agreement goes out after it, when somebody listens.
        stamp_s: of the newest map in it; 0 where all were saved maps.
        arrived_s: when the first map came that it shows and none before it did.
    """

    grid: grids.OccupancyGrid
    agreement: grids.OccupancyGrid
    stamp_s: float
    arrived_s: float | None


@dataclass
class _Counts:
    """What happened so far; written by the worker."""

    updates: int = 0
    searches: int = 0
    maps: int = 0
    resets: int = 0


class FusionNode(NodeBase):
    """Fuses the maps of several SLAMs while they grow; see ``slamfusion.fusion.live``.

    Reads the map topics of ``inputs`` and the poses beside them (``NAME/pose`` for ``NAME/map``);
    an entry ``file:PATH`` is a saved map. Writes ``fused/map`` and ``fused/agreement`` (reliable,
    transient local: who comes late gets the last ones; the agreement is sent only while somebody
    listens, and to the first who does), ``fused/pose``, ``/diagnostics`` and the transforms of
    ``FusedFrames``. Services: ``get_map``; ``save_map``, which answers the path or
    the reason; ``reset``, after which the newest maps begin a new fused frame.

    The callbacks only keep the newest message. One worker converts, fuses and publishes: of maps
    that come while it works only the newest of each input counts, and a fused map waits a moment
    for those. When several fused maps fall into one period of ``max_publish_rate_hz`` only the last
    is published.

    Args:
        context: rclpy's; default: the one of ``rclpy.init``.
        arguments: ROS arguments of this node alone.

    Raises:
        ConfigError: a parameter is refused.
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
        self._backend = open_backend(config.device.device)
        _warm(config, self._backend)
        self._live = LiveFusion(config, self._backend)

        # Written by the worker's thread, read by the executor's: each is replaced as a whole.
        self._inputs: tuple[tuple[LiveInput, ...], float] = ((), time.monotonic())
        self._last: LiveUpdate | None = None
        self._waiting: _Fused | None = None
        self._untold: _Fused | None = None
        self._published: OccupancyGrid | None = None
        self._grid: grids.OccupancyGrid | None = None
        self._published_s = float("-inf")
        self._arrived_s: float | None = None
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)
        self._counts = _Counts()
        # Written by the executor's thread, taken by the worker's.
        self._wanted_live: LiveConfig | None = None
        self._is_reset_wanted = threading.Event()
        self._lost: set[str] = set()

        self._map_topic = self.publisher(OccupancyGrid, MAP_TOPIC, qos.MAP)
        self._agreement_topic = self.publisher(OccupancyGrid, AGREEMENT_TOPIC, qos.MAP)
        self._frames = FusedFrames(self, self.settings)
        self._worker: Worker[_Wake] = Worker(self._work, 1, self._failed, "fusion")
        self._sources = {
            name: MapSource(self, name, entry, self._wake, self._on_pose)
            for name, entry in entries.items()
            if name not in self._saved
        }
        self._frames.watch(self._sources)
        node.create_service(GetMap, "get_map", self._serve(self._get_map))
        node.create_service(Trigger, "save_map", self._serve(self._save_map))
        node.create_service(Trigger, "reset", self._serve(self._reset))
        for name, grid in self._saved.items():
            self._live.put(name, grid, time.monotonic(), is_saved=True)
        self.timer(TURN_S, self._look_turn)
        self.timer(LOOK_S, self._frames.look)
        self.timer(LOOK_AROUND_S, self._look_around)
        self.log.info(
            f"fuses {', '.join(entries.values())} on {self._backend.name}; the fused map is on "
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
        if (self._waiting is not None and self._is_turn()) or self._is_agreement_wanted():
            self._wake()

    def _look_around(self) -> None:
        """See who publishes the inputs, and let ages be looked at."""
        for source in self._sources.values():
            source.look()
            since_s = source.silent_since_s
            is_lost = (
                since_s is not None and time.monotonic() - since_s > self.settings.lost_after_s
            )
            if is_lost and source.name not in self._lost and source.frame:
                topic = self.node.resolve_topic_name(source.topic)
                self._live.drop(source.name, f"lost: nobody publishes {topic!r} any more")
                self._lost.add(source.name)
            elif not is_lost:
                self._lost.discard(source.name)
        self._wake()

    def _on_settings(self, settings: FusionNodeConfig) -> None:
        self.settings = self._frames.settings = settings

    def _on_live(self, live: LiveConfig) -> None:
        self._wanted_live = live
        self._wake()

    def on_time_jump(self, delta_s: float) -> None:
        """Forget the odometry of a future that has not come; the maps speak for themselves."""
        if delta_s < 0.0:
            self._frames.on_time_jump(self.clock_s())

    def _serve(self, answer: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service's callback that cannot bring the node down."""

        def callback(_: Any, response: Any) -> Any:
            try:
                return answer(response)
            except Exception as error:  # noqa: BLE001  (a node must outlive a request)
                self.log.error(traceback.format_exc())
                text = f"{type(error).__name__}: {error}"
                self.troubles.add("service", Level.ERROR, text, SHOWN_S)
                if hasattr(response, "success"):
                    response.success, response.message = False, text
                return response

        return callback

    def _get_map(self, response: Any) -> Any:
        """Answer the last published map; without cells before the first."""
        if self._published is None:
            response.map.header.frame_id = self.settings.fused_frame
        else:
            response.map = self._published
        return response

    def _save_map(self, response: Any) -> Any:
        """Write the last published map."""
        grid = self._grid
        if grid is None:
            response.success, response.message = False, self._nothing_fused()
            return response
        try:
            path, _ = save_map(grid, self.settings.save_path)
        except (SlamFusionError, OSError) as error:
            response.success, response.message = False, f"not saved: {error}"
            self.troubles.add("save", Level.WARN, response.message, SHOWN_S)
            return response
        response.success, response.message = True, str(path.resolve())
        return response

    def _nothing_fused(self) -> str:
        problem = "no map yet" if self._last is None else self._last.problem
        return f"nothing is fused: {problem or 'no map yet'}"

    def _reset(self, response: Any) -> Any:
        """Let the worker begin a new fused frame."""
        self._is_reset_wanted.set()
        self._wake()
        response.success = True
        response.message = "the newest maps begin a new fused frame"
        return response

    # --- the worker's thread -----------------------------------------------------------------

    def _work(self, _wake: _Wake) -> None:
        """Take what came, fuse, publish; then do what could wait, until a map comes."""
        self._obey()
        for _ in range(ROUNDS):
            took = [self._take(source) for source in self._sources.values()]
            if not any(took):
                self._send()
                if self._waiting is not None:
                    return  # what could wait is not begun while a fused map waits for its turn
            update = self._live.update(time.monotonic(), self._has_maps)
            if update is not None:
                self._note(update)
            if self._waiting is not None and not self._may_gather(self._waiting):
                self._send(with_agreement=not self._has_maps())
            if update is None and not self._has_maps():
                return
        self._send()  # however many maps come

    def _send(self, *, with_agreement: bool = True) -> None:
        """Publish what waits, if its turn has come; the agreement where somebody listens."""
        if self._waiting is not None and self._is_turn():
            self._publish(self._waiting)
        if with_agreement and self._is_agreement_wanted():
            self._tell_agreement()

    def _obey(self) -> None:
        """Do what was asked for since the last turn."""
        wanted, self._wanted_live = self._wanted_live, None
        if wanted is not None:
            self._live.configure(wanted)
        if self._is_reset_wanted.is_set():
            self._is_reset_wanted.clear()
            self._live.reset()
            self._counts.resets += 1

    def _has_maps(self) -> bool:
        """Whether a map waits to be taken."""
        return any(source.is_waiting for source in self._sources.values())

    def _may_gather(self, fused: _Fused) -> bool:
        """Whether a fused map waits for the maps that came while it was made."""
        arrived_s = fused.arrived_s
        is_young = arrived_s is not None and time.monotonic() - arrived_s < GATHER_S
        return is_young and self._has_maps()

    def _is_agreement_wanted(self) -> bool:
        """Whether somebody listens to an agreement that was not sent."""
        return self._untold is not None and self._agreement_topic.get_subscription_count() > 0

    def _tell_agreement(self) -> None:
        """Send the agreement of the map that was published last."""
        fused, self._untold = self._untold, None
        if fused is not None:
            self._agreement_topic.publish(self._message(fused, fused.agreement))

    def _message(self, fused: _Fused, grid: grids.OccupancyGrid) -> OccupancyGrid:
        """Return a grid of a fused map as a message in the fused frame."""
        stamp = messages.to_stamp(fused.stamp_s)
        return messages.grid_to_message(grid, self.settings.fused_frame, stamp)

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
        for name, record in records.items():
            old = self._frames.believed.inputs.get(name)
            if old is not None and old.accepted == record.accepted:
                continue
            # Two calls: rclpy ties a place in the code to one level.
            if record.accepted:
                self.log.info(f"{name} votes: {record.reason}")
            else:
                self.log.warning(f"{name} does not vote: {record.reason}")
        self._frames.believed = Believed(records, update.reference)
        self._inputs = (update.inputs, time.monotonic())
        self._last = update
        self._counts.updates += 1
        self._counts.searches += update.is_full_search
        arrived_s, self._arrived_s = self._arrived_s, None
        if update.fused is None or update.agreement is None:
            return
        if self._waiting is not None:
            arrived_s = self._waiting.arrived_s
        stamps = [
            source.stamp_s
            for name, source in self._sources.items()
            if records.get(name) is not None and records[name].accepted and source.stamp_s
        ]
        newest_s = max(stamps, default=0.0)
        self._waiting = _Fused(update.fused, update.agreement, newest_s, arrived_s)

    def _is_turn(self) -> bool:
        """Whether the last published map is old enough for another one."""
        period_s = 1.0 / self.settings.max_publish_rate_hz
        return time.monotonic() - self._published_s >= period_s

    def _publish(self, fused: _Fused) -> None:
        self._waiting, self._untold = None, fused
        self._published_s = time.monotonic()
        message = self._message(fused, fused.grid)
        self._published, self._grid = message, fused.grid
        self._map_topic.publish(message)
        if fused.arrived_s is not None:
            self._latencies_s.append(time.monotonic() - fused.arrived_s)
        self._counts.maps += 1

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
        lines = [self._input_status(name, by_name.get(name), since_s) for name in names]
        return [self._fusion_status(lines), *lines]

    def _fusion_status(self, lines: list[Status]) -> Status:
        level, message = self.troubles.worst("")
        update = self._last
        out = [line.name.removeprefix("input ") for line in lines if line.level != Level.OK]
        voters = len(lines) - len(out)
        if not voters:
            words = self._nothing_fused()
            level = max(level, Level.ERROR if self._published is not None else Level.WARN)
        elif out:
            words = f"{voters} of {len(lines)} inputs vote; not: {', '.join(out)}"
            level = max(level, Level.WARN)
        else:
            words = f"all {voters} inputs vote"
        latency_ms = 1e3 * np.percentile([*self._latencies_s] or [0.0], (50.0, 95.0))
        grid = self._grid
        values = {
            "inputs": len(lines),
            "voters": voters,
            "reference": update.reference if update is not None else None,
            "pose from": self._frames.leader or None,
            "maps published": self._counts.maps,
            "updates": self._counts.updates,
            "full searches": self._counts.searches,
            "resets": self._counts.resets,
            "phantom cells": update.phantom_cells if update is not None else None,
            "map [cells]": "-" if grid is None else f"{grid.width} x {grid.height}",
            "latency median [ms]": float(latency_ms[0]),
            "latency p95 [ms]": float(latency_ms[1]),
            "device": self._backend.name,
        }
        if update is not None:
            values |= {f"{step} [ms]": 1e3 * spent for step, spent in update.time_s.items()}
        return Status("fusion", level, "; ".join(filter(None, (words, message))), values)

    def _input_status(self, name: str, record: LiveInput | None, since_s: float) -> Status:
        """Return the line of one input."""
        source = self._sources.get(name)
        if record is None:
            topic = "" if source is None else self.node.resolve_topic_name(source.topic)
            who = "nobody publishes it"
            if source is None or source.silent_since_s is None:
                who = "a node could publish it"
            return Status(f"input {name}", Level.STALE, f"no map on {topic!r} yet; {who}")
        transform = record.transform or Pose2()
        is_silent = record.reason.startswith(("lost", "no map for"))
        level = Level.OK if record.accepted else Level.STALE if is_silent else Level.WARN
        values: dict[str, object] = {
            "accepted": record.accepted,
            "score": record.score,
            "overlap": record.overlap,
            "tracked": record.is_tracked,
            "age [s]": record.age_s + since_s,
            "rate [Hz]": record.rate_hz,
            "maps": record.maps,
            "maps refused": record.rejected,
            "x [m]": transform.x if record.transform is not None else None,
            "y [m]": transform.y if record.transform is not None else None,
            "yaw [rad]": transform.yaw_rad if record.transform is not None else None,
            "frame": "-" if source is None else source.frame,
        }
        return Status(f"input {name}", level, record.reason, values)

    def close(self) -> None:
        """End the worker; the map that is being fused is fused to its end."""
        self._worker.close()


def _warm(config: RunConfig, backend: Backend) -> None:
    """Fuse two small drawn maps, so that the kernels are compiled before the first real ones."""
    cells = np.zeros((48, 60), dtype=np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = cells[10:14, 20:40] = cells[30:40, 44:47] = 100
    trial = LiveFusion(replace(config, live=replace(config.live, minimum_inputs=2)), backend)
    for number, name in enumerate("ab"):
        origin = Pose2(0.0, 0.0, 0.1 * number)
        trial.put(name, grids.OccupancyGrid(cells, 0.05, origin, name), 0.0)
    trial.update(0.0)
    moved = cells.copy()
    moved[20:24, 10:14] = 100
    trial.put("b", grids.OccupancyGrid(moved, 0.05, Pose2(0.0, 0.0, 0.1), "b"), 1.0)
    trial.update(1.0)
