"""States of mappers in files: everything that decides how a mapper goes on.

The state of an object is the attributes that its ``STATE`` names. A file is an uncompressed
``.npz``: a record (JSON) of all values, for each dtype one array with the values of all arrays one
after the other, and the SHA-256 of all of them. Files are read without pickle, and nothing is
unpacked that is larger than the file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.errors import SlamFusionError, shown
from slamfusion.geometry import F64, Pose2
from slamfusion.io import check_memory, write_atomic
from slamfusion.io.files import open_regular
from slamfusion.io.log import Skips
from slamfusion.json_values import dotted

Arrays = dict[str, npt.NDArray[Any]]
M = TypeVar("M", bound="SavedMapper")

# Names of the JSON part and of the digest in the file.
RECORD, DIGEST = "record", "digest"
# The dtype kinds of a state: booleans, integers and floats.
KINDS = "biuf"
QUOTE = "'"


class Stateful:
    """An object whose state is the attributes that ``STATE`` names.

    They are plain values, arrays, dataclasses, lists and dictionaries of these, random generators,
    or objects with ``to_state`` and ``restore`` of their own.
    """

    STATE: ClassVar[tuple[str, ...]] = ()

    def to_state(self) -> dict[str, Any]:
        """Return the state by attribute."""

        def state_of(value: Any) -> Any:
            if isinstance(value, np.random.Generator):
                return value.bit_generator.state
            return value.to_state() if hasattr(value, "to_state") else value

        return {name: state_of(getattr(self, name)) for name in self.STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what ``to_state`` returned; records and generators stay the same objects."""
        for name in self.STATE:
            own, value = getattr(self, name), state[name]
            record: Any = getattr(own, "__dataclass_params__", None)
            if hasattr(own, "to_state"):
                own.restore(value)
            elif isinstance(own, np.random.Generator):
                own.bit_generator.state = value
            elif None not in (_kind(own), _kind(value)) and _kind(own) != _kind(value):
                raise TypeError(f"{name}: wanted {_kind(own)}, found {_kind(value)}")
            elif record is not None and not record.frozen:
                vars(own).update(vars(value))
            else:
                setattr(self, name, value)


class Rows(Stateful):
    """A table of float64 that grows by a row at a time, in a tenth of the memory of a list."""

    def __init__(self, columns: int) -> None:
        self.table = np.empty((64, columns))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, *row: float) -> None:
        """Add a row."""
        if self._count == len(self.table):
            self.table = np.concatenate((self.table, np.empty_like(self.table)))
        self.table[self._count] = row
        self._count += 1

    def array(self) -> F64:
        """Return the rows, (N, columns), without a copy: a row that was added stays as it is."""
        return self.table[: self._count]

    def to_state(self) -> dict[str, Any]:
        """Return the rows."""
        return {"rows": self.array()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what ``to_state`` returned."""
        rows = state["rows"]
        check_arrays(state, {"rows": (np.float64, f"N {self.table.shape[1]}")})
        self.table = np.concatenate((rows, np.empty((64, self.table.shape[1]))))
        self._count = len(rows)


class SavedMapper(Stateful):
    """A mapper that can be saved and resumed, made of its settings, a device and a seed.

    ``STATE_KINDS`` lists the dataclasses in its state besides ``Pose2`` and ``Skips``.
    """

    name: str
    STATE_FORMAT: ClassVar[int]
    STATE_KINDS: ClassVar[tuple[type, ...]]
    _config: Any
    _seed: int

    def save_state(self, path: Path) -> None:
        """Write the whole state, atomically."""
        state, packed = pack(self.to_state())
        record = {"state": state, **self.owner()}
        arrays: dict[str, Any] = packed
        arrays[RECORD] = np.frombuffer(json.dumps(record).encode(), dtype=np.uint8)
        arrays[DIGEST] = np.frombuffer(digest(arrays), dtype=np.uint8)
        file = io.BytesIO()
        np.savez(file, **arrays)
        write_atomic(path, file.getbuffer())

    @classmethod
    def load_state(  # noqa: PYI019 - typing.Self needs Python 3.11
        cls: type[M], path: Path, config: Any, device: ComputeDevice, seed: int = 0
    ) -> M:
        """Return the mapper that ``save_state`` has written."""
        make: Any = cls
        made: M = make(config, device, seed)
        state, arrays = _read(path, made.owner())
        kinds = {kind.__name__: kind for kind in (Pose2, Skips, *cls.STATE_KINDS)}
        try:
            made.restore(unpack(state, arrays, kinds))
        except (
            LookupError,
            ValueError,
            TypeError,
            AttributeError,
            ArithmeticError,
            RecursionError,
        ) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            message = (
                f"{path}: a state that no mapper has saved ({reason}); make it again from the log"
            )
            raise SlamFusionError(message) from None
        return made

    def owner(self) -> dict[str, Any]:
        """Return what a state and the mapper that restores it must have in common."""
        settings = {"seed": self._seed, **dotted(dataclasses.asdict(self._config))}
        return {"name": self.name, "format": self.STATE_FORMAT, "settings": settings}


def pack(state: Any) -> tuple[Any, Arrays]:
    """Return a state as JSON values, and the values of all its arrays by dtype.

    In the JSON values ``{"array": [dtype, shape]}`` stands for the next array of that dtype,
    ``{"dict": [[key, value], ...]}`` for a dictionary, and ``{"Name": {...}}`` for a dataclass.
    Tuples become lists, except those that are keys.
    """
    parts: dict[str, list[npt.NDArray[Any]]] = {}

    def pack_one(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            parts.setdefault(value.dtype.name, []).append(value.ravel())
            return {"array": [value.dtype.name, value.shape]}
        if dataclasses.is_dataclass(value):
            fields = (item.name for item in dataclasses.fields(value))
            return {type(value).__name__: {name: pack_one(getattr(value, name)) for name in fields}}
        if isinstance(value, dict):
            return {"dict": [[key, pack_one(item)] for key, item in value.items()]}
        if isinstance(value, (list, tuple)):
            return [pack_one(item) for item in value]
        return value

    packed = pack_one(state)
    return packed, {name: np.concatenate(values) for name, values in parts.items()}


def unpack(packed: Any, arrays: Arrays, kinds: Mapping[str, type]) -> Any:
    """Return the state that ``pack`` was given."""
    rest = dict(arrays)

    def unpack_one(packed: Any) -> Any:
        if isinstance(packed, list):
            return [unpack_one(item) for item in packed]
        if not isinstance(packed, dict):
            return packed
        ((tag, value),) = packed.items()
        if tag == "array":
            name, shape = value
            size = math.prod(shape)
            array, rest[name] = rest[name][:size], rest[name][size:]
            return array.reshape(shape)
        if tag == "dict":
            return {
                tuple(key) if isinstance(key, list) else key: unpack_one(item)
                for key, item in value
            }
        return kinds[tag](**{name: unpack_one(item) for name, item in value.items()})

    state = unpack_one(packed)
    if any(name != array.dtype.name or array.size for name, array in rest.items()):
        raise ValueError("arrays of other values than the record says")
    return state


def _kind(value: Any) -> Any:
    """Return what stays the same of an attribute between scans; None of None."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim
    return None if value is None else type(value).__name__


def _read(path: Path, owner: dict[str, Any]) -> tuple[Any, Arrays]:
    """Return the packed state of a file, which must be of this owner."""
    try:
        arrays = _arrays(path)
        found_digest = arrays.pop(DIGEST, np.zeros(0, dtype=np.uint8)).tobytes()
        is_whole = found_digest == digest(arrays)
        record: dict[str, Any] = json.loads(arrays.pop(RECORD).tobytes())
        found = record["name"], record["format"]
    except SlamFusionError:  # no regular file, or too large
        raise
    except OSError as error:
        raise SlamFusionError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception:  # noqa: BLE001 - taking other files apart may end in anything
        message = f"{path}: not a whole state that `--save-state` has written"
        raise SlamFusionError(message) from None
    if found != (owner["name"], owner["format"]):
        raise SlamFusionError(
            f"{path}: wanted a state of {owner['name']}, format {owner['format']}, found "
            f"{shown(found[0]).strip(QUOTE)}, format {shown(found[1])}; make it again from the log"
        )
    if not is_whole:
        raise SlamFusionError(f"{path}: not a whole state: it was changed after it was saved")
    for key, value in record["settings"].items():
        if owner["settings"].get(key) != value:
            raise SlamFusionError(
                f"{path}: was made with {key} = {value}, found {owner['settings'].get(key)}; "
                "resume with the same settings"
            )
    return record["state"], arrays


def _arrays(path: Path) -> Arrays:
    """Return the arrays of a file, which together are not larger than it."""
    with open_regular(path, SlamFusionError) as file:
        size = os.fstat(file.fileno()).st_size
        check_memory(2 * size, "a state", str(path))
        with zipfile.ZipFile(file) as packed:
            if sum(part.file_size for part in packed.infolist()) > size:
                raise ValueError("parts that unpack to more than the file")
        file.seek(0)
        with np.load(file, allow_pickle=False) as loaded:
            arrays: Arrays = dict(loaded)
    if any(array.dtype.kind not in KINDS for array in arrays.values()):
        raise ValueError("an array of something else than numbers")
    return arrays


def digest(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Return the SHA-256 of named arrays: names, kinds, shapes and values."""
    hashed = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        hashed.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        hashed.update(array.tobytes())
    return hashed.digest()


def check_arrays(
    arrays: Mapping[str, npt.NDArray[Any]], wanted: Mapping[str, tuple[npt.DTypeLike, str]]
) -> dict[str, int]:
    """Refuse arrays of other dtypes or shapes, such as ``N 3``; return the length of each letter.

    A letter stands for the same length everywhere.
    """
    lengths: dict[str, int] = {}
    for name, (kind, text) in wanted.items():
        shape, sides = arrays[name].shape, text.split()
        fits = len(shape) == len(sides) and all(
            found == (int(side) if side.isdecimal() else lengths.setdefault(side, found))
            for found, side in zip(shape, sides, strict=True)
        )
        if not fits:
            known = ", ".join(f"{side} = {lengths[side]}" for side in sides if side in lengths)
            raise ValueError(f"{name}: wanted the shape ({text}), {known or 'any'}, found {shape}")
        if arrays[name].dtype != kind:
            raise ValueError(f"{name}: wanted {np.dtype(kind)}, found {arrays[name].dtype}")
    return lengths


def check_indices(name: str, indices: npt.ArrayLike, count: int, *, first: int = 0) -> None:
    """Refuse indices outside ``first`` to ``count - 1``."""
    found = np.asarray(indices)
    if found.dtype.kind not in "iu" and found.size:
        raise ValueError(f"{name}: wanted whole numbers, found {found.dtype}")
    if found.size and not first <= int(found.min()) <= int(found.max()) < count:
        raise ValueError(f"{name}: wanted indices of {first} to {count - 1}, found others")
