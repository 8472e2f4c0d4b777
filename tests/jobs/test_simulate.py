"""``simulate_course`` as a library: courses by name, file and settings, and their files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import RunConfig, SimulateConfig
from slamfusion.errors import SimulationError
from slamfusion.io import read_trajectory
from slamfusion.jobs.simulate import choose_course, save_simulated_drive, simulate_course
from slamfusion.json_values import plain
from tests.support.documents import check_document

DEVICE = NumpyDevice()
COURSE = """name: short
seed: 4
world: atrium
lidar: kinect
script:
  - {turn_deg: 30.0}
  - {forward_m: 0.5}
"""


def test_a_course_is_simulated_and_written(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(COURSE, encoding="utf-8")
    told: list[str] = []
    drive = simulate_course(
        tmp_path / "short.yaml", device=DEVICE, progress=lambda *words: told.append(words[0])
    )
    assert drive.recording.course.seed == 4
    assert set(told) == {"scans"}
    document = save_simulated_drive(drive, tmp_path / "out")
    check_document(plain(document), "simulate")
    assert document["scans"] == len(drive.recording.scans)
    assert all(Path(path).is_file() for path in document["files"])
    written = read_trajectory(tmp_path / "out" / "truth.tum")
    np.testing.assert_allclose(written.poses, drive.recording.truth.poses, atol=1e-6)


def test_a_course_is_chosen_by_name_file_and_settings(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(COURSE, encoding="utf-8")
    config = RunConfig(seed=9)
    assert choose_course("office", config).seed == 9
    assert choose_course(tmp_path / "short.yaml", config).seed == 4
    assert choose_course(tmp_path / "short.yaml", config, seed=7).seed == 7
    with_people = replace(config, simulate=SimulateConfig(people=5))
    assert choose_course("office", with_people).people == 5
    with pytest.raises(SimulationError, match="ofice"):
        simulate_course("ofice", device=DEVICE)
