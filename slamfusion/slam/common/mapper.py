"""``Mapper``: what every SLAM here offers, and the record of how well it is doing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import Skips
from slamfusion.json_values import printed_as
from slamfusion.scan import LaserScan
from slamfusion.trajectory import Trajectory

# Why a scan is passed over that no mapper can use.
BLIND = "no reading within the usable range"
# Share of the mean score below which a match is low: while tracking holds that is rare.
LOW_SHARE = 0.5


@dataclass(frozen=True)
class Step:
    """The result of one scan; the pose of the base is in the map frame.

    Attributes:
        used: False if the scan could not be used and the pose is dead reckoning.
        match_score: share of the scan's hits on known walls, 0 to 1; None for the first scan.
        reason: why the scan was not used, as counted in ``Health.skips``; else empty.
    """

    pose_map_base: Pose2
    used: bool
    match_score: float | None
    reason: str = ""


@dataclass
class Health:
    """How well a producer is doing; each kind of producer may add keys of its own."""

    scans: int = 0
    """Scans fed so far."""
    scans_used: int = 0
    """Of these, the ones that were matched or mapped."""
    match_score: float | None = None
    """Share of the last matched scan's hits that fell on known walls, 0 to 1."""
    mean_match_score: float | None = None
    """Mean of it over every matched scan."""
    low_scores: int = 0
    """Matched scans whose score was below half of the mean so far."""
    n_eff: float | None = None
    """Effective number of particles; null where there are none."""
    skips: Skips = field(default_factory=Skips, metadata=printed_as("skipped"))
    """Scans that were not used, by reason."""

    def warnings(self) -> tuple[str, ...]:
        """Return what contradicts the map, a sentence each."""
        return ()


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity over the time of a run, to be plotted.

    Attributes:
        stamps_s: (N,) float64, seconds, as the scans' stamps.
        values: (N,) float64, in ``unit``; an empty unit means a plain number.
        limit: value drawn as a line across the plot; None for none.
    """

    name: str
    unit: str
    stamps_s: F64
    values: F64
    limit: float | None = None


@dataclass(frozen=True)
class Closure:
    """Two scans of one place; ``weight`` is 1 for an inlier of the pose graph, 0 for an outlier.

    Attributes:
        motion: pose of the robot at the later scan in its frame at the earlier, metres, radians.
    """

    start_s: float
    end_s: float
    motion: Pose2
    weight: float


class Mapper(Protocol):
    """One SLAM: feed it scans in the order of time, ask it for its pose and map at any moment.

    The map frame starts at the first odometry pose (the identity without odometry), so producers
    of one log share their frame. Same scans, configuration and seed give the same bytes on one
    device. The grid and the trajectory carry the mapper's short ``name``.
    """

    name: str

    @property
    def health(self) -> Health:
        """The record so far."""

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Take the next scan, of a later stamp, and the base's pose in the odometry frame."""

    def trajectory(self) -> Trajectory:
        """Return the pose at every scan so far, by all that is known now."""

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return alternative paths, best first; may be empty."""

    def series(self) -> tuple[Series, ...]:
        """Return the producer's own quantities over time; may be empty."""

    def grid(self) -> OccupancyGrid:
        """Return the map; unknown where nothing was seen.

        Raises:
            SlamFusionError: no scan has been used yet, so there is no map.
        """

    def memory_bytes(self) -> int:
        """Return the bytes of the map and the filter, on host and device."""


@runtime_checkable
class ClosesLoops(Mapper, Protocol):
    """A mapper that recognises places where the robot has been before."""

    def closures(self) -> list[Closure]:
        """Return the closures so far, with their present weights."""


@dataclass(frozen=True, eq=False)
class MapJob:
    """What a map is drawn from, unaffected by later scans; at least one node.

    Attributes:
        poses: (N, 3) float64 poses of the nodes in the map frame: metres, metres, radians.
    """

    nodes: Sequence[Any]
    poses: F64
    name: str


@runtime_checkable
class DrawsAside(Mapper, Protocol):
    """A mapper whose map is drawn in another thread, while scans go on."""

    def map_job(self, *, is_settled: bool = False) -> MapJob:
        """Return what the map is drawn from; SlamFusionError if no scan has been used yet.

        If ``is_settled``, the map equals that of ``grid``; else the call takes no time.
        """

    def trajectory(self, job: MapJob | None = None) -> Trajectory:
        """Return the path of all scans; that of a map's nodes takes no time."""

    def map_drawer(self, device: ComputeDevice) -> Callable[[MapJob], OccupancyGrid]:
        """Return what draws its maps, one after another, on another device and in another thread.

        It shares nothing with the mapper.
        """
