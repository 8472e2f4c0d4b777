"""States of mappers in files: what decides how one goes on, checked on the way back in.

A file is an uncompressed ``.npz``: the arrays, the record (JSON) and the SHA-256 of all of them.
Nothing is unpacked, and no array is made, that is larger than the file.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.config import to_mapping
from slamfusion.errors import MemoryBudgetError, SlamFusionError, shown
from slamfusion.io import check_memory, write_atomic
from slamfusion.io.regular import open_regular
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.packing import Arrays, pack, unpack

__all__ = ["read_state", "restore_health", "restoring", "write_state"]

T = TypeVar("T")
# Names of the JSON part and of the digest in the file.
RECORD, DIGEST = "record", "digest"
SUFFIX = ".npy"
# Of booleans, whole numbers and floats a state is made.
KINDS = "biuf"
QUOTE = "'"


class _NoFileError(SlamFusionError):
    """A state was named that is no regular file."""


def write_state(path: Path, *, name: str, version: int, config: Any, seed: int, state: Any) -> None:
    """Write a state as an ``.npz`` file; whole or not at all.

    Args:
        path: the file.
        name: the mapper's.
        version: of what it writes.
        config: its settings; whoever goes on must have the same.
        seed: likewise.
        state: a dataclass, see ``slamfusion.slam.common.packing``.
    """
    values, arrays = pack(state)
    whole = {
        "state": values,
        "format": version,
        "name": name,
        "config": to_mapping(config),
        "seed": seed,
    }
    packed: dict[str, Any] = {
        RECORD: np.frombuffer(json.dumps(whole).encode(), dtype=np.uint8),
        **arrays,
    }
    packed[DIGEST] = np.frombuffer(_digest(packed), dtype=np.uint8)
    file = io.BytesIO()
    np.savez(file, **packed)
    write_atomic(path, file.getvalue())


def read_state(path: Path, *, name: str, version: int, config: Any, seed: int, kind: type[T]) -> T:
    """Return the state, of a dataclass ``kind``, that ``write_state`` has written.

    Raises:
        SlamFusionError: no such state, one of another mapper or version, one made with other
            settings or another seed, a damaged one, or one that lacks a part or has a wrong one.
    """
    try:
        arrays = _read_arrays(path)
        digest = arrays.pop(DIGEST, np.zeros(0, dtype=np.uint8)).tobytes()
        is_whole = digest == _digest(arrays)
        record: dict[str, Any] = json.loads(arrays.pop(RECORD).tobytes())
        found_name, found_version = record["name"], record["format"]
        made_with = {"seed": record["seed"], **_flat(record["config"])}
    except (MemoryBudgetError, _NoFileError):
        raise
    except OSError as error:
        message = f"{path}: cannot be read ({error.strerror or error})"
        raise SlamFusionError(message) from None
    except Exception:  # noqa: BLE001 - taking other files apart may end in anything
        message = f"{path}: not a whole state that `--save-state` has written"
        raise SlamFusionError(message) from None
    if (found_name, found_version) != (name, version):
        message = (
            f"{path}: wanted a state of {name}, format {version}, found "
            f"{shown(found_name).strip(QUOTE)}, format {shown(found_version)}"
        )
        raise SlamFusionError(message)
    if not is_whole:
        message = f"{path}: not a whole state: it was changed after it was saved"
        raise SlamFusionError(message)
    settings = {"seed": seed, **_flat(to_mapping(config))}
    for key, value in made_with.items():
        if settings.get(key) != value:
            message = (
                f"{path}: was made with {key} = {value}, found {settings.get(key)}; "
                "resume with the same settings"
            )
            raise SlamFusionError(message)
    with restoring(path):
        return unpack(kind, record["state"], arrays)


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Turn what goes wrong with a state's parts within a ``with`` block into one error.

    Raises:
        SlamFusionError: a part is missing, of a wrong kind, or does not fit the others.
    """
    try:
        yield
    except KeyError as error:
        message = f"{path}: not a whole state, {error} is missing"
        raise SlamFusionError(message) from None
    except (ValueError, TypeError, AttributeError, IndexError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:200]
        message = f"{path}: a state that no mapper has saved ({reason}); make it anew from the log"
        raise SlamFusionError(message) from None


def restore_health(health: Health, saved: Health) -> None:
    """Let a record hold what a saved one of its kind does; it stays the same object.

    Raises:
        ValueError: a count below 0.
    """
    for name, value in vars(saved).items():
        if isinstance(value, int) and value < 0:
            message = f"health.{name}: wanted a count, found {value}"
            raise ValueError(message)
    vars(health).update(vars(saved))


def _read_arrays(path: Path) -> Arrays:
    """Return the arrays of a file, none of which is larger than the file says it is.

    Raises:
        SlamFusionError: no regular file, or more than fits into memory.
        OSError: the file cannot be read.
        Exception: it is no such file.
    """
    arrays: Arrays = {}
    with open_regular(path, _NoFileError) as file:
        size = os.fstat(file.fileno()).st_size
        check_memory(2 * size, "a state", str(path))
        with zipfile.ZipFile(file) as packed:
            for info in packed.infolist():
                size -= info.file_size
                is_plain = info.compress_type == zipfile.ZIP_STORED
                if size < 0 or not is_plain or info.file_size != info.compress_size:
                    message = "parts that unpack to more than the file"
                    raise ValueError(message)
                arrays[info.filename.removesuffix(SUFFIX)] = _array(packed.read(info))
    return arrays


def _array(data: bytes) -> npt.NDArray[Any]:
    """Return the array of an ``.npy`` file that holds exactly it."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0
    shape, is_fortran, kind = (read if version == (1, 0) else _no_header)(file)
    rest = bytearray(data[file.tell() :])
    if kind.kind not in KINDS or min(shape, default=0) < 0:
        message = f"an array of {kind}"
        raise ValueError(message)
    if math.prod(shape) * kind.itemsize != len(rest):
        message = "an array of another size than it says"
        raise ValueError(message)
    return np.frombuffer(rest, dtype=kind).reshape(shape, order="F" if is_fortran else "C")


def _no_header(_: Any) -> Any:
    message = "an array in a form that is not written here"
    raise ValueError(message)


def _digest(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Return the SHA-256 of named arrays: names, kinds, shapes and values."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.digest()


def _flat(values: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Return nested settings by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{where}{key}."))
        else:
            flat[f"{where}{key}"] = value
    return flat
