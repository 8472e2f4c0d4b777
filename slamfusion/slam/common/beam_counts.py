"""``BeamCounts``: hits and visits of every cell, of scans that can be taken back.

Counts are whole numbers, and points are rounded to a lattice that does not depend on the map's
size: a map of scans of which some were taken back and counted elsewhere is bit for bit the same as
one of them from scratch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import BEAM_ONE, MOST_BEAMS, TILE
from slamfusion.geometry import B8, F64, I32, I64, U32, Scalar, corners, transform_points
from slamfusion.slam.common.tile_map import SharedTileMaps


@dataclass(frozen=True, eq=False)
class Beams:
    """Beams of scans on the lattice, in cells.

    Attributes:
        lasers: (N, 2) float64, of each scan.
        ends: (B, 2) float64.
        is_hit: (B,) bool, whether something is there.
        firsts: (N + 1,) int64, the beams of scan i are firsts[i] to firsts[i + 1] - 1.
    """

    lasers: F64
    ends: F64
    is_hit: B8
    firsts: I64

    @classmethod
    def of(cls, scans: Sequence[Any], poses: npt.ArrayLike, resolution: float) -> Beams:
        """Place scans, of ``ends`` and ``laser`` in metres in their frames, on the lattice."""
        hits = [scan.ends[:: -(-len(scan.ends) // MOST_BEAMS)] for scan in scans]
        sizes = np.array([len(own) for own in hits])
        of = np.repeat(np.arange(len(scans)), sizes)
        ends = np.concatenate(hits)
        lasers, placed = np.array([scan.laser for scan in scans]), np.array(poses)

        def in_cells(points: F64) -> F64:
            return np.asarray(np.rint(points / resolution * BEAM_ONE) / BEAM_ONE)

        return cls(
            in_cells(transform_points(placed, lasers)),
            in_cells(transform_points(placed, ends, of)),
            np.ones(len(ends), dtype=np.bool_),
            np.concatenate(([0], np.cumsum(sizes))).astype(np.int64),
        )

    @property
    def scans(self) -> I64:
        """The scan of each beam."""
        return np.repeat(np.arange(len(self.lasers)), np.diff(self.firsts))


class BeamCounts:
    """Hits and visits of every cell."""

    def __init__(self, device: ComputeDevice) -> None:
        self._device = device
        words = np.zeros((TILE, TILE), dtype=np.uint32)
        self._maps = SharedTileMaps(device, 1, {"hits": words, "visits": words})

    @property
    def memory_bytes(self) -> int:
        """Bytes of the counts."""
        return self._maps.memory_bytes

    def place(self, beams: Beams) -> I32:
        """Return the ends of beams, (B, 2), in 1/1024 cell of the lattice, with tiles for them."""
        maps, (low, high) = self._maps, corners(np.concatenate((beams.ends, beams.lasers)))
        maps.cover(low - 1.0, high + 1.0)
        lasers, ends = beams.lasers - maps.origin, beams.ends - maps.origin
        maps.make_writable(_pages_crossed(lasers, ends, beams.scans, maps.pages.shape[1:])[None])
        return self.ends(beams)

    def ends(self, beams: Beams) -> I32:
        """Return the same of beams that were placed before."""
        return np.asarray(_fixed(beams.ends - self._maps.origin) + self._corner)

    @property
    def _corner(self) -> I32:
        """The corner of the window in 1/1024 cell, (2,)."""
        return np.asarray(self._maps.corner * (TILE * BEAM_ONE), dtype=np.int32)

    def count(self, beams: Beams, ends: I32, sign: int) -> None:
        """Count beams with these ends, or with -1 take them back."""
        maps = self._maps
        hits, visits = maps.pools["hits"], maps.pools["visits"]
        lasers = _fixed(beams.lasers - maps.origin)[beams.scans]
        rows = np.concatenate((ends - self._corner, lasers), axis=1)
        is_hit = beams.is_hit.astype(np.uint8)
        self._device.count_walks(hits, visits, maps.page_tables, rows, is_hit, sign)

    def cells(
        self, rule: Callable[[U32, U32], npt.NDArray[Scalar]], kind: type[Scalar]
    ) -> tuple[npt.NDArray[Scalar], I64]:
        """Return cells (H, W), and the lattice's column and row of the first one.

        ``rule`` makes cells of the hits and visits of some tiles, (K, TILE, TILE) each.
        """
        return self._maps.made(rule, kind, ("hits", "visits"), 0)


def _fixed(cells: F64) -> I32:
    """Return places, cells of the window, in 1/1024 cell."""
    return np.asarray(np.floor(cells * BEAM_ONE), dtype=np.int32)


def _pages_crossed(lasers: F64, ends: F64, of: I64, shape: tuple[int, ...]) -> B8:
    """Return which pages beams may cross, (PH, PW) bool, with some neighbours.

    ``of`` is the scan of each beam. One beam of a scan is followed to the middle of each end page;
    the others stay within a page.
    """
    crossed = np.zeros(shape, dtype=np.bool_)
    col, row = np.floor(ends / TILE).astype(np.int64).T
    _, one = np.unique((of * shape[0] + row) * shape[1] + col, return_index=True)
    start = lasers[of[one]]
    middle = np.stack((col[one], row[one]), axis=1) * TILE + 0.5 * TILE
    steps = np.ceil(np.abs(middle - start).max(axis=1, initial=0.0) / (0.5 * TILE)).astype(np.int64)
    for step in range(int(steps.max(initial=0)) + 1):
        going = steps >= step
        share = step / np.maximum(steps[going], 1)
        at = start[going] + share[:, None] * (middle[going] - start[going])
        at_col, at_row = np.floor(at / TILE).astype(np.int64).T
        crossed[at_row, at_col] = True
    return np.asarray(scipy.ndimage.binary_dilation(crossed, np.ones((3, 3), dtype=np.bool_)))
