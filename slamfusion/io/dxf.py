"""Floor plans from CAD: a DXF drawing's lines as the walls of an occupancy grid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamfusion.errors import MapFileError, extra_needed
from slamfusion.geometry import I8
from slamfusion.io.files import check_memory

# Cell size in metres if the drawing has a unit; else the number of cells on its longest side,
# which are taken as that size until the scale is found.
CELL_M, UNITLESS_CELLS = 0.05, 1000
# Annotations, not building parts.
WORDS = frozenset(
    ("ATTDEF", "ATTRIB", "DIMENSION", "LEADER", "MLEADER", "MTEXT", "MULTILEADER", "TEXT")
)
# Largest distance between a curve and its chords, cells.
CHORD_CELLS = 0.25
MARGIN_CELLS = 4


def read_dxf(path: Path, resolution: float | None) -> tuple[I8, float, tuple[float, float]]:
    """Draw the lines of a DXF file's model space, without texts, dimensions and hidden layers.

    Args:
        resolution: metres per cell; None: 0.05 if the drawing has a unit, else the longest side
            gets 1000 cells of 0.05 m.

    Returns:
        Occupancy in percent (H, W), 100 at lines and 0 elsewhere, row 0 at the bottom; metres per
        cell; and the lower-left corner, metres in the drawing's frame.

    Raises:
        MapFileError: the file cannot be read or has no lines, or ezdxf is not installed.
        MemoryBudgetError: the plan would not fit into memory.
    """
    with extra_needed("plans", f"{path}: DXF drawings need", MapFileError):
        from ezdxf.disassemble import recursive_decompose, to_primitives  # noqa: PLC0415
        from ezdxf.enums import InsertUnits  # noqa: PLC0415
        from ezdxf.filemanagement import readfile  # noqa: PLC0415
        from ezdxf.lldxf.const import DXFError  # noqa: PLC0415
        from ezdxf.units import conversion_factor  # noqa: PLC0415
    try:
        drawing = readfile(path)
        has_unit = drawing.units != InsertUnits.Unitless
        unit = (
            conversion_factor(InsertUnits(drawing.units), InsertUnits.Meters) if has_unit else 0.0
        )
    except (OSError, DXFError, ValueError) as error:
        raise MapFileError(f"{path} cannot be read as a DXF drawing: {error}") from error
    shown = [entity for entity in recursive_decompose(drawing.modelspace()) if _is_built(entity)]
    boxes = [box for one in to_primitives(shown) if (box := one.bbox()).has_data]
    if not boxes:
        message = f"{path}: no lines in the model space of the drawing; export it as DXF with them"
        raise MapFileError(message)
    corners = np.array([(end.x, end.y) for box in boxes for end in (box.extmin, box.extmax)])
    lowest, sides = corners.min(axis=0), np.ptp(corners, axis=0)
    cell = resolution or CELL_M
    if not unit:
        unit = UNITLESS_CELLS * cell / float(sides.max())
    per_cell = cell / unit  # drawing units
    width, height = (int(side) + 1 + 2 * MARGIN_CELLS for side in sides / per_cell)
    check_memory(8 * width * height, f"a plan of {width} x {height} cells", str(path))
    cells = np.zeros((height, width), dtype=np.uint8)
    for primitive in to_primitives(shown, max_flattening_distance=CHORD_CELLS * per_cell):
        points = np.array([(point.x, point.y) for point in primitive.vertices()])
        if len(points) > 1:
            at = np.rint((points - lowest) / per_cell + MARGIN_CELLS).astype(np.int32)
            cv2.polylines(cells, [at], isClosed=False, color=100)
    origin = (lowest - MARGIN_CELLS * per_cell) * unit
    return cells.view(np.int8), cell, (float(origin[0]), float(origin[1]))


def _is_built(entity: Any) -> bool:
    """Return whether an entity is neither annotation nor on a hidden layer."""
    if entity.dxftype() in WORDS or entity.doc is None:
        return False
    layer = entity.doc.layers
    name = entity.dxf.layer
    return name not in layer or not (layer.get(name).is_off() or layer.get(name).is_frozen())
