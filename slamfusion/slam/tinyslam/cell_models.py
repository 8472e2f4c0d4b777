"""The cell models and the occupancy estimator of [H16], as plain definitions on arrays.

They say what the map kernels do in fixed point. A cell holds one value: 0 is free, 1 is occupied,
0.5 is what nothing is known of.

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016 [H16].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
CellModel = Callable[[npt.ArrayLike, npt.ArrayLike], F64]

# Value, 0 to 1, of a cell that nothing is known of: as likely a wall as free.
UNKNOWN_VALUE = 0.5


def base_cell(observations: npt.ArrayLike, quality: npt.ArrayLike) -> F64:
    """Return a cell's value by tinySLAM's own model, before and after each observation.

    Each observation v moves the value by a share q of the way: ``m <- (1 - q) m + q v``. What
    came last counts most, so the order matters.

    Args:
        observations: (N, ...), 0 free to 1 occupied, in order; more axes are more cells.
        quality: q, 0 to 1; one number, or one for each observation.

    Returns:
        (N + 1, ...) float64; the first is ``UNKNOWN_VALUE``.

    Source: [H16], the base cell.
    """
    told = np.asarray(observations, dtype=np.float64)
    values = np.full((len(told) + 1, *told.shape[1:]), UNKNOWN_VALUE)
    for index, (v, q) in enumerate(zip(told, np.broadcast_to(quality, told.shape), strict=True)):
        values[index + 1] = (1.0 - q) * values[index] + q * v
    return values


def mean_cell(observations: npt.ArrayLike, quality: npt.ArrayLike) -> F64:
    """Return a cell's value by the modified model, before and after each observation.

    The value is the mean of ``0.5 + (v - 0.5) q`` over the observations so far: their order does
    not matter, and one of low quality says little.

    Args:
        observations: (N, ...), 0 free to 1 occupied; more axes are more cells.
        quality: q, 0 to 1; one number, or one for each observation.

    Returns:
        (N + 1, ...) float64; the first is ``UNKNOWN_VALUE``.

    Source: [H16], the modified cell.
    """
    told = np.asarray(observations, dtype=np.float64)
    believed = UNKNOWN_VALUE + (told - UNKNOWN_VALUE) * np.broadcast_to(quality, told.shape)
    counts = np.arange(1, len(told) + 1, dtype=np.float64)
    means = np.cumsum(believed, axis=0) / counts.reshape(-1, *(1,) * (told.ndim - 1))
    return np.concatenate((np.full((1, *told.shape[1:]), UNKNOWN_VALUE), means))


# By the names of ``TinySlamConfig.cell_model``.
CELL_MODELS: dict[str, CellModel] = {"base": base_cell, "mean": mean_cell}


def area_behind(offset_x: npt.ArrayLike, offset_y: npt.ArrayLike, angle_rad: npt.ArrayLike) -> F64:
    """Return the share of a cell that lies behind a hit: the wall's part of it.

    The wall is taken to stand at the hit, normal to the beam; what of the unit square is farther
    along the beam is wall. All arguments broadcast.

    Args:
        offset_x: hit from the middle of the cell, in cells, -0.5 to 0.5.
        offset_y: the same along y.
        angle_rad: direction in which the beam flies, counter-clockwise from x.

    Returns:
        float64 shares, 0 to 1: exact areas.

    Source: [H16], the dynamic occupancy estimator.
    """
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    # Along the beam a point of the square lies at x cos + y sin: the sum of two uniform spreads
    # of widths |cos| and |sin|. The area beyond a distance is the tail of that trapezium.
    distance = np.asarray(offset_x) * cos + np.asarray(offset_y) * sin
    long, short = np.maximum(np.abs(cos), np.abs(sin)), np.minimum(np.abs(cos), np.abs(sin))
    away = np.abs(distance)
    flat = 0.5 - away / long
    left = np.maximum(0.5 * (long + short) - away, 0.0)
    corner = left**2 / np.maximum(2.0 * long * short, np.finfo(np.float64).tiny)
    tail = np.where(away <= 0.5 * (long - short), flat, corner)
    return np.asarray(np.where(distance < 0.0, 1.0 - tail, tail), dtype=np.float64)
