"""Normalise, align, vote: several occupancy grids of one place become one.

``fuse_grids`` is the whole pipeline, ``align_grids`` one alignment; the modules are its steps in
order: ``normalize``, ``features``, ``search``, ``accept``, ``consistency``. The vote
is ``slamfusion.vote``.
"""

from __future__ import annotations

from slamfusion.align.align import align_grids
from slamfusion.align.records import Alignment, FusionResult, InputRecord, RunnerUp
from slamfusion.fusion.pipeline import fuse_grids

__all__ = [
    "Alignment",
    "FusionResult",
    "InputRecord",
    "RunnerUp",
    "align_grids",
    "fuse_grids",
]
