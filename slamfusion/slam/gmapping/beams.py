"""``Beams``: what of a scan the filter uses, by gmapping's ``maxRange`` and ``maxUrange``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.scan import LaserScan

F64 = npt.NDArray[np.float64]

# Usable range where ``maxUrange`` is open: metres, and share of the laser's range, near whose end
# readings are often returns of nothing.
DEFAULT_USABLE_M, USABLE_SHARE = 80.0, 0.98


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams of a scan that count.

    Attributes:
        ends: (B, 2) metres in the robot's frame.
        is_hit: (B,) 1 for those that hit something there; the others are free up to their end.
        laser: (2,) likewise.
    """

    ends: F64
    is_hit: npt.NDArray[np.uint8]
    laser: F64

    @property
    def hits(self) -> F64:
        """(P, 2) the ends that hit something."""
        return np.asarray(self.ends[self.is_hit == 1])


def beams_of(scan: LaserScan, config: Any) -> Beams:
    """Return the beams of a scan that count.

    Args:
        scan: the sweep.
        config: a ``GmappingConfig``.
    """
    most = config.maxRange or scan.range_max_m
    usable = config.maxUrange or min(DEFAULT_USABLE_M, USABLE_SHARE * scan.range_max_m)
    usable = min(usable, most)
    hit = scan.is_hit(usable)
    free = scan.is_hit(most) & ~hit
    if most > scan.range_max_m:  # [G07]'s way to say that no return means free space
        free |= scan.is_clear()
    chosen = hit | free
    ends = scan.points(chosen, np.where(hit, scan.ranges, usable))
    laser = np.array([scan.mount.x, scan.mount.y])
    return Beams(ends, hit[chosen].astype(np.uint8), laser)
