"""Rays: the first thing that each ray through a grid meets.

``kernels/rays.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import numpy as np

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import OPEN, RAY_FLOATS, RAY_HIT_FLOATS, WALL
from slamfusion.geometry import F32

# A ray with a smaller cosine runs along the cells' edges.
SMALLEST_COSINE = 1e-9


def ray_table(rays: F32) -> F32:
    """Return rays (N, 4) with the reciprocals of cos and sin, (N, 6) float32.

    A cosine too small to divide by counts as 0, its reciprocal as infinite.
    """
    table = np.empty((len(rays), RAY_FLOATS), dtype=np.float32)
    table[:, :4] = rays
    tiny = np.abs(table[:, 2:4]) < SMALLEST_COSINE
    table[:, 2:4][tiny] = 0.0
    table[:, 4:] = np.inf
    np.divide(np.float32(1.0), table[:, 2:4], out=table[:, 4:], where=~tiny)
    return table


class RayDevice(ArrayDevice):
    """A device that casts rays."""

    def cast_rays(self, cells: DeviceArray[np.uint8], rays: F32, reach_cells: float) -> F32:
        """Follow rays through a grid to the first thing they meet, cell by cell.

        A ray that starts in a wall or in glass meets it at distance 0; one that starts off the grid
        may enter it; off the grid is open. A ray through a corner goes on to the next column first.

        Args:
            cells: (H, W) uint8: 0 open, 1 wall, 2 glass.
            rays: (N, 4) float32: x and y in cells (cell [r, c] covers [c, c + 1) x [r, r + 1)), cos
                and sin of the direction, a unit vector.

        Returns:
            (N, 4) float32: distance in cells to the first wall or glass, infinite for none; its
            class; the cosine between the ray and the normal of the cell edge where it was met (1
            where the ray starts, 0 for none); distance to the first wall, any glass passed,
            infinite for none.

        Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, Eurographics
        1987.
        """
        if self.opencl:
            count = len(rays)
            return self.opencl.launch_into(
                np.empty((count, RAY_HIT_FLOATS), np.float32), "cast_rays", (count,), cells,
                *cells.shape, self.upload(ray_table(rays)), count, reach_cells,
            )  # fmt: skip
        cells = host(cells)
        x, y, cosine, sine, per_x, per_y = ray_table(rays).T
        start, per = np.stack((x, y)), np.stack((per_x, per_y))
        step = np.sign(np.stack((cosine, sine))).astype(np.int64)
        faces = np.abs(np.stack((cosine, sine)))
        place = np.floor(start).astype(np.int64)
        size = np.array(cells.shape[::-1])[:, None]
        reach = np.float32(reach_cells)

        hits = np.tile(np.array([np.inf, 0.0, 0.0, np.inf], dtype=np.float32), (len(rays), 1))
        t = np.zeros(len(rays), dtype=np.float32)
        face = np.ones(len(rays), dtype=np.float32)
        going = np.flatnonzero(t <= reach)
        while going.size:
            at, steps = place[:, going], step[:, going]
            inside = ((at >= 0) & (at < size)).all(axis=0)
            leaving = (((steps <= 0) & (at < 0)) | ((steps >= 0) & (at >= size))).any(axis=0)
            met = np.zeros(going.size, dtype=np.uint8)
            met[inside] = cells[at[1, inside], at[0, inside]]

            new = (met != OPEN) & (hits[going, 1] == OPEN)
            hits[going[new], 0] = t[going[new]]
            hits[going[new], 1] = met[new]
            hits[going[new], 2] = face[going[new]]
            hits[going[met == WALL], 3] = t[going[met == WALL]]

            going = going[(met != WALL) & ~leaving]
            ways = step[:, going] != 0
            ahead = (place[:, going] + (step[:, going] > 0)).astype(np.float32) - start[:, going]
            edges = np.full(ahead.shape, np.inf, dtype=np.float32)
            np.multiply(ahead, per[:, going], out=edges, where=ways)
            axis = (edges[0] > edges[1]).astype(np.int64)
            column = np.arange(going.size)
            t[going] = edges[axis, column]
            face[going] = faces[axis, going]
            place[axis, going] += step[axis, going]
            going = going[t[going] <= reach]
        return hits
