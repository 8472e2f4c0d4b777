"""Maps as ROS map servers keep them: a YAML file and the picture it names.

Loading and saving follow nav2_map_server of ROS 2 Jazzy pixel for pixel (its pixel-by-pixel
``map_io``, built on 16-bit GraphicsMagick): the three colours of a pixel are averaged, in trinary
mode with alpha as a fourth; a cell is occupied *above* ``occupied_thresh`` and free *below*
``free_thresh``; saving writes 254 free, 0 occupied and 205 unknown. Row 0 of a picture is the top,
row 0 of a grid the bottom; the flip happens here and nowhere else.

Where GraphicsMagick 1.3.40 itself departs from the picture formats, the format is followed: it
drops the alpha of grey PNGs and the transparent colour of RGB ones, and scales a PGM whose maximum
does not divide 65535 by a whole number, so that its white falls short of white.
"""

from __future__ import annotations

import difflib
import logging
import math
import re
import reprlib
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import yaml

from slamfusion.errors import MapFileError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io.atomic import AtomicFiles
from slamfusion.io.images import Image, encode_image, looks_like_image, open_regular, read_image
from slamfusion.io.memory import WORKING_BYTES, check_memory

__all__ = ["load_map", "save_map"]

OCCUPIED_THRESH = 0.65
FREE_THRESH = 0.196

Cells = npt.NDArray[np.int8]
Shades = npt.NDArray[np.float64]

_LOG = logging.getLogger(__name__)
_KEYS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_TRUTH = {
    **dict.fromkeys(("1", "true", "yes", "on", "y"), True),
    **dict.fromkeys(("0", "false", "no", "off", "n"), False),
}
_YAML_LIMIT = 2**20
_BAND_PIXELS = 2**18
_QUANTUM_MAX = 65535.0


@dataclass(frozen=True)
class _Rules:
    """How a brightness becomes a cell."""

    mode: str = "trinary"
    negate: bool = False
    occupied_thresh: float = OCCUPIED_THRESH
    free_thresh: float = FREE_THRESH


@dataclass(frozen=True)
class _MapFile:
    """What a map's YAML says, checked."""

    image: Path
    resolution: float
    origin: Pose2
    rules: _Rules


def load_map(
    path: str | Path, *, resolution: float | None = None, name: str | None = None
) -> OccupancyGrid:
    """Load an occupancy grid from a map server's YAML, or from a bare picture.

    Where the YAML names ``x.pgm`` and only ``x.pgm.gz`` is there, that is read. A bare picture is
    read with the default rules (trinary, thresholds 0.65 and 0.196), its lower-left corner at the
    origin of the map frame.

    Args:
        path: the YAML, or a PGM, PNG or BMP (each also gzipped).
        resolution: metres per cell of a bare picture; must be left out for a YAML.
        name: the grid's name; default: the file's name without its endings.

    Raises:
        MapFileError: a file is missing, damaged or breaks the format's rules.
        MemoryBudgetError: the map would not fit into memory.
    """
    path = _existing(Path(path))
    if looks_like_image(path):
        if resolution is None:
            message = f"{path}: an image alone has no cell size; give --resolution or its YAML"
            raise MapFileError(message)
        entry = _MapFile(path, _check_resolution(str(path), resolution), Pose2(), _Rules())
    else:
        if resolution is not None:
            message = f"{path}: the YAML has its own resolution; leave --resolution out"
            raise MapFileError(message)
        entry = _read_yaml(path)
    image = read_image(entry.image)
    cells = _cells_from_image(image, entry.rules)
    if name is None:
        name = Path(path.name.removesuffix(".gz")).stem
    return OccupancyGrid(cells, entry.resolution, entry.origin, name)


def save_map(
    grid: OccupancyGrid,
    stem: str | Path,
    *,
    mode: str = "trinary",
    free_thresh: float = FREE_THRESH,
    occupied_thresh: float = OCCUPIED_THRESH,
    image_format: str | None = None,
) -> tuple[Path, Path]:
    """Save a grid as ``stem.yaml`` and its picture, both whole or neither.

    Loading gives the same grid back: in ``trinary`` mode the classes unknown, free (at most
    ``free_thresh``) and occupied (at least ``occupied_thresh``); in ``raw`` mode every value. In
    ``scale`` mode every value too when the thresholds are 0 and 1; with others loading stretches
    what lies between them to 0..100, as nav2 does.

    Args:
        grid: cells -1 and 0..100.
        stem: the path without its ending; missing folders are made.
        mode: ``trinary``, ``scale`` or ``raw``.
        free_thresh: written to the YAML; 0..1.
        occupied_thresh: written to the YAML; 0..1, above ``free_thresh``.
        image_format: ``pgm``, ``png`` or ``bmp``; default: ``png`` for scale, else ``pgm``.

    Returns:
        The paths of the YAML and of the picture.

    Raises:
        MapFileError: a rule above is broken, or a file cannot be written; nothing was changed.
    """
    stem = Path(stem)
    if image_format is None:
        image_format = "png" if mode == "scale" else "pgm"
    rules = _Rules(mode, negate=False, occupied_thresh=occupied_thresh, free_thresh=free_thresh)
    _check_saving(grid, stem, rules, image_format)
    yaml_path = stem.with_name(f"{stem.name}.yaml")
    image_path = stem.with_name(f"{stem.name}.{image_format}")
    bytes_per_cell = 8 if mode == "scale" else 3
    what = f"saving a {grid.width} x {grid.height} map"
    check_memory(bytes_per_cell * grid.cells.size + WORKING_BYTES, what, str(image_path))
    pixels = _pixels_from_cells(grid.cells, rules, image_format)
    text = _yaml_text(grid, image_path.name, rules)
    with AtomicFiles() as files:
        if image_format == "pgm":
            header = f"P5\n{grid.width} {grid.height}\n255\n".encode()
            files.add(image_path, header, pixels.data.cast("B"))
        else:
            files.add(image_path, encode_image(pixels, image_format, str(image_path)))
        files.add(yaml_path, text.encode())
    return yaml_path, image_path


# --- the YAML ------------------------------------------------------------------------------------


def _read_yaml(path: Path) -> _MapFile:
    """Read and check a map's YAML."""
    values = _parse_yaml(path)
    _refuse_misspelt_keys(path, values)
    image = _required(path, values, "image")
    if not isinstance(image, str) or not image:
        message = f"{path}: 'image' must name a file, found {reprlib.repr(image)}; name the picture"
        raise MapFileError(message)
    resolution = _check_resolution(str(path), _number(_required(path, values, "resolution")))
    origin = _required(path, values, "origin")
    numbers = [_number(item) for item in origin] if isinstance(origin, list) else []
    if len(numbers) != 3 or not all(
        isinstance(item, float) and math.isfinite(item) for item in numbers
    ):
        message = (
            f"{path}: 'origin' must be three finite numbers [x, y, yaw], "
            f"found {_shown(origin)}; write for example [0.0, 0.0, 0.0]"
        )
        raise MapFileError(message)
    absent = [key for key in ("negate", "occupied_thresh", "free_thresh") if key not in values]
    if absent:
        _LOG.info("%s: took the defaults for %s", path, ", ".join(absent))
    negate = values.get("negate", "0")
    if not isinstance(negate, str) or negate.lower() not in _TRUTH:
        message = f"{path}: 'negate' must be 0 or 1, found {_shown(negate)}; write 0 or 1"
        raise MapFileError(message)
    rules = _Rules(
        mode=_check_mode(str(path), values.get("mode", "trinary")),
        negate=_TRUTH[negate.lower()],
        occupied_thresh=_number(values.get("occupied_thresh", str(OCCUPIED_THRESH))),
        free_thresh=_number(values.get("free_thresh", str(FREE_THRESH))),
    )
    _check_thresholds(str(path), rules)
    picture = _existing(path.parent / image, f"{path}: 'image' names ")
    return _MapFile(picture, resolution, Pose2(*numbers), rules)


def _parse_yaml(path: Path) -> dict[Any, Any]:
    """Return the top mapping of a YAML file, all scalars as the text they are written in."""
    with open_regular(path) as file:
        data = file.read(_YAML_LIMIT + 1)
    if len(data) > _YAML_LIMIT or b"\x00" in data:
        message = f"{path}: wanted a map's YAML, found binary or endless data; give the YAML file"
        raise MapFileError(message)
    try:
        # BaseLoader builds text, lists and mappings only, so 1e-3 and 0.05 stay as written.
        values = yaml.load(data.decode("utf-8-sig"), Loader=yaml.BaseLoader)  # noqa: S506
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        message = f"{path}: not YAML ({reason}); mend the file or give the map's YAML"
        raise MapFileError(message) from None
    if not isinstance(values, dict):
        found = "nothing" if values in ("", None) else f"a {type(values).__name__}"
        message = (
            f"{path}: wanted a mapping with image, resolution and origin, found {found}; "
            "give the map's YAML"
        )
        raise MapFileError(message)
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
    """Return the value of a key that has no default."""
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


def _check_resolution(where: str, value: Any) -> float:
    """Return metres per cell, or say what was found instead."""
    usable = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (usable and math.isfinite(value) and value > 0):
        message = (
            f"{where}: 'resolution' must be a positive, finite number of metres per cell, "
            f"found {value if usable else _shown(value)}; write for example 0.05"
        )
        raise MapFileError(message)
    return float(value)


def _check_mode(where: str, mode: Any) -> str:
    """Return the mode in small letters, or name the three there are."""
    if not isinstance(mode, str) or mode.lower() not in _MODES:
        message = (
            f"{where}: 'mode' must be trinary, scale or raw, found {_shown(mode)}; "
            "write one of them or omit it"
        )
        raise MapFileError(message)
    return mode.lower()


def _check_thresholds(where: str, rules: _Rules) -> None:
    """Refuse thresholds that are no shares, or that cross."""
    for key, value in (
        ("free_thresh", rules.free_thresh),
        ("occupied_thresh", rules.occupied_thresh),
    ):
        usable = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (usable and 0.0 <= value <= 1.0):
            message = (
                f"{where}: {key!r} must lie in [0, 1], found {_shown(value)}; "
                "write a share of 1 or omit it for the default"
            )
            raise MapFileError(message)
    if rules.free_thresh >= rules.occupied_thresh:
        message = (
            f"{where}: 'free_thresh' ({_shown(float(rules.free_thresh))}) must be below "
            f"'occupied_thresh' ({_shown(float(rules.occupied_thresh))}); swap them or omit both "
            "for defaults"
        )
        raise MapFileError(message)


def _existing(path: Path, prefix: str = "") -> Path:
    """Return the path, or the same with .gz where only that is there."""
    packed = path.with_name(f"{path.name}.gz") if path.name else path
    try:
        if path.exists():
            return path
        if packed.exists():
            return packed
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        message = f"{prefix}{path}: cannot read: {reason}; check the path"
        raise MapFileError(message) from None
    message = f"{prefix}{path}: no such file; check the path"
    raise MapFileError(message)


def _yaml_text(grid: OccupancyGrid, image_name: str, rules: _Rules) -> str:
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
    )


def _yaml_number(value: float) -> str:
    """Return the shortest decimal that reads back as the same number.

    YAML 1.1 takes ``1e-05`` for text: a float needs its point.
    """
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text


# --- brightness to cells -------------------------------------------------------------------------


def _trinary_cells(shade: Shades, rules: _Rules) -> Cells:
    """Three classes; both comparisons strict."""
    occupancy = shade if rules.negate else 1.0 - shade
    cells = np.full(shade.shape, UNKNOWN, dtype=np.int8)
    cells[occupancy < rules.free_thresh] = FREE
    cells[occupancy > rules.occupied_thresh] = OCCUPIED
    return cells


def _scale_cells(shade: Shades, rules: _Rules) -> Cells:
    """Linear between the thresholds, rounded half to even."""
    occupancy = shade if rules.negate else 1.0 - shade
    span = rules.occupied_thresh - rules.free_thresh
    between = np.rint((occupancy - rules.free_thresh) / span * 100.0)
    # At a threshold itself the linear rule gives 0 or 100 as well, so clipping is the whole rule.
    return np.clip(between, FREE, OCCUPIED).astype(np.int8)


def _raw_cells(shade: Shades, rules: _Rules) -> Cells:
    """The 8-bit value itself up to 100, unknown above; ``negate`` has no say."""
    del rules
    value = np.floor(shade * 255.0 + 0.5)
    return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)


_MODES: dict[str, Callable[[Shades, _Rules], Cells]] = {
    "trinary": _trinary_cells,
    "scale": _scale_cells,
    "raw": _raw_cells,
}


def _cells_from_image(image: Image, rules: _Rules) -> Cells:
    """Return the cells (H, W) of a picture, bottom row first, read-only."""
    to_cells = _MODES[rules.mode]
    if image.pixels.ndim == 2:
        values = np.arange(image.maxval + 1)
        cells = _look_up_flipped(image.pixels, to_cells(_shade(values, image.maxval), rules))
    else:
        height, width = image.pixels.shape[:2]
        cells = np.empty((height, width), dtype=np.int8)
        for top, bottom in _bands(height, width):
            band = image.pixels[top:bottom][::-1]
            cells[height - bottom : height - top] = _colour_cells(band, image.maxval, rules)
    cells.flags.writeable = False
    return cells


def _colour_cells(band: npt.NDArray[Any], maxval: int, rules: _Rules) -> Cells:
    """Return the cells of colour pixels (H, W, 3), or (H, W, 4) with alpha."""
    # nav2 keeps what its forerunner did: in trinary mode alpha is averaged in like a colour, so
    # that a fully opaque pixel looks brighter than its colours.
    averaged = band if rules.mode == "trinary" else band[..., :3]
    channels = averaged.shape[-1]
    quanta = _quanta(averaged, maxval).sum(axis=-1)
    cells = _MODES[rules.mode](quanta / channels / _QUANTUM_MAX, rules)
    if rules.mode == "scale" and band.shape[-1] == 4:
        cells[band[..., 3] != maxval] = UNKNOWN
    return cells


def _shade(values: npt.NDArray[Any], maxval: int) -> Shades:
    """Return brightness 0..1 of grey values, in the 16-bit steps of nav2's image library."""
    return _quanta(values, maxval) / _QUANTUM_MAX


def _quanta(values: npt.NDArray[Any], maxval: int) -> Shades:
    """Return values 0..maxval as whole numbers 0..65535."""
    return np.floor(values.astype(np.float64) * (_QUANTUM_MAX / maxval) + 0.5)


def _look_up_flipped(values: npt.NDArray[Any], table: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return ``table[values]`` upside down, a band of rows at a time to spare memory."""
    height, width = values.shape
    result = np.empty((height, width), dtype=table.dtype)
    padded = np.resize(table, 256) if values.dtype == np.uint8 else table
    for top, bottom in _bands(height, width):
        band = values[top:bottom]
        looked_up = cv2.LUT(band, padded) if values.dtype == np.uint8 else padded[band]
        result[height - bottom : height - top] = looked_up[::-1]
    return result


def _bands(height: int, width: int) -> list[tuple[int, int]]:
    """Return half-open ranges of rows, each small enough for the processor to keep at hand."""
    rows = max(_BAND_PIXELS // width, 1)
    return [(top, min(top + rows, height)) for top in range(0, height, rows)]


# --- cells to pixels -----------------------------------------------------------------------------


def _check_saving(grid: OccupancyGrid, stem: Path, rules: _Rules, image_format: str) -> None:
    """Refuse what could not be loaded back as the same map."""
    where = str(stem)
    try:
        kind = stat.S_IFMT(stem.stat().st_mode)
    except (OSError, ValueError):  # nothing there, or writing will say what is wrong
        kind = stat.S_IFREG
    if stem.name in {"", ".."} or kind not in {stat.S_IFREG, stat.S_IFDIR}:
        message = f"{where}: cannot write: a device or no file name; give a path such as out/map"
        raise MapFileError(message)
    _check_mode(where, rules.mode)
    _check_thresholds(where, rules)
    if image_format not in {"pgm", "png", "bmp"}:
        message = f"{where}: image format must be pgm, png or bmp, found {image_format!r}; use pgm"
        raise MapFileError(message)
    if rules.mode == "scale" and image_format != "png" and (grid.cells == UNKNOWN).any():
        message = (
            f"{where}: mode scale keeps unknown cells in the alpha channel, which {image_format} "
            "has not; use png"
        )
        raise MapFileError(message)
    if rules.mode == "trinary":
        read_back = _trinary_cells(_shade(np.array([254, 205, 0]), 255), rules)
        if read_back.tolist() != [FREE, UNKNOWN, OCCUPIED]:
            message = (
                f"{where}: with free_thresh {rules.free_thresh:g} and occupied_thresh "
                f"{rules.occupied_thresh:g} the saved greys 254, 205, 0 would not load as free, "
                f"unknown, occupied; use {FREE_THRESH} and {OCCUPIED_THRESH}"
            )
            raise MapFileError(message)


def _pixels_from_cells(cells: Cells, rules: _Rules, image_format: str) -> npt.NDArray[np.uint8]:
    """Return the picture of the cells, top row first: grey, or grey as colours and alpha."""
    # The table is indexed with the cell's byte, so unknown (-1) stands at 255.
    table = np.full(256, 205, dtype=np.uint8)
    value = np.arange(OCCUPIED + 1)
    if rules.mode == "trinary":
        table[: OCCUPIED + 1][value >= np.rint(rules.occupied_thresh * 100.0)] = 0
        table[: OCCUPIED + 1][value <= np.rint(rules.free_thresh * 100.0)] = 254
    elif rules.mode == "raw":
        table[: OCCUPIED + 1] = value
        table[255] = 255
    else:
        # nav2's image library cuts to 16 bits, and cuts those to 8.
        table[: OCCUPIED + 1] = (((100 - value) / 100.0 * _QUANTUM_MAX).astype(np.int64)) // 257
        table[255] = 127
    grey: npt.NDArray[np.uint8] = _look_up_flipped(cells.view(np.uint8), table)
    if rules.mode != "scale" or image_format != "png":
        return grey
    opaque = np.full(256, 255, dtype=np.uint8)
    opaque[255] = 0
    alpha = _look_up_flipped(cells.view(np.uint8), opaque)
    return np.dstack((grey, grey, grey, alpha))
