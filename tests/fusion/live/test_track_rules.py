"""What is kept of an input, and when its walls still stand: both sides of every limit."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import NumpyDevice
from slamfusion.config import LiveConfig, NormalizeConfig
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.live import track as tracks
from slamfusion.fusion.live.lattice import Layer
from slamfusion.fusion.live.track import Change, Track, compare
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.vote.lattice import Lattice
from tests.support.examples import examples

RULES = NormalizeConfig()
LIVE = LiveConfig(steady_share=0.75, track_share=0.25)
DEVICE = NumpyDevice()
CELL_M = 0.25
LATTICE = Lattice(CELL_M, Pose2())


def layer(cells: Any, row: int = 0, col: int = 0) -> Layer:
    return Layer(np.array(cells, dtype=np.int8), LATTICE, row, col)


def grid_of(cells: Any, origin: Pose2 | None = None, resolution: float = CELL_M) -> OccupancyGrid:
    return OccupancyGrid(np.array(cells, dtype=np.int8), resolution, origin or Pose2(), "a")


def walls_of(count: int, of: int = 200) -> OccupancyGrid:
    """Return a map of one row of known cells, the first of them walls."""
    cells = np.zeros((1, of), dtype=np.int8)
    cells[0, :count] = 100
    return grid_of(cells)


# -- what stands -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("standing", "contradicted", "before", "is_steady"),
    [
        # As many walls as one needs to judge at all.
        (24, 0, 24, True),
        (23, 0, 23, False),
        # Two in five of those before, however few of the rest are free now.
        (400, 0, 1000, True),
        (399, 0, 1000, False),
        (400, 100, 1000, True),
        # Three in four of those that can be judged.
        (750, 250, 1000, True),
        (749, 251, 1000, False),
        (1000, 0, 1000, True),
        (20, 0, 1000, False),
    ],
)
def test_enough_old_walls_must_stand(
    standing: int, contradicted: int, before: int, is_steady: bool
) -> None:
    change = Change(None, 0, standing, contradicted, before)
    assert change.is_steady(0.75) is is_steady
    assert change.is_lost
    assert change.after is None


@given(
    before=st.integers(0, 200),
    standing=st.integers(0, 200),
    contradicted=st.integers(0, 200),
    more=st.integers(0, 50),
    share=st.floats(0.0, 1.0),
)
def test_more_walls_that_stand_never_end_it(
    before: int, standing: int, contradicted: int, more: int, share: float
) -> None:
    worse = Change(None, 0, standing, contradicted + more, before)
    same = Change(None, 0, standing, contradicted, before)
    better = Change(None, 0, standing + more, contradicted, before)
    assert worse.is_steady(share) <= same.is_steady(share) <= better.is_steady(share)


@pytest.mark.parametrize(
    ("was", "now", "differs", "standing", "contradicted"),
    [
        (65, 64, 1, 0, 0),
        (65, 66, 0, 1, 0),
        (100, 65, 0, 1, 0),
        (100, -1, 1, 0, 0),
        (100, 0, 1, 0, 1),
        (100, 25, 1, 0, 1),
        (100, 26, 1, 0, 0),
        (64, 65, 1, 0, 0),
        (64, 0, 0, 0, 0),
    ],
)
def test_what_a_cell_may_become(
    was: int, now: int, differs: int, standing: int, contradicted: int
) -> None:
    before = int(was >= 65)
    one, other = (np.full((3, 3), 50) for _ in range(2))
    one[1, 1], other[1, 1] = was, now
    change = compare(layer(one), layer(other), before, RULES, DEVICE)
    assert (change.walls, change.before) == (differs, before)
    assert (change.standing, change.contradicted) == (standing, contradicted)
    assert change.is_lost is (now < 0)


VALUES = st.sampled_from((-1, -1, 0, 0, 1, 25, 26, 64, 65, 66, 100, 100))
PATCH = st.tuples(st.integers(1, 6), st.integers(1, 6)).flatmap(
    lambda shape: st.lists(
        st.lists(VALUES, min_size=shape[1], max_size=shape[1]),
        min_size=shape[0],
        max_size=shape[0],
    )
)


def by_hand(old: Layer, new: Layer) -> Change:
    """Return what a map changed, cell by cell; outside of a layer all is unknown."""

    def cell(of: Layer, row: int, col: int) -> int:
        box = of.box
        is_inside = box.row0 <= row < box.row1 and box.col0 <= col < box.col1
        return int(of.cells[row - box.row0, col - box.col0]) if is_inside else -1

    def has_wall(of: Layer, row: int, col: int) -> bool:
        near = itertools.product((row - 1, row, row + 1), (col - 1, col, col + 1))
        return any(cell(of, *place) >= 65 for place in near)

    places = list(itertools.product(range(-7, 13), range(-7, 13)))
    pairs = {place: (cell(old, *place), cell(new, *place)) for place in places}
    differ = [place for place, (a, b) in pairs.items() if a != b]
    before = [place for place, (a, _) in pairs.items() if a >= 65]
    after = [place for place, (_, b) in pairs.items() if b >= 65]
    gone = [place for place in before if not has_wall(new, *place)]
    box = None
    if differ:
        (rows, cols) = zip(*differ, strict=True)
        box = CellBox(min(rows), min(cols), max(rows) + 1, max(cols) + 1)
    return Change(
        box,
        sum((a >= 65) != (b >= 65) for a, b in pairs.values()),
        len(before) - len(gone),
        sum(0 <= pairs[place][1] <= 25 for place in gone),
        len(before),
        len(after),
        any(a >= 0 > b for a, b in pairs.values()),
    )


@settings(max_examples=examples(120))
@given(old=PATCH, new=PATCH, row=st.integers(-6, 6), col=st.integers(-6, 6), band=st.booleans())
def test_a_change_is_what_differs_cell_by_cell(
    old: list[list[int]], new: list[list[int]], row: int, col: int, band: bool
) -> None:
    one, other = layer(old), layer(new, row, col)
    wanted = by_hand(one, other)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracks, "SPARE_SHARE", 1000)
        patch.setattr("slamfusion.fusion.live.limits.BAND_CELLS", 1 if band else 1 << 18)
        assert compare(one, other, wanted.before, RULES, DEVICE) == wanted


@pytest.mark.parametrize(("away", "is_far"), [(52, False), (53, True), (80, True), (9, False)])
def test_maps_far_apart_are_not_compared_cell_by_cell(
    monkeypatch: pytest.MonkeyPatch, away: int, is_far: bool
) -> None:
    """Of 80 known cells each, four times as many are 10 rows of 64 columns, margins included."""
    rng = np.random.default_rng(away)
    cells = [rng.choice([0, 64, 65, 100], (8, 10)) for _ in range(2)]
    for map_cells in cells:
        map_cells[[0, -1], :] = 100
        map_cells[:, [0, -1]] = 65
    one, other = layer(cells[0]), layer(cells[1], 0, away)
    walls = int((one.cells >= 65).sum())
    replaced = tracks._replaced
    seen: list[Change] = []

    def recorded(*arguments: Any) -> Change:
        seen.append(replaced(*arguments))
        return seen[-1]

    monkeypatch.setattr(tracks, "_replaced", recorded)
    change = compare(one, other, walls, RULES, DEVICE)
    assert len(seen) == is_far
    monkeypatch.setattr(tracks, "SPARE_SHARE", 1000)
    nearby = compare(one, other, walls, RULES, DEVICE)
    # Beside each other a wall may stand beside a wall; far apart nothing does.
    assert replace(change, standing=0) == replace(nearby, standing=0)
    if is_far:
        assert change == nearby


def test_on_another_lattice_all_may_be_lost_and_the_walls_are_counted_later() -> None:
    one = layer(walls_of(30).cells)
    other = replace(one, lattice=Lattice(CELL_M, Pose2(0.1)))
    change = compare(one, other, 30, RULES, DEVICE)
    assert change.box == one.box
    assert change.is_lost
    assert change.after is None
    assert change.is_steady(0.75)


# -- what is kept ----------------------------------------------------------------------------------


def test_a_new_input_has_nothing() -> None:
    new = Track("a")
    assert (new.version, new.walls, new.drift, new.key_drift, new.maps) == (0, 0, 0, 0, 0)
    assert (new.is_live, new.is_steady, new.accepted, new.is_tracked) == (False,) * 4
    assert (new.score, new.overlap, new.rest_s, new.patience_s) == (0.0, 0.0, 0.0, 1.0)
    assert (new.jump_version, new.jump_maps, new.confirms, new.searches) == (-1, 0, 0, 0)
    assert new.searched_s == new.jump_s == -math.inf
    assert new.relay
    assert new.reason == new.why == "no map yet"
    assert not new.votes
    assert new._features_drift == 0
    assert "_features=" not in repr(new)
    assert (new.centre(), new.corners().shape) == ((0.0, 0.0), (4, 2))
    with pytest.raises(ValueError, match="a has no map"):
        new.features(CELL_M, RULES, 0.0, DEVICE)
    new.place(CELL_M, RULES, DEVICE)
    assert new.layer is None


@pytest.mark.parametrize("accepted", [True, False])
@pytest.mark.parametrize("is_steady", [True, False])
@pytest.mark.parametrize("contradiction", ["", "its poses"])
def test_what_is_believed_stands_and_is_not_contradicted_votes(
    accepted: bool, is_steady: bool, contradiction: str
) -> None:
    track = Track(
        "a", accepted=accepted, is_steady=is_steady, contradiction=contradiction, reason="own"
    )
    assert track.stands is (accepted and is_steady)
    assert track.votes is (accepted and is_steady and not contradiction)
    assert track.why == (contradiction if track.stands and contradiction else "own")
    track.refuse("refused")
    assert not track.stands
    assert track.why == "refused"


def test_before_the_first_fusion_equal_maps_are_one() -> None:
    track, first = Track("a"), walls_of(30)

    def follow(grid: OccupancyGrid) -> int:
        assert track.follow(grid, None, RULES, LIVE, DEVICE) is None
        assert track.grid is grid
        return track.version

    assert follow(first) == 1
    assert follow(replace(first)) == 1
    assert track.maps == 2
    others = (
        replace(first, origin=Pose2(1.0)),
        replace(first, origin=Pose2(1.0), resolution=0.5),
        replace(walls_of(31), origin=Pose2(1.0), resolution=0.5),
    )
    assert [follow(grid) for grid in others] == [2, 3, 4]
    assert track.layer is None
    # The first after the first fusion is laid out.
    track.relay = False
    assert track.follow(first, CELL_M, RULES, LIVE, DEVICE) is None
    assert (track.version, track.maps, track.walls) == (5, 6, 30)
    assert track.layer is not None
    assert track.relay


def placed(grid: OccupancyGrid, live: LiveConfig = LIVE) -> Track:
    """Return a track that has one map and was aligned with it."""
    track = Track("a")
    track.follow(grid, CELL_M, RULES, live, DEVICE)
    track.transform = Pose2()
    track.accepted = track.is_steady = True
    track.relay = False
    track.pin()
    return track


def test_a_map_that_changes_nothing_is_the_same_version() -> None:
    track = placed(walls_of(100))
    features = track.features(CELL_M, RULES, 0.0, DEVICE)
    change = track.follow(walls_of(100), CELL_M, RULES, LIVE, DEVICE)
    assert change == Change(None, 0, 100, 0, 100, 100, is_lost=False)
    assert (track.version, track.maps, track.drift, track.unlaid) == (1, 2, 0, None)
    assert track.stands
    assert track.features(CELL_M, RULES, 0.0, DEVICE) is features


def test_walls_that_come_and_go_are_counted_until_it_is_aligned() -> None:
    track = placed(walls_of(100))
    track.follow(walls_of(110), CELL_M, RULES, LIVE, DEVICE)
    track.follow(walls_of(105), CELL_M, RULES, LIVE, DEVICE)
    assert (track.version, track.maps, track.walls) == (3, 3, 105)
    assert (track.drift, track.key_drift, track._features_drift) == (15, 15, 15)
    assert track.unlaid == CellBox(0, 100, 1, 110)
    assert not track.relay
    assert track.stands
    track.tried, track.jump = (3, "b", 1), Pose2()
    track.pin()
    assert (track.drift, track.key_drift, track.jump, track.tried) == (0, 0, None, None)
    assert track.key == (track.layer, 105)
    assert track._features_drift == 15, "what is looked at is as old as before"
    # Beside its lattice all of it is laid again.
    moved = replace(walls_of(105), origin=Pose2(0.1))
    track.follow(moved, CELL_M, RULES, LIVE, DEVICE)
    assert track.relay


def test_a_map_whose_walls_do_not_stand_is_steady_no_more() -> None:
    for count, stands in ((75, True), (74, False)):
        # A wall beside one that is left stands too: a cell is off by one at the edge.
        track = placed(walls_of(100))
        features = track.features(CELL_M, RULES, 1.0, DEVICE)
        track.follow(walls_of(count - 1), CELL_M, RULES, LIVE, DEVICE)
        assert track.is_steady is stands
        assert track.accepted
        assert (track.features(CELL_M, RULES, 1.0, DEVICE) is features) is stands


def test_walls_that_creep_are_held_against_the_map_that_was_aligned() -> None:
    # Ten walls less each time: each map stands beside the one before, not beside the first.
    track = placed(walls_of(100))
    steady = []
    for count in (90, 80, 70):
        track.follow(walls_of(count), CELL_M, RULES, LIVE, DEVICE)
        steady.append(track.is_steady)
    assert steady == [True, True, False]


@pytest.mark.parametrize(("key_drift", "is_looked_at"), [(24, False), (25, False), (26, True)])
def test_the_aligned_map_is_looked_at_when_much_has_come_and_gone(
    monkeypatch: pytest.MonkeyPatch, key_drift: int, is_looked_at: bool
) -> None:
    track = placed(walls_of(100))
    track.key_drift = key_drift
    looked: list[Layer] = []

    def stand_in(old: Layer, *_: object) -> Change:
        looked.append(old)
        return Change(None, 0, 0, 100, 100)

    monkeypatch.setattr(tracks, "compare", stand_in)
    assert track._stands(RULES, LIVE, DEVICE) is not is_looked_at
    assert looked == ([track.layer] if is_looked_at else [])
    assert track.key_drift == (0 if is_looked_at else key_drift)
    for missing in ("key", "layer"):
        other = placed(walls_of(100))
        other.key_drift = 99
        setattr(other, missing, None)
        assert other._stands(RULES, LIVE, DEVICE)


def test_a_track_without_a_layer_pins_none() -> None:
    track = Track("a", drift=3, key_drift=3)
    track.pin()
    assert track.key is None
    assert track.drift == track.key_drift == 0


@pytest.mark.parametrize(("drift", "is_kept"), [(24, True), (25, True), (26, False)])
def test_features_are_those_of_an_older_map_while_few_walls_changed(
    drift: int, is_kept: bool
) -> None:
    track = placed(walls_of(100))
    features = track.features(CELL_M, RULES, 0.25, DEVICE)
    assert isinstance(features, GridFeatures)
    track._features_drift = drift
    assert (track.features(CELL_M, RULES, 0.25, DEVICE) is features) is is_kept
    assert track._features_drift == (drift if is_kept else 0)


def test_a_wall_of_a_layer_is_what_the_thresholds_say() -> None:
    track = placed(grid_of([[65, 64, 100, 0, -1, 66]]))
    assert track.walls == 3
    assert track.known == CellBox(0, 0, 1, 6)


def test_all_unknown_is_known_nowhere() -> None:
    track = placed(grid_of([[-1, -1], [-1, -1]]))
    assert (track.known, track.walls) == (None, 0)
    assert track.corners().tolist() == [[0.0, 0.0]] * 4
    # It begins to be known, and goes back into the unknown.
    track.follow(grid_of([[-1, -1], [-1, 0]]), CELL_M, RULES, LIVE, DEVICE)
    assert track.known == CellBox(1, 1, 2, 2)
    track.follow(grid_of([[-1, -1], [-1, -1]]), CELL_M, RULES, LIVE, DEVICE)
    assert track.known is None


@pytest.mark.parametrize("side", range(4))
def test_what_is_known_grows_and_shrinks_at_each_side(side: int) -> None:
    cells = np.full((7, 7), -1, dtype=np.int8)
    cells[2:5, 2:5] = 0
    # A tip on each side, and the cell beyond it.
    tips, beyond = ((1, 3), (5, 3), (3, 1), (3, 5)), ((0, 3), (6, 3), (3, 0), (3, 6))
    for tip in tips:
        cells[tip] = 0
    track = placed(grid_of(cells))
    assert track.known == CellBox(1, 1, 6, 6)
    for place, value in ((beyond[side], 0), (beyond[side], -1), (tips[side], -1), (tips[side], 50)):
        cells = cells.copy()
        cells[place] = value
        grid = grid_of(cells)
        track.follow(grid, CELL_M, RULES, LIVE, DEVICE)
        assert track.known == grid.known_box()


# -- how far ---------------------------------------------------------------------------------------


def test_how_far_two_transforms_carry_a_map_apart() -> None:
    # Eight cells by four of a quarter metre: 2 m by 1 m from (1, 2).
    origin = Pose2(1.0, 2.0)
    track = placed(grid_of(np.zeros((4, 8)), origin))
    assert track.centre() == (2.0, 2.5)
    wanted = [[1.0, 2.0], [1.0, 3.0], [3.0, 2.0], [3.0, 3.0]]
    assert track.corners().tolist() == wanted
    assert track.apart(Pose2(), Pose2(3.0, 4.0)) == (5.0, 0.0, 5.0)
    assert track.apart(Pose2(), Pose2(0.0, 4.0)) == (4.0, 0.0, 4.0)
    assert track.apart(Pose2(), Pose2(3.0, 0.0)) == (3.0, 0.0, 3.0)
    centre, turn, corners = track.apart(Pose2(), Pose2(0.0, 0.0, math.pi))
    assert centre == pytest.approx(2.0 * math.hypot(2.0, 2.5))
    assert turn == pytest.approx(math.pi)
    assert corners == pytest.approx(2.0 * math.hypot(3.0, 3.0))


@given(x=st.floats(-9.0, 9.0), y=st.floats(-9.0, 9.0), yaw=st.floats(-9.0, 9.0))
def test_no_point_of_a_map_is_farther_apart_than_its_corners(
    x: float, y: float, yaw: float
) -> None:
    track = placed(grid_of(np.zeros((4, 8)), Pose2(1.0, 2.0)))
    moved = Pose2(x, y, yaw)
    centre, turn, corners = track.apart(Pose2(), moved)
    assert centre <= corners + 1e-9
    assert turn == pytest.approx(abs(wrap_angle(yaw)))
    assert track.apart(moved, Pose2())[2] == pytest.approx(corners)
