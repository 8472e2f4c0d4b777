"""Worlds: what beams meet, glass among the walls, and how a cable tilts a robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute.layout import GLASS, OPEN, WALL
from slamfusion.config import ObstacleConfig, WorldConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io import save_map
from slamfusion.sim import draw_building
from slamfusion.sim.world import World, thin_walls, tilt_of, zone_place
from slamfusion.sim.worlds import Floor, draw_floor, pick_glass
from tests.sim.places import room, world_of

MISLEADING = ("ring-100", "ring-300", "wings", "pillars", "rooms")
DRAWN = ("office", "corridor", "hall", "atrium", "yard", *MISLEADING)


def floor_of(name: str, seed: int = 0, resolution: float = 0.05) -> Floor:
    config = WorldConfig(name=name, resolution=resolution)
    return draw_floor(config, np.random.default_rng(seed))


@pytest.mark.parametrize("resolution", [0.04, 0.1])
@pytest.mark.parametrize("name", DRAWN)
def test_start_is_free_and_the_cells_have_the_asked_size(name: str, resolution: float) -> None:
    floor = floor_of(name, 1, resolution)
    row, col = floor.grid.cell_indices(np.array([floor.start.x, floor.start.y]))
    assert floor.grid.resolution == resolution
    assert (floor.grid.cells[row - 3 : row + 4, col - 3 : col + 4] == FREE).all()


@pytest.mark.parametrize("name", ["office", "corridor", "hall", "atrium", *MISLEADING])
def test_what_is_inside_is_closed(name: str) -> None:
    cells = np.pad(floor_of(name, 2).grid.cells, 1, mode="edge")
    assert not np.any(cells[[0, -1]] == FREE)
    assert not np.any(cells[:, [0, -1]] == FREE)


def test_yard_has_gaps_through_which_beams_leave() -> None:
    cells = floor_of("yard", 1).grid.cells
    free_beside_unknown = (cells[:, :-1] == FREE) & (cells[:, 1:] == UNKNOWN)
    assert free_beside_unknown.any()


@pytest.mark.parametrize("length_m", [100.0, 300.0])
def test_a_ring_is_as_long_as_it_says(length_m: float) -> None:
    floor = floor_of(f"ring-{length_m:g}")
    # From the start over the corners back to it; then the drive goes on.
    stops = np.array([(0.0, 0.0), *floor.stops[:5]])
    assert stops[-1].tolist() == [0.0, 0.0]
    assert np.hypot(*np.diff(stops, axis=0).T).sum() == pytest.approx(length_m)


def cells_around(floor: Floor, x: float, y: float, half_m: float) -> np.ndarray:
    row, col = floor.grid.cell_indices(np.array([x, y]))
    reach = round(half_m / floor.grid.resolution)
    return floor.grid.cells[row - reach : row + reach, col - reach : col + reach]


@pytest.mark.parametrize(
    ("name", "period_m", "count"), [("wings", 11.0, 2), ("rooms", 4.0, 8), ("pillars", 2.5, 5)]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_copies_are_equal_to_the_cell(name: str, period_m: float, count: int, seed: int) -> None:
    floor = floor_of(name, seed)
    # In a wing or a room; in the ring at the lower wall, left of the start.
    x, y = {"wings": (0.0, 5.6), "rooms": (0.0, 3.0), "pillars": (-5.0, 0.0)}[name]
    half_m = {"wings": 3.9, "rooms": 1.9, "pillars": 1.2}[name]
    first = cells_around(floor, x, y, half_m)
    assert (first == OCCUPIED).any()
    for number in range(1, count):
        other = cells_around(floor, x + number * period_m, y, half_m)
        np.testing.assert_array_equal(other, first)


def test_classes_are_open_wall_and_glass() -> None:
    cells = np.array([[UNKNOWN, FREE, OCCUPIED, OCCUPIED]], dtype=np.int8)
    glass = np.array([[False, False, False, True]])
    world = World(OccupancyGrid(cells, 0.05), glass)
    assert world.classes().tolist() == [[OPEN, OPEN, WALL, GLASS]]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_glass_is_a_share_of_the_walls(share: float) -> None:
    grid = floor_of("office").grid
    glass = pick_glass(grid, share, np.random.default_rng(5))
    assert not (glass & (grid.cells != OCCUPIED)).any()
    found = np.count_nonzero(glass) / np.count_nonzero(grid.cells == OCCUPIED)
    assert share <= found <= share + 0.02


def test_a_saved_map_is_a_world(tmp_path: Path) -> None:
    grid = room(4.0, 3.0)
    save_map(grid, tmp_path / "drawn")
    config = WorldConfig(name="map", map=str(tmp_path / "drawn.yaml"))
    floor = draw_floor(config, np.random.default_rng(0))
    assert floor.grid.cells.tobytes() == grid.cells.tobytes()
    assert floor.grid.origin == grid.origin
    assert floor.start is None


def test_a_map_world_needs_its_map_and_no_other_has_one() -> None:
    for config in (WorldConfig(name="map"), WorldConfig(name="hall", map="drawn.yaml")):
        with pytest.raises(SimulationError, match="a drawn place or a map, found name"):
            draw_floor(config, np.random.default_rng(0))


CABLE = ObstacleConfig(x_m=1.0, y_m=2.0, yaw_rad=np.pi / 2, across_m=0.4, along_m=2.0)


def test_zone_is_a_turned_rectangle() -> None:
    points = np.array([(1.0, 2.0), (1.9, 2.1), (1.0, 2.19), (1.0, 2.21), (2.1, 2.0)])
    across, on = zone_place(CABLE, points)
    assert on.tolist() == [True, True, True, False, False]
    assert across[:3] == pytest.approx([0.0, 0.25, 0.475])


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_nose_goes_up_then_down_whichever_way_it_is_crossed(turn: float) -> None:
    yaw = np.pi / 2 + turn
    ahead = 0.1 * np.array((np.cos(yaw), np.sin(yaw)))
    poses = np.array([(1.0 - ahead[0], 2.0 - ahead[1], yaw), (1.0 + ahead[0], 2.0 + ahead[1], yaw)])
    tilt = tilt_of(world_of(room(9.0, 9.0), obstacles=(CABLE,)), poses)
    assert tilt[:, 0] == pytest.approx([CABLE.pitch_rad, -CABLE.pitch_rad])
    assert tilt[:, 1] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_driving_along_a_cable_rolls() -> None:
    world = world_of(room(9.0, 9.0), obstacles=(CABLE,))
    # On the near side the ground rises along +y, which is to the left of a robot that looks at +x.
    tilt = tilt_of(world, np.array([(1.0, 1.9, 0.0), (1.0, 1.0, 0.0)]))
    assert tilt[0] == pytest.approx([0.0, CABLE.pitch_rad], abs=1e-12)
    assert tilt[1].tolist() == [0.0, 0.0]


def test_thin_walls_keeps_the_surfaces_that_a_lidar_can_see() -> None:
    # A room (.) whose walls (#) are two cells thick, and a block of 3 x 3 in it; ? is unknown.
    drawn = (
        "?????????",
        "#########",
        "#########",
        "##.....##",
        "##.###.##",
        "##.###.##",
        "##.###.##",
        "##.....##",
    )
    wanted = (
        "?????????",
        "?????????",
        "??#####??",
        "?#.....#?",
        "?#.###.#?",
        "?#.#?#.#?",
        "?#.###.#?",
        "?#.....#?",
    )
    value = {"?": UNKNOWN, ".": FREE, "#": OCCUPIED}
    cells = [
        np.array([[value[c] for c in row] for row in rows], np.int8) for rows in (drawn, wanted)
    ]
    truth = OccupancyGrid(cells[0], 0.05, Pose2(1.0, 2.0, 0.3), "truth")
    thin = thin_walls(truth)
    assert thin.cells.tolist() == cells[1].tolist()
    assert (thin.resolution, thin.origin, thin.name) == (0.05, truth.origin, "truth")


# --- a building of any size -----------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0.04, 0.05, 0.1])
def test_size_is_the_asked_one_in_metres(resolution: float) -> None:
    grid = draw_building(np.random.default_rng(0), 14.0, 9.0, resolution)
    assert grid.width == pytest.approx(14.0 / resolution, abs=1)
    assert grid.height == pytest.approx(9.0 / resolution, abs=1)


def test_has_free_rooms_walls_and_an_unknown_outside() -> None:
    grid = draw_building(np.random.default_rng(1), 16.0, 11.0)
    share = {value: float(np.mean(grid.cells == value)) for value in (FREE, OCCUPIED, UNKNOWN)}
    assert share[FREE] > 0.6
    assert 0.02 < share[OCCUPIED] < 0.2
    assert share[UNKNOWN] > 0.03
    row, col = grid.cell_indices(np.zeros(2))
    assert grid.cells[row, col] == FREE, "the map frame's zero is a free place in the corridor"


@pytest.mark.parametrize("seed", range(5))
def test_free_cells_never_touch_the_outside(seed: int) -> None:
    cells = np.pad(draw_building(np.random.default_rng(seed), 18.0, 12.0).cells, 1, mode="edge")
    assert not np.any(cells[[0, -1]] == FREE)
    assert not np.any(cells[:, [0, -1]] == FREE)
