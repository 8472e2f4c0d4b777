"""The maps of a drive of an experiment: fused as in ``run``, in every way."""

from __future__ import annotations

import numpy as np

from slamfusion.compute import open_device
from slamfusion.config import RunConfig
from slamfusion.evidence.beams import scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.experiments.fusions import (
    CHOICE,
    FUSED_PATH,
    FUSIONS,
    DriveMaps,
    alone,
    fuse_in_every_way,
    produce_maps,
)
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, moved, recorded
from tests.support.producers import room_drive

TRUTH = circuit()
SCANS = recorded(TRUTH)
NEAR = Trajectory(TRUTH.stamps_s, TRUTH.poses + np.array([0.0, 0.0, 0.001]))
PATHS = {"tinyslam": NEAR, "gmapping": moved(TRUTH, (0.9, 1.2, 0.0), 108), "graph": TRUTH}


def test_a_producer_that_fails_is_named_and_the_others_go_on() -> None:
    scans, told = room_drive(6), []
    made = produce_maps(
        {"tinyslam": scans, "graph": []},
        RunConfig(),
        open_device(),
        lambda *words: told.append(words[0]),
    )
    assert made.maps["tinyslam"] is not None
    assert made.maps["graph"] is None
    assert "graph could use none of 0 scans" in made.notes["graph"]
    assert set(made.paths) == {"tinyslam"}
    assert told == sorted(told)
    assert len(told) == 6


def test_a_harmed_producer_is_also_left_out_of_the_votes_and_bends_no_fused_path() -> None:
    device, scans = open_device(), [*scan_hits(SCANS)]
    maps = {
        name: draw_map(scans, path, device, resolution=0.05, name=name)
        for name, path in PATHS.items()
    }
    made = DriveMaps(maps, PATHS)
    found = fuse_in_every_way(made, SCANS, RunConfig(), device, harmed="gmapping")
    assert list(found.maps) == [*BUILT_IN, *FUSIONS, *map(alone, FUSIONS)]
    assert set(found.paths) == {*PATHS, FUSED_PATH}
    assert found.choice in {"tinyslam", "graph"}
    ate_m = found.path_errors(TRUTH)
    assert ate_m[FUSED_PATH] < 0.1 * ate_m["gmapping"]

    # Where the scans cannot be asked all vote as they are.
    found = fuse_in_every_way(made, SCANS[:20], RunConfig(), device)
    assert CHOICE in found.notes
    assert found.choice == ""
