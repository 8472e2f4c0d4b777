"""SLAMfusion: align the occupancy grids of several 2D SLAMs and let them vote cell by cell.

The library in a few lines::

    from slamfusion import fuse_maps, map_log, save_fused_maps

    made = map_log("drive.log", "graph")
    fused = fuse_maps([made.grid, "saved.yaml"])
    save_fused_maps(fused, "out/fused")

``__init__.pyi`` lists the public names; each is loaded on first use. The work is in
``slamfusion.jobs``, the settings in ``slamfusion.config``.
"""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names
from slamfusion.version import __version__ as __version__

__all__, __getattr__ = lazy_names(__name__, __file__)


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})
