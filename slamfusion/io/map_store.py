"""Maps that do not fit into memory: Zarr stores, written chunk by chunk, renamed at the end.

A store is a folder in Zarr's format 2: the group's attributes have the map's ``resolution`` (metres
per cell) and ``origin`` (x, y in metres and yaw in radians of the lower-left corner of cell
[0, 0]); each array is (H, W) int8 with rows growing along +y. Chunks that were not written are -1,
unknown, and take no space.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from slamfusion.errors import MapFileError
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid


class MapStore:
    """A store that is being written; the ``with`` block renames it into place.

    Until then it has a hidden name next to its place. An error in the block removes it.
    """

    def __init__(
        self,
        path: str | Path,
        names: Sequence[str],
        shape: tuple[int, int],
        chunk: int,
        resolution: float,
        origin: Pose2,
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Start a store; ``resolution`` in metres per cell, ``origin`` of cell [0, 0]'s corner."""
        self.path = Path(path)
        check_store(self.path)
        self._part = self.path.with_name(f".{self.path.name}.{secrets.token_hex(8)}")
        zarr, version = _zarr()
        import numcodecs  # noqa: PLC0415  (comes with Zarr)

        with self._whole_or_nothing():
            self._part.mkdir(parents=True)
            group = zarr.open_group(str(self._part), mode="w", **version)
            for name in names:
                array = zarr.create(
                    shape=shape,
                    chunks=(min(chunk, shape[0]), min(chunk, shape[1])),
                    dtype="i1",
                    fill_value=UNKNOWN,
                    compressor=numcodecs.Zlib(1),
                    store=str(self._part),
                    path=name,
                    **version,
                )
                array.attrs["_ARRAY_DIMENSIONS"] = ["y", "x"]  # what xarray asks for
            group.attrs.update(
                {
                    **(attributes or {}),
                    "resolution": resolution,
                    "origin": [origin.x, origin.y, origin.yaw_rad],
                }
            )
            self._arrays = {name: group[name] for name in names}

    def write(self, name: str, box: CellBox, cells: I8) -> None:
        """Write a box of cells of an array."""
        try:
            self._arrays[name][box.row0 : box.row1, box.col0 : box.col1] = cells
        except OSError as error:
            raise self._cannot_write(error) from None

    def __enter__(self) -> MapStore:  # noqa: PYI034  typing.Self needs Python 3.11
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._remove()
            return
        with self._whole_or_nothing():
            check_store(self.path)
            self._part.rename(self.path)

    @contextmanager
    def _whole_or_nothing(self) -> Iterator[None]:
        """Remove the store if the ``with`` block raises."""
        try:
            yield
        except OSError as error:
            self._remove()
            raise self._cannot_write(error) from None
        except BaseException:
            self._remove()
            raise

    def _remove(self) -> None:
        with suppress(OSError):
            shutil.rmtree(self._part)

    def _cannot_write(self, error: OSError) -> MapFileError:
        reason = error.strerror or str(error)
        return MapFileError(f"{self.path}: cannot write: {reason}; choose another place")


def check_store(path: Path) -> None:
    """Refuse to write over something, or without Zarr, before any work."""
    if os.path.lexists(path):
        message = f"{path} exists, and a store is not overwritten; remove it or name another"
        raise MapFileError(message)
    _zarr()


def read_stored_map(path: str | Path, name: str) -> OccupancyGrid:
    """Read a whole map from a store."""
    zarr, _ = _zarr()
    try:
        group = zarr.open_group(str(path), mode="r")
        cells = np.ascontiguousarray(group[name][:], dtype=np.int8)
        resolution = float(group.attrs["resolution"])
        origin = Pose2(*(float(value) for value in group.attrs["origin"]))
    except (OSError, KeyError, ValueError, TypeError) as error:
        message = f"{path}: no store with a map {name!r} ({error}); name one that fuse wrote"
        raise MapFileError(message) from None
    cells.flags.writeable = False
    return OccupancyGrid(cells, resolution, origin, name)


def _zarr() -> tuple[Any, dict[str, int]]:
    try:
        import zarr  # noqa: PLC0415  (an extra)
    except ImportError as error:
        message = f"a store needs Zarr ({error}); pip install 'slamfusion[fleet]'"
        raise MapFileError(message) from None
    is_new = int(zarr.__version__.split(".")[0]) >= 3
    return zarr, {"zarr_format": 2} if is_new else {"zarr_version": 2}
