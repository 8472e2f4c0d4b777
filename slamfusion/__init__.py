"""SLAMfusion: align the occupancy grids of several 2D SLAMs and let them vote cell by cell.

The library in a few lines::

    from slamfusion import fuse_maps, map_log, save_fused_maps

    made = map_log("drive.log", "graph")
    fused = fuse_maps([made.grid, "saved.yaml"])
    save_fused_maps(fused, "out/fused")

``__init__.pyi`` lists the public names. Each is loaded when it is first asked for: what is not used
costs nothing. The work is in ``slamfusion.jobs``, the settings in ``slamfusion.config``.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

from slamfusion.version import __version__ as __version__

# Where each public name is defined.
_HOMES = {
    name.name: node.module or ""
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
}
__all__ = sorted(_HOMES)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})
