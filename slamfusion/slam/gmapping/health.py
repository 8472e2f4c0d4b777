"""``FilterHealth``: how well the particle filter is doing."""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.slam.common.mapper import Health
from slamfusion.slam.records import HealthJson


@dataclass
class FilterHealth(Health):
    """How well the particle filter is doing.

    Attributes:
        best_score: of the best particle at the last filter step: sum over its hits, each 0 to 1.
        filter_steps: times that the particles were weighed and mapped.
        resamplings: times that they were resampled.
        resamplings_for_memory: of these, the ones that ``memory_budget`` asked for.
        rejected: matches of single particles below ``minimumScore``.
        path_entropy: mean over the path of the entropy of the particles' pose, nats.
        tiles_owned: tiles of the maps that one particle uses alone.
        tiles_shared: tiles that several use.
    """

    best_score: float | None = None
    filter_steps: int = 0
    resamplings: int = 0
    resamplings_for_memory: int = 0
    rejected: int = 0
    path_entropy: float | None = None
    tiles_owned: int = 0
    tiles_shared: int = 0

    def to_json(self) -> HealthJson:
        """Return the record for a JSON document."""
        return {
            **super().to_json(),
            "filter": {
                "best_score": self.best_score,
                "filter_steps": self.filter_steps,
                "resamplings": self.resamplings,
                "resamplings_for_memory": self.resamplings_for_memory,
                "rejected": self.rejected,
                "path_entropy": self.path_entropy,
                "tiles_owned": self.tiles_owned,
                "tiles_shared": self.tiles_shared,
            },
        }
