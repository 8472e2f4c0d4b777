"""What a producer's node says of its SLAM on ``/diagnostics``."""

from __future__ import annotations

import time

from slamfusion.ros.frames import TransformStore
from slamfusion.ros.scan_gate import ScanGate
from slamfusion.slam.session import Drawn, Snapshot

STRAY = "a stamp far from those before and after it"


def producer_figures(
    snapshot: Snapshot,
    drawn: Drawn,
    gate: ScanGate,
    odometry: TransformStore | None,
    strays: int,
) -> dict[str, object]:
    """Return the figures of the SLAM's line.

    Args:
        snapshot: of the worker of scans.
        drawn: of the worker of maps.
        gate: which scans go on.
        odometry: where odometry is kept; None: there is none.
        strays: scans left out for their stamps.
    """
    health, heard_s = snapshot.health, None if odometry is None else odometry.last_s
    median_ms, high_ms = snapshot.latencies_ms()
    left_out = {STRAY: strays} if strays else {}
    left_out |= snapshot.left_out
    return {
        "scans fed": snapshot.fed,
        "scans used": health.scans_used,
        "scans held for their stamps": gate.held,
        "scans without odometry": snapshot.without_odometry,
        "maps published": drawn.maps,
        "maps begun anew": gate.jumps_back,
        "match score": health.match_score,
        "mean match score": health.mean_match_score,
        "low scores": health.low_scores,
        "effective particles": health.n_eff,
        "latency median [ms]": median_ms,
        "latency p95 [ms]": high_ms,
        "map [cells]": f"{drawn.shape[0]} x {drawn.shape[1]}",
        "reading the map [ms]": 1e3 * snapshot.map_time_s,
        "drawing the map [ms]": None if drawn.time_s is None else 1e3 * drawn.time_s,
        "memory [MB]": snapshot.memory_bytes / 1e6,
        "odometry with a stray stamp": None if odometry is None else odometry.strays,
        "last odometry [s ago]": None if heard_s is None else time.monotonic() - heard_s,
        **{f"left out: {key}": count for key, count in left_out.items()},
        **{f"not used: {key}": count for key, count in health.skips.items()},
    }
