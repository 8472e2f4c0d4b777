"""Live fusion: the frame never moves, every doubt is named, the healthy go on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig, VoteConfig
from slamfusion.errors import ConfigError
from slamfusion.fusion import fuse_grids
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid, trinary_cells
from tests.fusion.drawings import building, degraded, fusion_config, off_by, padded
from tests.fusion.live.maps import (
    AWAY,
    Drive,
    assert_same_lattice,
    littered,
    live_fusion,
    moved_frame,
    noise,
    on_lattice,
    share_standing,
    shifted,
    started,
    three,
    touched,
)
from tests.support.examples import examples

pytestmark = pytest.mark.once

# -- the first fusion ------------------------------------------------------------------------------


def test_live_maps_are_not_drawn(device: ComputeDevice) -> None:
    with pytest.raises(ConfigError, match="'drawn' draws the map from the scans of a log"):
        live_fusion(device, "drawn")


@pytest.mark.parametrize("mode", ["majority", "consensus"])
def test_the_first_fusion_is_that_of_the_offline_command(device: ComputeDevice, mode: str) -> None:
    grids = list(three().values())
    config = replace(fusion_config(), vote=VoteConfig(mode=mode, extent="union"))
    offline = fuse_grids(grids, config, device)
    update = Drive(live_fusion(device, mode)).step(*grids)
    assert update.reference == offline.reference
    assert np.array_equal(on_lattice(update.fused, offline.fused), offline.fused.cells)
    assert np.array_equal(on_lattice(update.agreement, offline.agreement), offline.agreement.cells)
    for live, record in zip(update.inputs, offline.inputs, strict=True):
        assert live.transform == record.alignment.transform
        assert live.accepted == record.accepted


def test_a_bent_map_is_named_live_as_by_the_offline_command(device: ComputeDevice) -> None:
    place = building(3, 12.0, 10.0)
    grids = [
        degraded(place, index, name, yaw_rad=yaw_rad, bend_cells=bend_cells)[0]
        for index, (name, yaw_rad, bend_cells) in enumerate(
            [("a", 0.0, 0.3), ("b", -1.1, 0.3), ("bent", 0.4, 7.0)]
        )
    ]
    config = replace(fusion_config(), vote=VoteConfig("consensus", extent="union"))
    offline = fuse_grids(grids, config, device)
    drive = Drive(live_fusion(device, "consensus"))
    drive.step(*grids)
    assert list(offline.bent) == ["bent"]
    assert drive.input("bent").reason.endswith(f"; {offline.bent['bent'].words}")
    found = {name: drive.input(name).wall_agreement for name in offline.wall_agreement}
    assert found == offline.wall_agreement


def test_nothing_new_is_no_update_and_an_equal_map_publishes_nothing(device: ComputeDevice) -> None:
    drive = started(device)
    assert drive.maybe() is None
    again = drive.step(*three().values())
    assert again.fused is None
    assert drive.accepted() == "abc"


# -- the frame never moves -------------------------------------------------------------------------

MARGINS = st.tuples(*[st.integers(-25, 40)] * 4)


@settings(max_examples=examples(15), deadline=None)
@given(steps=st.lists(st.tuples(st.sampled_from("bc"), MARGINS), min_size=1, max_size=4))
def test_growing_cropping_and_shifting_an_input_never_moves_a_fused_cell(
    device: ComputeDevice, steps: list[tuple[str, tuple[int, int, int, int]]]
) -> None:
    # Two voters are the same map, so that they decide every cell that they know, whatever the
    # third says: the fused map is the reference's, cell by cell.
    a, b = three()["a"], three()["b"]
    drive = Drive(live_fusion(device))
    drive.step(a, b, moved_frame(a, AWAY).with_name("c"))
    reference = drive.live.inputs()[0]
    assert reference.transform == Pose2()
    own = trinary_cells(a.cells, NormalizeConfig())
    known = own >= 0
    grids = {"b": b, "c": b.with_name("c")}
    for name, (south, west, north, east) in steps:
        if name == "b":
            drive.maybe(padded(grids["b"], south, west, north, east))
        else:
            drive.maybe(
                moved_frame(padded(a, *map(abs, (south, west, north, east))), AWAY).with_name("c")
            )
        fused = on_lattice(drive.fused, a)
        if drive.input("c").accepted:
            assert np.array_equal(np.where(fused == 100, 1, fused)[known], own[known])


@pytest.mark.parametrize("gone", ["a", "b", "c"])
def test_an_input_that_is_lost_and_returns_leaves_every_wall_where_it_was(
    device: ComputeDevice, gone: str
) -> None:
    drive = started(device)
    first = drive.fused
    before = {record.name: record.transform for record in drive.live.inputs()}
    drive.live.drop(gone, "its producer is gone")
    drive.step(*(touched(three()[name], 1) for name in "abc" if name != gone))
    assert drive.input(gone).reason == "its producer is gone"
    assert drive.accepted() == "abc".replace(gone, "")
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97
    update = drive.step(touched(three()[gone], 2))
    assert update.inputs[0].name == "a"
    assert drive.accepted() == "abc"
    assert drive.input(gone).fit.is_tracked
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97
    for record in drive.live.inputs():
        shift, turn = off_by(three()[record.name], record.transform, before[record.name])
        assert shift < 1.0
        assert turn < 0.5


# -- who goes on -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "bad", "words"),
    [
        ("a", OccupancyGrid(np.full((60, 70), -1, dtype=np.int8), 0.1), "unknown"),
        ("b", OccupancyGrid(np.zeros((60, 70), dtype=np.int8), 0.1), "too few walls"),
        ("a", noise(), "noise"),
        ("b", OccupancyGrid(np.full((300, 300), 100, dtype=np.int8), 0.1), "all occupied"),
    ],
)
def test_a_map_that_says_too_little_is_named_and_the_others_go_on(
    device: ComputeDevice, bad: OccupancyGrid, words: str, name: str
) -> None:
    drive = started(device)
    first = drive.fused
    update = drive.step(bad.with_name(name))
    assert words in drive.input(name).reason
    assert drive.input(name).messages.rejected == 1
    assert drive.accepted() == "abc".replace(name, "")
    assert update.reference != name
    assert share_standing(first, update.fused) > 0.97
    drive.step(three()[name])
    assert drive.accepted() == "abc"


def test_a_third_tells_which_of_two_is_wrong_also_when_it_is_the_reference(
    device: ComputeDevice,
) -> None:
    drive = started(device, search_share=0.95)
    first = drive.fused
    update = drive.step(littered(three()["a"], 1))
    for number in range(2):
        update = drive.maybe(touched(three()["b"], number), touched(three()["c"], number)) or update
    assert drive.accepted() == "bc"
    assert update.reference in {"b", "c"}
    assert "not with it" in drive.input("a").reason or "walls" in drive.input("a").reason
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.95


def test_two_that_disagree_are_both_named_and_nothing_new_is_published(
    device: ComputeDevice,
) -> None:
    drive = started(device, "ab")
    last = drive.fused
    for number in range(3):
        places = [building(50 + 2 * number + n, 12.0, 10.0) for n in range(2)]
        update = drive.step(places[0].with_name("a"), places[1].with_name("b"))
        assert drive.accepted() == ""
        assert update.fused is None
        assert update.problem == "no input fits the last fused map"
        assert all("to " in r.reason or "not fit" in r.reason for r in update.inputs)
    assert drive.fused is last
    update = drive.step(three()["a"], three()["b"])
    assert drive.accepted() == "ab"
    assert_same_lattice(last, update.fused)


@pytest.mark.parametrize("name", ["a", "b"])
def test_of_two_that_disagree_the_one_goes_on_that_fits_the_map_they_agreed_on(
    device: ComputeDevice, name: str
) -> None:
    drive = started(device, "ab")
    last = drive.fused
    other = "ab".replace(name, "")
    # The other's map must change a little too: the reference alone is held against nobody.
    update = drive.step(littered(three()[name], 1), touched(three()[other], 1))
    assert drive.accepted() == other
    assert "alone" in drive.input(other).reason
    assert not drive.input(name).accepted
    assert drive.input(name).reason
    assert_same_lattice(last, update.fused)
    assert share_standing(update.fused, last) > 0.9
    drive.step(three()[name])
    assert drive.accepted() == "ab"


def test_walls_of_the_reference_that_creep_do_not_take_the_frame_along(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    first = drive.fused
    grid = padded(three()["a"], 0, 0, 0, 20)
    for cells in range(1, 11):
        drive.step(shifted(grid, cells))
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.95
    for name in "bc":
        assert drive.input(name).accepted


def test_a_step_of_the_reference_alone_moves_no_other_input(device: ComputeDevice) -> None:
    drive = started(device, "bc")
    assert drive.step(three()["a"]).reference == "b"
    places = {name: drive.input(name).transform for name in "ac"}
    drive.step(moved_frame(three()["b"], Pose2(0.2, 0.0, 0.0)))
    assert drive.accepted() == "bca"
    assert {name: drive.input(name).transform for name in "ac"} == places
    found = drive.input("b").transform
    assert found.x == pytest.approx(-0.2, abs=0.03)


def test_a_reference_that_is_drawn_anew_beside_its_lattice_each_time_keeps_the_frame(
    device: ComputeDevice,
) -> None:
    fine = building(7, 12.0, 10.0, 0.05)

    def drawn(name: str, row: int, col: int) -> OccupancyGrid:
        """The place at 0.1 m, its corner moved by half cells: what a growing map may do."""
        cells = fine.cells[row:, col:]
        height, width = (size // 2 * 2 for size in cells.shape)
        blocks = cells[:height, :width].reshape(height // 2, 2, width // 2, 2)
        origin = Pose2(0.05 * col, 0.05 * row, 0.0)
        return OccupancyGrid(blocks.max(axis=(1, 3)), 0.1, origin, name)

    drive = Drive(live_fusion(device))
    others = [moved_frame(drawn(name, 0, 0), AWAY) for name in "bc"]
    drive.step(drawn("a", 0, 0), *others)
    first = drive.fused
    for number in range(1, 7):
        drive.step(drawn("a", number, 2 * number + 1))
        assert drive.accepted() == "abc"
        assert_same_lattice(first, drive.fused)
        assert share_standing(drive.fused, first) > 0.97


def test_all_walls_moved_at_once_and_the_last_fused_map_tells_where(device: ComputeDevice) -> None:
    drive = started(device)
    first = drive.fused
    for number in range(8):
        drive.maybe(*(touched(moved_frame(three()[name], AWAY), number, 0.002) for name in "abc"))
    assert drive.accepted() == "abc", [record.reason for record in drive.live.inputs()]
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97


# -- health ----------------------------------------------------------------------------------------


def test_health_counts_what_came(device: ComputeDevice) -> None:
    drive = started(device)
    for number in range(4):
        drive.step(touched(three()["b"], number))
    record = drive.input("b")
    assert record.messages.maps == 5
    assert record.messages.rate_hz == pytest.approx(1.0)
    assert record.messages.received_s == drive.now_s
    assert drive.input("a").messages.received_s == drive.now_s - 4.0
    assert 0.3 < record.fit.score <= 1.0
    assert 0.3 < record.fit.overlap <= 1.0
    assert drive.input("a").fit.score == 1.0
