"""Rows of Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["row", "table"]


def row(*cells: str) -> str:
    """Return one row; a bar in a cell is no border."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table with its head."""
    columns = tuple(columns)
    lines = [row(*columns), row(*("---",) * len(columns))]
    return "\n".join([*lines, *(row(*cells) for cells in rows)])
