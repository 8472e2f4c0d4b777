"""Brightness to cells and cells to pixels, as a map server reads and writes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.config import NormalizeConfig
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, trinary_cells
from slamfusion.io.images import Pixels
from slamfusion.io.map_yaml import Rules

Cells = npt.NDArray[np.int8]
Shades = npt.NDArray[np.float64]

# What map savers write.
FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY = 254, 205, 0
_BAND_PIXELS = 2**18
_QUANTUM_MAX = 65535.0


def _trinary_cells(shade: Shades, rules: Rules) -> Cells:
    """Three classes; both comparisons strict."""
    occupancy = shade if rules.negate else 1.0 - shade
    cells = np.full(shade.shape, UNKNOWN, dtype=np.int8)
    cells[occupancy < rules.free_thresh] = FREE
    cells[occupancy > rules.occupied_thresh] = OCCUPIED
    return cells


def _scale_cells(shade: Shades, rules: Rules) -> Cells:
    """Linear between the thresholds, rounded half to even."""
    occupancy = shade if rules.negate else 1.0 - shade
    span = rules.occupied_thresh - rules.free_thresh
    between = np.rint((occupancy - rules.free_thresh) / span * 100.0)
    # At a threshold itself the linear rule gives 0 or 100 as well, so clipping is the whole rule.
    return np.clip(between, FREE, OCCUPIED).astype(np.int8)


def _raw_cells(shade: Shades, rules: Rules) -> Cells:
    """The 8-bit value itself up to 100, unknown above; ``negate`` has no say."""
    del rules
    value = np.floor(shade * 255.0 + 0.5)
    return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)


_MODES: dict[str, Callable[[Shades, Rules], Cells]] = {
    "trinary": _trinary_cells,
    "scale": _scale_cells,
    "raw": _raw_cells,
}


def classes_of_greys(rules: Rules) -> list[int]:
    """Return as what the greys of free, unknown and occupied read in trinary mode."""
    greys = np.array([FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY])
    classes: list[int] = _trinary_cells(_shade(greys, 255), rules).tolist()
    return classes


def cells_from_image(
    pixels: Pixels, rules: Rules, *, legacy_unknown: bool = False
) -> tuple[Cells, int]:
    """Return the cells of a picture, and how many of them are unknown but do not read so.

    Those have the grey that map savers write for unknown, under trinary thresholds that take it for
    free or occupied, or with an alpha channel, which makes it brighter.

    Args:
        pixels: (H, W), (H, W, 3) or (H, W, 4), uint8 or uint16, top row first.
        rules: of its YAML.
        legacy_unknown: read those cells as unknown.

    Returns:
        (H, W) int8, bottom row first, read-only; and the count, the same with and without
        ``legacy_unknown``.
    """
    height, width = pixels.shape[:2]
    maxval = int(np.iinfo(pixels.dtype).max)
    grey = UNKNOWN_GREY * maxval // 255
    may_be_unknown = rules.mode == "trinary" and not rules.negate
    count = 0
    if pixels.ndim == 2:
        table = _MODES[rules.mode](_shade(np.arange(maxval + 1), maxval), rules)
        if may_be_unknown and table[grey] != UNKNOWN:
            bands = (pixels[top:bottom] == grey for top, bottom in _bands(height, width))
            count = sum(int(np.count_nonzero(band)) for band in bands)
            if legacy_unknown:
                table[grey] = UNKNOWN
        cells = _look_up_flipped(pixels, table)
    else:
        cells = np.empty((height, width), dtype=np.int8)
        for top, bottom in _bands(height, width):
            band = pixels[top:bottom][::-1]
            own = _colour_cells(band, maxval, rules)
            if may_be_unknown:
                is_grey = (band[..., :3] == grey).all(axis=-1) & (own != UNKNOWN)
                count += int(np.count_nonzero(is_grey))
                if legacy_unknown:
                    own[is_grey] = UNKNOWN
            cells[height - bottom : height - top] = own
    cells.flags.writeable = False
    return cells, count


def with_settled_edges(cells: Cells, pixels: Pixels, rules: Rules) -> Cells:
    """Return cells in which the grey ones on the edge of a wall are a wall or free.

    In an anti-aliased drawing, and in a map of probabilities, one or two grey cells lie between a
    wall and free ground. They are decided at half, so that the face of the wall is found. The grey
    of unknown cells, and grey cells elsewhere, stay unknown.

    Args:
        cells: (H, W) int8, as ``cells_from_image`` returns them.
        pixels: the picture that they come from.
        rules: of its YAML.
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
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))

    def reached(kind: int) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return the grey cells one step from a class, and those at most two from it."""
        near = [np.asarray(classes == kind)]
        for _ in range(2):
            near.append(between & (cv2.dilate(near[-1].view(np.uint8), cross) > 0))
        return near[1], near[1] | near[2]

    (wall, walls), (free, frees) = reached(1), reached(0)
    is_edge = (wall & frees) | (walls & free)
    settled = np.where(is_edge, np.where(percent >= 50, OCCUPIED, FREE), cells).astype(np.int8)
    settled.flags.writeable = False
    return settled


def _colour_cells(band: npt.NDArray[Any], maxval: int, rules: Rules) -> Cells:
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


def pixels_from_cells(
    cells: Cells, rules: Rules, image_format: str, classes: NormalizeConfig
) -> npt.NDArray[np.uint8]:
    """Return the picture of the cells, top row first: grey, or grey as colours and alpha.

    Args:
        cells: (H, W) int8, -1 unknown, 0..100 percent; bottom row first.
        rules: the mode.
        image_format: ``png`` has an alpha channel in scale mode, other formats have none.
        classes: in trinary mode, the thresholds in percent.
    """
    # The table is indexed with the cell's byte, so unknown (-1) stands at 255.
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
