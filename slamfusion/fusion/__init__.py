"""Normalise, align, vote: several occupancy grids of one place become one.

``fuse_grids`` is the whole pipeline, ``align_grids`` one alignment; the modules are its steps in
order: ``normalize``, ``features``, ``search``, ``accept``, ``consistency``. The vote
is ``slamfusion.vote``.
"""

from __future__ import annotations

from slamfusion.fusion.align import align_grids
from slamfusion.fusion.pipeline import fuse_grids
from slamfusion.fusion.records import Alignment, FusionResult, InputRecord, RunnerUp

__all__ = [
    "Alignment",
    "FusionResult",
    "InputRecord",
    "RunnerUp",
    "align_grids",
    "fuse_grids",
]
