"""Courses: which robot drives where. Some have a name; others are written in a YAML file.

A course file holds ``name``, ``seed``, ``world``, ``lidar``, ``drive``, ``start`` ([x, y, yaw] in
m, m, rad), ``people`` (how many, or a list), ``obstacles`` (yes, no, or a list), and ``waypoints``
([x, y] in m each) or a ``script``. ``world``, ``lidar`` and ``drive`` are a name, or a mapping of
the fields of ``WorldConfig``, ``LidarConfig`` and ``DriveConfig``. All but ``world`` may be left
out: waypoints, people and obstacles are then chosen by the seed.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

from slamfusion.config import (
    COURSES,
    INTEGER_MAX,
    ActionConfig,
    DrawnPlace,
    DriveConfig,
    LidarConfig,
    ObstacleConfig,
    PersonConfig,
    PlaceName,
    SimulateConfig,
    WorldConfig,
    from_mapping,
    to_mapping,
)
from slamfusion.errors import ConfigError, SimulationError, shown
from slamfusion.geometry import Pose2
from slamfusion.io.yaml_file import read_yaml
from slamfusion.sim.drive import DRIVES
from slamfusion.sim.world import LIDARS, Person

T = TypeVar("T")
Point = tuple[float, float]

WORLD_NAMES: tuple[str, ...] = get_args(DrawnPlace)
KEYS = (
    "name",
    "seed",
    "world",
    "lidar",
    "drive",
    "start",
    "waypoints",
    "script",
    "people",
    "obstacles",
)


@dataclass(frozen=True)
class Course:
    """Everything that decides a simulated drive.

    Attributes:
        name: of the log; a plain file name.
        seed: of every random number, beside those of a world with its own.
        world: where.
        start: first pose, map frame; None: the world's.
        waypoints: x and y in metres, map frame; None: planned.
        script: what the wheels do; empty: drive along the waypoints.
        people: who walks about, or how many.
        obstacles: cables on the floor, or whether there is one on the way.
        folder: a relative map file of the world lies here.

    Raises:
        SimulationError: a name that is no plain file name, or waypoints beside a script.
    """

    name: str
    seed: int
    world: WorldConfig
    lidar: LidarConfig
    drive: DriveConfig
    start: Pose2 | None = None
    waypoints: tuple[Point, ...] | None = None
    script: tuple[ActionConfig, ...] = ()
    people: int | tuple[Person, ...] = 0
    obstacles: bool | tuple[ObstacleConfig, ...] = False
    folder: Path = Path()

    def __post_init__(self) -> None:
        if not self.name or self.name.startswith(".") or set(self.name) & set("/\\\0\n"):
            message = (
                f"a course's name must be a plain file name, found {shown(self.name)}; change it"
            )
            raise SimulationError(message)
        if self.script and self.waypoints is not None:
            raise SimulationError(f"{self.name}: give waypoints or a script, not both")


def named_course(name: str, seed: int) -> Course:
    """Return one of ``COURSES``.

    Raises:
        SimulationError: there is no such course; the nearest is named.
    """
    if name not in COURSES:
        near = difflib.get_close_matches(name, COURSES, n=1, cutoff=0.0)[0]
        raise SimulationError(
            f"{name}: no course file and no course of that name; the nearest one is {near!r}, "
            f"the others are {', '.join(known for known in COURSES if known != near)}"
        )
    return _course({"name": name, "seed": seed, **COURSES[name][1]}, name, Path())


def load_course(path: str | Path, seed: int = 0) -> Course:
    """Read a course file.

    Args:
        seed: where the file has none.

    Raises:
        ConfigError: what is no YAML, an unknown key (the nearest is named), a wrong type or range.
        SimulationError: settings that contradict each other.
    """
    path = Path(path)
    values = read_yaml(path, ConfigError, "a course's YAML")
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: wanted a mapping of settings, found {type(values).__name__}")
    return _course({"name": path.stem, "seed": seed, **values}, str(path), path.parent)


def with_overrides(course: Course, changes: SimulateConfig) -> Course:
    """Return a course with the settings of a run put in.

    A world by file is taken relative to the current folder. A course that is named after its world
    is then named after the new one.

    Raises:
        SimulationError: a cell size for a map file, which has its own.
    """
    name, world = course.name, course.world
    if changes.world is not None:
        is_drawn = changes.world in WORLD_NAMES
        if name in WORLD_NAMES:
            name = changes.world if is_drawn else Path(changes.world).stem
        world = replace(
            world,
            name=cast("PlaceName", changes.world) if is_drawn else "map",
            map=None if is_drawn else str(Path(changes.world).absolute()),
        )
    if changes.resolution is not None:
        if world.map is not None:
            message = f"{world.map}: a map file has its own cell size; leave --resolution out"
            raise SimulationError(message)
        world = replace(world, resolution=changes.resolution)
    if changes.world_seed is not None:
        world = replace(world, seed=changes.world_seed)
    if changes.glass_share is not None:
        world = replace(world, glass_share=changes.glass_share)
    return replace(
        course,
        name=name,
        world=world,
        lidar=course.lidar if changes.lidar is None else LIDARS[changes.lidar],
        drive=course.drive if changes.drive is None else DRIVES[changes.drive],
        people=course.people if changes.people is None else changes.people,
        obstacles=course.obstacles if changes.obstacle is None else changes.obstacle,
    )


def course_to_mapping(course: Course) -> dict[str, Any]:
    """Return a course as its file holds it; ``load_course`` gives the same course back."""
    people, obstacles = course.people, course.obstacles
    values: dict[str, Any] = {
        "name": course.name,
        "seed": course.seed,
        "world": to_mapping(course.world),
        "lidar": to_mapping(course.lidar),
        "drive": to_mapping(course.drive),
        "people": people
        if isinstance(people, int)
        else [
            {"waypoints": [list(point) for point in person.waypoints]} | to_mapping(person.settings)
            for person in people
        ],
        "obstacles": obstacles
        if isinstance(obstacles, bool)
        else [to_mapping(obstacle) for obstacle in obstacles],
    }
    if course.start is not None:
        values["start"] = [course.start.x, course.start.y, course.start.yaw_rad]
    if course.waypoints is not None:
        values["waypoints"] = [list(point) for point in course.waypoints]
    if course.script:
        values["script"] = [to_mapping(action) for action in course.script]
    return values


# --- from the file -------------------------------------------------------------------------------


def _course(values: dict[str, Any], where: str, folder: Path) -> Course:
    for key in values:
        if key not in KEYS:
            near = difflib.get_close_matches(shown(key), KEYS, n=1, cutoff=0.0)[0]
            message = f"{where}: unknown key {shown(key)}; the nearest known one is {near!r}"
            raise ConfigError(message)
    if "world" not in values:
        message = f"{where}: 'world' is missing; give one of {', '.join(WORLD_NAMES)} or a map file"
        raise ConfigError(message)
    people, obstacles = values.get("people", 0), values.get("obstacles", False)
    waypoints = values.get("waypoints")
    return Course(
        name=_of_type(values["name"], str, f"{where}: name"),
        seed=_count(values["seed"], f"{where}: seed"),
        world=_world(values["world"], f"{where}: world"),
        lidar=_modelled(values.get("lidar", {}), LIDARS, "hokuyo", f"{where}: lidar"),
        drive=_modelled(values.get("drive", {}), DRIVES, "differential", f"{where}: drive"),
        start=_start(values.get("start"), f"{where}: start"),
        waypoints=None if waypoints is None else _points(waypoints, f"{where}: waypoints"),
        script=tuple(
            from_mapping(ActionConfig, item, f"{where}: script {number}")
            for number, item in enumerate(_list(values.get("script"), f"{where}: script"), 1)
        ),
        people=_people(people, f"{where}: people"),
        obstacles=obstacles
        if isinstance(obstacles, bool)
        else tuple(
            from_mapping(ObstacleConfig, item, f"{where}: obstacle {number}")
            for number, item in enumerate(_list(obstacles, f"{where}: obstacles"), 1)
        ),
        folder=folder,
    )


def _world(value: Any, where: str) -> WorldConfig:
    if isinstance(value, str):
        value = {"name": value} if value in WORLD_NAMES else {"name": "map", "map": value}
    return from_mapping(WorldConfig, value, where)


def _modelled(value: Any, models: Mapping[str, T], default: str, where: str) -> T:
    """Read a laser or drive: a model's name, or a mapping that changes some of a model's fields."""
    if isinstance(value, str):
        value = {"model": value}
    under: T | type[T] = type(models[default])
    if isinstance(value, dict):
        model = value.get("model", default)
        if isinstance(model, str) and model in models:
            under = models[model]
    return from_mapping(under, value, where)


def _start(value: Any, where: str) -> Pose2 | None:
    if value is None:
        return None
    return Pose2(*_numbers(value, 3, where))


def _people(value: Any, where: str) -> int | tuple[Person, ...]:
    if not isinstance(value, list):
        return _count(value, where)
    people = []
    for number, item in enumerate(value, start=1):
        place = f"{where}: person {number}"
        settings = dict(_of_type(item, dict, place))
        waypoints = _points(settings.pop("waypoints", []), f"{place}: waypoints")
        if not waypoints:
            message = f"{place}: 'waypoints' is missing; give at least one [x, y] in metres"
            raise ConfigError(message)
        people.append(Person(waypoints, from_mapping(PersonConfig, settings, place)))
    return tuple(people)


def _points(value: Any, where: str) -> tuple[Point, ...]:
    points = []
    for number, item in enumerate(_list(value, where), start=1):
        x, y = _numbers(item, 2, f"{where}: number {number}")
        points.append((x, y))
    return tuple(points)


def _numbers(value: Any, count: int, where: str) -> tuple[float, ...]:
    row = value if isinstance(value, list) else []
    numbers = [item for item in row if type(item) in {int, float} and abs(item) < 1e7]
    if len(row) != count or len(numbers) != count:
        message = f"{where}: wanted {count} numbers in metres and radians, found {shown(value)}"
        raise ConfigError(message)
    return tuple(float(item) for item in numbers)


def _count(value: Any, where: str) -> int:
    if type(value) is not int or not 0 <= value <= INTEGER_MAX:
        raise ConfigError(f"{where}: wanted a whole number from 0, found {shown(value)}")
    return value


def _list(value: Any, where: str) -> list[Any]:
    return [] if value is None else _of_type(value, list, where)


def _of_type(value: Any, kind: type[T], where: str) -> T:
    if not isinstance(value, kind):
        raise ConfigError(f"{where}: wanted a {kind.__name__}, found {shown(value)}")
    return value
