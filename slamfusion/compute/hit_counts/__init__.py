"""Hit counts: gmapping's map update, counted hits and visits, and the score field they give.

N maps (particles) have a page table each, (N, PH, PW) int32, over one common window and one set of
pools (T, TILE, TILE); see ``slamfusion.compute.tiles``. A tile that is written must be on one page
of one map only: see ``touch_pages`` and ``copy_tiles``. Positions are in cells of the window.

A cell of ``counts`` (uint32) has its hits in the upper and its visits, hits included, in the lower
16 bits. A cell of ``sums`` (uint32) sums over the hits their offset in the cell, 0 to 15 in 1/16
cell, in x in the upper and in y in the lower 16 bits; an offset stands for the middle of its
sixteenth. An unseen cell is 0 in all pools. A half of a sum has room for the hits of a cell that is
nearly full and of one scan more; see ``FULL_HITS`` and ``MOST_BEAMS`` in ``layout``.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/hit_counts.cl`` do it on a device.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray
from slamfusion.compute.layout import MOST_BEAMS, MOST_REACH, TABLE_LAST
from slamfusion.errors import DeviceError

__all__ = ["BeamScan", "FieldRule", "HitCountDevice", "check_beams", "check_rule"]

U8 = npt.NDArray[np.uint8]
F32 = npt.NDArray[np.float32]


class BeamScan(NamedTuple):
    """A scan as it is written into every map, on the host.

    What lies outside the window is moved to its border.

    Attributes:
        ends: (B, 2) float32 ends of the beams, cells, in the robot's frame.
            ``count_beams`` takes up to ``MOST_BEAMS``.
        is_hit: (B,) uint8, 0 where the beam is free up to its end and met nothing.
        laser: (2,) float32, cells, in the robot's frame.
        poses: (N, 4) float32, the robot in each map: x, y in cells of the window, cos, sin.
    """

    ends: F32
    is_hit: U8
    laser: F32
    poses: F32


class FieldRule(NamedTuple):
    """How the score field follows from the counts.

    Attributes:
        table: (256,) uint8, never rising: the field by the squared distance, in (1/256 cell)^2,
            between the centre of a cell and the mean hit of an occupied one; the last for all that
            is farther.
        shift: the distance is shifted right by this first.
        reach: how many cells around, 0 to ``MOST_REACH``, occupied ones are looked for.
        occupied: a cell is occupied with more hits than this share of its visits, in 1/65536,
        least_hits: and at least this many hits.
    """

    table: U8
    shift: int
    reach: int
    occupied: int
    least_hits: int


def check_beams(scan: BeamScan) -> None:
    """Refuse a scan that could make a cell's sums flow over.

    Raises:
        DeviceError: it has more than ``MOST_BEAMS`` beams.
    """
    if len(scan.ends) > MOST_BEAMS:
        message = f"a scan to be counted has up to {MOST_BEAMS} beams, found {len(scan.ends)}"
        raise DeviceError(message)


def check_rule(rule: FieldRule) -> None:
    """Refuse a rule that no kernel can follow.

    Raises:
        DeviceError: the reach is too far, or the table is no table of distances.
    """
    if not 0 <= rule.reach <= MOST_REACH:
        message = f"the field reaches 0 to {MOST_REACH} cells, asked for {rule.reach}"
        raise DeviceError(message)
    if rule.table.shape != (TABLE_LAST + 1,) or (rule.table[1:] > rule.table[:-1]).any():
        message = f"the field's table must have {TABLE_LAST + 1} entries that never rise"
        raise DeviceError(message)


class HitCountDevice(ArrayDevice, Protocol):
    """A device that counts beams, in place; the scan comes from the host.

    ``hit_counts.numpy`` says what each operation does.
    """

    def touch_pages(
        self, pages: DeviceArray[np.int32], scan: BeamScan, reach: int
    ) -> npt.NDArray[np.uint8]:
        """See ``hit_counts.numpy.touch_pages``."""

    def count_beams(
        self,
        counts: DeviceArray[np.uint32],
        sums: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        scan: BeamScan,
        *,
        take_back: bool = False,
    ) -> bool:
        """See ``hit_counts.numpy.count_beams``."""

    def settle_field(
        self,
        counts: DeviceArray[np.uint32],
        sums: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        scan: BeamScan,
        rule: FieldRule,
    ) -> None:
        """See ``hit_counts.numpy.settle_field``."""
