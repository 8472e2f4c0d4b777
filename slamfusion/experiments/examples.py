"""The maps that an experiment keeps of some drives, against the truth: to be drawn and shown."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.errors import MapFileError
from slamfusion.evaluation import maps_of_differences
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid

# Where an experiment keeps what it has done of its drives.
FOLDER = "trials"
SUFFIX = ".npz"
MAP, RESOLUTION = "map ", "resolution"


@dataclass(frozen=True, eq=False)
class Example:
    """The maps of one drive against the truth.

    Attributes:
        differences: by method (H, W) int8, codes of ``slamfusion.evaluation``, all on one lattice.
        resolution: metres per cell.
    """

    differences: Mapping[str, npt.NDArray[np.int8]]
    resolution: float

    def packed(self) -> bytes:
        """Return the bytes of its file."""
        arrays: dict[str, Any] = {f"{MAP}{name}": item for name, item in self.differences.items()}
        arrays[RESOLUTION] = np.float64(self.resolution)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()


def example_file(folder: Path, name: str) -> Path:
    """Return where the maps of a drive are kept, below the folder of an experiment."""
    return folder / FOLDER / f"{name}{SUFFIX}"


def read_example(folder: Path, name: str) -> Example:
    """Return the maps of a drive that were kept.

    Raises:
        OSError: they were not.
    """
    with np.load(example_file(folder, name)) as stored:
        differences = {
            key.removeprefix(MAP): np.asarray(stored[key], dtype=np.int8)
            for key in stored.files
            if key != RESOLUTION
        }
        return Example(differences, float(stored[RESOLUTION]))


def examples_in(folder: Path) -> list[str]:
    """Return the names of the drives whose maps are kept in an experiment's folder."""
    return sorted(path.stem for path in (folder / FOLDER).glob(f"*{SUFFIX}"))


def example_maps(folder: Path, name: str) -> tuple[OccupancyGrid, list[OccupancyGrid]]:
    """Return the truth and the maps of a drive, all on one lattice.

    Where a map lacks a true wall its cells are unknown, whatever it has there.

    Raises:
        MapFileError: the file is damaged.
    """
    try:
        example = read_example(folder, name)
        return maps_of_differences(example.differences, example.resolution, Pose2())
    except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile) as error:
        path = example_file(folder, name)
        message = f"{path}: cannot be read as the maps of a drive ({error}); run it again"
        raise MapFileError(message) from error
