"""What the scans say of the paths, on a page: the paths have the colours of the other pictures."""

from __future__ import annotations

import numpy as np

from slamfusion.compute import open_device
from slamfusion.evidence import judged_scans, recommend, score_paths
from slamfusion.palette import NAMED
from slamfusion.report.evidence import evidence_section
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, recorded

TRUTH = circuit()
NEAR = Trajectory(TRUTH.stamps_s, TRUTH.poses + np.array([0.0, 0.0, 0.001]))


def test_the_fused_path_has_its_colour_and_the_slams_theirs() -> None:
    device = open_device()
    evidence = score_paths(
        judged_scans(recorded(TRUTH)), {"graph": NEAR, "fused": TRUTH, "gmapping": NEAR}, device
    )
    slams = ("graph", "gmapping")
    answer = recommend(evidence, slams, device, fused="fused")
    section = evidence_section(answer, evidence)
    (picture,) = section.pictures
    assert picture.legend == {name: NAMED[name] for name in ("graph", "fused", "gmapping")}
    (table,) = section.tables
    column = table.columns.index("from the fused path [m]")
    assert table.folded, "the reasons stand below the answer"
    found = {row[0].text: row[column].text for row in table.rows}
    assert found["fused"] == "-"
    assert found["graph"] == found["gmapping"] == "0.000"
    # A path that only has this name is one like the others.
    answer = recommend(evidence, tuple(evidence.scores), device)
    section = evidence_section(answer, evidence)
    assert [row[column].text for row in section.tables[0].rows] == ["-"] * 3
