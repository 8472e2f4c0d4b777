"""DXF drawings are read as maps: walls without words, in metres where the drawing has a unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import MapFileError
from slamfusion.grid import OCCUPIED
from slamfusion.io.map_server import load_map

ezdxf = pytest.importorskip("ezdxf", reason="ezdxf comes with the plans extra")

METRES, MILLIMETRES, UNITLESS = 6, 4, 0


def drawing(path: Path, unit: int, per_metre: float) -> Path:
    """Write a room of 12 m x 8 m with a wall, the arc of a door, words, and a hidden layer."""
    document = ezdxf.new()
    document.units = unit
    space = document.modelspace()
    corners = np.array([(0, 0), (12, 0), (12, 8), (0, 8)]) * per_metre
    space.add_lwpolyline(corners, close=True)
    space.add_line((5 * per_metre, 0), (5 * per_metre, 3 * per_metre))
    space.add_arc((5 * per_metre, 3 * per_metre), per_metre, 0, 90)
    space.add_text("Kitchen").set_placement((2 * per_metre, 6 * per_metre))
    document.layers.add("hidden").off()
    far = 40 * per_metre
    space.add_line((far, far), (far, 2 * far), dxfattribs={"layer": "hidden"})
    document.saveas(path)
    return path


@pytest.mark.parametrize(("unit", "per_metre"), [(METRES, 1.0), (MILLIMETRES, 1000.0)])
def test_a_drawing_with_a_unit_has_its_size(tmp_path: Path, unit: int, per_metre: float) -> None:
    grid = load_map(drawing(tmp_path / "plan.dxf", unit, per_metre))
    assert grid.name == "plan"
    assert grid.resolution == 0.05
    rows, cols = np.nonzero(grid.cells == OCCUPIED)
    low, high = grid.cell_centres(rows, cols).min(axis=0), grid.cell_centres(rows, cols).max(axis=0)
    assert low == pytest.approx((0.0, 0.0), abs=0.05)
    assert high == pytest.approx((12.0, 8.0), abs=0.05)
    # The door's arc is there, the word is not.
    centres = grid.cell_centres(rows, cols)
    on_arc = np.abs(np.hypot(*(centres - (5.0, 3.0)).T) - 1.0) < 0.05
    assert np.count_nonzero(on_arc & (centres > (5.05, 3.05)).all(axis=1)) > 20
    assert not ((centres > (0.1, 5.0)) & (centres < (4.9, 7.9))).all(axis=1).any()


def test_a_drawing_without_a_unit_gets_cells_of_the_size_given(tmp_path: Path) -> None:
    path = drawing(tmp_path / "plan.dxf", UNITLESS, 39.37)
    grid = load_map(path, resolution=0.02)
    assert grid.resolution == 0.02
    assert grid.width == pytest.approx(1000, abs=10)


def test_a_broken_or_empty_drawing_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.dxf"
    broken.write_text("no drawing")
    with pytest.raises(MapFileError, match="cannot be read as a DXF drawing"):
        load_map(broken)
    empty = tmp_path / "empty.dxf"
    ezdxf.new().saveas(empty)
    with pytest.raises(MapFileError, match="no lines in the model space"):
        load_map(empty)
