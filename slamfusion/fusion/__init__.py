"""Normalise, align, vote: several occupancy grids of one place become one.

``fuse_grids`` is the whole pipeline. One alignment is ``slamfusion.align``, the vote
``slamfusion.vote``.
"""

from __future__ import annotations

from slamfusion.align.align import align_grids
from slamfusion.align.records import Alignment, FusionResult, InputRecord, RunnerUp
from slamfusion.fusion.pipeline import fuse_grids

__all__ = ["Alignment", "FusionResult", "InputRecord", "RunnerUp", "align_grids", "fuse_grids"]
