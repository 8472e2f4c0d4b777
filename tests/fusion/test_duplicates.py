"""One map given twice has one vote, and is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.errors import AlignmentError
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.inputs import find_copies
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, degraded, draw, fusion_config, with_origin

QUICK = fusion_config()


def two() -> list[OccupancyGrid]:
    """Two maps of one place."""
    return [
        degraded(building(2), seed, name, yaw_rad=seed)[0] for seed, name in ((1, "a"), (2, "b"))
    ]


def test_equal_cells_resolution_and_origin_make_a_copy() -> None:
    room = draw("###\n#.#\n###")
    others = {
        "cell": draw("###\n# #\n###"),
        "size": draw("###\n#.#\n###", 0.2),
        "place": with_origin(room, Pose2(0.1, 0.0, 0.0)),
        "turned": with_origin(room, Pose2(0.0, 0.0, 0.1)),
        "shape": draw("###\n#.#"),
    }
    grids = [room.with_name("a"), *(grid.with_name(name) for name, grid in others.items())]
    assert find_copies(grids) == {}
    assert find_copies([*grids, room.with_name("b"), room.with_name("c")]) == {"b": "a", "c": "a"}


def test_the_copy_that_something_is_known_of_votes() -> None:
    grids = [draw("###").with_name(name) for name in "abc"]
    assert find_copies(grids, {"b"}) == {"a": "b", "c": "b"}
    assert find_copies(grids, {"c", "b"}) == {"a": "b", "c": "b"}


def test_a_copy_is_named_and_changes_no_vote(device: ComputeDevice) -> None:
    grids = two()
    wanted = fuse_grids(grids, QUICK, device)
    result = fuse_grids([*grids, grids[0].with_name("again")], QUICK, device)
    assert np.array_equal(result.fused.cells, wanted.fused.cells)
    assert list(result.weights) == ["a", "b"]
    assert result.rejected == ()
    (copy,) = result.copies
    assert (copy.name, copy.copy_of, copy.accepted) == ("again", "a", False)
    assert "the same map as a" in copy.reason
    voter = result.inputs[0].alignment
    assert copy.alignment == replace(voter, moving="again")


def test_each_copy_votes_where_that_is_asked_for(device: ComputeDevice) -> None:
    grids = [*two(), two()[0].with_name("again")]
    result = fuse_grids(grids, replace(QUICK, keep_duplicates=True), device)
    assert list(result.weights) == ["a", "b", "again"]
    assert result.copies == ()


def test_copies_alone_are_no_fusion(device: ComputeDevice) -> None:
    grids = [two()[0], two()[0].with_name("again")]
    with pytest.raises(AlignmentError, match=r"a, again are the same map, .* --keep-duplicates"):
        fuse_grids(grids, QUICK, device)


def test_a_map_in_other_units_is_left_out_and_named(device: ComputeDevice) -> None:
    grids = two()
    wrong = replace(grids[1], resolution=1000.0 * grids[1].resolution).with_name("wrong")
    result = fuse_grids([*grids, wrong], QUICK, device)
    (left_out,) = result.rejected
    assert left_out.name == "wrong"
    assert "1000 times coarser" in left_out.reason
    assert "in other units" in left_out.reason
    with pytest.raises(AlignmentError, match="in other units"):
        fuse_grids([grids[0], wrong], QUICK, device)
