"""Live fusion: the frame never moves, every doubt is named, the healthy go on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import SMALLEST, NormalizeConfig, VoteConfig
from slamfusion.errors import ConfigError
from slamfusion.fusion import fuse_grids
from slamfusion.fusion.live.voting import FusedLayers
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid, trinary_cells
from slamfusion.io import memory
from slamfusion.vote import boxes
from tests.fusion.drawings import building, fusion_config, off_by, padded
from tests.fusion.live.maps import (
    AWAY,
    Drive,
    assert_same_lattice,
    littered,
    live_fusion,
    moved_frame,
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


def test_a_map_goes_by_the_name_of_its_input(device: ComputeDevice) -> None:
    live = live_fusion(device)
    for index, (name, grid) in enumerate(three().items()):
        live.put(name, grid.with_name(f"map {index}"), 1.0)
    update = live.update(1.0)
    assert update is not None
    assert update.fused is not None
    assert [item.name for item in update.inputs if item.accepted] == ["a", "b", "c"]


def test_live_maps_are_not_drawn(device: ComputeDevice) -> None:
    with pytest.raises(ConfigError, match="'drawn' draws the map from the scans of a log"):
        live_fusion(device, "drawn")


@pytest.mark.parametrize("mode", ["majority", "consensus"])
def test_the_first_fusion_is_that_of_the_offline_command(device: ComputeDevice, mode: str) -> None:
    grids = list(three().values())
    config = replace(fusion_config(), vote=VoteConfig(mode=mode, extent="union"))
    offline = fuse_grids(grids, config, device)
    update = Drive(live_fusion(device, mode)).step(*grids)
    assert update.fused is not None
    assert update.agreement is not None
    assert update.reference == offline.reference
    assert np.array_equal(on_lattice(update.fused, offline.fused), offline.fused.cells)
    assert np.array_equal(on_lattice(update.agreement, offline.agreement), offline.agreement.cells)
    for live, record in zip(update.inputs, offline.inputs, strict=True):
        assert record.alignment is not None
        assert live.transform == record.alignment.transform
        assert live.accepted == record.accepted


def test_nothing_is_published_before_two_inputs_agree(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device))
    first = drive.step(three()["a"])
    assert first.fused is None
    assert "waits for 2 inputs" in first.problem
    assert "waits for 2 inputs" in drive.input("a").reason
    stranger = drive.step(building(99, 12.0, 10.0).with_name("stranger"))
    assert stranger.fused is None
    assert "align" in drive.input("stranger").reason
    agreed = drive.step(three()["b"])
    assert agreed.fused is not None
    assert drive.accepted() == "ab"
    assert not drive.input("stranger").accepted


def test_a_single_input_is_its_own_fusion_where_that_is_asked_for(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device, minimum_inputs=1))
    update = drive.step(three()["a"])
    assert update.fused is not None
    assert update.reference == "a"
    own = trinary_cells(three()["a"].cells, NormalizeConfig())
    assert np.array_equal(on_lattice(update.fused, three()["a"]), np.where(own == 1, 100, own))


def test_nothing_new_is_no_update_and_an_equal_map_publishes_nothing(device: ComputeDevice) -> None:
    drive = started(device)
    assert drive.maybe() is None
    again = drive.step(*three().values())
    assert again.fused is None
    assert again.changed_box is None
    assert drive.accepted() == "abc"


def test_reset_starts_again_with_the_newest_maps(device: ComputeDevice) -> None:
    drive = started(device)
    drive.live.reset()
    update = drive.step()
    assert update.fused is not None
    assert update.reference == "a"
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
    reference = drive.live.inputs(drive.now_s)[0]
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
        assert drive.fused is not None
        fused = on_lattice(drive.fused, a)
        if drive.input("c").accepted:
            assert np.array_equal(np.where(fused == 100, 1, fused)[known], own[known])


@settings(max_examples=examples(15), deadline=None)
@given(name=st.sampled_from("abc"), margins=st.tuples(*[st.integers(0, 60)] * 4))
def test_unknown_margins_of_an_input_change_nothing(
    device: ComputeDevice, name: str, margins: tuple[int, int, int, int]
) -> None:
    drive = started(device)
    first = drive.fused
    before = {record.name: record.transform for record in drive.live.inputs(drive.now_s)}
    update = drive.step(padded(three()[name], *margins))
    assert update.fused is None
    drive.step(padded(touched(three()[name], 1, 0.0005), *margins))
    assert drive.fused is not None
    assert first is not None
    assert (np.asarray(on_lattice(drive.fused, first)) != first.cells).mean() < 0.001
    after = {record.name: record.transform for record in drive.live.inputs(drive.now_s)}
    assert after == before


@pytest.mark.parametrize("mode", ["majority", "consensus"])
@pytest.mark.parametrize("at_once", [1, 3])
def test_what_was_not_voted_on_again_is_as_if_it_had_been(
    device: ComputeDevice, mode: str, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What changed in several places is several votes also in a small map.
    monkeypatch.setattr(boxes, "SPARE_CELLS", 0)
    drive = Drive(live_fusion(device, mode))
    drive.step(*three().values())
    rng = np.random.default_rng(4)
    for number in range(6):
        grids = []
        for name in "abc"[number % 3 :][:at_once]:
            grid = three()[name]
            cells = grid.cells.copy()
            row, col = rng.integers(0, grid.height - 20), rng.integers(0, grid.width - 20)
            cells[row : row + 8, col : col + 8] = rng.integers(-1, 101, (8, 8))
            grids.append(replace(grid, cells=cells))
        drive.step(*grids)
    live = drive.live
    layers = live._layers
    assert layers.box is not None
    fresh = FusedLayers(live._config, live._live, device)
    fresh.lattice = layers.lattice
    fresh.grow(layers.box, "all")
    for track in live._tracks.values():
        assert track.layer is not None
        assert track.known is not None
        assert track.transform is not None
        fresh.lay(track.name, track.layer, track.known, track.transform, None)
    fresh.vote("abc", layers.box)
    for one, other in zip(layers.grids(), fresh.grids(), strict=True):
        assert np.array_equal(one.cells, other.cells)
        assert one.origin == other.origin
    assert layers.phantom_cells == fresh.phantom_cells


def test_only_what_changed_is_voted_on_again(device: ComputeDevice) -> None:
    drive = started(device)
    grid = three()["a"]
    cells = grid.cells.copy()
    cells[40:44, 50:53] = np.where(cells[40:44, 50:53] == 0, 100, 0)
    update = drive.step(replace(grid, cells=cells))
    assert update.changed_box is not None
    assert update.fused is not None
    assert update.changed_box.area <= 60
    row, col = assert_same_lattice(update.fused, grid)
    box = update.changed_box
    assert box.row0 <= row + 40
    assert row + 44 <= box.row1
    assert box.col0 <= col + 50
    assert col + 53 <= box.col1


@pytest.mark.parametrize("gone", ["a", "b", "c"])
def test_an_input_that_is_lost_and_returns_leaves_every_wall_where_it_was(
    device: ComputeDevice, gone: str
) -> None:
    drive = started(device)
    first = drive.fused
    assert first is not None
    before = {record.name: record.transform for record in drive.live.inputs(drive.now_s)}
    drive.live.drop(gone, "its producer is gone")
    drive.step(*(touched(three()[name], 1) for name in "abc" if name != gone))
    assert drive.input(gone).reason == "its producer is gone"
    assert drive.accepted() == "abc".replace(gone, "")
    assert drive.fused is not None
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97
    update = drive.step(touched(three()[gone], 2))
    assert update.inputs[0].name == "a"
    assert drive.accepted() == "abc"
    assert drive.input(gone).is_tracked
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97
    for record in drive.live.inputs(drive.now_s):
        shift, turn = off_by(three()[record.name], record.transform, before[record.name])
        assert shift < 1.0
        assert turn < 0.5


def test_the_lattice_is_kept_when_a_finer_map_comes_and_grows(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device))
    fine = three()["a"]
    doubled = np.repeat(np.repeat(fine.cells, 2, axis=0), 2, axis=1)
    fine = OccupancyGrid(doubled, fine.resolution / 2, fine.origin, "fine")
    first = drive.step(three()["b"], three()["c"]).fused
    assert first is not None
    drive.step(fine)
    assert drive.input("fine").accepted, drive.input("fine").reason
    with_fine = drive.fused
    assert with_fine is not None
    assert_same_lattice(first, with_fine)
    # It grows by an odd number of its own cells: half a fused cell.
    grown = drive.step(padded(fine, 7, 3, 1, 5))
    assert grown.fused is None


# -- who goes on -----------------------------------------------------------------------------------


def upside_down(grid: OccupancyGrid) -> OccupancyGrid:
    return replace(grid, cells=np.ascontiguousarray(grid.cells[::-1]))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (OccupancyGrid(np.full((60, 70), -1, dtype=np.int8), 0.1), "unknown"),
        (OccupancyGrid(np.array([[100]], dtype=np.int8), 0.1), "too few walls"),
        (OccupancyGrid(np.full((4, 4), 100, dtype=np.int8), 0.1), "too few walls"),
        (OccupancyGrid(np.zeros((60, 70), dtype=np.int8), 0.1), "too few walls"),
    ],
)
@pytest.mark.parametrize("name", ["a", "b"])
def test_a_map_that_says_too_little_is_named_and_the_others_go_on(
    device: ComputeDevice, bad: OccupancyGrid, words: str, name: str
) -> None:
    drive = started(device)
    first = drive.fused
    assert first is not None
    update = drive.step(bad.with_name(name))
    assert words in drive.input(name).reason
    assert drive.input(name).rejected == 1
    assert drive.accepted() == "abc".replace(name, "")
    assert update.fused is not None
    assert update.reference != name
    assert share_standing(first, update.fused) > 0.97
    drive.step(three()[name])
    assert drive.accepted() == "abc"


@pytest.mark.parametrize("name", ["a", "c"])
def test_an_upside_down_map_is_refused_and_taken_back_when_it_is_right(
    device: ComputeDevice, name: str
) -> None:
    drive = started(device)
    first = drive.fused
    assert first is not None
    for number in range(3):
        drive.step(touched(upside_down(three()[name]), number))
        assert drive.accepted() == "abc".replace(name, "")
        assert drive.fused is not None
        assert share_standing(first, drive.fused) > 0.97
    drive.step(three()[name])
    assert drive.accepted() == "abc"
    assert_same_lattice(first, drive.fused)


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_producer_that_starts_again_elsewhere_is_believed_at_its_second_map(
    device: ComputeDevice, name: str
) -> None:
    drive = started(device)
    first = drive.fused
    assert first is not None
    last = drive.input(name).transform
    assert last is not None
    again = moved_frame(three()[name], AWAY)
    drive.step(again)
    assert "must confirm it" in drive.input(name).reason
    assert drive.accepted() == "abc".replace(name, "")
    assert not drive.maybe(again) or not drive.input(name).accepted, "the same map confirms nothing"
    drive.step(touched(again, 1, 0.002))
    assert drive.accepted() == "abc"
    found = drive.input(name).transform
    assert found is not None
    shift, turn = off_by(again, found, last.compose(AWAY.inverse()))
    assert shift < 1.0
    assert turn < 0.5
    assert drive.fused is not None
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97


def test_a_transform_that_jumped_once_is_not_believed(device: ComputeDevice) -> None:
    drive = started(device)
    before = drive.input("b").transform
    drive.step(moved_frame(three()["b"], AWAY))
    assert drive.accepted() == "ac"
    drive.step(touched(three()["b"], 1))
    assert drive.accepted() == "abc"
    assert drive.input("b").transform == before


def test_a_third_tells_which_of_two_is_wrong_also_when_it_is_the_reference(
    device: ComputeDevice,
) -> None:
    drive = started(device, search_share=0.95)
    first = drive.fused
    assert first is not None
    update = drive.step(littered(three()["a"], 1))
    for number in range(2):
        update = drive.maybe(touched(three()["b"], number), touched(three()["c"], number)) or update
    assert drive.accepted() == "bc"
    assert update.reference in {"b", "c"}
    assert "not with it" in drive.input("a").reason or "walls" in drive.input("a").reason
    assert drive.fused is not None
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.95


def test_two_that_disagree_are_both_named_and_nothing_new_is_published(
    device: ComputeDevice,
) -> None:
    drive = Drive(live_fusion(device))
    drive.step(three()["a"], three()["b"])
    last = drive.fused
    assert last is not None
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
    assert update.fused is not None
    assert_same_lattice(last, update.fused)


@pytest.mark.parametrize("name", ["a", "b"])
def test_of_two_that_disagree_the_one_goes_on_that_fits_the_map_they_agreed_on(
    device: ComputeDevice, name: str
) -> None:
    drive = Drive(live_fusion(device))
    drive.step(three()["a"], three()["b"])
    last = drive.fused
    assert last is not None
    other = "ab".replace(name, "")
    # The other's map must change a little too: the reference alone is held against nobody.
    update = drive.step(littered(three()[name], 1), touched(three()[other], 1))
    assert drive.accepted() == other
    assert "alone" in drive.input(other).reason
    assert not drive.input(name).accepted
    assert drive.input(name).reason
    assert update.fused is not None
    assert_same_lattice(last, update.fused)
    assert share_standing(update.fused, last) > 0.9
    drive.step(three()[name])
    assert drive.accepted() == "ab"


def test_the_one_whose_walls_moved_is_doubted_not_the_one_that_stood(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device))
    drive.step(three()["a"], three()["b"])
    first = drive.fused
    assert first is not None
    drive.step(building(99, 12.0, 10.0).with_name("a"))
    assert drive.accepted() == "b"
    assert "alone" in drive.input("b").reason
    assert drive.fused is not None
    assert_same_lattice(first, drive.fused)
    assert share_standing(drive.fused, first) > 0.97


def test_walls_of_the_reference_that_creep_do_not_take_the_frame_along(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    first = drive.fused
    assert first is not None
    grid = padded(three()["a"], 0, 0, 0, 20)
    for cells in range(1, 11):
        drive.step(shifted(grid, cells))
    assert drive.fused is not None
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.95
    for name in "bc":
        assert drive.input(name).accepted


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
    assert first is not None
    for number in range(1, 7):
        drive.step(drawn("a", number, 2 * number + 1))
        assert drive.accepted() == "abc"
        assert drive.fused is not None
        assert_same_lattice(first, drive.fused)
        assert share_standing(drive.fused, first) > 0.97


def test_all_walls_moved_at_once_and_the_last_fused_map_tells_where(device: ComputeDevice) -> None:
    drive = started(device)
    first = drive.fused
    assert first is not None
    for number in range(8):
        drive.maybe(*(touched(moved_frame(three()[name], AWAY), number, 0.002) for name in "abc"))
    assert drive.accepted() == "abc", [record.reason for record in drive.live.inputs(drive.now_s)]
    assert drive.fused is not None
    assert_same_lattice(first, drive.fused)
    assert share_standing(first, drive.fused) > 0.97


def test_a_place_that_looks_alike_from_two_sides_is_believed_on_the_side_where_it_was(
    device: ComputeDevice,
) -> None:
    def room(name: str, frame: Pose2, *, has_boxes: bool) -> OccupancyGrid:
        """A room that looks the same turned by half, but for some boxes."""
        cells = np.zeros((80, 120), dtype=np.int8)
        cells[:2], cells[-2:], cells[:, :2], cells[:, -2:] = 100, 100, 100, 100
        cells[20:24, 30:34] = cells[-24:-20, -34:-30] = 100
        if has_boxes:
            cells[10:30, 60:80:4] = cells[50:54, 10:50] = 100
        return moved_frame(OccupancyGrid(cells, 0.1, Pose2(), name), frame)

    frames = {"a": Pose2(), "b": AWAY}
    drive = Drive(live_fusion(device))
    for has_boxes in (True, False):
        drive.step(*(room(name, pose, has_boxes=has_boxes) for name, pose in frames.items()))
        assert drive.accepted() == "ab"
    judge = drive.live._supervisor
    track = judge.tracks["b"]
    aligner = judge._aligner
    aligner.search(track, aligner.held(judge.tracks["a"]))
    assert track.votes, track.reason
    assert track.transform is not None
    shift, turn = off_by(room("b", AWAY, has_boxes=False), track.transform, AWAY.inverse())
    assert shift < 1.0
    assert turn < 0.5
    # Nothing tells the sides apart for one that comes new.
    drive.step(room("c", AWAY, has_boxes=False))
    assert "ambiguous" in drive.input("c").reason


# -- health ----------------------------------------------------------------------------------------


def test_health_counts_what_came(device: ComputeDevice) -> None:
    drive = started(device)
    for number in range(4):
        drive.step(touched(three()["b"], number))
    record = drive.input("b")
    assert record.maps == 5
    assert record.rate_hz == pytest.approx(1.0)
    assert record.age_s == 0.0
    assert drive.input("a").age_s == 4.0
    assert 0.3 < record.score <= 1.0
    assert 0.3 < record.overlap <= 1.0
    assert drive.input("a").score == 1.0


def test_an_input_that_memory_cannot_hold_is_named(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = started(device)
    far = three()["b"]
    grown = padded(far, 0, 0, 0, 3000)
    cells = grown.cells.copy()
    cells[0, -1] = 0
    monkeypatch.setattr(memory, "available_memory", lambda: 100_000)
    update = drive.step(replace(grown, cells=cells))
    assert "memory" in drive.input("b").reason
    assert drive.accepted() == "ac"
    assert update.fused is not None
    monkeypatch.undo()
    drive.step(three()["b"])
    assert drive.accepted() == "abc"


def test_the_extent_may_be_that_of_the_reference(device: ComputeDevice) -> None:
    drive = Drive(live_fusion(device, "consensus", extent="reference"))
    update = drive.step(*three().values())
    assert update.fused is not None
    vote = VoteConfig(extent="reference")
    config = replace(fusion_config(), reference=SMALLEST, vote=vote)
    offline = fuse_grids(list(three().values()), config, device)
    assert update.fused.cells.shape == offline.fused.cells.shape
    assert np.array_equal(update.fused.cells, offline.fused.cells)
