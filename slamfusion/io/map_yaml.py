"""The YAML of a map server's map: read and checked, and written."""

from __future__ import annotations

import difflib
import logging
import math
import re
import reprlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import yaml

from slamfusion.errors import MapFileError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid, implausible
from slamfusion.io.images import cannot_read
from slamfusion.io.yaml_file import read_yaml

OCCUPIED_THRESH = 0.65
FREE_THRESH = 0.196
# A path of more characters is none.
NAME_MAX = 1000
MODES = ("trinary", "scale", "raw")

_LOG = logging.getLogger(__name__)
# Of the picture's pixels (``pixel_digest``): tells a picture of another map. Map servers ignore it.
DIGEST = "pixels_sha256"
_KEYS = (
    "image",
    "resolution",
    "origin",
    "negate",
    "occupied_thresh",
    "free_thresh",
    "mode",
    DIGEST,
)
_SAVER = "ros2 run nav2_map_server map_saver_cli -f map"
# By the end of the name: what is no map of a map server, and how to get one of it.
_NO_MAPS = {
    **dict.fromkeys(
        (".posegraph", ".data"),
        f"a pose graph of slam_toolbox; load it there, and save its map with {_SAVER}",
    ),
    ".pbstream": "a state of Cartographer; export its map with ros2 run cartographer_ros "
    "cartographer_pbstream_to_ros_map -pbstream_filename FILE -map_filestem map",
    ".json": "JSON, as of a robot vacuum; export its map as PNG, and give its cell size with "
    "--resolution",
    **dict.fromkeys(
        (".dwg", ".svg", ".pdf"),
        "a drawing; export it as PNG, walls black on white, and give metres per pixel with "
        "--resolution",
    ),
    **dict.fromkeys(
        (".bt", ".ot", ".pcd", ".ply", ".las", ".laz"),
        f"a 3D map; load it in octomap_server, and save its map with {_SAVER} -t projected_map",
    ),
    **dict.fromkeys(
        (".bag", ".db3", ".mcap", ".clf", ".log"), "a log; make its map with slamfusion run"
    ),
}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_TRUTH = {
    **dict.fromkeys(("1", "true", "yes", "on", "y"), True),
    **dict.fromkeys(("0", "false", "no", "off", "n"), False),
}


@dataclass(frozen=True)
class Rules:
    """How a brightness becomes a cell."""

    mode: str = "trinary"
    negate: bool = False
    occupied_thresh: float = OCCUPIED_THRESH
    free_thresh: float = FREE_THRESH


@dataclass(frozen=True)
class MapFile:
    """What a map's YAML says, checked.

    Attributes:
        image: the picture; may be there with ``.gz`` alone.
        resolution, origin, rules: of its cells.
        digest: of the picture's pixels; None if the YAML has none.
        named: the path that the YAML names, where nothing is there and ``image`` lies beside the
            YAML; None elsewhere.
    """

    image: Path
    resolution: float
    origin: Pose2
    rules: Rules
    digest: str | None = None
    named: str | None = None


def read_map_yaml(path: Path) -> MapFile:
    """Read and check a map's YAML."""
    kind = _NO_MAPS.get(path.suffix.lower())
    if kind is not None:
        raise MapFileError(f"{path}: wanted a map's YAML or picture, found {kind}")
    values = _parse_yaml(path)
    _refuse_misspelt_keys(path, values)
    image = _required(path, values, "image")
    if not isinstance(image, str) or not 0 < len(image) <= NAME_MAX:
        message = f"{path}: 'image' must name a file, found {reprlib.repr(image)}; name the picture"
        raise MapFileError(message)
    resolution = check_resolution(str(path), _number(_required(path, values, "resolution")))
    origin = _required(path, values, "origin")
    numbers = [_number(item) for item in origin] if isinstance(origin, list) else []
    if len(numbers) != 3 or not all(
        isinstance(item, float) and math.isfinite(item) for item in numbers
    ):
        raise MapFileError(
            f"{path}: 'origin' must be three finite numbers [x, y, yaw], "
            f"found {_shown(origin)}; write for example [0.0, 0.0, 0.0]"
        )
    reason = implausible(resolution, Pose2(*numbers))
    if reason is not None:
        raise MapFileError(f"{path}: {reason}; correct 'origin' in the YAML")
    absent = [key for key in ("negate", "occupied_thresh", "free_thresh") if key not in values]
    if absent:
        _LOG.info("%s: took the defaults for %s", path, ", ".join(absent))
    negate = values.get("negate", "0")
    if not isinstance(negate, str) or negate.lower() not in _TRUTH:
        raise MapFileError(f"{path}: 'negate' must be 0 or 1, found {_shown(negate)}; write 0 or 1")
    rules = Rules(
        mode=check_mode(str(path), values.get("mode", "trinary")),
        negate=_TRUTH[negate.lower()],
        occupied_thresh=_number(values.get("occupied_thresh", str(OCCUPIED_THRESH))),
        free_thresh=_number(values.get("free_thresh", str(FREE_THRESH))),
    )
    check_thresholds(str(path), rules)
    picture, named = path.parent / image, None
    # A path of the machine on which the map was made, with / or with \.
    name = PureWindowsPath(image).name
    if name and not _is_there(picture) and _is_there(path.parent / name):
        picture, named = path.parent / name, image
    existing(picture, f"{path}: 'image' names ")
    return MapFile(picture, resolution, Pose2(*numbers), rules, values.get(DIGEST), named)


def _is_there(path: Path) -> bool:
    with suppress(MapFileError):
        return bool(existing(path))
    return False


def _parse_yaml(path: Path) -> dict[Any, Any]:
    """Return the top mapping of a YAML file, all scalars as the text they are written in."""
    try:
        values = read_yaml(path, MapFileError, "a map's YAML", as_text=True)
    except OSError as error:
        raise cannot_read(path, error) from None
    if not isinstance(values, dict):
        found = "nothing" if values in ("", None) else f"a {type(values).__name__}"
        raise MapFileError(
            f"{path}: wanted a mapping with image, resolution and origin, found {found}; "
            "give the map's YAML"
        )
    return values


def _refuse_misspelt_keys(path: Path, values: dict[Any, Any]) -> None:
    """Refuse a key that looks like an absent known one; other foreign keys are left alone."""
    for key in values:
        if key not in _KEYS:
            near = difflib.get_close_matches(str(key), _KEYS, n=1, cutoff=0.8)
            if near and near[0] not in values:
                message = f"{path}: unknown key {_shown(key)}; write {near[0]!r} if that is meant"
                raise MapFileError(message)


def _required(path: Path, values: dict[Any, Any], key: str) -> Any:
    if key not in values:
        message = f"{path}: the key {key!r} is missing; add it, as the map server's format asks"
        raise MapFileError(message)
    return values[key]


def _number(value: Any) -> Any:
    """Return the number that a scalar's text spells; anything else unchanged, to be refused."""
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return float(value)
    return value


def _shown(value: Any) -> str:
    """Return a value from a file for a message: short, on one line, numbers without quotes."""
    if isinstance(value, float):
        return f"{value:.2f}" if value == round(value, 2) else f"{value:g}"
    if isinstance(value, list):
        return reprlib.repr(value).replace("'", "")
    return reprlib.repr(value)


def check_resolution(where: str, value: Any) -> float:
    """Return metres per cell, or say what was found instead."""
    usable = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (usable and math.isfinite(value) and value > 0):
        raise MapFileError(
            f"{where}: 'resolution' must be a positive, finite number of metres per cell, "
            f"found {value if usable else _shown(value)}; write for example 0.05"
        )
    reason = implausible(value, Pose2())
    if reason is not None:
        raise MapFileError(f"{where}: {reason}; write for example 0.05")
    return float(value)


def check_mode(where: str, mode: Any) -> str:
    """Return the mode in small letters, or name the three there are."""
    if not isinstance(mode, str) or mode.lower() not in MODES:
        raise MapFileError(
            f"{where}: 'mode' must be trinary, scale or raw, found {_shown(mode)}; "
            "write one of them or omit it"
        )
    return mode.lower()


def check_thresholds(where: str, rules: Rules) -> None:
    """Refuse thresholds that are no shares, or that cross."""
    for key, value in (
        ("free_thresh", rules.free_thresh),
        ("occupied_thresh", rules.occupied_thresh),
    ):
        usable = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (usable and 0.0 <= value <= 1.0):
            raise MapFileError(
                f"{where}: {key!r} must lie in [0, 1], found {_shown(value)}; "
                "write a share of 1 or omit it for the default"
            )
    if rules.free_thresh >= rules.occupied_thresh:
        raise MapFileError(
            f"{where}: 'free_thresh' ({_shown(float(rules.free_thresh))}) must be below "
            f"'occupied_thresh' ({_shown(float(rules.occupied_thresh))}); swap them or omit both "
            "for defaults"
        )


def existing(path: Path, prefix: str = "") -> Path:
    """Return the path, or the same with .gz where only that is there."""
    packed = path.with_name(f"{path.name}.gz") if path.name else path
    try:
        if path.exists():
            return path
        if packed.exists():
            return packed
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapFileError(f"{prefix}{path}: cannot read: {reason}; check the path") from None
    raise MapFileError(f"{prefix}{path}: no such file; check the path")


def map_yaml_text(grid: OccupancyGrid, image_name: str, rules: Rules, digest: str) -> str:
    """Return the YAML of a saved map; numbers keep every digit they need and no more."""
    origin = (grid.origin.x, grid.origin.y, grid.origin.yaw_rad)
    image = yaml.safe_dump({"image": image_name}, allow_unicode=True, width=math.inf)
    return (
        f"{image}"
        f"mode: {rules.mode}\n"
        f"resolution: {_yaml_number(grid.resolution)}\n"
        f"origin: [{', '.join(_yaml_number(value) for value in origin)}]\n"
        "negate: 0\n"
        f"occupied_thresh: {_yaml_number(rules.occupied_thresh)}\n"
        f"free_thresh: {_yaml_number(rules.free_thresh)}\n"
        f"{DIGEST}: {digest}\n"
    )


def _yaml_number(value: float) -> str:
    """Return the shortest decimal that reads back as the same number.

    YAML 1.1 takes ``1e-05`` for text: a float needs its point.
    """
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text
