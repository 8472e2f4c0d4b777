"""``DriveInput``: the scans of the fusion node, and what they say of the poses of its inputs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from nav_msgs.msg import Path
from sensor_msgs.msg import LaserScan

from slamfusion.config import FusionNodeConfig, LogConfig
from slamfusion.deskew import Deskewer
from slamfusion.errors import TrajectoryError
from slamfusion.fusion.live.session import FusionState
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan
from slamfusion.jobs.live_drive import DriveSolution, LiveDrive, Pace
from slamfusion.ros import messages, qos
from slamfusion.ros.base import SHOWN_S, Level, NodeBase, Worker, open_node_device
from slamfusion.ros.input_health import MAP_SUFFIX, MapSource
from slamfusion.ros.scan_input import SCAN_TOPIC, ArrivedScan, ScanInput
from slamfusion.slam.session import LeftOutError

PATH_TOPIC = "fused/path"
# Poses of the published path at most, evenly chosen.
PATH_POSES = 2000
# Scans that wait to be read; of more the oldest is dropped.
SCAN_QUEUE = 20


class DriveInput:
    """Hears ``scan`` and ``NAME/path``, solves the drive and publishes ``fused/path``.

    Scans are read in one thread, and the drive is solved in another, with a device of its own.

    Args:
        state: returns what is fused now; from any thread.
        on_solution: called with each solution, in the thread that solves.

    Attributes:
        scans: gives the odometry, too.
        solution: the last one; None before the first. Any thread may read it.
    """

    def __init__(
        self,
        base: NodeBase,
        settings: FusionNodeConfig,
        device: str,
        state: Callable[[], FusionState],
        on_solution: Callable[[DriveSolution], None],
    ) -> None:
        self.scans = ScanInput(base, settings)
        self.solution: DriveSolution | None = None
        self._base, self._settings = base, settings
        self._state, self._on_solution = state, on_solution
        self._deskewer = Deskewer(LogConfig(deskew=settings.deskew, sweep_s=settings.sweep_s))
        self._drive = LiveDrive(open_node_device(device, base.diagnostics))
        self._count, self._pace = 0, Pace()
        self._paths: dict[str, tuple[MapSource, Any]] = {}
        self._path_topic = base.node.create_publisher(Path, PATH_TOPIC, qos.MAP)
        self._reader: Worker[ArrivedScan] = Worker(self._read, SCAN_QUEUE, base.failed, "scans")
        self._solver: Worker[None] = Worker(self._solve, 1, base.failed, "drive")
        base.subscribe(LaserScan, SCAN_TOPIC, self._on_scan, qos.SENSOR)

    # --- in the executor's thread --------------------------------------------------------------

    def put_pose(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Take a pose of an input."""
        self._drive.add_pose(name, stamp_s, pose)

    def forget(self) -> None:
        """Let a new drive start."""
        self._drive.forget()
        self.solution = None

    def look(self, sources: Mapping[str, MapSource]) -> None:
        """Listen to the paths of the inputs while scans are heard; solve what is left to solve."""
        self.scans.name_odometry()
        self._solver.put(None)
        for name, (source, subscription) in [*self._paths.items()]:
            if sources.get(name) is not source:
                self._base.node.destroy_subscription(subscription)
                del self._paths[name]
                self._drive.remove(name)
        for name, source in sources.items():
            if self._count and name not in self._paths and source.topic.endswith(MAP_SUFFIX):
                topic = source.topic.removesuffix(MAP_SUFFIX) + "/path"

                def on_path(message: Any, name: str = name) -> None:
                    self._on_path(name, message)

                subscription = self._base.subscribe(Path, topic, on_path, qos.MAP)
                self._paths[name] = source, subscription

    def _on_scan(self, message: Any) -> None:
        passed = self.scans.offer(message)
        if passed.jump is not None and passed.jump.is_back:
            self.forget()
        for scan in passed.items:
            self._reader.put(scan)

    def _on_path(self, name: str, message: Any) -> None:
        try:
            path = messages.path_from_message(message, name)
        except TrajectoryError as error:
            text = f"the path of {name!r} is left out: {error}"
            self._base.diagnostics.add(f"path {name}", Level.WARN, text, SHOWN_S)
            return
        self._drive.set_path(name, path)

    # --- in threads of their own ---------------------------------------------------------------

    def _read(self, arrived: ArrivedScan) -> None:
        """Convert and deskew a scan, as the producers do."""
        try:
            scan = self.scans.read(arrived)
        except LeftOutError:
            return  # named by who reads it
        within, odometry = self._deskewer.follow(
            scan, lambda times_s: self.scans.odometry_at(arrived, times_s, is_first=False)
        )
        self._drive.add_scan(LogScan(self._deskewer.moved(scan, within), odometry, 1))
        self._count += 1
        self._solver.put(None)

    def _solve(self, _: None) -> None:
        """Solve the drive if it is time to, and if scans have come since."""
        began_s = time.monotonic()
        depth = self._pace.due(began_s, self._count)
        if depth is None:
            return
        state = self._state()
        transforms = {name: state.transform(name) for name in state.inputs}
        solution = self._drive.solve(
            depth,
            lattice=state.lattice,
            transforms={name: place for name, place in transforms.items() if place is not None},
            resolution=state.resolution if self._settings.draw else None,
        )
        self._pace.done(depth, began_s, time.monotonic())
        if solution is None:
            return
        self.solution = solution
        self._on_solution(solution)
        if self._path_topic.get_subscription_count():
            path, frame = solution.path, self._settings.fused_frame
            stamp = messages.to_stamp(float(path.stamps_s[-1]))
            self._path_topic.publish(messages.path_to_message(path, frame, stamp, PATH_POSES))

    def close(self) -> None:
        """End both threads."""
        self._reader.close()
        self._solver.close()
