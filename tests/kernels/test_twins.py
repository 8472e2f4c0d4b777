"""Every operation of every device equals its NumPy twin."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.compute.self_test import OPERATIONS, self_test
from slamfusion.errors import DeviceError
from tests.kernels.checks import CHECKS, Sample, differences
from tests.support.examples import examples

SMALL = {
    "odd": Sample((13, 29), seed=2),
    "one row": Sample((1, 37), seed=3),
    "one column": Sample((31, 1), seed=4),
    "one cell": Sample((1, 1), seed=5),
    "all unknown": Sample((11, 35), seed=6, known_share=0.0),
    "all known": Sample((16, 64), seed=7, known_share=1.0),
    "no overlap": Sample((12, 34), seed=8, away=5000.0),
}
LARGE = {"odd and large": Sample((131, 203), seed=9), "long": Sample((3, 1030), seed=10)}


@pytest.mark.parametrize("name", CHECKS)
def test_operation_equals_its_twin(device: ComputeDevice, name: str):
    for words, sample in (SMALL | LARGE).items():
        assert not differences(name, device, sample), words


@pytest.mark.jazzy  # every operation
@pytest.mark.parametrize("name", CHECKS)
@settings(
    max_examples=examples(15),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    shape=st.tuples(st.integers(1, 80), st.integers(1, 80)),
    seed=st.integers(0, 2**32 - 1),
    known_share=st.sampled_from((0.0, 0.3, 0.9, 1.0)),
)
def test_operation_equals_its_twin_at_any_size(
    pocl: ComputeDevice, name: str, shape: tuple[int, int], seed: int, known_share: float
):
    assert not differences(name, pocl, Sample(shape, seed=seed, known_share=known_share))


@pytest.mark.parametrize("name", CHECKS)
def test_repeated_runs_give_the_same_bytes(pocl: ComputeDevice, fresh: ComputeDevice, name: str):
    sample = Sample((61, 83), seed=11)
    first = [array.tobytes() for array in CHECKS[name](pocl, sample)]
    for other in (pocl, pocl, fresh):
        assert [array.tobytes() for array in CHECKS[name](other, sample)] == first


@pytest.mark.once
def test_self_test_passes(pocl: ComputeDevice):
    assert self_test(pocl) == [(name, True, "equals its NumPy twin") for name in OPERATIONS]


def test_self_test_names_a_wrong_kernel(monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise DeviceError("no memory")

    wrong = NumpyDevice()
    scores = wrong.pose_scores
    monkeypatch.setattr(wrong, "pose_scores", lambda side: [s + 1 for s in scores(side)])
    monkeypatch.setattr(wrong, "warp", fail)
    assert self_test(wrong) == [
        ("pose_scores", False, "3 values differ from its NumPy twin"),
        ("warp", False, "no memory"),
        ("piece_sums", True, "equals its NumPy twin"),
        ("vote_majority", True, "equals its NumPy twin"),
    ]
