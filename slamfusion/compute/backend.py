"""``Backend``: the dozen operations that run once per cell, point or candidate pose.

Host logic is written once above this protocol. Arrays that stay on the device are passed as opaque
handles from ``upload`` or from another operation; small results come back as NumPy arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.compute import hit_map_reference, reference, slam_reference
from slamfusion.compute.hit_map_reference import BeamScan, FieldRule
from slamfusion.compute.reference import DISTANCE_MAX
from slamfusion.compute.slam_reference import BeamRule, SmearRule

__all__ = ["Backend", "Handle", "NumpyBackend"]

Handle: TypeAlias = Any
# ``correlate`` does shifts along a row in multiples of this.
SHIFT_LANES = 32


class Backend(Protocol):
    """What a compute device must offer; ``slamfusion.compute.reference`` defines each operation.

    Attributes:
        name: the device in words, for tables and reports.
        is_opencl: False for the NumPy twins.
    """

    name: str
    is_opencl: bool

    def upload(self, array: npt.NDArray[Any]) -> Handle:
        """Bring an array to the device."""

    def download(self, handle: Handle) -> npt.NDArray[Any]:
        """Bring an array back, shape and dtype kept."""

    def solid_walls(self, cells: Handle) -> Handle:
        """See ``reference.solid_walls``."""

    def surface_walls(self, cells: Handle, solid: Handle) -> Handle:
        """See ``reference.surface_walls``."""

    def shrink(self, walls: Handle, cells: Handle, step: int) -> tuple[Handle, Handle]:
        """See ``reference.shrink``."""

    def distance_squared(self, walls: Handle, reach: int = DISTANCE_MAX) -> Handle:
        """See ``reference.distance_squared``."""

    def score_field(
        self,
        distance2: Handle,
        free_share: Handle,
        hit: npt.NDArray[np.uint16],
        miss: npt.NDArray[np.uint16],
        base: int,
    ) -> Handle:
        """See ``reference.score_field``."""

    def look_up(self, values: Handle, table: npt.NDArray[np.uint16]) -> Handle:
        """See ``reference.look_up``."""

    def max_window(self, field: Handle, window: int, *, along_rows: bool, fill: int) -> Handle:
        """See ``reference.max_window``."""

    def warp(
        self, cells: Handle, poses: npt.NDArray[np.int64], shape: tuple[int, int], fill: int
    ) -> Handle:
        """See ``reference.warp``."""

    def confusion(self, a: Handle, b: Handle) -> npt.NDArray[np.int64]:
        """See ``reference.confusion``."""

    def squared_error(
        self, a: Handle, b: Handle, poses: npt.NDArray[np.int64], stride: int
    ) -> npt.NDArray[np.int64]:
        """See ``reference.squared_error``."""

    def correlate(
        self, fields: Handle, offsets: npt.NDArray[np.int32], shift_shape: tuple[int, int]
    ) -> Handle:
        """See ``reference.correlate``; ``shift_shape[1]`` a multiple of 32."""

    def polyphase(
        self, field: Handle, corner: tuple[int, int], step: int, shape: tuple[int, int], fill: int
    ) -> Handle:
        """See ``reference.polyphase``."""

    def bound_blocks(
        self,
        blocks: npt.NDArray[np.int32],
        starts: Handle,
        classes: npt.NDArray[np.uint8],
        fields: Handle,
        fill: int,
        *,
        least: int = -1,
    ) -> npt.NDArray[np.int32]:
        """See ``reference.bound_blocks``."""

    def tile_peaks(
        self, forward: Handle, backward: Handle, width: int, tile: int
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """See ``reference.tile_peaks``."""

    def pose_counts(
        self,
        points: npt.NDArray[np.int32],
        poses: npt.NDArray[np.int64],
        field: Handle,
        distance2: Handle,
        free_cell: Handle,
        *,
        base: int,
        near2: int,
        far2: int,
    ) -> npt.NDArray[np.int64]:
        """See ``reference.pose_counts``."""

    def refine_terms(
        self,
        points: Handle,
        poses: npt.NDArray[np.float32],
        distance: Handle,
        *,
        scale: float,
        centre: tuple[float, float],
        backward: bool,
    ) -> npt.NDArray[np.float64]:
        """See ``reference.refine_terms``."""

    def vote_majority(
        self, grids: Sequence[npt.NDArray[np.int8]], *, unknown_votes: bool
    ) -> reference.Votes:
        """See ``reference.vote_majority``; the grids come from the host and return to it."""

    def vote_weighted(
        self,
        grids: Sequence[npt.NDArray[np.int8]],
        weights: npt.NDArray[np.int32],
        *,
        unknown_votes: bool,
    ) -> reference.Votes:
        """See ``reference.vote_weighted``."""

    def vote_log_odds(
        self,
        grids: Sequence[npt.NDArray[np.int8]],
        odds: npt.NDArray[np.int32],
        *,
        occupied_percent: int,
        free_percent: int,
    ) -> reference.Votes:
        """See ``reference.vote_log_odds``."""

    def cast_rays(
        self, cells: Handle, rays: npt.NDArray[np.float32], reach_cells: float
    ) -> npt.NDArray[np.float32]:
        """See ``reference.cast_rays``."""

    def extend(self, pool: Handle, count: int, fill: int) -> Handle:
        """Return a pool (T, ...) with ``count`` tiles, T or more; the new ones hold ``fill``."""

    def score_poses(
        self,
        field: Handle,
        pages: Handle,
        points: Handle,
        poses: npt.NDArray[np.float32],
        *,
        reach: int = 0,
    ) -> npt.NDArray[np.int64]:
        """See ``slam_reference.score_poses``; the poses come from the host."""

    def climb(
        self,
        field: Handle,
        pages: Handle,
        points: Handle,
        guesses: npt.NDArray[np.float32],
        starts: npt.NDArray[np.float32],
        steps: npt.NDArray[np.float32],
        *,
        scale: float,
    ) -> npt.NDArray[np.float32]:
        """See ``slam_reference.climb``; guesses, starts and steps come from the host."""

    def climb_maps(
        self,
        field: Handle,
        pages: Handle,
        points: Handle,
        guesses: npt.NDArray[np.float32],
        starts: npt.NDArray[np.float32],
        sizes: npt.NDArray[np.float32],
        *,
        tries: int,
        scale: float,
    ) -> npt.NDArray[np.float32]:
        """See ``slam_reference.climb_maps``; guesses, starts and sizes come from the host."""

    def score_maps(
        self,
        field: Handle,
        pages: Handle,
        points: Handle,
        poses: npt.NDArray[np.float32],
        table: npt.NDArray[np.int32],
    ) -> npt.NDArray[np.int64]:
        """See ``slam_reference.score_maps``; poses and table come from the host."""

    def tiny_mark(
        self, observed: Handle, pages: Handle, beams: Handle, rule: BeamRule, wanted: Handle
    ) -> bool:
        """See ``slam_reference.tiny_mark``; works in place."""

    def tiny_fold(
        self,
        observed: Handle,
        valley: Handle,
        published: Handle,
        field: Handle,
        pages: Handle,
        beams: Handle,
        rule: BeamRule,
    ) -> None:
        """See ``slam_reference.tiny_fold``; works in place."""

    def touch_pages(self, pages: Handle, scan: BeamScan, reach: int) -> npt.NDArray[np.uint8]:
        """See ``hit_map_reference.touch_pages``; the scan comes from the host."""

    def copy_tiles(self, pools: tuple[Handle, ...], pairs: npt.NDArray[np.int32]) -> None:
        """See ``hit_map_reference.copy_tiles``; works in place, the pairs come from the host."""

    def take_tiles(self, pool: Handle, numbers: npt.NDArray[np.int32]) -> npt.NDArray[Any]:
        """See ``hit_map_reference.take_tiles``; the numbers come from the host."""

    def count_beams(
        self,
        counts: Handle,
        sums: Handle,
        pages: Handle,
        scan: BeamScan,
        *,
        take_back: bool = False,
    ) -> bool:
        """See ``hit_map_reference.count_beams``; works in place."""

    def settle_field(
        self,
        counts: Handle,
        sums: Handle,
        field: Handle,
        pages: Handle,
        scan: BeamScan,
        rule: FieldRule,
    ) -> None:
        """See ``hit_map_reference.settle_field``; works in place."""

    def smear_mark(
        self, observed: Handle, pages: Handle, beams: Handle, rule: SmearRule, wanted: Handle
    ) -> bool:
        """See ``slam_reference.smear_mark``; works in place."""

    def smear_fold(
        self,
        observed: Handle,
        states: Handle,
        field: Handle,
        pages: Handle,
        beams: Handle,
        rule: SmearRule,
    ) -> None:
        """See ``slam_reference.smear_fold``; works in place."""


class NumpyBackend:
    """The twins as a backend: the whole program without OpenCL, slowly and plainly."""

    name = "NumPy twins (no OpenCL)"
    is_opencl = False

    solid_walls = staticmethod(reference.solid_walls)
    surface_walls = staticmethod(reference.surface_walls)
    shrink = staticmethod(reference.shrink)
    distance_squared = staticmethod(reference.distance_squared)
    score_field = staticmethod(reference.score_field)
    look_up = staticmethod(reference.look_up)
    max_window = staticmethod(reference.max_window)
    warp = staticmethod(reference.warp)
    confusion = staticmethod(reference.confusion)
    squared_error = staticmethod(reference.squared_error)
    correlate = staticmethod(reference.correlate)
    polyphase = staticmethod(reference.polyphase)
    bound_blocks = staticmethod(reference.bound_blocks)
    tile_peaks = staticmethod(reference.tile_peaks)
    pose_counts = staticmethod(reference.pose_counts)
    refine_terms = staticmethod(reference.refine_terms)
    vote_majority = staticmethod(reference.vote_majority)
    vote_weighted = staticmethod(reference.vote_weighted)
    vote_log_odds = staticmethod(reference.vote_log_odds)
    score_poses = staticmethod(slam_reference.score_poses)
    climb = staticmethod(slam_reference.climb)
    climb_maps = staticmethod(slam_reference.climb_maps)
    score_maps = staticmethod(slam_reference.score_maps)
    tiny_mark = staticmethod(slam_reference.tiny_mark)
    tiny_fold = staticmethod(slam_reference.tiny_fold)
    smear_mark = staticmethod(slam_reference.smear_mark)
    smear_fold = staticmethod(slam_reference.smear_fold)
    touch_pages = staticmethod(hit_map_reference.touch_pages)
    copy_tiles = staticmethod(hit_map_reference.copy_tiles)
    take_tiles = staticmethod(hit_map_reference.take_tiles)
    count_beams = staticmethod(hit_map_reference.count_beams)
    settle_field = staticmethod(hit_map_reference.settle_field)
    cast_rays = staticmethod(reference.cast_rays)

    @staticmethod
    def upload(array: npt.NDArray[Any]) -> Handle:
        """Return a copy that operations may change in place."""
        return array.copy()

    @staticmethod
    def download(handle: Handle) -> npt.NDArray[Any]:
        """Return the array itself."""
        array: npt.NDArray[Any] = handle
        return array

    @staticmethod
    def extend(pool: Handle, count: int, fill: int) -> Handle:
        """Return a longer copy."""
        grown = np.full((count, *pool.shape[1:]), fill, dtype=pool.dtype)
        grown[: len(pool)] = pool
        return grown
