"""``DriveInput``: the scans of the fusion node, and the fused path solved from them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

from nav_msgs.msg import Path

from slamfusion.config import LogConfig
from slamfusion.deskew import Deskewer
from slamfusion.errors import TrajectoryError
from slamfusion.io import LogScan
from slamfusion.jobs.live_drive import DriveSolution, LiveDrive, Pace
from slamfusion.ros import messages, qos
from slamfusion.ros.base import Worker
from slamfusion.ros.input_health import MapSource
from slamfusion.ros.scan_input import ArrivedScan, ScanInput
from slamfusion.slam.session import LeftOutError

if TYPE_CHECKING:
    from slamfusion.ros.fusion_node import FusionNode

PATH_TOPIC = "fused/path"
# Scans that wait to be read; then the oldest is dropped.
SCAN_QUEUE = 20


class DriveInput:
    """Receives ``scan`` and ``NAME/path``, solves the drive and publishes ``fused/path``.

    Scans are read in one thread, and the drive is solved in another, with its own device.

    Args:
        on_solution: called with each solution, in the solver's thread.

    Attributes:
        live: the drive so far; takes the poses of the inputs.
        solution: the last one; None before the first. Any thread may read it.
    """

    def __init__(
        self, node: FusionNode, device: str, on_solution: Callable[[DriveSolution], None]
    ) -> None:
        settings = node.settings
        self.solution: DriveSolution | None = None
        self._node, self._on_solution = node, on_solution
        self._deskewer = Deskewer(LogConfig(deskew=settings.deskew, sweep_s=settings.sweep_s))
        self.live = LiveDrive(node.open_device(device))
        self._count, self._pace = 0, Pace()
        self._path_topic = node.node.create_publisher(Path, PATH_TOPIC, qos.MAP)
        self._reader: Worker[ArrivedScan] = Worker(self._read, SCAN_QUEUE, node.failed, "scans")
        self._solver: Worker[None] = Worker(self._solve, 1, node.failed, "drive")
        self.scans = ScanInput(node, settings, self._reader.put, self.forget)

    # --- in the executor's thread --------------------------------------------------------------

    def forget(self) -> None:
        """Start a new drive."""
        self.live.forget()
        self.solution = None

    def look(self, sources: Mapping[str, MapSource]) -> None:
        """Subscribe to the inputs' paths once scans arrive; start the solver."""
        self.scans.name_odometry()
        self._solver.put(None)
        for name, source in sources.items() if self._count else ():
            source.hear_path(partial(self._on_path, name))

    def _on_path(self, name: str, data: bytes) -> None:
        try:
            path = messages.path_from_bytes(data, name)
        except TrajectoryError as error:
            text = f"the path of {name!r} is left out: {error}"
            self._node.diagnostics.note(f"path {name}", text)
            return
        self.live.set_path(name, path)

    # --- in threads of their own ---------------------------------------------------------------

    def _read(self, arrived: ArrivedScan) -> None:
        try:
            scan = self.scans.read(arrived)
        except LeftOutError:
            return  # reported by ``read``
        within, odometry = self._deskewer.follow(
            scan, lambda times_s: self.scans.odometry_at(arrived, times_s, is_first=False)
        )
        self.live.add_scan(LogScan(self._deskewer.moved(scan, within), odometry, 1))
        self._count += 1
        self._solver.put(None)

    def _solve(self, _: None) -> None:
        began_s = time.monotonic()
        depth = self._pace.due(began_s, self._count)
        if depth is None:
            return
        state, settings = self._node.session.snapshot, self._node.settings
        transforms = {name: state.transform(name) for name in state.inputs}
        solution = self.live.solve(
            depth,
            lattice=state.lattice,
            transforms={name: place for name, place in transforms.items() if place is not None},
            resolution=state.resolution if settings.draw else None,
        )
        self._pace.done(depth, began_s, time.monotonic())
        if solution is None:
            return
        self.solution = solution
        self.live.take(solution)
        self._on_solution(solution)
        if self._path_topic.get_subscription_count():
            stamp = messages.to_stamp(float(solution.path.stamps_s[-1]))
            frame = settings.fused_frame
            self._path_topic.publish(messages.path_to_bytes(solution.path, frame, stamp))

    def close(self) -> None:
        """End both threads."""
        self._reader.close()
        self._solver.close()
