"""The refined path is taken where the scans do not speak against it, and scored as it is."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.evidence import JudgedScans, refine_borne_out, refinement, score_paths, with_path
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, moved


def wavy(truth: Trajectory) -> Trajectory:
    """Return the true path with slow errors of some centimetres."""
    turn = 2.0 * np.pi * np.arange(len(truth)) / 40.0
    off = np.stack((0.05 * np.sin(turn), 0.05 * np.cos(turn), 0.01 * np.sin(turn)), axis=1)
    return Trajectory(truth.stamps_s, truth.poses + off, "fused")


def test_a_path_that_lays_walls_on_each_other_is_taken(
    device: ComputeDevice, scans: JudgedScans
) -> None:
    truth = circuit()
    evidence = score_paths(scans, {"truth": truth}, device)
    given = wavy(truth)
    found = refine_borne_out(evidence, given, device)
    assert found.is_taken
    assert found.comparison.verdict == "better"
    assert found.path.name == "fused"
    assert not np.array_equal(found.path.poses, given.poses)
    assert tuple(found.evidence.scores) == ("truth", "fused")
    again = with_path(evidence, "fused", found.path, device).scores["fused"]
    assert found.evidence.scores["fused"].consistency == again.consistency
    assert found.evidence.scores["fused"].name == "fused"
    assert found.to_json()["taken"]


def test_a_path_that_the_scans_speak_against_is_not_taken(
    device: ComputeDevice, scans: JudgedScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = circuit()
    given = Trajectory(truth.stamps_s, truth.poses, "fused")
    evidence = score_paths(scans, {"other": wavy(truth)}, device)
    # What a refinement that pulls two walls together would do.
    monkeypatch.setattr(
        refinement, "refine_path", lambda _, path: moved(path, (0.4, 0.0, 0.0), len(path) // 2)
    )
    found = refine_borne_out(evidence, given, device)
    assert not found.is_taken
    assert found.comparison.verdict == "worse"
    assert found.path is given
    plain = with_path(evidence, "fused", given, device).scores["fused"]
    assert found.evidence.scores["fused"].consistency == plain.consistency
    assert tuple(found.evidence.scores) == ("other", "fused")
    assert found.to_json() == {
        "taken": False,
        "verdict": "worse",
        "difference": found.comparison.difference,
        "difference_95": (found.comparison.low, found.comparison.high),
        "p_value": found.comparison.p_value,
    }
