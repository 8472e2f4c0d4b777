"""What a row of scans says of the robot: tracked, unsure, tracking failed, or kidnapped."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.slam.graph.tracking_quality import (
    BAD_SHARE,
    FAILED_BAD,
    FAILED_SCANS,
    LOST_SCANS,
    RESET_SHARE,
    TrackingQuality,
    TrackingStatus,
)

GOOD, BAD = BAD_SHARE, BAD_SHARE - 1e-9


def judged(fits: list[float], *, is_sure: bool = True) -> list[TrackingStatus]:
    """Return what is said of scans in a row, numbered from 1, all sure or none."""
    quality = TrackingQuality()
    return [
        quality.judge(number, fit, is_sure=is_sure, has_jumped=False)
        for number, fit in enumerate(fits, 1)
    ]


def test_a_robot_is_kidnapped_after_as_many_unsure_scans_in_a_row():
    assert judged([BAD] * LOST_SCANS, is_sure=False) == [
        *["unsure"] * (LOST_SCANS - 1),
        "kidnapped",
    ]


@pytest.mark.parametrize(
    ("fit", "has_jumped", "status"),
    [
        (RESET_SHARE - 1e-9, True, "kidnapped"),
        (RESET_SHARE, True, "tracked"),
        (RESET_SHARE - 1e-9, False, "tracked"),
    ],
)
def test_after_a_reset_of_the_odometry_one_scan_that_fits_worse_is_enough(
    fit: float, *, has_jumped: bool, status: TrackingStatus
):
    assert TrackingQuality().judge(1, fit, is_sure=True, has_jumped=has_jumped) == status


@pytest.mark.parametrize(
    ("later", "last"), [(FAILED_SCANS - 1, "failed"), (FAILED_SCANS, "tracked")]
)
def test_tracking_fails_with_as_many_bad_scans_among_the_last(later: int, last: TrackingStatus):
    fits = [BAD] * (FAILED_BAD - 1) + [GOOD] * FAILED_SCANS
    fits[later] = BAD
    said = judged(fits[: later + 1])
    assert said[:-1] == ["tracked"] * later
    assert said[-1] == last


def test_a_new_local_map_forgets_what_was():
    quality = TrackingQuality()
    for number in range(LOST_SCANS - 1):
        quality.judge(number, BAD, is_sure=False, has_jumped=False)
    quality.reset()
    assert quality.judge(LOST_SCANS, BAD, is_sure=True, has_jumped=False) == "tracked"
    assert quality == TrackingQuality(0, [LOST_SCANS])


ORDER: dict[TrackingStatus, int] = {"tracked": 0, "unsure": 1, "failed": 1, "kidnapped": 2}


@given(
    fits=st.lists(st.floats(0.0, 1.2), min_size=1, max_size=30),
    worse=st.lists(st.floats(0.0, 1.0), min_size=30, max_size=30),
)
def test_scans_that_fit_worse_never_make_it_better(fits: list[float], worse: list[float]):
    better = judged(fits)
    lower = judged([fit * share for fit, share in zip(fits, worse, strict=False)])
    assert all(ORDER[low] >= ORDER[high] for low, high in zip(lower, better, strict=True))
