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

import logging
import stat
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path

import numpy as np

from slamfusion.config import NormalizeConfig
from slamfusion.errors import MapFileError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, implausible
from slamfusion.io.atomic import AtomicFiles
from slamfusion.io.images import encode_image, looks_like_image, pixel_digest, read_image
from slamfusion.io.map_cells import (
    cells_from_image,
    classes_of_greys,
    pixels_from_cells,
    with_settled_edges,
)
from slamfusion.io.map_yaml import (
    DIGEST,
    FREE_THRESH,
    OCCUPIED_THRESH,
    MapFile,
    Rules,
    check_mode,
    check_resolution,
    check_thresholds,
    existing,
    map_yaml_text,
    read_map_yaml,
)
from slamfusion.io.memory import WORKING_BYTES, check_memory

# The thresholds of the vote: what is saved is what votes.
VOTE = NormalizeConfig()
# A writer replaces the picture and then, within a millisecond, the YAML.
READ_TIMES, WAIT_S = 20, 0.01

_LOG = logging.getLogger(__name__)


class _OtherPictureError(MapFileError):
    """The picture is not the one that the YAML was written for."""


def load_map(
    path: str | Path,
    *,
    resolution: float | None = None,
    name: str | None = None,
    legacy_unknown: bool = False,
    settle_edges: bool = False,
    warn: Callable[[str], None] = _LOG.warning,
) -> OccupancyGrid:
    """Load an occupancy grid from a map server's YAML, or from a bare picture.

    Where the YAML names ``x.pgm`` and only ``x.pgm.gz`` is there, that is read. A bare picture is
    read with the default rules (trinary, thresholds 0.65 and 0.196), its lower-left corner at the
    origin of the map frame.

    The YAML that ``save_map`` writes holds a digest of the picture's pixels. If the picture is
    another one, another process may be replacing both: they are read again before they are refused.

    Map savers write the grey 205 for unknown; with a ``free_thresh`` above 0.196, 0.25 for example,
    it reads as free, as in nav2; so it does with an alpha channel, which nav2 averages in. That is
    warned of with the number of cells.

    If nothing is at the picture's path, as in a YAML of another machine, a picture of this name
    beside the YAML is read, with a warning.

    Args:
        path: the YAML, or a PGM, PNG or BMP (each also gzipped).
        resolution: metres per cell of a bare picture; must be left out for a YAML.
        name: the grid's name; default: the file's name without its endings.
        legacy_unknown: read such cells as unknown.
        settle_edges: read grey cells between a wall and free ground as one of both, so that walls
            of drawings have their faces (``with_settled_edges``); nav2 reads them as unknown.
        warn: told in a sentence what is doubtful about the map.

    Raises:
        MapFileError: a file is missing, damaged or breaks the format's rules.
        MemoryBudgetError: the map would not fit into memory.
    """
    load = partial(_load, Path(path), resolution, name, legacy_unknown, settle_edges, warn)
    for _ in range(READ_TIMES - 1):
        with suppress(_OtherPictureError):
            return load()
        time.sleep(WAIT_S)
    return load()


def _load(
    path: Path,
    resolution: float | None,
    name: str | None,
    legacy_unknown: bool,  # noqa: FBT001
    settle_edges: bool,  # noqa: FBT001
    warn: Callable[[str], None],
) -> OccupancyGrid:
    """Return the map as its files are now."""
    path = existing(path)
    if looks_like_image(path):
        if resolution is None:
            message = f"{path}: an image alone has no cell size; give --resolution or its YAML"
            raise MapFileError(message)
        entry = MapFile(path, check_resolution(str(path), resolution), Pose2(), Rules())
    else:
        if resolution is not None:
            message = f"{path}: the YAML has its own resolution; leave --resolution out"
            raise MapFileError(message)
        entry = read_map_yaml(path)
    pixels = read_image(existing(entry.image))
    if entry.digest is not None and pixel_digest(pixels) != entry.digest:
        message = (
            f"{path}: its picture {entry.image.name} belongs to another map or was edited; save "
            f"the map again, or delete the line {DIGEST!r} from the YAML to use both as they are"
        )
        raise _OtherPictureError(message)
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
            "beside the YAML"
        )
    if count and not legacy_unknown:
        has_alpha = pixels.shape[2:] == (4,)
        cause = (
            "because map servers average the alpha channel in"
            if has_alpha
            else f"under 'free_thresh' {entry.rules.free_thresh:g}"
        )
        mend = "save it without alpha" if has_alpha else "write free_thresh: 0.196"
        warn(
            f"{path}: {count} cells of grey 205, which map savers write for unknown, do not read "
            f"as unknown {cause}; read them so with --legacy-unknown (nodes: "
            f"legacy_unknown:=true), or {mend}"
        )
    if name is None:
        name = Path(path.name.removesuffix(".gz")).stem
    return OccupancyGrid(cells, entry.resolution, entry.origin, name)


def map_sources(path: Path) -> list[Path]:
    """Return the files that ``load_map`` reads, and the names that stand for packed ones.

    Of a map that cannot be read as many as are known: it is refused when it is loaded.
    """
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
    files: AtomicFiles | None = None,
) -> tuple[Path, Path]:
    """Save a grid as its picture and ``stem.yaml``; see ``AtomicFiles``.

    In ``trinary`` mode the classes that vote are saved: unknown 205, free 254, occupied 0. Loading
    gives them back, here and in nav2, and with the thresholds written by default, 0.65 and 0.196,
    no unknown cell reads as free. In ``raw`` mode loading gives every value; in ``scale`` mode too
    when the thresholds are 0 and 1; with others loading stretches what lies between them to
    0..100, as nav2 does.

    Args:
        grid: cells -1 and 0..100.
        stem: the path without its ending; missing folders are made.
        mode: ``trinary``, ``scale`` or ``raw``.
        free_thresh: written to the YAML; 0..1.
        occupied_thresh: written to the YAML; 0..1, above ``free_thresh``.
        image_format: ``pgm``, ``png`` or ``bmp``; default: ``png`` for scale, else ``pgm``.
        classes: in ``trinary`` mode, what is free and what is occupied; the thresholds of the vote.
        files: the set of files to join; default: one of its own.

    Returns:
        The paths of the YAML and of the picture.

    Raises:
        MapFileError: a rule above is broken, the grid's resolution or origin would be refused when
            loading (``implausible``), or a file cannot be written; nothing was changed.
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
    text = map_yaml_text(grid, image_path.name, rules, pixel_digest(pixels))
    with nullcontext(files) if files is not None else AtomicFiles() as whole:
        whole.add(image_path, encode_image(pixels, image_format))
        whole.add(yaml_path, text.encode())
    return yaml_path, image_path


def saved_files(
    stem: Path, mode: str = "trinary", image_format: str | None = None
) -> tuple[Path, Path]:
    """Return the YAML and the picture that ``save_map`` writes."""
    if image_format is None:
        image_format = "png" if mode == "scale" else "pgm"
    return Path(f"{stem}.yaml"), Path(f"{stem}.{image_format}")


def _check_saving(grid: OccupancyGrid, stem: Path, rules: Rules, image_format: str) -> None:
    """Refuse what could not be loaded back as the same map."""
    where = str(stem)
    try:
        kind = stat.S_IFMT(stem.stat().st_mode)
    except (OSError, ValueError):  # nothing there, or writing will say what is wrong
        kind = stat.S_IFREG
    if stem.name in {"", ".."} or kind not in {stat.S_IFREG, stat.S_IFDIR}:
        message = f"{where}: cannot write: a device or no file name; give a path such as out/map"
        raise MapFileError(message)
    reason = implausible(grid.resolution, grid.origin)
    if reason is not None:
        message = f"{where}: cannot write: {reason}; correct the map's resolution or origin"
        raise MapFileError(message)
    check_mode(where, rules.mode)
    check_thresholds(where, rules)
    if image_format not in {"pgm", "png", "bmp"}:
        message = f"{where}: image format must be pgm, png or bmp, found {image_format!r}; use pgm"
        raise MapFileError(message)
    if rules.mode == "scale" and image_format != "png" and (grid.cells == UNKNOWN).any():
        message = (
            f"{where}: mode scale keeps unknown cells in the alpha channel, which {image_format} "
            "has not; use png"
        )
        raise MapFileError(message)
    if rules.mode == "trinary" and classes_of_greys(rules) != [FREE, UNKNOWN, OCCUPIED]:
        message = (
            f"{where}: with free_thresh {rules.free_thresh:g} and occupied_thresh "
            f"{rules.occupied_thresh:g} the saved greys 254, 205, 0 would not load as free, "
            f"unknown, occupied; use {FREE_THRESH} and {OCCUPIED_THRESH}"
        )
        raise MapFileError(message)
