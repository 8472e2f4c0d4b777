"""Typed states as plain values and arrays, and back: what a state file is made of.

A state is a frozen dataclass of plain values, ``Pose2``, arrays, and tuples, lists, dictionaries
with text keys or further dataclasses of these. Its arrays are kept apart, under the path of their
field (``graph.nodes.ends``); everything else is JSON.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from slamfusion.errors import shown
from slamfusion.geometry import Pose2
from slamfusion.slam.common.shapes import LARGEST

__all__ = ["Arrays", "pack", "unpack"]

# No map is larger, and no yaw is counted on through more turns.
FARTHEST_M, TURNS_RAD = 1e7, 1e6
Arrays = dict[str, npt.NDArray[Any]]
T = TypeVar("T")


def pack(state: Any) -> tuple[dict[str, Any], Arrays]:
    """Return a state, a dataclass, as plain values and arrays by their paths."""
    arrays: Arrays = {}
    return _packed(state, "", arrays), arrays


def unpack(kind: type[T], record: dict[str, Any], arrays: Arrays) -> T:
    """Return the state of a kind that ``pack`` has taken apart.

    Raises:
        KeyError: a part is missing; it is named.
        TypeError: a part is of another kind than its annotation says; it is named.
        ValueError: parts do not fit each other.
    """
    state: T = _unpacked(kind, record, "", arrays)
    return state


def _packed(value: Any, where: str, arrays: Arrays) -> Any:
    if isinstance(value, np.ndarray):
        arrays[where] = value
        return None
    if dataclasses.is_dataclass(value):
        names = (item.name for item in dataclasses.fields(value))
        return {name: _packed(getattr(value, name), _path(where, name), arrays) for name in names}
    if isinstance(value, dict):
        return {key: _packed(item, _path(where, key), arrays) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_packed(item, _path(where, str(i)), arrays) for i, item in enumerate(value)]
    return value


def _unpacked(kind: Any, value: Any, where: str, arrays: Arrays) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        _check(value is None and _has_kind(arrays[where], inner[1]), kind, where, arrays[where])
        return arrays[where]
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = _hints(kind)
        _check(isinstance(value, dict) and not value.keys() - hints.keys(), kind, where, value)
        found = {
            name: _unpacked(hint, _part(value, name, where), _path(where, name), arrays)
            for name, hint in hints.items()
        }
        made = kind(**found)
        if isinstance(made, Pose2):
            is_near = max(abs(made.x), abs(made.y)) <= FARTHEST_M and abs(made.yaw_rad) <= TURNS_RAD
            _check(is_near, kind, where, made)
        return made
    if origin in (Union, types.UnionType):
        (known,) = (one for one in inner if one is not type(None))
        return None if value is None else _unpacked(known, value, where, arrays)
    if origin is dict:
        _check(isinstance(value, dict), kind, where, value)
        return {
            key: _unpacked(inner[1], item, _path(where, key), arrays) for key, item in value.items()
        }
    if origin in (list, tuple):
        is_even = origin is list or inner[1:] == (Ellipsis,)
        _check(
            isinstance(value, list) and (is_even or len(value) == len(inner)), kind, where, value
        )
        kinds = inner[:1] * len(value) if is_even else inner
        parts = enumerate(zip(kinds, value, strict=True))
        return origin(
            _unpacked(one, item, _path(where, str(i)), arrays) for i, (one, item) in parts
        )
    if kind is not Any:
        _check(_is_of(kind, value), kind, where, value)
    return value


def _is_of(kind: Any, value: Any) -> bool:
    """Return whether a plain value is one of a kind."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if kind is float:
        return type(value) in {int, float} and abs(value) <= LARGEST
    if kind is int:
        return type(value) is int and abs(value) < 2**63
    return type(value) is kind


def _has_kind(array: npt.NDArray[Any], wanted: Any) -> bool:
    """Return whether an array's values are of the kind that its annotation says."""
    (kind,) = get_args(wanted) or (Any,)
    return kind is Any or array.dtype == np.dtype(kind)


def _check(is_right: object, kind: Any, where: str, value: Any) -> None:
    if not is_right:
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else shown(value)
        message = f"{where}: wanted {getattr(kind, '__name__', kind)}, found {found}"
        raise TypeError(message)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields."""
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in dataclasses.fields(kind)}


def _part(value: dict[str, Any], name: str, where: str) -> Any:
    if name not in value:
        raise KeyError(_path(where, name))
    return value[name]


def _path(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name
