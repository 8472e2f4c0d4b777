"""``Mapper``: what every SLAM here offers, and the record of how well it is doing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol, cast, runtime_checkable

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import Skips
from slamfusion.scan import LaserScan
from slamfusion.slam.records import HealthJson
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True)
class Step:
    """What one scan did.

    Attributes:
        pose_map_base: where the robot's base now is in the map frame; metres, radians.
        used: False when the scan told nothing and the pose is dead reckoning.
        match_score: share of the scan's hits that fell on known walls, 0 to 1; None for the first.
        reason: why the scan was not used, in the words of ``Health.skips``; empty when it was.
    """

    pose_map_base: Pose2
    used: bool
    match_score: float | None
    reason: str = ""


@dataclass
class Health:
    """How well a mapper is doing; ``HealthJson`` explains the figures."""

    scans: int = 0
    scans_used: int = 0
    match_score: float | None = None
    mean_match_score: float | None = None
    low_scores: int = 0
    n_eff: float | None = None
    skips: Skips = field(default_factory=Skips)

    def warnings(self) -> tuple[str, ...]:
        """Return what contradicts the map in the producer's own words, a sentence each."""
        return ()

    def to_json(self) -> HealthJson:
        """Return the record for a JSON document."""
        figures = {item.name: getattr(self, item.name) for item in fields(Health)}
        skipped = figures.pop("skips").to_json()
        return cast("HealthJson", {**figures, "skipped": skipped})

    def own_figures(self) -> dict[str, Any]:
        """Return what a kind of producer counts of its own, by name."""
        common = {item.name for item in fields(Health)}
        return {
            item.name: getattr(self, item.name) for item in fields(self) if item.name not in common
        }


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity over the time of a run, to be plotted.

    Attributes:
        name: what is counted, e.g. ``effective particles``.
        unit: of the values; empty for a plain number.
        stamps_s: (N,) float64, seconds, as the scans' stamps.
        values: (N,) float64.
        limit: a value worth a line across the plot; None for none.
    """

    name: str
    unit: str
    stamps_s: F64
    values: F64
    limit: float | None = None


@dataclass(frozen=True)
class Closure:
    """Two scans of one place.

    Attributes:
        motion: pose of the robot at the later in its frame at the earlier, metres and radians.
        weight: 1 where the graph believes it, 0 where it goes against the rest.
    """

    start_s: float
    end_s: float
    motion: Pose2
    weight: float


class Mapper(Protocol):
    """One SLAM: feed it scans in the order of time, ask it for its pose and map at any moment.

    The map frame starts at the first odometry pose (at the identity without odometry), so maps of
    several producers on one log begin in one frame. Same scans, configuration and seed give the
    same bytes on one device.

    Attributes:
        name: short name, e.g. ``tinyslam``; the grid and the trajectory carry it.
    """

    name: str

    @property
    def health(self) -> Health:
        """The record so far."""

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Take the next scan.

        Args:
            scan: with a stamp later than the last one's.
            odometry: pose of the base in the odometry frame at the scan's time; None: none known.
        """

    def trajectory(self) -> Trajectory:
        """Return the pose at every scan fed so far, by today's knowledge."""

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return what else it believes the path to be, best first; may be empty."""

    def series(self) -> tuple[Series, ...]:
        """Return how its own quantities went over time, to be plotted; may be empty."""

    def grid(self) -> OccupancyGrid:
        """Return the map; unknown where nothing was seen.

        Raises:
            SlamFusionError: no scan has been used yet, so there is no map.
        """

    def memory_bytes(self) -> int:
        """Return the bytes that the map and the filter hold, on host and device."""


@runtime_checkable
class ClosesLoops(Mapper, Protocol):
    """A mapper that recognises places where the robot has been before."""

    def closures(self) -> list[Closure]:
        """Return the closures so far, as they are judged now."""


@dataclass(frozen=True, eq=False)
class MapJob:
    """What a map is drawn from: it does not change when the mapper goes on.

    Attributes:
        nodes: at least one; what is drawn at each pose, as the drawer knows it.
        poses: (N, 3) float64 of them in the map frame: metres, metres, radians.
    """

    nodes: Sequence[Any]
    poses: F64
    name: str


class MapDrawer(Protocol):
    """Draws the maps of one mapper, one after another, on a device and in a thread of its own."""

    def draw(self, job: MapJob) -> OccupancyGrid:
        """Return the map."""


@runtime_checkable
class DrawsAside(Mapper, Protocol):
    """A mapper whose map is drawn in another thread, while scans go on."""

    def map_job(self, *, is_settled: bool = False) -> MapJob:
        """Return what the map is drawn from.

        Args:
            is_settled: drawn from it the map is that of ``grid``; else asking takes no time.

        Raises:
            SlamFusionError: no scan has been used yet, so there is no map.
        """

    def map_drawer(self, device: ComputeDevice) -> MapDrawer:
        """Return what draws its maps on another device; it shares nothing with the mapper."""
