"""``FusionNode``: maps of any SLAMs in, one fused map out, live."""

from __future__ import annotations

import time
import traceback
from collections.abc import Sequence
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
)
from slamfusion.fusion.live import LiveFusion
from slamfusion.fusion.live.outbox import Fused, Outbox
from slamfusion.fusion.live.session import FusionSession, warm_up
from slamfusion.ros import messages
from slamfusion.ros.base import Level, NodeBase, Status
from slamfusion.ros.clocks import Clocks
from slamfusion.ros.device import open_node_device
from slamfusion.ros.fused_frames import FusedFrames
from slamfusion.ros.fused_output import AGREEMENT_TOPIC, MAP_TOPIC, FusedOutput
from slamfusion.ros.fusion_inputs import FusionInputs
from slamfusion.ros.fusion_ports import FusionPorts
from slamfusion.ros.fusion_services import FusionServices
from slamfusion.ros.fusion_status import fusion_figures, fusion_status, input_status
from slamfusion.ros.input_entries import load_saved
from slamfusion.ros.live_page import LivePage
from slamfusion.ros.map_source import MapSource
from slamfusion.ros.parameters import declare, declare_starts, parameter_names
from slamfusion.ros.stamps import Stamps
from slamfusion.ros.state_keeper import Memory
from slamfusion.ros.worker import Worker
from slamfusion.ros.writers import Writers

CHANGEABLE = (
    *("discover", "discovery_rate_hz"),
    *("max_publish_rate_hz", "publish_tf", "save_path", "lost_after_s"),
)
# How often the node looks whether a fused map may go out, at frames, and who publishes its inputs;
# and shows itself on the page.
TURN_S, LOOK_S, LOOK_AROUND_S, SHOW_S = 0.02, 0.1, 1.0, 0.5
SHOWN_S = 10.0
# From so many inputs on the executor rests so many times as long as it works.
MANY, REST = 8, 3.0


def make_node(_: str, **options: Any) -> NodeBase:
    """Return the fusion node; see ``FusionNode``."""
    return FusionNode(**options)


class _Wake:
    """Tells the worker to look what there is to do."""


class FusionNode(NodeBase):
    """Fuses the maps of several SLAMs while they grow; see ``slamfusion.fusion.live``.

    Reads the map topics of ``inputs`` and the poses beside them (``NAME/pose`` for ``NAME/map``);
    an entry ``file:PATH`` is a saved map. Writes ``fused/map`` and ``fused/agreement`` (reliable,
    transient local: who comes late gets the last ones; the agreement is sent only while somebody
    listens, and to the first who does), ``fused/pose``, ``/diagnostics`` and the transforms of
    ``FusedFrames``. Services: those of ``FusionServices``.

    ``start.NAME`` says where an input's map frame is expected (x, y, yaw and tolerances); see
    ``slamfusion.align.starts``.

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
        is_open = bool(self.settings.discover)
        outputs = MAP_TOPIC, AGREEMENT_TOPIC
        self.inputs = FusionInputs(self, outputs, is_open=is_open, on_change=self._on_inputs)
        names = tuple(self.inputs.entries)
        least = LiveConfig().minimum_inputs
        live = LiveConfig(minimum_inputs=least if is_open else min(least, len(names)))
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
            start=declare_starts(node, names, may_come=is_open),
        )
        self._stamps, self._clocks = Stamps(self.clock_s), Clocks(self.clock_s, self.diagnostics)
        # Before the inputs: of what has come the odometry is heard first, and then the poses.
        self._frames = FusedFrames(self, self.settings)
        callbacks = self._wake, self._on_pose
        self.inputs.begin(
            lambda name, entry: load_saved(name, entry, config.map_files, self.log.warning),
            lambda name, topic: MapSource(
                self,
                name,
                topic,
                self.settings.lost_after_s,
                self._stamps,
                self._clocks,
                *callbacks,
            ),
        )
        self._device = open_node_device(config.device.device, self.diagnostics)
        fusion = LiveFusion(config, self._device, None if is_open else names)
        warm_up(config, self._device)

        self._outbox = Outbox(self.settings.max_publish_rate_hz)
        self._services = FusionServices(self, self)
        carry_out = self._services.carry_out
        page = LivePage(self, self.settings, carry_out) if self.settings.page else None
        self._page = page
        self._output = FusedOutput(
            self, self.settings, self._outbox, *([] if page is None else [page.put_fused])
        )
        self._writers = Writers(self, MAP_TOPIC)
        self._memory = Memory(self, fusion, self.settings.state_path, names)
        if (kept := self._memory.restored) is not None:
            self._outbox.offer(Fused(*kept.grids(), kept.stamp_s, None))
        self._session = FusionSession(fusion, self._outbox, self._memory)
        self._told_votes = 0
        self._worker: Worker[_Wake] = Worker(self._turn, 1, self._failed, "fusion")
        self._frames.watch(self.inputs.sources)
        heard = [] if page is None else [page.put_heard]
        self._ports = FusionPorts(self, self.inputs, self._output, *heard)
        self.timer(TURN_S, self._look_turn)
        self.timer(LOOK_S, self._look)
        self.timer(SHOW_S, self._show)
        self.timer(LOOK_AROUND_S, self._look_around)
        self.log.info(
            f"fuses {', '.join(self.inputs.entries.values()) or self.settings.discover} on "
            f"{self._device.name}; the fused map is on {node.resolve_topic_name(MAP_TOPIC)!r} in "
            f"frame {self.settings.fused_frame!r}"
        )
        self._wake()

    @property
    def rest(self) -> float:
        """Leave the worker three quarters of the interpreter, where inputs are many."""
        return REST if len(self.inputs.sources) >= MANY else 0.0

    # --- callbacks, in the executor's thread -------------------------------------------------

    def _on_inputs(self, removed: Sequence[str]) -> None:
        """Forget inputs that are none any more, and let the worker see to those that came."""
        for name in removed:
            self._session.forget(name)
            self._stamps.remove(name)
            self._writers.remove(name)
        self._frames.watch(self.inputs.sources)
        self._wake()

    def _wake(self) -> None:
        self._worker.put(_Wake())

    def _on_pose(self, source: MapSource) -> None:
        """Let a pose be compared with the others', and send what it tells."""
        heard = source.pose
        if heard is not None:
            self._session.hear(source.name, messages.stamp_s(heard.stamp), heard.pose)
        self._frames.believed = self._session.snapshot.believed
        self._frames.on_pose(source)
        if self._page is not None:
            self._page.put_pose(source)

    def _look_turn(self) -> None:
        """Wake the worker for what had to wait for its turn, or for somebody who listens."""
        if self._outbox.is_due(self._output.is_heard):
            self._wake()

    def _look(self) -> None:
        """See which inputs are lost or back, and send what is new of the frames and votes."""
        self.inputs.discover(self.settings)
        for name, source in self.inputs.sources.items():
            if self._session.look(
                name, source.lost, has_map=bool(source.frame), is_back=source.is_back
            ):
                self._wake()
        snapshot = self._session.snapshot
        self._frames.believed = snapshot.believed
        self._frames.look()
        if snapshot.votes != self._told_votes:  # who votes is said at once, not within the second
            self._told_votes = snapshot.votes
            self.publish_diagnostics()
            self._show()
        if self._page is not None:
            self._page.look()

    def _show(self) -> None:
        """Show how the inputs are on the page."""
        if self._page is not None:
            believed = self._session.snapshot.believed
            self._page.show(self.statuses(), believed, self.inputs.sources.values())

    def _look_around(self) -> None:
        """See who publishes the inputs and the fused map, and let ages be looked at."""
        sources = self.inputs.sources
        for source in sources.values():
            source.look()
        self._writers.look({name: source.topic for name, source in sources.items()})
        self._frames.rival = self._writers.rival
        self._clocks.look(sources)
        self._wake()

    def _on_settings(self, settings: FusionNodeConfig) -> None:
        self.settings = self._frames.settings = self._output.settings = settings
        self._outbox.rate_hz = settings.max_publish_rate_hz
        for source in self.inputs.sources.values():
            source.ask(settings.lost_after_s)

    def _on_live(self, live: LiveConfig) -> None:
        self._session.ask_settings(live)
        self._wake()

    def on_time_jump(self, delta_s: float) -> None:
        """Forget the odometry of a future that has not come; the maps speak for themselves."""
        if delta_s < 0.0:
            self._stamps.forget()
            self._clocks.forget()
            self._frames.on_time_jump(self.clock_s())

    @property
    def published(self) -> tuple[OccupancyGrid, grids.OccupancyGrid] | None:
        """The last published map as message and as grid; None before the first."""
        return self._output.published

    def nothing_fused(self) -> str:
        """Say why no input votes."""
        return self._session.snapshot.nothing_fused

    def load_input(self, entry: str) -> tuple[grids.OccupancyGrid | None, str]:
        """Let a saved map be an input; return it, or why not."""
        return self.inputs.load(entry)

    def ask_reset(self) -> None:
        """Let the worker begin a new fused frame."""
        self._session.ask_reset()
        self._wake()

    # --- the worker's thread -----------------------------------------------------------------

    def _turn(self, _wake: _Wake) -> None:
        """Let the session do what there is to do."""
        self._session.turn(self._ports)

    def _failed(self, _: Any, error: Exception) -> None:
        """Name what the worker stumbled over."""
        if not self.diagnostics.is_on("worker"):
            self.log.error("".join(traceback.format_exception(error)))
        text = f"{type(error).__name__}: {error}"
        self.diagnostics.add("worker", Level.ERROR, text, SHOWN_S)

    # --- diagnostics -------------------------------------------------------------------------

    def statuses(self) -> list[Status]:
        """Return a line for the fusion and one for each input."""
        snapshot = self._session.snapshot
        by_name = snapshot.believed.inputs
        since_s = time.monotonic() - snapshot.noted_s
        lines = []
        for name, entry in self.inputs.entries.items():
            source = self.inputs.sources.get(name)
            topic = "" if source is None else self.node.resolve_topic_name(source.topic)
            frame = "-" if source is None else self._frames.child_frame(source) or source.frame
            lines.append(
                input_status(name, entry, source, topic, frame, by_name.get(name), since_s)
            )
        is_worse = self.published is not None and not self._memory.is_unconfirmed
        worst = Level.ERROR if is_worse else Level.WARN
        wrong, nothing = self.diagnostics.worst(""), self.nothing_fused()
        figures = fusion_figures(
            snapshot, self._outbox.sent, self.published, self._frames.leader, self._device.name
        )
        return [fusion_status(lines, wrong, nothing, worst, figures), *lines]

    def close(self) -> None:
        """End the worker; the map that is being fused is fused to its end, and the state kept."""
        if self._page is not None:
            self._page.close()
        self._memory.close(is_whole=self._worker.close())
