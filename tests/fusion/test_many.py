"""Many maps: the promising pairs, groups in their right places, and a false pair that is named."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.starts import StartPose, Starts
from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.errors import AlignmentError
from slamfusion.fusion import grouping
from slamfusion.fusion.grouping import FusionSetup, rank_pairs
from slamfusion.fusion.groups import AlignedGroup, Members, align_group
from slamfusion.geometry import Pose2
from tests.fusion.drawings import features_of, fusion_config
from tests.support.sites import ManyMaps, many_maps

pytestmark = pytest.mark.usefixtures("remembered_searches")

QUICK = fusion_config()
RIGHT_M = 0.3


@pytest.fixture(scope="module")
def site() -> ManyMaps:
    """Ten maps of 15 m: eight of one building, two of another."""
    return many_maps(10, 3, 300)


@pytest.fixture(scope="module")
def features(site: ManyMaps, device: ComputeDevice) -> dict[str, GridFeatures]:
    return {grid.name: features_of(grid, device) for grid in site.grids}


def transforms(group: Members) -> dict[str, Pose2]:
    return {name: pair.transform for name, pair in group.alignments.items()}


def aligned(features: dict[str, GridFeatures], **more: Any) -> AlignedGroup:
    return align_group(features, {}, FusionSetup(QUICK, NumpyDevice(), **more), list(features))


def test_pairs_that_share_ground_are_more_promising_than_all_others(
    site: ManyMaps, features: dict[str, GridFeatures]
) -> None:
    ranked = rank_pairs(features)
    number = {name: index for index, name in enumerate(features)}
    assert len(ranked) == math.comb(len(features), 2)
    leads = {(number[pair.a], number[pair.b]): pair.lead for pair in ranked}
    near = [lead for key, lead in leads.items() if site.neighbours.get(key, 0.0) >= 0.3]
    apart = [lead for key, lead in leads.items() if key not in site.neighbours]
    assert len(near) >= 5
    assert min(near) > max(apart)
    assert [pair.lead for pair in ranked] == sorted(leads.values(), reverse=True)


def test_groups_of_many_maps_lie_in_their_places(
    site: ManyMaps, features: dict[str, GridFeatures]
) -> None:
    told: list[tuple[str, int, int]] = []
    found = aligned(features, progress=lambda *step: told.append(step))
    assert len(found.alignments) == 8
    (other,) = found.others
    assert len(other.alignments) == 2
    for group in (found, other):
        errors = site.errors_m(group.reference, transforms(group))
        assert max(errors.values()) < RIGHT_M
        assert all(pair.accepted for pair in group.alignments.values())
    assert set(found.left_out) == set(other.alignments)
    # Far fewer than all 45 pairs are searched in full.
    searched = [pair for pair in found.pairs if not pair.reason.startswith("tracked")]
    assert len(searched) <= 16
    assert told[-1][0] == "vote"
    over = [pair for pair in found.alignments.values() if pair.reason.startswith("its place")]
    assert over
    assert all(pair.decision == "accepted" for pair in over)


@pytest.mark.once
def test_a_false_pair_is_named_and_the_maps_lie_right_without_it(
    site: ManyMaps, features: dict[str, GridFeatures]
) -> None:
    """The pair that is believed first is put 5 m aside, of those that loops are about."""
    wrong: list[frozenset[str]] = []
    most = max(site.buildings, key=site.buildings.count)
    names = {grid.name for grid, its in zip(site.grids, site.buildings, strict=True) if its == most}

    def lie(pair: Alignment, _: Pair) -> Alignment:
        key = frozenset((pair.reference, pair.moving))
        if pair.accepted and key <= names and (not wrong or key == wrong[0]):
            wrong[:] = [key]
            pair = replace(pair, transform=pair.transform.compose(Pose2(4.0, 3.0)))
        return pair

    found = aligned(features, second_look=lie)
    (false,) = [pair for pair in found.pairs if {pair.reference, pair.moving} == wrong[0]]
    assert not false.accepted
    assert false.decision == "different place"
    assert false.reason.startswith("taken back: ")
    assert len(found.alignments) == 8
    errors = site.errors_m(found.reference, transforms(found))
    assert max(errors.values()) < RIGHT_M


@pytest.mark.once
def test_starts_say_which_pairs_are_searched(
    site: ManyMaps, features: dict[str, GridFeatures]
) -> None:
    """All maps have one, in the frame of their building; the second building stands far away."""
    far = {0: Pose2(), 1: Pose2(500.0, 0.0)}
    given = {
        grid.name: StartPose(far[building].compose(pose), 1.0, 0.2)
        for grid, building, pose in zip(site.grids, site.buildings, site.poses, strict=True)
    }
    found = aligned(features, starts=Starts(given))
    assert len(found.alignments) == 8
    assert max(site.errors_m(found.reference, transforms(found)).values()) < RIGHT_M
    number = {grid.name: index for index, grid in enumerate(site.grids)}
    for pair in found.pairs:
        assert site.buildings[number[pair.reference]] == site.buildings[number[pair.moving]]


def test_maps_of_which_no_two_fit_are_refused(features: dict[str, GridFeatures]) -> None:
    told = {name: StartPose(Pose2(500.0 * n, 0.0)) for n, name in enumerate(features)}
    with pytest.raises(AlignmentError, match=r"no two of the inputs .* no two can meet\)"):
        aligned(features, starts=Starts(told))


def test_the_best_pair_of_each_map_is_searched_where_nothing_is_promising(
    features: dict[str, GridFeatures], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grouping, "RATIO_MIN", math.inf)
    searched: list[str] = []

    def refuse(pair: Pair, *_: Any, **__: Any) -> Alignment:
        searched.extend(features.grid.name for features in pair)
        return Alignment(moving="a", reference="b", reason="no")

    monkeypatch.setattr(grouping, "align_pair", refuse)
    with pytest.raises(AlignmentError, match="no two of the inputs"):
        aligned(features)
    assert set(searched) == features.keys()
    assert len(searched) < 2 * len(features)
