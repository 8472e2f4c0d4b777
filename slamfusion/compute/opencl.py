"""All families on one OpenCL device: an operation is one kernel launch, or two, on one queue."""

from __future__ import annotations

from slamfusion.compute.cell_means.opencl import OpenCLCellMeans
from slamfusion.compute.chunk_marks.opencl import OpenCLChunkMarks
from slamfusion.compute.doubled_walls.opencl import OpenCLDoubledWalls
from slamfusion.compute.fields.opencl import OpenCLFields
from slamfusion.compute.hit_counts.opencl import OpenCLHitCounts
from slamfusion.compute.rays.opencl import OpenCLRays
from slamfusion.compute.scan_match.opencl import OpenCLScanMatch
from slamfusion.compute.search.opencl import OpenCLSearch
from slamfusion.compute.tiles.opencl import OpenCLTiles
from slamfusion.compute.votes.opencl import OpenCLVotes
from slamfusion.compute.wall_pieces.opencl import OpenCLWallPieces

__all__ = ["OpenCLDevice"]


class OpenCLDevice(
    OpenCLFields,
    OpenCLSearch,
    OpenCLVotes,
    OpenCLRays,
    OpenCLTiles,
    OpenCLScanMatch,
    OpenCLCellMeans,
    OpenCLHitCounts,
    OpenCLChunkMarks,
    OpenCLDoubledWalls,
    OpenCLWallPieces,
):
    """``ComputeDevice`` on one OpenCL device.

    Raises:
        DeviceError: no such device, or the kernels do not build on it.
    """
