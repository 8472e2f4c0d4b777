"""What pages are told: changed tiles only, each thing once, in its newest state."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory
from slamfusion.web.scene import TILE, Scene, encode_tile
from tests.web.maps import noise, painted, texts, tiles


@pytest.fixture
def scene() -> Scene:
    return Scene("test", is_live=True)


def test_a_tile_is_what_it_was_and_one_of_equal_cells_is_small() -> None:
    cells = noise(TILE, TILE).cells
    told = tiles([encode_tile("a", (-1, 2), 5.0, cells)], "a")
    assert list(told) == [(-1, 2)]
    assert np.array_equal(told[-1, 2], cells)
    unknown = np.full((TILE, TILE), -1, dtype=np.int8)
    data = encode_tile("a", (0, 0), 5.0, unknown)
    assert len(data) < 80
    assert np.array_equal(tiles([data], "a")[0, 0], unknown)


def test_only_changed_tiles_are_told(scene: Scene) -> None:
    grid = noise(300, 300)
    scene.put_map("a", grid, "input")
    first, seq = scene.since(0)
    assert len(tiles(first, "a")) == 9
    assert np.array_equal(painted(tiles(first, "a"), 300, 300, (0, 0)), grid.cells)
    scene.put_map("a", grid, "input")
    assert scene.since(seq) == ([], seq)
    cells = grid.cells.copy()
    cells[130, 5] = 100 if cells[130, 5] != 100 else 0
    scene.put_map("a", OccupancyGrid(cells, 0.05, grid.origin, "a"), "input")
    later, _ = scene.since(seq)
    assert list(tiles(later, "a")) == [(1, 0)]
    assert not texts(later, "layer")


def test_a_map_that_grows_to_the_left_and_below_sends_no_tile_twice(scene: Scene) -> None:
    grid = noise(TILE, TILE)
    scene.put_map("a", grid, "input")
    _, seq = scene.since(0)
    grown = np.full((TILE + 7, TILE + 40), -1, dtype=np.int8)
    grown[7:, 40:] = grid.cells
    grown[3, 3] = 100
    origin = Pose2(-40 * 0.05, -7 * 0.05, 0.0)
    scene.put_map("a", OccupancyGrid(grown, 0.05, origin, "a"), "input")
    later, _ = scene.since(seq)
    assert list(tiles(later, "a")) == [(-1, -1)]
    whole, _ = scene.since(0)
    assert np.array_equal(painted(tiles(whole, "a"), TILE + 7, TILE + 40, (-7, -40)), grown)


def test_another_lattice_begins_again(scene: Scene) -> None:
    scene.put_map("a", noise(50, 50), "input")
    _, seq = scene.since(0)
    for origin in (Pose2(0.02, 0.0, 0.0), Pose2(0.0, 0.0, 0.1)):
        scene.put_map("a", OccupancyGrid(noise(50, 50).cells, 0.05, origin, "a"), "input")
        later, _ = scene.since(seq)
    (layer,) = texts(later, "layer")
    assert layer["epoch"] == 3
    assert layer["anchor"] == [0.0, 0.0, 0.1]
    assert np.array_equal(painted(tiles(later, "a"), 50, 50, (0, 0)), noise(50, 50).cells)


def test_what_is_known_no_more_is_told(scene: Scene) -> None:
    scene.put_map("a", noise(50, 50), "input")
    _, seq = scene.since(0)
    gone = OccupancyGrid(np.full((50, 50), -1, dtype=np.int8), 0.05, Pose2(), "a")
    scene.put_map("a", gone, "input")
    later, _ = scene.since(seq)
    assert (tiles(later, "a")[0, 0] == -1).all()


def test_a_slow_page_gets_the_newest_state_alone(scene: Scene) -> None:
    for seed in range(20):
        scene.put_map("a", noise(100, 100, seed=seed), "input")
        scene.put_status([], number=seed)
    messages, _ = scene.since(0)
    assert len([item for item in messages if isinstance(item, bytes)]) == 1
    assert [item["number"] for item in texts(messages, "status")] == [19]


def test_a_vote_that_changes_is_an_event(scene: Scene) -> None:
    one = {"name": "a", "transform": None, "score": 0.5}
    for votes, reason in ((True, "fits"), (True, "fits well"), (False, "lost"), (False, "lost")):
        scene.put_status([{**one, "votes": votes, "reason": reason}])
    said = [event["text"] for event in texts(scene.since(0)[0], "event")]
    assert said == ["a votes: fits", "a does not vote: lost"]


def test_a_path_goes_on_where_it_was(scene: Scene) -> None:
    for x_m in (0.0, 0.01, 1.0):
        scene.put_point("a", x_m, 0.0, 10.0 * x_m)
    messages, seq = scene.since(0)
    assert texts(messages, "trail")[0]["points"] == [[0.0, 0.0, 0.0], [1.0, 0.0, 10.0]]
    scene.put_point("a", 2.0, 0.0, 30.0)
    assert texts(scene.since(seq)[0], "trail")[0]["points"] == [[2.0, 0.0, 30.0]]


def test_a_whole_path_ends_when_the_robot_stops_turning(scene: Scene) -> None:
    scene.put_paths(
        {"a": Trajectory(np.array([5.0, 6.0, 9.0]), np.array([[0, 0, 0], [1, 0, 0], [1, 0, 2.0]]))}
    )
    (trail,) = texts(scene.since(0)[0], "trail")
    assert trail["points"] == [[0, 0, 0], [1, 0, 1], [1, 0, 4]]


def test_a_map_that_is_taken_away_is_told_and_may_come_again(scene: Scene) -> None:
    grid = noise(50, 50)
    scene.put_map("a", grid, "input")
    scene.put_point("a", 1.0, 2.0)
    _, seq = scene.since(0)
    scene.remove("a")
    scene.remove("never there")
    later, seq = scene.since(seq)
    assert texts(later, "layer") == [{"type": "layer", "name": "a", "gone": True}]
    assert len(later) == 1
    # Who looks only now is not shown it, and who comes again is drawn whole.
    assert not tiles(scene.since(0)[0], "a")
    assert not texts(scene.since(0)[0], "trail")
    scene.put_map("a", grid, "input")
    later, _ = scene.since(seq)
    assert len(tiles(later, "a")) == 1
    (layer,) = texts(later, "layer")
    assert layer["epoch"] == 2
    assert np.array_equal(painted(tiles(later, "a"), 50, 50, (0, 0)), grid.cells)


def test_a_map_that_waits_and_is_taken_away_is_never_told(scene: Scene) -> None:
    scene.put_map("a", noise(50, 50), "input")
    scene.put_map("b", noise(50, 50), "input")
    scene.remove("a")
    messages, _ = scene.since(0)
    assert [layer["name"] for layer in texts(messages, "layer")] == ["b"]
    assert tiles(messages, "b")
    assert not tiles(messages, "a")


def test_a_map_taken_away_while_it_is_cut_stays_away() -> None:
    def clock() -> float:
        scene.remove("a")
        return 0.0

    scene = Scene("test", is_live=True, clock=clock)
    scene.put_map("a", noise(50, 50), "input")
    messages, _ = scene.since(0)
    assert texts(messages, "layer") == [{"type": "layer", "name": "a", "gone": True}]
    assert not tiles(messages, "a")
