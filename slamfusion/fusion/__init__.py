"""Normalise, align, vote: several occupancy grids of one place become one.

``fuse_grids`` is the whole pipeline, ``align_grids`` one alignment; the modules are its steps in
order: ``normalize``, ``features``, ``search``, ``proof``, ``accept``, ``consistency``, ``vote``.
"""

from __future__ import annotations

from slamfusion.fusion.align import align_grids
from slamfusion.fusion.pipeline import fuse_grids
from slamfusion.fusion.records import Alignment, FusionResult, InputRecord, RunnerUp, VoteResult

__all__ = [
    "Alignment",
    "FusionResult",
    "InputRecord",
    "RunnerUp",
    "VoteResult",
    "align_grids",
    "fuse_grids",
]
