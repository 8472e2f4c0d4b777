"""``check_installation`` as a library: what is wrong stands in the document."""

from __future__ import annotations

import pytest

from slamfusion.config import DeviceConfig, RunConfig
from slamfusion.jobs.doctor import check_installation

NUMPY = RunConfig(device=DeviceConfig(device="numpy"))


def test_a_device_that_is_not_there_is_a_problem_and_no_error() -> None:
    found = check_installation(RunConfig(device=DeviceConfig(device="abacus")))
    assert not found.ok
    assert found.device is None
    assert any("abacus" in problem for problem in found.problems)


def test_two_rclpy_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda _: "7.1.6")
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    assert "two rclpy" not in "; ".join(check_installation(NUMPY).problems)
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    assert "two rclpy" in "; ".join(check_installation(NUMPY).problems)
