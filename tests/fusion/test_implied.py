"""Rejected pairs under the transform that others imply: borne out, contradicted, nothing shared."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.grouping import FusionSetup, GroupSearch, SecondLook
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of, fusion_config, part

QUICK = replace(fusion_config(), keep_duplicates=True)


def looked(device: ComputeDevice, grids: dict[str, OccupancyGrid], at: Pose2) -> tuple[bool, str]:
    features = {name: features_of(grid, device) for name, grid in grids.items()}
    reference, moving = grids
    search = GroupSearch(features, FusionSetup(FusionConfig(), device))
    found = search.look(reference, moving, at)
    return found.stands, found.words


@pytest.mark.parametrize(
    ("end", "start", "at", "stands", "words"),
    [
        (0.8, 0.3, Pose2(0.1, -0.1, math.radians(0.5)), True, "^(9[789]|100)%"),
        (0.8, 0.3, Pose2(1.5, 0.7), False, ""),
        (0.8, 0.3, Pose2(0.0, 0.0, math.radians(25.0)), False, ""),
        # On little ground nothing is contradicted.
        (0.5, 0.45, Pose2(0.3, 0.2), True, "of the ground in common$"),
    ],
)
def test_walls_bear_out_or_contradict_what_others_imply(
    device: ComputeDevice, end: float, start: float, at: Pose2, *, stands: bool, words: str
) -> None:
    place = building(3, 11.0, 9.0)
    grids = {"a": part(place, 0.0, end, "a"), "b": part(place, start, 1.0, "b")}
    found = looked(device, grids, at)
    assert found[0] == stands
    assert re.search(words, found[1])


def test_another_building_on_the_same_ground_contradicts(device: ComputeDevice) -> None:
    grids = {"a": building(3, 11.0, 9.0).with_name("a"), "b": building(4, 11.0, 9.0).with_name("b")}
    stands, _ = looked(device, grids, Pose2())
    assert not stands


def refusing(a: str, b: str, put: Pose2 | None = None) -> SecondLook:
    """Reject one pair; put another one, of ``b`` and a third, aside where asked."""

    def second_look(pair: Alignment, _: Pair) -> Alignment:
        names = {pair.reference, pair.moving}
        if names == {a, b}:
            return replace(pair, accepted=False, reason="refused by hand")
        if put is not None and b in names:
            aside = put if pair.moving == b else put.inverse()
            return replace(pair, transform=pair.transform.compose(aside))
        return pair

    return second_look


def test_a_group_stands_over_a_rejected_pair_that_its_walls_bear_out(device: ComputeDevice) -> None:
    place = building(3, 11.0, 9.0)
    grids = [place.with_name("a"), place.with_name("b"), place.with_name("c")]
    result = fuse_grids(grids, QUICK, device, second_look=refusing("a", "c"))
    assert [record.name for record in result.accepted] == ["a", "b", "c"]
    (over,) = [r for r in result.accepted if r.reason.startswith("accepted over others")]
    assert "100% of what" in over.reason


def test_a_group_does_not_stand_over_a_rejected_pair_that_contradicts(
    device: ComputeDevice,
) -> None:
    place = building(3, 11.0, 9.0)
    grids = [place.with_name(name) for name in "abc"]
    look = refusing("a", "c", Pose2(1.7, 0.0))
    result = fuse_grids(grids, QUICK, device, second_look=look)
    assert len(result.accepted) == 2
    (left,) = result.rejected
    assert left.name in {"a", "c"}
    assert "refused by hand; where the others put it, it gives" in left.reason
