"""Courses: by name, from a file, changed by options, and written so that they come back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from slamfusion.config import COURSES, ObstacleConfig, PersonConfig, SimulateConfig
from slamfusion.errors import ConfigError, SimulationError
from slamfusion.sim.courses import course_to_mapping, load_course, named_course, with_overrides
from slamfusion.sim.drive import DRIVES
from slamfusion.sim.world import LIDARS

FULL = {
    "name": "mine",
    "seed": 9,
    "world": {"name": "hall", "seed": 4, "glass_share": 0.1},
    "lidar": {"model": "kinect", "beams": 64},
    "drive": {"model": "tracks", "slip_left": 0.2},
    "start": [1, -0.5, 0.25],
    "waypoints": [[2, 3], [4.5, 1]],
    "people": [{"waypoints": [[0, 0], [3, 3]], "speed_mps": 0.8}],
    "obstacles": [{"x_m": 2.0, "yaw_rad": 1.0}],
}


def written(folder: Path, values: Any) -> Path:
    path = folder / "course.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


def test_a_file_says_everything(tmp_path: Path) -> None:
    course = load_course(written(tmp_path, FULL))
    assert (course.name, course.seed, course.world.name, course.world.seed) == (
        "mine",
        9,
        "hall",
        4,
    )
    assert (course.lidar.beams, course.lidar.range_max_m) == (64, 4.0)
    assert course.drive.slip_left == 0.2
    assert course.drive.slip_right == DRIVES["tracks"].slip_right
    assert course.start == (1.0, -0.5, 0.25)
    assert course.waypoints == ((2.0, 3.0), (4.5, 1.0))
    (person,) = course.people
    assert person == PersonConfig(((0.0, 0.0), (3.0, 3.0)), speed_mps=0.8)
    assert course.obstacles == (ObstacleConfig(x_m=2.0, yaw_rad=1.0),)


def test_a_world_is_enough(tmp_path: Path) -> None:
    course = load_course(written(tmp_path, {"world": "yard"}), seed=3)
    assert (course.name, course.seed, course.world.name) == ("course", 3, "yard")
    assert course.lidar == LIDARS["hokuyo"]
    assert course.drive == DRIVES["differential"]
    assert course.waypoints is None
    assert (course.people, course.obstacles) == (0, False)


def test_any_other_world_is_a_map_file(tmp_path: Path) -> None:
    for world in ("floor.yaml", {"map": "floor.yaml"}):
        course = load_course(written(tmp_path, {"world": world}))
        assert (course.world.name, course.world.map) == ("map", str(tmp_path / "floor.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_named_courses_survive_their_file(tmp_path: Path, name: str) -> None:
    course = named_course(name, 5)
    again = load_course(written(tmp_path, course_to_mapping(course)))
    assert course_to_mapping(again) == course_to_mapping(course)
    assert again.script == course.script
    assert again.lidar == course.lidar


def test_unknown_course_names_the_nearest() -> None:
    with pytest.raises(
        SimulationError, match=r"no course file, and the course 'coridor' .*'corridor'"
    ):
        named_course("coridor", 0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"world": "hall", "ladar": "kinect"},
            "unknown key 'ladar'; the nearest known one is 'lid",
        ),
        ({"world": {"name": "hall", "glas": 1}}, "world: unknown key 'glas'; the nearest known"),
        ({"world": {"name": "halls"}}, "world: name: must be one of office"),
        ({"world": "hall", "lidar": "velodyne"}, "lidar: model: must be one of kinect"),
        ({"world": "hall", "lidar": {"beams": "many"}}, "lidar: beams: wanted int, found 'many'"),
        ({"world": "hall", "drive": {"speed": 1}}, "drive: unknown key 'speed'; the nearest"),
        ({"world": "hall", "waypoints": [[1, 2, 3]]}, "waypoints: number 1: wanted 2 numbers"),
        ({"world": "hall", "waypoints": [[1, float("nan")]]}, "number 1: wanted 2 numbers"),
        ({"world": "hall", "start": [1, 2]}, "start: wanted 3 numbers"),
        ({"world": "hall", "people": -1}, "people: wanted a whole number from 0, found -1"),
        ({"world": "hall", "people": [{"speed_mps": 1}]}, "number 1: 'waypoints' is missing"),
        (
            {"world": "hall", "script": [{"turn_deg": 1, "wait_s": 1}]},
            "script: number 1: a command is one",
        ),
        ({"world": "hall", "script": [{}]}, "found none of them"),
        ({"world": "hall", "obstacles": [{"x": 1}]}, "obstacles: number 1: unknown key 'x'"),
        ({"world": "hall", "obstacles": 3}, "obstacles: wanted bool or a list, found 3"),
        ({"world": "hall", "seed": 1.5}, "seed: wanted int, found 1.5"),
        ({"seed": 1}, "'world' is missing; give one of office"),
        ([1], "wanted a mapping of settings, found list"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, values: Any, words: str) -> None:
    path = written(tmp_path, values)
    with pytest.raises(ConfigError) as caught:
        load_course(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["", "../x", ".hidden", "a/b"])
def test_a_name_that_is_no_file_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(SimulationError, match="must be a plain file name"):
        load_course(written(tmp_path, {"world": "hall", "name": name}))


def test_waypoints_beside_a_script_are_refused(tmp_path: Path) -> None:
    values = {"world": "hall", "waypoints": [[1, 1]], "script": [{"wait_s": 1}]}
    with pytest.raises(SimulationError, match="waypoints or a script, not both"):
        load_course(written(tmp_path, values))


def test_options_change_a_course() -> None:
    changes = SimulateConfig(
        world="hall",
        world_seed=7,
        resolution=0.1,
        lidar="rplidar",
        drive="tracks",
        obstacle=True,
        people=4,
        glass_share=0.2,
    )
    course = with_overrides(named_course("office", 1), changes)
    world = course.world
    assert (course.name, course.seed) == ("hall", 1)
    assert (world.name, world.seed, world.resolution, world.glass_share) == ("hall", 7, 0.1, 0.2)
    assert (course.lidar, course.drive) == (LIDARS["rplidar"], DRIVES["tracks"])
    assert (course.people, course.obstacles) == (4, True)
    assert with_overrides(course, SimulateConfig()) == course


def test_a_map_file_has_its_own_cell_size() -> None:
    with pytest.raises(SimulationError, match="leave --resolution out"):
        with_overrides(named_course("hall", 0), SimulateConfig(world="a.yaml", resolution=0.1))
