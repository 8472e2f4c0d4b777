"""Compare four operations of a device with their NumPy twins, for ``slamfusion doctor``.

The tests of the kernels compare every operation, over many shapes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute.compute_device import ComputeDevice, NumpyDevice
from slamfusion.compute.lattice import fixed_poses, point_planes
from slamfusion.compute.search import ScoredSide
from slamfusion.compute.wall_pieces import PieceSide, piece_points
from slamfusion.errors import DeviceError, counted

SHAPE = (33, 70)
RNG = np.random.default_rng(1)
GRIDS = list(RNG.choice(np.array([-1, 0, 1], np.int8), (3, *SHAPE), p=(0.3, 0.56, 0.14)))
FIELD = RNG.integers(0, 256, SHAPE).astype(np.uint8)
# Cell centres, x and y in half cells, and motions of about the size of the grids.
POINTS = (2 * RNG.integers(0, SHAPE[::-1], (150, 2)) + 1).astype(np.int32)
POSES = fixed_poses(RNG.uniform(-0.5, 0.5, (3, 3)) * (70.0, 70.0, 6.0))
# What a piece of wall looks up in each cell, what points face, and the first point of each piece.
WORDS = RNG.integers(0, 2**32, SHAPE, np.uint32)
FACING = RNG.integers(0, 256, len(POINTS)).astype(np.uint8)
STARTS = np.array([0, 1, 60, len(POINTS)], np.int32)


def _search(device: ComputeDevice) -> list[npt.NDArray[Any]]:
    points, field = point_planes(POINTS, device), device.upload(FIELD)
    return device.pose_scores(ScoredSide(points, POSES.T.astype(np.float64), field, base=64))


def _warp(device: ComputeDevice) -> list[npt.NDArray[Any]]:
    return [device.download(device.warp(device.upload(GRIDS[0]), POSES, SHAPE, -1))]


def _pieces(device: ComputeDevice) -> list[npt.NDArray[Any]]:
    pieces = piece_points(POINTS, FACING, STARTS, device)
    side = PieceSide(pieces, POSES.T.astype(np.float64), device.upload(WORDS), 64)
    return [*device.start_piece_sums(side, sided=True)()]


# By the name of the operation.
OPERATIONS: dict[str, Callable[[ComputeDevice], Sequence[npt.NDArray[Any] | int]]] = {
    "pose_scores": _search,
    "warp": _warp,
    "piece_sums": _pieces,
    "vote_majority": lambda device: device.vote_majority(GRIDS, unknown_votes=True),
}


def self_test(device: ComputeDevice) -> list[tuple[str, bool, str]]:
    """Run the operations once; return name, equality with the twin, and result of each."""
    results = []
    for name, operation in OPERATIONS.items():
        try:
            pairs = zip(operation(device), operation(NumpyDevice()), strict=True)
            wrong = sum(int(np.count_nonzero(own != twin)) for own, twin in pairs)
            found = f"{counted(wrong, 'value', 'differ')} from its NumPy twin" if wrong else ""
        except DeviceError as error:
            found = str(error)
        results.append((name, not found, found or "equals its NumPy twin"))
    return results
