"""Prove an alignment the best of a written-down search set, or say how far it may be off.

**The search set.** Yaws ``start + 2 pi k / K`` with K the smallest count for which one step moves
the farthest wall point by at most one cell; for each, every whole-cell shift that lands the centre
of the moving grid on a cell centre inside the window where the circle around its walls overlaps
the reference at all (or inside the given window).

**The score** of a member, an integer: up to ``proof_points`` wall points p of the moving grid, each
worth the reference's evidence field L (see ``wall_evidence``; 0..15, wide: sigma
``proof_sigma_cells``; unknown ground is worth its base) in the cell
``u_k(p) + t``, where ``u_k(p) = floor(R(yaw_k) (p - centre) + 1/2)`` and t is the shift.

**The bound.** A block holds ``step`` consecutive yaws around a middle yaw and ``step`` x ``step``
shifts. A point at radius r moves by at most ``a = r * (step - 1) / 2 * (2 pi / K)`` between the
middle yaw and any other of the block (a chord is no longer than its arc), so each coordinate of u
stays within ``floor(x -+ a + 1/2)`` of the middle's exact x. Over the shifts of the block the
point therefore reads only cells of one window of ``step + ceil(2 a)`` cells a side, plus one for
the two roundings, that starts at ``floor(x - a + 1/2)`` plus the block's first shift. The largest
L in that window bounds the point, and the sum over points bounds every member of the block. A
block whose bound does not exceed the answer's score holds nothing better and is dropped; the
others are split into two yaw halves and four shift quarters. At step 1 the window is a single cell
and the bound is the score.

When every block is dropped, no member of the search set outside the answer's neighbourhood scores
above it: ``bound_gap`` is 0. A member that does is a rival: the caller refines it, takes it if its
full score is better, and goes on from there.

Sources: Land and Doig 1960 (branch and bound); Olson, ICRA 2009, and Hess et al., ICRA 2016, for
the max-pooled bound of a correlative score. The yaw blocks and the radius classes are ours.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import SHIFT_LANES
from slamfusion.compute.shift_spans import grouped, shift_spans
from slamfusion.config import AlignConfig
from slamfusion.fusion.features import GridFeatures, spread_sample
from slamfusion.fusion.shifts import SearchWindow, shift_range

__all__ = ["LatticeScore", "Proof", "prove"]

F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]

TOP = 15
RADIUS_CLASSES = (0.35, 0.55, 0.75, 1.0)
FULL_LEVEL_WORK = 6e8
BLOCKS_AT_ONCE = 1 << 17
MEMBERS_KEPT = 64
APART = 8
MEMBERS_AT_ONCE = 1 << 15


@dataclass(frozen=True)
class Proof:
    """What the branch and bound found.

    Attributes:
        bound_gap: 0 when nothing in the search set beats the answer; otherwise by how much a member
            or an undecided block may, in units of the score (1 for every point on a wall).
        rivals: (R, 3) members that score above the answer, best first: where the centre lands in
            cells, yaw in rad.
        finished: whether every block was decided before the deadline.
        blocks: blocks bounded in all.
    """

    bound_gap: float
    rivals: F64
    finished: bool
    blocks: int


class LatticeScore:
    """The integer score over the search set of one pair of grids."""

    def __init__(
        self,
        reference: GridFeatures,
        moving: GridFeatures,
        config: AlignConfig,
        window: SearchWindow,
        device: ComputeDevice,
    ) -> None:
        """Lay out the yaws, the shifts, the points and the field."""
        self.device = device
        table = reference.evidence_table(1, config.proof_sigma_cells, TOP)
        self.base = table.base
        self.field = reference.field(1, table)
        points = spread_sample(moving.level(1).points, config.proof_points)
        self.own = points / 2.0 - np.array(moving.centre)
        self.radii = np.hypot(self.own[:, 0], self.own[:, 1])
        walls = np.concatenate((moving.level(1).points, moving.wall_points))
        far = np.hypot(*(walls / 2.0 - np.array(moving.centre)).T)
        self.reach = math.ceil(float(far.max())) + 1
        self.turn = max(4, math.ceil(2.0 * math.pi * float(far.max())))
        self.yaw_step = 2.0 * math.pi / self.turn
        if window.yaw_rad >= math.pi:
            self.first_yaw, self.yaw_count = 0, self.turn
        else:
            half = math.floor(window.yaw_rad / self.yaw_step)
            self.first_yaw, self.yaw_count = -half, 2 * half + 1
        self.start_yaw = window.start[2]
        shape = reference.shape
        self.rows = shift_range(shape[0], self.reach, window.start[1], window, 1)
        self.cols = shift_range(shape[1], self.reach, window.start[0], window, 1)
        # Where walls are everywhere, a point on one is worth no more than one in the unknown.
        self.scale = float(max(1, table.span) * len(self.own))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Yaws, rows and columns of the search set."""
        return self.yaw_count, self.rows[1] - self.rows[0], self.cols[1] - self.cols[0]

    @property
    def plane_cells(self) -> int:
        """Cells of the padded field that the shifts read: what the search set costs in memory."""
        _, height, width = self.shape
        return (height + 2 * self.reach) * (width + 2 * self.reach)

    def yaw(self, index: npt.ArrayLike) -> F64:
        """Return the yaw in rad of (fractional) yaw indices."""
        return np.asarray(
            self.start_yaw + (self.first_yaw + np.asarray(index, dtype=np.float64)) * self.yaw_step
        )

    def turned(self, yaws: F64) -> tuple[F64, F64]:
        """Return the exact x and y (K, N) of the points at the yaws, centre at the origin."""
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        return cos * self.own[:, 0] - sin * self.own[:, 1], sin * self.own[:, 0] + cos * self.own[
            :, 1
        ]

    def motions(self, members: npt.NDArray[np.int64]) -> F64:
        """Return members (M, 3: yaw index, row, column) as where the centre lands and yaw."""
        return np.stack(
            (
                members[:, 2] + self.cols[0] + 0.5,
                members[:, 1] + self.rows[0] + 0.5,
                self.yaw(members[:, 0]),
            ),
            axis=1,
        )

    def member(self, motion: F64) -> tuple[int, int, int]:
        """Return the member nearest a motion: yaw index, row and column of the search set."""
        turn = (motion[2] - self.start_yaw + math.pi) % (2.0 * math.pi) - math.pi
        index = round(turn / self.yaw_step) - self.first_yaw
        if self.yaw_count == self.turn:
            index %= self.turn
        row = math.floor(motion[1]) - self.rows[0]
        col = math.floor(motion[0]) - self.cols[0]
        _, height, width = self.shape
        return (
            min(max(index, 0), self.yaw_count - 1),
            min(max(row, 0), height - 1),
            min(max(col, 0), width - 1),
        )

    def score_box(
        self, yaws: npt.NDArray[np.int64], rows: tuple[int, int], cols: tuple[int, int]
    ) -> I32:
        """Return the exact scores (K, h, w) of a box of members.

        Args:
            yaws: (K,) yaw indices in the search set.
            rows, cols: half-open ranges of shifts in the search set.
        """
        height, width = rows[1] - rows[0], cols[1] - cols[0]
        lanes = -(-width // SHIFT_LANES) * SHIFT_LANES
        shape = (height + 2 * self.reach + 2, lanes + 2 * self.reach + 2)
        corner = (self.rows[0] + rows[0] - self.reach, self.cols[0] + cols[0] - self.reach)
        plane = self.device.polyphase(self.field, corner, 1, shape, self.base)
        x, y = self.turned(self.yaw(yaws))
        at_row = np.floor(y + 0.5).astype(np.int32) + self.reach
        at_col = np.floor(x + 0.5).astype(np.int32) + self.reach
        offsets = at_row * shape[1] + at_col
        scores = self.device.correlate(_as_planes(plane, shape), offsets, (height, lanes))
        return self.device.download(scores)[:, :, :width]


def _as_planes(handle: DeviceArray[Any], shape: tuple[int, int]) -> DeviceArray[Any]:
    """View a (1, 1, H, W) polyphase result as the (1, H, W) that ``correlate`` takes."""
    return handle.reshape((1, *shape))


def neighbourhood_best(lattice: LatticeScore, motion: F64, radius: int) -> tuple[int, F64]:
    """Return the best score within ``radius`` cells and yaw steps of a motion, and its member."""
    k, row, col = lattice.member(motion)
    count, height, width = lattice.shape
    yaws = np.arange(k - radius, k + radius + 1)
    # Whole turns differ in the last bit of a cosine, and so in a rounding: keep to the set's own.
    yaws = (
        np.unique(yaws % lattice.turn)
        if count == lattice.turn
        else yaws[(yaws >= 0) & (yaws < count)]
    )
    rows = (max(row - radius, 0), min(row + radius + 1, height))
    cols = (max(col - radius, 0), min(col + radius + 1, width))
    scores = lattice.score_box(yaws, rows, cols)
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    member = np.array([[yaws[best[0]], rows[0] + best[1], cols[0] + best[2]]], dtype=np.int64)
    return int(scores.max()), lattice.motions(member)[0]


def prove(lattice: LatticeScore, answer_score: int, deadline_s: float) -> Proof:
    """Search the whole set for a member that scores above ``answer_score``.

    Args:
        lattice: the search set and its score.
        answer_score: the best score in the answer's neighbourhood.
        deadline_s: stop after this many seconds; whole batches are finished, so it may run over by
            one batch.

    Returns:
        The proof; see the module's text for the argument.
    """
    end = time.perf_counter() + deadline_s
    step = _first_step(lattice)
    bounds = _bound_all(lattice, step)
    group, row, col = np.nonzero(bounds > answer_score)
    value = bounds[group, row, col]
    blocks = np.stack((group, row * step, col * step), axis=1).astype(np.int32)
    order = np.argsort(-value, kind="stable")
    blocks, value = blocks[order], value[order]
    done = bounds.size
    undecided = 0
    while len(blocks) and step > 1:
        if len(blocks) * step**3 <= MEMBERS_AT_ONCE:
            # So few are left that scoring their members outright is cheaper than bounding them.
            while step > 1:
                step //= 2
                blocks = _split(blocks, step, lattice.shape)
            value = _BlockBounds(lattice, step, blocks).bounds(blocks)
            done += len(blocks)
            keep = value > answer_score
            blocks, value = blocks[keep], value[keep]
            order = np.argsort(-value, kind="stable")
            blocks, value = blocks[order], value[order]
            break
        step //= 2
        halves = np.concatenate((2 * blocks, 2 * blocks + 1))  # only the yaw groups count
        pools = _BlockBounds(lattice, step, halves)
        kept_blocks, kept_values = [], []
        for start in range(0, len(blocks), BLOCKS_AT_ONCE // 8):
            if time.perf_counter() > end:
                undecided = max(undecided, int(value[start:].max()))
                break
            children = _split(blocks[start : start + BLOCKS_AT_ONCE // 8], step, lattice.shape)
            child_values = pools.bounds(children)
            done += len(children)
            keep = child_values > answer_score
            kept_blocks.append(children[keep])
            kept_values.append(child_values[keep])
        blocks = np.concatenate(kept_blocks) if kept_blocks else blocks[:0]
        value = np.concatenate(kept_values) if kept_values else value[:0]
        order = np.argsort(-value, kind="stable")
        blocks, value = blocks[order], value[order]
        if undecided:
            undecided = max(undecided, int(value.max(initial=0)))
            blocks = blocks[:0]
    rivals = lattice.motions(_spread(blocks.astype(np.int64)))
    highest = max(undecided, int(value.max(initial=0)) if len(blocks) else 0)
    gap = max(0, highest - answer_score) / lattice.scale if highest else 0.0
    return Proof(gap, rivals, undecided == 0, done)


def _spread(members: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the best members (best first), none within 8 cells and yaw steps of a better one."""
    kept: list[npt.NDArray[np.int64]] = []
    while len(members) and len(kept) < MEMBERS_KEPT:
        kept.append(members[0])
        members = members[np.abs(members - members[0]).max(axis=1) > APART]
    return np.array(kept, dtype=np.int64).reshape(-1, 3)


def _first_step(lattice: LatticeScore) -> int:
    """Return the smallest block size whose full level stays within the work limit."""
    count, height, width = lattice.shape
    step = 2
    while count / step * (height / step) * (width / step) * len(lattice.own) > FULL_LEVEL_WORK:
        step *= 2
    return step


def _split(blocks: I32, step: int, shape: tuple[int, int, int]) -> I32:
    """Return the children of blocks of ``2 * step`` that hold a member of the search set."""
    children = np.concatenate(
        [
            np.stack(
                (2 * blocks[:, 0] + a, blocks[:, 1] + b * step, blocks[:, 2] + c * step), axis=1
            )
            for a in (0, 1)
            for b in (0, 1)
            for c in (0, 1)
        ]
    )
    inside = (
        (children[:, 0] * step < shape[0])
        & (children[:, 1] < shape[1])
        & (children[:, 2] < shape[2])
    )
    return np.ascontiguousarray(children[inside])


class _Windows:
    """Where each point's window starts for every yaw group of a level, and the window sizes."""

    def __init__(self, lattice: LatticeScore, step: int, groups: npt.NDArray[np.int64]) -> None:
        middle = groups * step + (step - 1) / 2.0
        x, y = lattice.turned(lattice.yaw(middle))
        far = float(lattice.radii.max())
        limits = np.array(RADIUS_CLASSES) * max(far, 1e-9) * (1.0 + 1e-9)
        self.classes = np.searchsorted(limits, lattice.radii).clip(0, len(limits) - 1)
        # One step turns the farthest wall by at most a cell; points of the sample lie within it.
        half = (step - 1) / 2.0 * lattice.yaw_step
        slack = limits[self.classes] * half + 1e-6
        if step == 1:
            slack = np.zeros_like(slack)
        self.rows = np.floor(y - slack + 0.5).astype(np.int32) + lattice.rows[0]
        self.cols = np.floor(x - slack + 0.5).astype(np.int32) + lattice.cols[0]
        extra = np.ceil(2.0 * (limits * half + 1e-6)).astype(int)
        self.sizes = [1 if step == 1 else step + int(e) for e in extra]


def _pooled(lattice: LatticeScore, window: int, pad: int) -> DeviceArray[Any]:
    """Return the field, padded by ``pad`` before it, with the maximum over windows."""
    height, width = lattice.field.shape
    padded = lattice.device.polyphase(
        lattice.field, (-pad, -pad), 1, (height + pad, width + pad), lattice.base
    ).reshape((height + pad, width + pad))
    along = lattice.device.max_window(padded, window, along_rows=True, fill=lattice.base)
    return lattice.device.max_window(along, window, along_rows=False, fill=lattice.base)


def _bound_all(lattice: LatticeScore, step: int) -> I32:
    """Return the bound of every block of a level: (groups, rows, cols) int32."""
    windows = _Windows(lattice, step, np.arange(-(-lattice.shape[0] // step)))
    device = lattice.device
    _, height, width = lattice.shape
    rows, cols = -(-height // step), -(-width // step)
    lanes = -(-cols // SHIFT_LANES) * SHIFT_LANES
    row0, col0 = int(windows.rows.min()), int(windows.cols.min())
    plane_rows = (int(windows.rows.max()) - row0) // step + rows + 1
    plane_cols = (int(windows.cols.max()) - col0) // step + lanes + 1
    pad = max(windows.sizes)
    planes = []
    for size in windows.sizes:
        pooled = _pooled(lattice, size, pad)
        corner = (row0 + pad, col0 + pad)
        planes.append(
            device.download(
                device.polyphase(pooled, corner, step, (plane_rows, plane_cols), lattice.base)
            )
        )
    field = device.upload(np.stack(planes).reshape(1, -1, plane_cols))
    at_row, at_col = windows.rows - row0, windows.cols - col0
    plane = (windows.classes * step + at_row % step) * step + at_col % step
    offsets = (plane * plane_rows + at_row // step) * plane_cols + at_col // step
    order = grouped(lattice.own)
    # Where a window of the widest class meets the field, in blocks.
    first = (1 - max(windows.sizes)) // step
    ends = [-(-size // step) for size in lattice.field.shape]
    box = (first, ends[0], first, ends[1])
    spans = shift_spans(
        windows.rows[:, order] // step, windows.cols[:, order] // step, np.array([box])
    )
    scores = device.correlate(
        field, offsets[:, order].astype(np.int32), (rows, lanes), spans, lattice.base
    )
    return device.download(scores)[:, :, :cols]


class _BlockBounds:
    """Bounds of listed blocks at one level."""

    def __init__(self, lattice: LatticeScore, step: int, blocks: I32) -> None:
        """Prepare the windows of the yaw groups among ``blocks``."""
        groups = np.unique(blocks[:, 0]).astype(np.int64)
        self.slots = np.zeros(int(groups[-1]) + 1, dtype=np.int32)
        self.slots[groups] = np.arange(len(groups), dtype=np.int32)
        windows = _Windows(lattice, step, groups)
        self.device, self.base = lattice.device, lattice.base
        self.pad = max(windows.sizes)
        sizes = sorted(set(windows.sizes))
        pooled = [self.device.download(_pooled(lattice, size, self.pad)) for size in sizes]
        self.fields = self.device.upload(np.stack(pooled))
        plane = np.array([sizes.index(size) for size in windows.sizes], dtype=np.uint8)
        self.classes = plane[windows.classes]
        starts = np.stack((windows.rows, windows.cols), axis=1) + self.pad
        self.starts = self.device.upload(np.ascontiguousarray(starts.astype(np.int32)))

    def bounds(self, blocks: I32) -> I32:
        """Return the bound of each block (B, 3): yaw group, first row, first column."""
        own = blocks.copy()
        own[:, 0] = self.slots[blocks[:, 0]]
        return self.device.bound_blocks(own, self.starts, self.classes, self.fields, self.base)
