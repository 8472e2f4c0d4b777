"""What the scans say of the paths, on a page: the paths have the colours of the other pictures."""

from __future__ import annotations

import re

import numpy as np

from slamfusion.compute import open_device
from slamfusion.evidence.beams import judged_scans
from slamfusion.evidence.predictive import score_paths
from slamfusion.evidence.recommendation import recommend
from slamfusion.palette import NAMED
from slamfusion.report.paths import evidence_section
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
    answer = recommend(evidence, slams, fused="fused")
    section = evidence_section(answer, evidence)
    (picture,) = section.pictures
    assert picture.legend == {name: NAMED[name] for name in ("graph", "fused", "gmapping")}
    assert "<details>" in section.tables, "the reasons stand below the answer"
    found = dict(re.findall(r'<tr><td class="\w+">(\w+)</td>.*">(.*)</td></tr>', section.tables))
    assert found == {"fused": "-", "graph": "0.000", "gmapping": "0.000"}
    # A path that only has this name is one like the others.
    answer = recommend(evidence, tuple(evidence.scores))
    section = evidence_section(answer, evidence)
    assert section.tables.count('<td class="plain number">-</td></tr>') == 3
