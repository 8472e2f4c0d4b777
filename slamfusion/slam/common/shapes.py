"""What arrays from outside must be: shapes that fit each other, indices that lead somewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def check_shapes(arrays: Mapping[str, Array], wanted: Mapping[str, str]) -> dict[str, int]:
    """Return the length that each letter stands for.

    Args:
        arrays: by name.
        wanted: by name too, sides parted by blanks: a number, or a letter that is the same length
            wherever it stands, ``N 3`` for example; empty for a single value.

    Raises:
        ValueError: an array has another shape; it is named.
    """
    lengths: dict[str, int] = {}
    for name, text in wanted.items():
        shape, sides = arrays[name].shape, text.split()
        fits = len(shape) == len(sides) and all(
            found == (int(side) if side.isdecimal() else lengths.setdefault(side, found))
            for found, side in zip(shape, sides, strict=True)
        )
        if not fits:
            known = ", ".join(f"{side} = {lengths[side]}" for side in sides if side in lengths)
            message = f"{name}: wanted the shape ({text}), {known or 'any'}, found {shape}"
            raise ValueError(message)
    return lengths


def check_kinds(arrays: Mapping[str, Array], wanted: Mapping[str, npt.DTypeLike]) -> None:
    """Refuse arrays of other dtypes.

    Raises:
        ValueError: one is; it is named.
    """
    for name, kind in wanted.items():
        if arrays[name].dtype != kind:
            message = f"{name}: wanted {np.dtype(kind)}, found {arrays[name].dtype}"
            raise ValueError(message)


def check_indices(name: str, indices: npt.ArrayLike, count: int, *, first: int = 0) -> None:
    """Refuse indices outside ``first`` to ``count - 1``.

    Raises:
        ValueError: one is outside.
    """
    found = np.asarray(indices)
    if found.dtype.kind not in "iu" and found.size:
        message = f"{name}: wanted whole numbers, found {found.dtype}"
        raise ValueError(message)
    if found.size and not first <= int(found.min()) <= int(found.max()) < count:
        message = f"{name}: wanted indices of {first} to {count - 1}, found others"
        raise ValueError(message)
