"""``BeamCounts``: scans that are taken back leave no trace."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.slam.common.beam_counts import BeamCounts, Beams

RESOLUTION = 0.05


def beams_at(x_m: float, seed: int) -> Beams:
    """Return one scan of 90 beams of up to 8 m."""
    random = np.random.default_rng(seed)
    angles, ranges_m = random.uniform(-np.pi, np.pi, 90), random.uniform(1.0, 8.0, 90)
    ends = ranges_m[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    scan = SimpleNamespace(ends=ends, laser=np.zeros(2))
    return Beams.of([scan], [(x_m, 0.3, 0.7)], RESOLUTION)


def test_a_scan_far_off_is_taken_back_after_the_window_has_moved(device: ComputeDevice):
    counts = BeamCounts(device)
    near, far, before = beams_at(0.0, 1), beams_at(700.0, 2), beams_at(-40.0, 3)
    for beams in (near, far, before):
        counts.count(beams, counts.place(beams), 1)
    counts.count(far, counts.ends(far), -1)
    alone = BeamCounts(device)
    for beams in (near, before):
        alone.count(beams, alone.place(beams), 1)
    for pick in (lambda hits, _: hits, lambda _, visits: visits):
        left, wanted = (own.cells(pick, np.uint32)[0] for own in (counts, alone))
        assert left.sum() == wanted.sum() > 0
        assert left.max() == wanted.max()
