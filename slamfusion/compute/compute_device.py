"""``ComputeDevice``: every family of operations on one device, and the device of the NumPy twins.

Host logic is written once above these protocols, and asks for the families that it needs. Arrays
that stay on the device travel as ``DeviceArray``; small results come back as NumPy arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy.typing as npt

from slamfusion.compute.cell_means import CellMeanDevice
from slamfusion.compute.cell_means import numpy as cell_means
from slamfusion.compute.chunk_marks import ChunkMarkDevice
from slamfusion.compute.chunk_marks import numpy as chunk_marks
from slamfusion.compute.doubled_walls import DoubledWallDevice
from slamfusion.compute.doubled_walls import numpy as doubled_walls
from slamfusion.compute.fields import FieldDevice
from slamfusion.compute.fields import numpy as fields
from slamfusion.compute.hit_counts import HitCountDevice
from slamfusion.compute.hit_counts import numpy as hit_counts
from slamfusion.compute.rays import RayDevice
from slamfusion.compute.rays import numpy as rays
from slamfusion.compute.scan_match import ScanMatchDevice
from slamfusion.compute.scan_match import numpy as scan_match
from slamfusion.compute.search import SearchDevice
from slamfusion.compute.search import numpy as search
from slamfusion.compute.tiles import TileDevice
from slamfusion.compute.tiles import numpy as tiles
from slamfusion.compute.votes import VoteDevice
from slamfusion.compute.votes import numpy as votes
from slamfusion.compute.wall_pieces import WallPieceDevice
from slamfusion.compute.wall_pieces import numpy as wall_pieces

__all__ = ["FAMILIES", "ComputeDevice", "NumpyDevice"]

# The protocol of each family by the name of its folder, which is that of its kernels' file too.
FAMILIES: dict[str, type] = {
    "fields": FieldDevice,
    "search": SearchDevice,
    "votes": VoteDevice,
    "rays": RayDevice,
    "tiles": TileDevice,
    "scan_match": ScanMatchDevice,
    "cell_means": CellMeanDevice,
    "hit_counts": HitCountDevice,
    "chunk_marks": ChunkMarkDevice,
    "doubled_walls": DoubledWallDevice,
    "wall_pieces": WallPieceDevice,
}


class ComputeDevice(
    FieldDevice,
    SearchDevice,
    VoteDevice,
    RayDevice,
    TileDevice,
    ScanMatchDevice,
    CellMeanDevice,
    HitCountDevice,
    ChunkMarkDevice,
    DoubledWallDevice,
    WallPieceDevice,
    Protocol,
):
    """What a compute device must offer: all families."""


def _twin(function: Callable[..., Any]) -> Any:
    """Return a twin as an operation of ``NumpyDevice``.

    The protocols promise to take any ``DeviceArray``. A twin takes arrays of the host, which is
    what this device's arrays are: the one place where types cannot tell.
    """
    return staticmethod(function)


class NumpyDevice:
    """The twins as a device: the whole program without OpenCL, slowly and plainly."""

    name = "NumPy twins (no OpenCL)"
    is_opencl = False

    solid_walls = _twin(fields.solid_walls)
    surface_walls = _twin(fields.surface_walls)
    shrink = _twin(fields.shrink)
    distance_squared = _twin(fields.distance_squared)
    score_field = _twin(fields.score_field)
    look_up = _twin(fields.look_up)
    look_up_where = _twin(fields.look_up_where)
    max_window = _twin(fields.max_window)
    warp = _twin(fields.warp)

    confusion = _twin(search.confusion)
    squared_error = _twin(search.squared_error)
    correlate = _twin(search.correlate)
    polyphase = _twin(search.polyphase)
    bound_blocks = _twin(search.bound_blocks)
    tile_peaks = _twin(search.tile_peaks)
    pose_counts = _twin(search.pose_counts)
    pose_scores = _twin(search.pose_scores)
    refine_terms = _twin(search.refine_terms)

    vote_majority = _twin(votes.vote_majority)
    vote_walls = _twin(votes.vote_walls)

    cast_rays = _twin(rays.cast_rays)

    extend = _twin(tiles.extend)
    copy_tiles = _twin(tiles.copy_tiles)
    take_tiles = _twin(tiles.take_tiles)

    score_poses = _twin(scan_match.score_poses)
    climb = _twin(scan_match.climb)
    climb_maps = _twin(scan_match.climb_maps)
    score_maps = _twin(scan_match.score_maps)

    mark_scan = _twin(cell_means.mark_scan)
    integrate_scan = _twin(cell_means.integrate_scan)
    mark_likelihood = _twin(cell_means.mark_likelihood)
    update_likelihood = _twin(cell_means.update_likelihood)

    touch_pages = _twin(hit_counts.touch_pages)
    count_beams = _twin(hit_counts.count_beams)
    settle_field = _twin(hit_counts.settle_field)

    mark_chunks = _twin(chunk_marks.mark_chunks)
    nearest_marks = _twin(chunk_marks.nearest_marks)

    mark_doubled = _twin(doubled_walls.mark_doubled)

    piece_sums = _twin(wall_pieces.piece_sums)

    @staticmethod
    def upload(array: npt.NDArray[Any]) -> Any:
        """Return a copy that operations may change in place."""
        return array.copy()

    @staticmethod
    def download(handle: Any) -> npt.NDArray[Any]:
        """Return the array itself."""
        array: npt.NDArray[Any] = handle
        return array

    @staticmethod
    def finish() -> None:
        """Return at once: each operation ends before it returns."""
