"""Where one path leaves another: spans of time, and how far the two are apart."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.beams import JudgedScans
from slamfusion.evidence.parting import PART_M, path_gap_m, path_spans
from slamfusion.evidence.predictive import score_paths
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, moved
from tests.support.examples import examples

TRUTH = circuit()


@settings(max_examples=examples(20), deadline=None)
@given(
    x=st.floats(-1e3, 1e3),
    yaw_rad=st.floats(-math.pi, math.pi),
    share=st.floats(0.55, 0.95),
    is_first=st.booleans(),
)
def test_a_broken_part_does_not_turn_the_rest(
    device: ComputeDevice,
    scans: JudgedScans,
    x: float,
    yaw_rad: float,
    share: float,
    is_first: bool,
):
    cut = int((1.0 - share if is_first else share) * len(TRUTH))
    broken = moved(TRUTH, (3.0, 1.0, 0.5), cut)
    path = moved(broken, (x, 7.0, yaw_rad))
    evidence = score_paths(scans, {"truth": TRUTH, "broken": path}, device)
    gap_m = path_gap_m(evidence, "broken", "truth")
    right, wrong = (gap_m[cut:], gap_m[:cut]) if is_first else (gap_m[:cut], gap_m[cut:])
    assert right.max() < 1e-6
    assert wrong.max() > 1.0


def test_spans_cover_the_drive_and_short_ones_are_none(device: ComputeDevice, scans: JudgedScans):
    poses = TRUTH.poses.copy()
    poses[40:42, 0] += 2.0 * PART_M  # half a second
    poses[80:100, 0] += 2.0 * PART_M
    path = Trajectory(TRUTH.stamps_s, poses)
    evidence = score_paths(scans, {"truth": TRUTH, "path": path}, device)
    spans = path_spans(evidence, "path", "truth")
    assert [span.agrees for span in spans] == [True, False, True]
    assert [span.from_s for span in spans] == [0.0, 20.0, 25.0]
    assert [span.to_s for span in spans] == [20.0, 25.0, 35.75]
    assert path_spans(evidence, "truth", "truth")[0].gap_m == pytest.approx(0.0, abs=1e-9)
