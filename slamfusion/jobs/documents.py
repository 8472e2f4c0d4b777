"""What all JSON documents and records have in common: plain values, and what a result rests on."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamfusion.config import RunConfig, to_mapping
from slamfusion.version import versions

if TYPE_CHECKING:
    from slamfusion.jobs.records import CircumstancesJson, SettingsJson


def record_bytes(document: Any) -> bytes:
    """Return a document as the indented UTF-8 text of a JSON file; NaN and infinity become null."""
    from slamfusion.json_values import plain  # noqa: PLC0415  (NumPy loads slowly; --help needs none)

    return (json.dumps(plain(document), indent=2, allow_nan=False) + "\n").encode()


def path_text(path: Path | None) -> str | None:
    """Return a path as a JSON document has it; None where no file was named."""
    return None if path is None else str(path)


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


def settings_used(config: RunConfig) -> SettingsJson:
    """Return the settings and the versions that a result rests on, for a JSON document."""
    return {"config": to_mapping(config), "versions": versions()}


def circumstances(config: RunConfig, device: str) -> CircumstancesJson:
    """Return what a computed result depends on besides its inputs, for a JSON document."""
    return {
        "device": device,
        "seed": config.seed,
        "config": to_mapping(config),
        "versions": versions(),
    }
