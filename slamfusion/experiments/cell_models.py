"""Table II of [H16]: what the cell models make of twelve observations in two orders.

Deterministic: a cell starts at 0.5 and is told 12 values, of which 3, 6 or 9 are occupied (0.95)
and the others free (0.01).

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import Row, result_rows
from slamfusion.experiments.records import CellModelJson
from slamfusion.slam.tinyslam.cell_models import CELL_MODELS

__all__ = ["CellModelRow", "as_table", "check_table_two", "table_two"]

OBSERVATIONS = 12
OCCUPIED_COUNTS = (3, 6, 9)
OCCUPIED_VALUE = 0.95
FREE_VALUE = 0.01
QUALITY = {"base": 0.2, "mean": 1.0}
# "Forward": the occupied observations come first; "backward": the free ones.
PAPER = {
    ("base", "forward"): (0.105, 0.225, 0.460),
    ("base", "backward"): (0.502, 0.737, 0.858),
    ("mean", "forward"): (0.245, 0.480, 0.715),
    ("mean", "backward"): (0.245, 0.480, 0.715),
}


@dataclass(frozen=True)
class CellModelRow:
    """One cell of the table.

    Attributes:
        model: ``base``, or ``mean``: the paper's modified model.
        order: ``forward``: occupied first; ``backward``: free first.
        occupied: how many of the observations are occupied.
        values: of the cell, before and after each observation.
        paper: what the paper prints.
    """

    model: str
    order: str
    occupied: int
    values: tuple[float, ...]
    paper: float

    @property
    def value(self) -> float:
        """The cell after all observations."""
        return self.values[-1]

    @property
    def is_equal(self) -> bool:
        """Whether the value is the paper's in all three decimals."""
        return f"{self.value:.3f}" == f"{self.paper:.3f}"

    def figure_rows(self) -> list[Row]:
        """Return the cell after all observations."""
        case = f"{self.order}, {self.occupied} occupied"
        return result_rows(case, "", self.model, {"value": self.value})

    def to_json(self) -> CellModelJson:
        """Return the row for a JSON document."""
        return {
            "model": self.model,
            "order": self.order,
            "occupied": self.occupied,
            "observations": OBSERVATIONS,
            "value": self.value,
            "paper": self.paper,
            "equal": self.is_equal,
            "values": list(self.values),
        }


def table_two() -> tuple[CellModelRow, ...]:
    """Compute every cell of the table, models first, then orders, then counts.

    Source: [H16], Table II.
    """
    rows = []
    for (model, order), printed in PAPER.items():
        for occupied, paper in zip(OCCUPIED_COUNTS, printed, strict=True):
            told = [OCCUPIED_VALUE] * occupied + [FREE_VALUE] * (OBSERVATIONS - occupied)
            if order == "backward":
                told.reverse()
            values = CELL_MODELS[model](told, QUALITY[model])
            rows.append(CellModelRow(model, order, occupied, tuple(values.tolist()), paper))
    return tuple(rows)


def as_table(rows: Sequence[CellModelRow]) -> tuple[list[str], list[list[str]]]:
    """Return the table in the shape of the paper's: a row for model and order."""
    counts = list(dict.fromkeys(row.occupied for row in rows))
    heading = [
        "model",
        "order",
        *(f"{count} occupied" for count in counts),
        *(f"paper, {count}" for count in counts),
        "equal",
    ]
    cells = []
    for model, order in dict.fromkeys((row.model, row.order) for row in rows):
        own = [row for row in rows if (row.model, row.order) == (model, order)]
        is_equal = all(row.is_equal for row in own)
        cells.append(
            [
                model,
                order,
                *(f"{row.value:.3f}" for row in own),
                *(f"{row.paper:.3f}" for row in own),
                "yes" if is_equal else "NO",
            ]
        )
    return heading, cells


def check_table_two(rows: Sequence[CellModelRow]) -> None:
    """Refuse a table that is not the paper's.

    Raises:
        SlamFusionError: a value differs in its three decimals; all that do are named.
    """
    different = [row for row in rows if not row.is_equal]
    if different:
        where = ", ".join(f"{row.model} {row.order} {row.occupied}" for row in different)
        message = f"{len(different)} of {len(rows)} values differ from Table II of [H16]: {where}"
        raise SlamFusionError(message)
