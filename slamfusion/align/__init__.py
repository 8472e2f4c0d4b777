"""Do two occupancy grids show one place, and where do they lie on each other?

``align_grids`` is one alignment; ``align.py`` lists its steps in order.
"""

from __future__ import annotations

from slamfusion.align.align import align_grids
from slamfusion.align.records import Alignment

__all__ = ["Alignment", "align_grids"]
