"""Courses: which robot drives where, named or from a YAML file.

A course file holds ``name``, ``seed``, ``world``, ``lidar``, ``drive``, ``start`` ([x, y, yaw] in
m, m, rad), ``people`` (a number or a list), ``obstacles`` (yes, no, or a list), and ``waypoints``
([x, y] in m each) or a ``script``. ``world``, ``lidar`` and ``drive`` are a name, or a mapping of
the fields of ``WorldConfig``, ``LidarConfig`` and ``DriveConfig``. Only ``world`` is required;
omitted waypoints, people and obstacles are chosen by the seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

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
)
from slamfusion.errors import ConfigError, SimulationError, shown, unknown
from slamfusion.io.yaml_file import read_yaml
from slamfusion.sim.drive import DRIVES
from slamfusion.sim.route import Point
from slamfusion.sim.world import LIDARS

WORLD_NAMES: tuple[str, ...] = get_args(DrawnPlace)


@dataclass(frozen=True)
class Course:
    """Everything that decides a simulated drive, as its file holds it.

    Attributes:
        name: of the log; a plain file name.
        seed: of every random number, beside those of a world with its own.
        people: who walks about, or how many.
        obstacles: cables on the floor, or whether there is one on the way.
        start: first pose, map frame, metres and radians; None: the world's.
        waypoints: x and y in metres, map frame; None: planned.
        script: what the wheels do; empty: drive along the waypoints.

    Raises:
        ConfigError: a number below 0, or a person without a place.
        SimulationError: a name that is no plain file name, or waypoints beside a script.
    """

    name: str
    seed: int
    world: WorldConfig
    lidar: LidarConfig
    drive: DriveConfig
    people: int | tuple[PersonConfig, ...] = 0
    obstacles: bool | tuple[ObstacleConfig, ...] = False
    start: tuple[float, float, float] | None = None
    waypoints: tuple[Point, ...] | None = None
    script: tuple[ActionConfig, ...] = ()

    def __post_init__(self) -> None:
        for key in ("seed", "people"):
            value = getattr(self, key)
            if isinstance(value, int) and not 0 <= value <= INTEGER_MAX:
                raise ConfigError(f"{key}: wanted a whole number from 0, found {shown(value)}")
        for number, person in enumerate(() if isinstance(self.people, int) else self.people, 1):
            if not person.waypoints:
                raise ConfigError(
                    f"people: number {number}: 'waypoints' is missing; give at least one [x, y] in "
                    "metres"
                )
        if not self.name or self.name.startswith(".") or set(self.name) & set("/\\\0\n"):
            message = (
                f"a course's name must be a plain file name, found {shown(self.name)}; change it"
            )
            raise SimulationError(message)
        if self.script and self.waypoints is not None:
            raise SimulationError(f"{self.name}: give waypoints or a script, not both")


def named_course(name: str, seed: int) -> Course:
    """Return one of ``COURSES``; an unknown name is a ``SimulationError``."""
    if name not in COURSES:
        raise SimulationError(f"no course file, and the course {unknown(name, COURSES)}")
    return _course({"name": name, "seed": seed, **COURSES[name][1]}, name, Path())


def load_course(path: str | Path, seed: int = 0) -> Course:
    """Read a course file; ``seed`` is the default of its seed.

    Raises:
        ConfigError: not YAML, an unknown key (with the nearest one), a wrong type or range.
        SimulationError: settings that contradict each other.
    """
    path = Path(path)
    values = read_yaml(path, ConfigError, "a course's YAML")
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: wanted a mapping of settings, found {type(values).__name__}")
    return _course({"name": path.stem, "seed": seed, **values}, str(path), path.parent)


def with_overrides(course: Course, changes: SimulateConfig) -> Course:
    """Return a course with the settings of a run; a course named after its world is renamed.

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
    if changes.resolution is not None and world.map is not None:
        message = f"{world.map}: a map file has its own cell size; leave --resolution out"
        raise SimulationError(message)
    wanted: dict[str, Any] = {
        "resolution": changes.resolution,
        "seed": changes.world_seed,
        "glass_share": changes.glass_share,
    }
    world = replace(world, **{key: own for key, own in wanted.items() if own is not None})
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
    """Return a course as its file holds it, for ``load_course``."""
    left_out = [key for key in ("start", "waypoints", "script") if not getattr(course, key)]
    return {key: value for key, value in asdict(course).items() if key not in left_out}


def _course(values: dict[str, Any], where: str, folder: Path) -> Course:
    values = dict(values)
    world = values.get("world")
    if isinstance(world, str):
        values["world"] = world = {"name": world} if world in WORLD_NAMES else {"map": world}
    if isinstance(world, dict) and world.get("map") is not None:
        values["world"] = {"name": "map", **world}
    bases = {}
    for key, models, default in (("lidar", LIDARS, "hokuyo"), ("drive", DRIVES, "differential")):
        value = values.get(key, {})
        # A model's name, or a mapping that changes some of a model's fields.
        values[key] = value = {"model": value} if isinstance(value, str) else value
        model = value.get("model") if isinstance(value, dict) else None
        known = cast("Mapping[Any, Any]", models)
        bases[key] = known.get(model if isinstance(model, str) else None, known[default])
    course = from_mapping(Course("course", 0, WorldConfig(), **bases), values, where)
    if world is None:
        message = f"{where}: 'world' is missing; give one of {', '.join(WORLD_NAMES)} or a map file"
        raise ConfigError(message)
    if course.world.map is None:
        return course
    return replace(course, world=replace(course.world, map=str(folder / course.world.map)))
