"""``Intake``: hands what came of the inputs to their tracks, and refuses what cannot be used."""

from __future__ import annotations

from collections.abc import Mapping

from slamfusion.compute import ComputeDevice
from slamfusion.config import LiveConfig, NormalizeConfig
from slamfusion.errors import GridError, MemoryBudgetError
from slamfusion.fusion.inputs import odd_resolution
from slamfusion.fusion.live.inbox import Inbox
from slamfusion.fusion.live.limits import too_large, unusable
from slamfusion.fusion.live.supervisor import InputSupervisor
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid


class Intake:
    """Empties an inbox into tracks.

    Attributes:
        live: when an input is stale, and when its old walls stand; may be replaced.
    """

    def __init__(
        self, inbox: Inbox, thresholds: NormalizeConfig, live: LiveConfig, device: ComputeDevice
    ) -> None:
        """Take from an inbox; ``thresholds`` say what is a wall, ``device`` resamples."""
        self.live = live
        self._inbox = inbox
        self._thresholds = thresholds
        self._device = device

    def collect(
        self,
        supervisor: InputSupervisor,
        restored: Mapping[str, Pose2],
        resolution: float | None,
        now_s: float,
    ) -> bool:
        """Hand what came to the tracks; return whether there was any.

        Args:
            supervisor: has the tracks; new inputs are added to them.
            restored: where inputs of an earlier run lay in the fused frame, by name.
            resolution: metres per fused cell; None before the first fusion.
            now_s: on the clock of the inbox.
        """
        tracks = supervisor.tracks
        fresh, received = self._inbox.take()
        for name, item in fresh.items():
            track = tracks.setdefault(name, Track(name, transform=restored.get(name)))
            reason = item.gone or item.refused
            if reason is None and item.grid is not None:
                reason = self._follow(supervisor, track, item.grid, resolution)
                if reason is not None:
                    self._inbox.count_rejected(name)
            if reason is not None:
                track.is_live = False
                track.refuse(reason)
        # Older than another's, not than now: when the robot stands still all fall silent together.
        newest = max(received.values(), default=now_s)
        for name, came in received.items():
            stale = tracks.get(name)
            if stale is not None and stale.is_live and newest - came > self.live.stale_after_s:
                stale.is_live = False
                stale.refuse(f"no map for {now_s - came:.0f} s")
        return bool(fresh)

    def _follow(
        self,
        supervisor: InputSupervisor,
        track: Track,
        grid: OccupancyGrid,
        resolution: float | None,
    ) -> str | None:
        """Let a track follow its new map; return why it cannot, in words."""
        reason = unusable(grid, self._thresholds)
        if reason is not None:
            return reason
        if resolution is not None:
            reason = odd_resolution(grid.resolution, resolution)
        reason = reason or too_large(grid, resolution or grid.resolution)
        if reason is not None:
            return reason
        try:
            change = track.follow(grid, resolution, self._thresholds, self.live, self._device)
        except (GridError, MemoryBudgetError) as error:
            return str(error)
        except MemoryError:
            return f"no memory is left for a map of {grid.height} x {grid.width} cells"
        if not track.is_live:
            track.is_live = True
            track.tried = None
            track.refuse("new; not aligned yet")
        if change is not None and track.name == supervisor.reference:
            for other in supervisor.tracks.values():
                if other is not track:
                    other.drift += change.walls
        return None
