"""States of mappers taken apart, changed, and put together again as if they had been saved so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.slam.common.state import DIGEST, RECORD, _digest

__all__ = ["read_parts", "write_arrays", "write_parts"]

Arrays = dict[str, npt.NDArray[Any]]


def read_parts(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Return the record and the arrays of a saved state."""
    with np.load(path) as file:
        arrays = dict(file)
    del arrays[DIGEST]
    return json.loads(arrays.pop(RECORD).tobytes()), arrays


def write_parts(path: Path, record: Any, arrays: Arrays) -> None:
    """Write a record and arrays with the digest that belongs to them."""
    text = np.frombuffer(json.dumps(record).encode(), dtype=np.uint8)
    write_arrays(path, {**arrays, RECORD: text})


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays, the record among them, with the digest that belongs to them."""
    whole: dict[str, Any] = {name: array for name, array in arrays.items() if name != DIGEST}
    whole[DIGEST] = np.frombuffer(_digest(whole), dtype=np.uint8)
    with path.open("wb") as file:
        np.savez(file, **whole)
