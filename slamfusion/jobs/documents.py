"""How values are written: a document as JSON, and numbers in tables."""

from __future__ import annotations

import json
import math
from typing import Any

from slamfusion.json_values import plain


def record_bytes(document: Any) -> bytes:
    """Return a document as the indented UTF-8 text of a JSON file; NaN and infinity become null."""
    return (json.dumps(plain(document), indent=2, allow_nan=False) + "\n").encode()


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for a table; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}f}"


def spread(mean: float, deviation: float, digits: int) -> str:
    """Return a mean with its deviation; without, where there is none."""
    text = number(deviation, digits)
    return number(mean, digits) if text == "-" else f"{number(mean, digits)} ± {text}"


def p_text(p_value: float | None) -> str:
    """Return a p-value for a table: three decimals, or ``<0.001``; a dash where there is none."""
    return "<0.001" if p_value is not None and p_value < 0.001 else number(p_value)
