"""A state comes back whole and only where it belongs; anything else is refused by name."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.compute import NumpyDevice
from slamfusion.config import MatcherConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.packing import pack, unpack
from slamfusion.slam.common.state import read_state, restore_health, write_state
from slamfusion.slam.common.tracking import Tracker, TrackerState


@dataclass(frozen=True)
class Config:
    """Settings of a producer that is none."""

    reach_m: float = 8.0
    matcher: MatcherConfig = field(default_factory=MatcherConfig)


OWNER: dict[str, Any] = {"name": "drawn", "version": 3, "config": Config(), "seed": 5}
RECORD = {"scans": 7, "path": [0.5, None, "x"]}
ARRAYS: dict[str, npt.NDArray[Any]] = {
    "cells": np.arange(12, dtype=np.int8).reshape(3, 4),
    "poses": np.array([[0.1, math.pi, -1e-300]]),
}


@dataclass(frozen=True)
class Kept:
    """The state of a mapper that is none."""

    record: dict[str, Any]
    cells: npt.NDArray[np.int8]
    poses: npt.NDArray[np.float64]


def write(path: Path, record: Any = RECORD, **others: Any) -> None:
    write_state(path, **{**OWNER, "state": Kept(record, **ARRAYS), **others})


def read(path: Path, **others: Any) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    kept = read_state(path, **{**OWNER, "kind": Kept, **others})
    return kept.record, {name: getattr(kept, name) for name in ARRAYS}


def assert_whole(path: Path, **others: Any) -> None:
    record, arrays = read(path, **others)
    assert record == RECORD
    for name, wanted in ARRAYS.items():
        assert arrays[name].dtype == wanted.dtype
        np.testing.assert_array_equal(arrays[name], wanted)


# -- files -----------------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write(tmp_path / "drawn.state")
    return tmp_path / "drawn.state"


def refused(path: Path, **others: Any) -> str:
    with pytest.raises(SlamFusionError) as caught:
        read(path, **others)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_a_state_comes_back_whole(path: Path) -> None:
    assert_whole(path)


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"name": "other"}, "wanted a state of other, format 3, found drawn, format 3"),
        ({"version": 4}, "wanted a state of drawn, format 4, found drawn, format 3"),
        ({"version": 2}, "wanted a state of drawn, format 2, found drawn, format 3"),
        ({"seed": 6}, "was made with seed = 5, found 6; resume with the same settings"),
        ({"config": Config(8.001)}, "was made with reach_m = 8.0, found 8.001; resume with"),
        (
            {"config": Config(matcher=MatcherConfig(beams=121))},
            "was made with matcher.beams = 120, found 121; resume with the same settings",
        ),
        ({"config": MatcherConfig()}, "was made with reach_m = 8.0, found None; resume with"),
    ],
)
def test_a_state_of_another_owner_is_refused_by_what_differs(
    path: Path, others: dict[str, Any], words: str
) -> None:
    assert refused(path, **others).startswith(words)


@pytest.mark.parametrize("kept", [0, 1, 100, -1])
def test_a_state_that_was_cut_short_is_refused(path: Path, kept: int) -> None:
    path.write_bytes(path.read_bytes()[:kept])
    assert refused(path) == "not a whole state that `--save-state` has written"


def test_what_is_no_state_is_refused(path: Path, tmp_path: Path) -> None:
    assert refused(tmp_path / "none") == "cannot be read (No such file or directory)"
    path.write_bytes(b"free_thresh: 0.25\n")
    assert "not a whole state" in refused(path)
    np.savez(path.open("wb"), cells=np.zeros(3))
    assert "not a whole state" in refused(path)
    for record in ({}, {"name": "drawn"}, [3]):
        text = np.frombuffer(json.dumps(record).encode(), dtype=np.uint8)
        np.savez(path.open("wb"), record=text)
        assert "not a whole state" in refused(path)


def test_a_state_that_would_run_code_is_refused(path: Path, tmp_path: Path) -> None:
    class Runs:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (tmp_path / "ran",)

    np.savez(path.open("wb"), record=np.array([Runs()], dtype=object))
    assert "not a whole state" in refused(path)
    assert not (tmp_path / "ran").exists()


def test_a_state_that_cannot_be_written_leaves_the_one_before(path: Path) -> None:
    with pytest.raises(TypeError):
        write(path, record={"scans": object()})
    assert_whole(path)
    assert [item.name for item in path.parent.iterdir()] == [path.name]


# -- what states are made of -----------------------------------------------------------------------


def through_file(state: Any) -> Any:
    """Return a state as a file gives it back."""
    values, arrays = pack(state)
    return unpack(type(state), json.loads(json.dumps(values)), arrays)


NUMBERS = st.floats(-1e6, 1e6)


@given(pose=st.none() | st.builds(Pose2, NUMBERS, NUMBERS, NUMBERS))
def test_a_pose_comes_back_to_the_last_bit(pose: Pose2 | None) -> None:
    state = TrackerState({}, pose, None, Pose2(), 0.0, 0.0, None)
    assert through_file(state) == state


def test_a_health_record_comes_back_with_what_was_left_out() -> None:
    health = Health(9, 7, 0.4, 0.5, 2, 12.5)
    for scan in (3, 5):
        health.skips.add("no hits", scan)
    again = Health()
    restore_health(again, through_file(health))
    assert again == health
    # What was restored is its own: what comes later is not written into what was kept.
    again.skips.add("no hits", 8)
    assert health.skips.lines == {"no hits": [3, 5]}


@pytest.mark.parametrize("scans", [0, 1, 4])
def test_a_tracker_goes_on_as_if_it_had_not_stopped(scans: int) -> None:
    def start() -> Tracker:
        return Tracker(MatcherConfig(), NumpyDevice(), np.random.default_rng(8), Health())

    walked = start()
    for scan in range(scans):
        pose = Pose2(0.2 * scan, 0.1, 0.05 * scan)
        walked.advance(pose, None if scan == 2 else replace(pose, y=0.0), 10.0 + 0.5 * scan)
        walked._remember(0.4 + 0.1 * scan)
        walked.rng.standard_normal(3)
    resumed = start()
    resumed.restore(through_file(walked.to_state()))
    for name in ("pose", "odometry", "step", "step_s", "stamp_s", "running_mean_score"):
        assert getattr(resumed, name) == getattr(walked, name), name
    assert resumed.rng.random() == walked.rng.random()
    for odometry in (None, Pose2(0.9, 0.1, 0.2)):
        for one, other in zip(
            resumed.hypotheses(12.1, odometry), walked.hypotheses(12.1, odometry), strict=True
        ):
            np.testing.assert_array_equal(one.pose, other.pose)
            assert (one.spread, one.loss) == (other.spread, other.loss)
