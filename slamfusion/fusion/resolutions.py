"""Cell sizes that cannot be fused with those of the other maps."""

from __future__ import annotations

from collections.abc import Mapping

# How many times coarser or finer than the fused cells a map's may be. Walls are compared within
# 0.15 m, which says nothing of cells of a metre; and cells of 1 mm make a hall too large.
RATIO_MAX = 16.0
# A cell size in centimetres or millimetres is at least so many times as large.
UNITS_RATIO = 99.0


def odd_resolutions(resolutions: Mapping[str, float]) -> dict[str, str]:
    """Return, in words, whose cells are too coarse or too fine to be fused with the others'.

    The typical resolution is the median, of an even number the coarser one.

    Args:
        resolutions: by name, metres per cell.
    """
    if not resolutions:
        return {}
    typical = sorted(resolutions.values())[len(resolutions) // 2]
    reasons = {name: odd_resolution(size, typical) for name, size in resolutions.items()}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def odd_resolution(size: float, typical: float) -> str | None:
    """Return in words that cells are too coarse or too fine for others, or None; m per cell."""
    ratio = max(size / typical, typical / size)
    if ratio <= RATIO_MAX:
        return None
    word = "coarser" if size > typical else "finer"
    said = (
        f"cells of {size:g} m are {ratio:.4g} times {word} than those of the others ({typical:g} "
        f"m); {RATIO_MAX:g} times can be fused"
    )
    return f"{said}; is one in other units than metres?" if ratio >= UNITS_RATIO else said
