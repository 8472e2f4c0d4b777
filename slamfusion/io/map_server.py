"""Maps as ROS map servers keep them: a YAML file and the picture it names.

Loading and saving follow nav2_map_server of ROS 2 Jazzy pixel for pixel (its pixel-by-pixel
``map_io``, built on 16-bit GraphicsMagick): the three colours of a pixel are averaged, in trinary
mode with alpha as a fourth; a cell is occupied *above* ``occupied_thresh`` and free *below*
``free_thresh``; saving writes 254 free, 0 occupied and 205 unknown. Row 0 of a picture is the top,
row 0 of a grid the bottom; the flip happens here and nowhere else.

Departures from GraphicsMagick 1.3.40, to follow the picture formats: it drops the alpha of grey
PNGs and the transparent colour of RGB ones, and a PGM whose maximum does not divide 65535 is scaled
by a whole number, so that its white is too dark.
"""

from __future__ import annotations

import difflib
import logging
import math
import re
import reprlib
import stat
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from slamfusion.config import NormalizeConfig
from slamfusion.errors import MapFileError, counted
from slamfusion.geometry import B8, F64, I8, U8, Pose2
from slamfusion.grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    implausible,
    row_parts,
    trinary_cells,
)
from slamfusion.io.files import WORKING_BYTES, AtomicFiles, check_memory
from slamfusion.io.images import (
    Pixels,
    cannot_read,
    encode_image,
    looks_like_image,
    pixel_digest,
    read_image,
)
from slamfusion.io.lines import KINDS, saved_files
from slamfusion.io.yaml_file import read_yaml

_LOG = logging.getLogger(__name__)

# What map savers write.
FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY = 254, 205, 0
_QUANTUM_MAX = 65535.0
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
# The thresholds of the vote: what is saved is what votes.
VOTE = NormalizeConfig()
# A writer replaces the picture and, within a millisecond, the YAML.
READ_TIMES, WAIT_S = 20, 0.01
# Longest path in a YAML, characters.
NAME_MAX = 1000
# Digest of the picture's pixels: detects a picture of another map. Map servers ignore it.
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
# Files by suffix that are not maps of a map server, and how to get a map from them.
_NO_MAPS = {
    **dict.fromkeys(
        (".posegraph", ".data"),
        f"a pose graph of slam_toolbox; load it there, and save its map with {_SAVER}",
    ),
    ".pbstream": "a state of Cartographer; export its map with ros2 run cartographer_ros "
    "cartographer_pbstream_to_ros_map -pbstream_filename FILE -map_filestem map",
    ".json": "JSON; next to results is their map as YAML, and a robot vacuum exports its map as "
    "PNG, for which give the cell size with --resolution",
    **dict.fromkeys(
        (".dwg", ".svg", ".pdf"),
        "a drawing; export it as PNG, walls black on white, and give metres per pixel with "
        "--resolution",
    ),
    **dict.fromkeys(
        (".bt", ".ot", ".pcd", ".ply", ".las", ".laz"),
        f"a 3D map; load it in octomap_server, and save its map with {_SAVER} -t projected_map",
    ),
    **dict.fromkeys((".tum", ".csv"), KINDS[".tum"]),
    **dict.fromkeys(
        (".bag", ".db3", ".mcap", ".clf", ".log"), "a log; make its map with slamfusion run"
    ),
}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_TRUTH = {
    **dict.fromkeys(("1", "true", "yes", "on", "y"), True),
    **dict.fromkeys(("0", "false", "no", "off", "n"), False),
}


# --- pixels and cells ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Rules:
    """How a brightness becomes a cell."""

    mode: str = "trinary"
    negate: bool = False
    occupied_thresh: float = OCCUPIED_THRESH
    free_thresh: float = FREE_THRESH

    def check(self, where: str) -> None:
        """Refuse an unknown mode, and thresholds outside [0, 1] or in the wrong order."""
        if self.mode not in _MODES:
            wanted = "be trinary, scale or raw"
            raise _wrong(where, "mode", wanted, self.mode, "write one of them or omit it")
        for key in ("free_thresh", "occupied_thresh"):
            value = getattr(self, key)
            usable = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (usable and 0.0 <= value <= 1.0):
                advice = "write a share of 1 or omit it for the default"
                raise _wrong(where, key, "lie in [0, 1]", value, advice)
        if self.free_thresh >= self.occupied_thresh:
            raise MapFileError(
                f"{where}: 'free_thresh' ({_shown(float(self.free_thresh))}) must be below "
                f"'occupied_thresh' ({_shown(float(self.occupied_thresh))}); swap them or omit "
                "both for defaults"
            )


def _trinary_cells(shade: F64, rules: Rules) -> I8:
    """Three classes; both comparisons strict."""
    occupancy = shade if rules.negate else 1.0 - shade
    cells = np.full(shade.shape, UNKNOWN, dtype=np.int8)
    cells[occupancy < rules.free_thresh] = FREE
    cells[occupancy > rules.occupied_thresh] = OCCUPIED
    return cells


def _scale_cells(shade: F64, rules: Rules) -> I8:
    """Linear between the thresholds, rounded half to even."""
    occupancy = shade if rules.negate else 1.0 - shade
    span = rules.occupied_thresh - rules.free_thresh
    between = np.rint((occupancy - rules.free_thresh) / span * 100.0)
    # At the thresholds the linear rule gives 0 and 100.
    return np.clip(between, FREE, OCCUPIED).astype(np.int8)


def _raw_cells(shade: F64, rules: Rules) -> I8:
    """The 8-bit value itself up to 100, unknown above; ``negate`` is ignored."""
    del rules
    value = np.floor(shade * 255.0 + 0.5)
    return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)


_MODES: dict[str, Callable[[F64, Rules], I8]] = {
    "trinary": _trinary_cells,
    "scale": _scale_cells,
    "raw": _raw_cells,
}


def cells_from_image(
    pixels: Pixels, rules: Rules, *, legacy_unknown: bool = False
) -> tuple[I8, int]:
    """Return the cells of a picture, and the number of unknown cells that do not read so.

    Those have the grey that map savers write for unknown, but trinary thresholds, an alpha channel
    (which brightens) or ``negate`` make them free or occupied. ``legacy_unknown`` reads them as
    unknown if the map is not negated.

    Args:
        pixels: (H, W), (H, W, 3) or (H, W, 4), uint8 or uint16, top row first.

    Returns:
        (H, W) int8, bottom row first, read-only; and the count, with and without
        ``legacy_unknown``.
    """
    maxval = int(np.iinfo(pixels.dtype).max)
    grey = UNKNOWN_GREY * maxval // 255
    may_be_unknown = rules.mode == "trinary"
    # A map with this grey is hardly negated, so free and occupied would stay exchanged.
    legacy_unknown = legacy_unknown and not rules.negate
    count = 0
    if pixels.ndim == 2:
        shades = _quanta(np.arange(maxval + 1), maxval) / _QUANTUM_MAX
        table = _MODES[rules.mode](shades, rules)
        if may_be_unknown and table[grey] != UNKNOWN:
            count = int(np.count_nonzero(pixels == grey))
            if legacy_unknown:
                table[grey] = UNKNOWN
        cells = table[pixels[::-1]]
    else:
        height, width = pixels.shape[:2]
        cells = np.empty((height, width), dtype=np.int8)
        for part in row_parts((height, width)):
            band = pixels[part]
            own = _colour_cells(band, maxval, rules)
            if may_be_unknown:
                is_grey = (band[..., :3] == grey).all(axis=-1) & (own != UNKNOWN)
                count += int(np.count_nonzero(is_grey))
                if legacy_unknown:
                    own[is_grey] = UNKNOWN
            cells[::-1][part] = own
    cells.flags.writeable = False
    return cells, count


def _colour_cells(band: npt.NDArray[Any], maxval: int, rules: Rules) -> I8:
    # As in nav2, trinary mode averages alpha in like a colour, so that an opaque pixel is brighter.
    averaged = band if rules.mode == "trinary" else band[..., :3]
    channels = averaged.shape[-1]
    quanta = _quanta(averaged, maxval).sum(axis=-1)
    cells = _MODES[rules.mode](quanta / channels / _QUANTUM_MAX, rules)
    if rules.mode == "scale" and band.shape[-1] == 4:
        cells[band[..., 3] != maxval] = UNKNOWN
    return cells


def _quanta(values: npt.NDArray[Any], maxval: int) -> F64:
    """Return values 0..maxval as integers 0..65535, as nav2's image library does."""
    return np.floor(values.astype(np.float64) * (_QUANTUM_MAX / maxval) + 0.5)


def with_settled_edges(cells: I8, pixels: Pixels, rules: Rules) -> I8:
    """Return cells in which grey cells on the edge of a wall are occupied or free.

    Anti-aliased drawings and probability maps have one or two grey cells between a wall and free
    ground. They are decided at 50 %. The grey of unknown cells, and grey cells elsewhere, stay.

    Args:
        cells: (H, W) int8, as ``cells_from_image`` returns them.
    """
    percent = cells
    if rules.mode == "trinary":
        whole = replace(rules, mode="scale", free_thresh=0.0, occupied_thresh=1.0)
        percent = cells_from_image(pixels, whole)[0]
    classes = trinary_cells(cells, NormalizeConfig())
    between = (classes == UNKNOWN) & (percent != UNKNOWN)
    if rules.mode == "trinary":
        between &= percent != round(100.0 * (1.0 - UNKNOWN_GREY / 255.0))
    if not between.any():
        return cells
    import cv2  # noqa: PLC0415  (loads slowly; who saves maps needs none)

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))

    def reached(kind: int) -> tuple[B8, B8]:
        """Return the grey cells one step, and at most two steps, from a class."""
        near = [np.asarray(classes == kind)]
        for _ in range(2):
            near.append(between & (cv2.dilate(near[-1].view(np.uint8), cross) > 0))
        return near[1], near[1] | near[2]

    (wall, walls), (free, frees) = reached(1), reached(0)
    is_edge = (wall & frees) | (walls & free)
    settled = np.where(is_edge, np.where(percent >= 50, OCCUPIED, FREE), cells).astype(np.int8)
    settled.flags.writeable = False
    return settled


def pixels_from_cells(cells: I8, rules: Rules, image_format: str, classes: NormalizeConfig) -> U8:
    """Return the picture of the cells, top row first: grey, or grey as colours and alpha.

    Args:
        cells: (H, W) int8, -1 unknown, 0..100 percent; bottom row first.
    """
    # Indexed with the cell's byte: unknown (-1) is 255.
    table = np.full(256, UNKNOWN_GREY, dtype=np.uint8)
    value = np.arange(OCCUPIED + 1)
    if rules.mode == "trinary":
        voted = trinary_cells(value.astype(np.int8), classes)
        table[: OCCUPIED + 1][voted == 1] = OCCUPIED_GREY
        table[: OCCUPIED + 1][voted == 0] = FREE_GREY
    elif rules.mode == "raw":
        table[: OCCUPIED + 1] = value
        table[255] = 255
    else:
        # nav2's image library truncates to 16 bits, then to 8.
        table[: OCCUPIED + 1] = (((100 - value) / 100.0 * _QUANTUM_MAX).astype(np.int64)) // 257
        table[255] = 127
    flipped = cells.view(np.uint8)[::-1]
    grey: U8 = table[flipped]
    if rules.mode != "scale" or image_format != "png":
        return grey
    opaque = np.full(256, 255, dtype=np.uint8)
    opaque[255] = 0
    return np.dstack((grey, grey, grey, opaque[flipped]))


# --- reading -------------------------------------------------------------------------------------


def load_map(
    path: str | Path,
    *,
    resolution: float | None = None,
    name: str | None = None,
    legacy_unknown: bool = False,
    settle_edges: bool = False,
    warn: Callable[[str], None] = _LOG.warning,
) -> OccupancyGrid:
    """Load an occupancy grid from a map server's YAML, a bare picture or a DXF drawing.

    If the YAML names ``x.pgm`` and only ``x.pgm.gz`` exists, that is read; if the picture's path
    does not exist, a picture of that name next to the YAML is read, with a warning. A bare picture
    is read with the default rules (trinary, thresholds 0.65 and 0.196), its lower-left corner at
    the origin of the map frame.

    The YAML of ``save_map`` holds a digest of the pixels. If it does not match, both files are read
    again, in case another process is replacing them, and then refused.

    Map savers write grey 205 for unknown; with ``free_thresh`` above 0.196 or an alpha channel it
    reads as free, with ``negate`` as occupied, as in nav2, with a warning.

    Args:
        path: the YAML, or a PGM, PNG or BMP (each also gzipped), or a DXF drawing.
        resolution: metres per cell of a bare picture or a drawing (see ``read_dxf``); not for a
            YAML.
        name: default: the file's name without its endings.
        legacy_unknown: read grey 205 as unknown.
        settle_edges: read grey cells between a wall and free ground as one of both
            (``with_settled_edges``); nav2 reads them as unknown.

    Raises:
        MapFileError: a file is missing, damaged or breaks the format's rules.
        MemoryBudgetError: the map would not fit into memory.
    """
    path = existing(Path(path))
    stem = Path(path.name.removesuffix(".gz")).stem
    if path.suffix.lower() == ".dxf":
        from slamfusion.io.dxf import read_dxf  # noqa: PLC0415  (OpenCV loads slowly)

        cells, resolution, corner = read_dxf(path, resolution)
        return OccupancyGrid(cells, resolution, Pose2(*corner), name or stem)
    kind = _NO_MAPS.get(Path(path.name.lower().removesuffix(".gz")).suffix)
    if kind is not None:
        raise MapFileError(f"{path}: wanted a map's YAML or picture, found {kind}")
    if looks_like_image(path):
        if resolution is None:
            raise MapFileError(
                f"{path}: an image alone has no cell size; give --resolution or its YAML, or find "
                f"it with: slamfusion align MAP {path} --scale free"
            )
        entry = MapFile(path, _checked_resolution(path, resolution), Pose2(), Rules())
        pixels = read_image(path)
    else:
        if resolution is not None:
            raise MapFileError(f"{path}: the YAML has its own resolution; leave --resolution out")
        entry, pixels = _entry_with_picture(path)
    cells, count = cells_from_image(pixels, entry.rules, legacy_unknown=legacy_unknown)
    if settle_edges:
        plain, cells = cells, with_settled_edges(cells, pixels, entry.rules)
        settled = np.count_nonzero(plain != cells)
        if settled:
            warn(
                f"{path}: {settled} grey cells between walls and free ground, as drawings have, "
                "are measured as wall or free, whichever is nearer"
            )
    if entry.named is not None:
        warn(
            f"{path}: its picture {entry.named!r} is not there; read instead: {entry.image.name} "
            "next to the YAML"
        )
    if count and (entry.rules.negate or not legacy_unknown):
        warn(
            f"{path}: {counted(count, 'cell')} of grey 205, which map savers write for unknown, "
            "cannot be read as unknown "
            f"{_why_known(entry.rules, has_alpha=pixels.shape[2:] == (4,))}"
        )
    return OccupancyGrid(cells, entry.resolution, entry.origin, name or stem)


def _why_known(rules: Rules, *, has_alpha: bool) -> str:
    """Return why the grey of unknown cells does not read as unknown, and what to do."""
    if rules.negate:
        return "because 'negate' is set; write negate: 0 if the walls are black"
    cause, advice = f"under 'free_thresh' {rules.free_thresh:g}", "write free_thresh: 0.196"
    if has_alpha:
        cause = "because map servers average the alpha channel in"
        advice = "save it without alpha"
    option = "--legacy-unknown (nodes: legacy_unknown:=true)"
    return f"{cause}; read them so with {option}, or {advice}"


def _entry_with_picture(path: Path) -> tuple[MapFile, Pixels]:
    """Read a YAML and its picture; again if they do not match."""
    for _ in range(READ_TIMES):
        entry = read_map_yaml(path)
        pixels = read_image(existing(entry.image))
        if entry.digest in {None, pixel_digest(pixels)}:
            return entry, pixels
        time.sleep(WAIT_S)
    raise MapFileError(
        f"{path}: its picture {entry.image.name} belongs to another map or was edited; save the "
        f"map again, or delete the line {DIGEST!r} from the YAML to use both as they are"
    )


@dataclass(frozen=True)
class MapFile:
    """The checked content of a map's YAML.

    Attributes:
        image: may exist with ``.gz`` only.
        digest: of the picture's pixels; None if the YAML has none.
        named: the path in the YAML, if ``image`` was found next to the YAML instead.
    """

    image: Path
    resolution: float
    origin: Pose2
    rules: Rules
    digest: str | None = None
    named: str | None = None


def read_map_yaml(path: Path) -> MapFile:
    """Read and check a map's YAML."""
    values = _yaml_values(path)
    image, origin = values["image"], values["origin"]
    if not isinstance(image, str) or not 0 < len(image) <= NAME_MAX:
        raise _wrong(path, "image", "name a file", image, "name the picture")
    resolution = _checked_resolution(path, _number(values["resolution"]))
    numbers = [_number(item) for item in origin] if isinstance(origin, list) else []
    if len(numbers) != 3 or not all(
        isinstance(item, float) and math.isfinite(item) for item in numbers
    ):
        wanted = "be three finite numbers [x, y, yaw]"
        raise _wrong(path, "origin", wanted, origin, "write for example [0.0, 0.0, 0.0]")
    reason = implausible(resolution, Pose2(*numbers))
    if reason is not None:
        raise MapFileError(f"{path}: {reason}; correct 'origin' in the YAML")
    absent = [key for key in ("negate", "occupied_thresh", "free_thresh") if key not in values]
    if absent:
        _LOG.info("%s: took the defaults for %s", path, ", ".join(absent))
    negate = values.get("negate", "0")
    if not isinstance(negate, str) or negate.lower() not in _TRUTH:
        raise _wrong(path, "negate", "be 0 or 1", negate, "write 0 or 1")
    mode = values.get("mode", "trinary")
    rules = Rules(
        mode=mode.lower() if isinstance(mode, str) else mode,
        negate=_TRUTH[negate.lower()],
        occupied_thresh=_number(values.get("occupied_thresh", str(OCCUPIED_THRESH))),
        free_thresh=_number(values.get("free_thresh", str(FREE_THRESH))),
    )
    rules.check(str(path))
    picture, named = path.parent / image, None
    # The path may be of another machine, with / or \.
    name = PureWindowsPath(image).name
    if name and not _is_there(picture) and _is_there(path.parent / name):
        picture, named = path.parent / name, image
    existing(picture, f"{path}: 'image' names ")
    return MapFile(picture, resolution, Pose2(*numbers), rules, values.get(DIGEST), named)


def _is_there(path: Path) -> bool:
    with suppress(MapFileError):
        return bool(existing(path))
    return False


def _yaml_values(path: Path) -> dict[Any, Any]:
    """Return the top mapping of a map's YAML, all scalars as text."""
    try:
        values = read_yaml(path, MapFileError, "a map's YAML", as_text=True)
    except OSError as error:
        raise cannot_read(path, error) from None
    if not isinstance(values, dict) or not values.keys() & {*_KEYS}:
        keys = [*values] if isinstance(values, dict) else values
        found = _shown(keys) if keys else "nothing"
        raise MapFileError(
            f"{path}: wanted a mapping with image, resolution and origin, found {found}; "
            "give the map's YAML"
        )
    for key in values:  # a key close to a missing known one; others are ignored
        near = difflib.get_close_matches(str(key), _KEYS, n=1, cutoff=0.8)
        if key not in _KEYS and near and near[0] not in values:
            message = f"{path}: unknown key {_shown(key)}; write {near[0]!r} if that is meant"
            raise MapFileError(message)
    for key in ("image", "resolution", "origin"):
        if key not in values:
            message = f"{path}: the key {key!r} is missing; add it, as the map server's format asks"
            raise MapFileError(message)
    return values


def _wrong(where: Path | str, key: str, wanted: str, value: Any, advice: str) -> MapFileError:
    return MapFileError(f"{where}: {key!r} must {wanted}, found {_shown(value)}; {advice}")


def _number(value: Any) -> Any:
    """Return the number that a text spells; anything else unchanged."""
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return float(value)
    return value


def _shown(value: Any) -> str:
    """Return a value from a file for a message: short, on one line."""
    if isinstance(value, float):
        return f"{value:.2f}" if value == round(value, 2) else f"{value:g}"
    if isinstance(value, list):
        return reprlib.repr(value).replace("'", "")
    return reprlib.repr(value)


def _checked_resolution(where: Path, value: Any) -> float:
    usable = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (usable and math.isfinite(value) and value > 0):
        wanted = "be a positive, finite number of metres per cell"
        raise _wrong(where, "resolution", wanted, value, "write for example 0.05")
    reason = implausible(value, Pose2())
    if reason is not None:
        raise MapFileError(f"{where}: {reason}; write for example 0.05")
    return float(value)


def existing(path: Path, prefix: str = "") -> Path:
    """Return the path, or the same with .gz if only that exists."""
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


# --- saving --------------------------------------------------------------------------------------


def map_sources(path: Path) -> list[Path]:
    """Return the files that ``load_map`` reads; of an unreadable map those that are known."""
    files = [path]
    with suppress(MapFileError):
        files.append(existing(path))
        if not looks_like_image(files[-1]):
            files.append(read_map_yaml(files[-1]).image)
            files.append(existing(files[-1]))
    return files


def save_map(
    grid: OccupancyGrid,
    stem: str | Path,
    *,
    mode: str = "trinary",
    free_thresh: float = FREE_THRESH,
    occupied_thresh: float = OCCUPIED_THRESH,
    image_format: str | None = None,
    classes: NormalizeConfig = VOTE,
) -> tuple[Path, Path]:
    """Save a grid as its picture and ``stem.yaml``; see ``AtomicFiles``.

    ``trinary`` saves unknown 205, free 254, occupied 0; loading gives the same classes, here and
    in nav2. ``raw`` keeps every value; ``scale`` too if the thresholds are 0 and 1, otherwise
    loading stretches the values between them to 0..100, as nav2 does.

    Args:
        grid: cells -1 and 0..100.
        stem: the path without its ending; missing folders are made.
        mode: ``trinary``, ``scale`` or ``raw``.
        free_thresh: written to the YAML; 0..1.
        occupied_thresh: written to the YAML; 0..1, above ``free_thresh``.
        image_format: ``pgm``, ``png`` or ``bmp``; default: ``png`` for scale, else ``pgm``.
        classes: thresholds of free and occupied in ``trinary`` mode.

    Returns:
        The paths of the YAML and of the picture.

    Raises:
        MapFileError: a rule above is broken, the resolution or origin is ``implausible``, or a file
            cannot be written; nothing was changed.
    """
    stem = Path(stem)
    yaml_path, image_path = saved_files(stem, mode, image_format)
    image_format = image_path.suffix.removeprefix(".")
    rules = Rules(mode, negate=False, occupied_thresh=occupied_thresh, free_thresh=free_thresh)
    _check_saving(grid, stem, rules, image_format)
    bytes_per_cell = 12 if mode == "scale" else 4
    what = f"saving a {grid.width} x {grid.height} map"
    check_memory(bytes_per_cell * grid.cells.size + WORKING_BYTES, what, str(image_path))
    pixels = pixels_from_cells(grid.cells, rules, image_format, classes)
    text = _yaml_text(grid, image_path.name, rules, pixel_digest(pixels))
    with AtomicFiles() as files:
        files.add(image_path, encode_image(pixels, image_format))
        files.add(yaml_path, text.encode())
    return yaml_path, image_path


def _check_saving(grid: OccupancyGrid, stem: Path, rules: Rules, image_format: str) -> None:
    where = str(stem)
    try:
        kind = stat.S_IFMT(stem.stat().st_mode)
    except (OSError, ValueError):  # absent; other errors are reported on writing
        kind = stat.S_IFREG
    if stem.name in {"", ".."} or kind not in {stat.S_IFREG, stat.S_IFDIR}:
        message = f"{where}: cannot write: a device or no file name; give a path such as out/map"
        raise MapFileError(message)
    reason = implausible(grid.resolution, grid.origin)
    if reason is not None:
        message = f"{where}: cannot write: {reason}; correct the map's resolution or origin"
        raise MapFileError(message)
    rules.check(where)
    if image_format not in {"pgm", "png", "bmp"}:
        message = f"{where}: image format must be pgm, png or bmp, found {image_format!r}; use pgm"
        raise MapFileError(message)
    if rules.mode == "scale" and image_format != "png" and (grid.cells == UNKNOWN).any():
        raise MapFileError(
            f"{where}: mode scale keeps unknown cells in the alpha channel, which {image_format} "
            "has not; use png"
        )
    greys = _quanta(np.array([FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY]), 255) / _QUANTUM_MAX
    as_read = _trinary_cells(greys, rules).tolist()
    if rules.mode == "trinary" and as_read != [FREE, UNKNOWN, OCCUPIED]:
        raise MapFileError(
            f"{where}: with free_thresh {rules.free_thresh:g} and occupied_thresh "
            f"{rules.occupied_thresh:g} the saved greys 254, 205, 0 would not load as free, "
            f"unknown, occupied; use {FREE_THRESH} and {OCCUPIED_THRESH}"
        )


def _yaml_text(grid: OccupancyGrid, image_name: str, rules: Rules, digest: str) -> str:
    values = {
        "image": image_name,
        "mode": rules.mode,
        "resolution": float(grid.resolution),
        "origin": [float(part) for part in (grid.origin.x, grid.origin.y, grid.origin.yaw_rad)],
        "negate": 0,
        "occupied_thresh": float(rules.occupied_thresh),
        "free_thresh": float(rules.free_thresh),
        DIGEST: digest,
    }
    return yaml.safe_dump(
        values, allow_unicode=True, width=math.inf, sort_keys=False, default_flow_style=None
    )
