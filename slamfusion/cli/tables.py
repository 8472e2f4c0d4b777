"""Tables as text: fitted to a terminal's width, or as lines of tab-separated values in a pipe."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

__all__ = ["NOTHING", "Table", "one_line"]

# Between columns of a terminal, and before each of them.
GAP, INDENT = "  ", " "
# Text is wrapped down to this many characters before a table is cut into several.
LEAST_TEXT = 18
NOTHING = "-"
# Paths of people are shorter; what is longer is no word.
WORD_CHARACTERS, WORD_ENDS = 400, 40


def one_line(text: str) -> str:
    """Return the text without line breaks and control characters; the middle of long words goes."""
    words = (
        word if len(word) <= WORD_CHARACTERS else f"{word[:WORD_ENDS]}...{word[-WORD_ENDS:]}"
        for word in text.split()
    )
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in " ".join(words)
    )


@dataclass(frozen=True)
class Table:
    """Rows of cells under heads, each row with a note of any length.

    Attributes:
        columns: heads with their units; a name that ends in a space is of text, aligned left.
        rows: as many cells each; the first names the row.
        notes: one for each row, e.g. a reason; empty where there is nothing to say.
        title: a line above; empty for none.
        has_head: whether the heads are shown.
        note_head: head of the notes in a pipe, where they are a column.
        names: so many of the first columns name the row, and stand in every part of a table that is
            cut.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    title: str = ""
    has_head: bool = True
    note_head: str = "reason"
    names: int = 1

    def tabbed(self) -> Iterator[str]:
        """Yield a line for each row, cells parted by tabs, nothing wrapped, padded or drawn."""
        if self.title:
            yield one_line(self.title)
        heads = [name.strip() for name in self.columns]
        if self.has_head:
            yield "\t".join([*heads, self.note_head] if self.notes else heads)
        for index, row in enumerate(self.rows):
            cells = [*row, self.notes[index]] if self.notes else row
            yield "\t".join(map(one_line, cells))

    def fitted(self, width: int) -> Iterator[str]:
        """Yield lines of at most ``width`` characters.

        Columns that hold nothing are left out. Heads and text are wrapped; where that is not enough
        the table is cut into several, each with the names. Notes stand below their rows.
        """
        rows = [[one_line(cell) for cell in row] for row in self.rows]
        cells = zip(*rows, strict=True) if rows else ((),) * len(self.columns)
        columns = [_Column.of(name, own) for name, own in zip(self.columns, cells, strict=True)]
        kept = [
            column
            for index, column in enumerate(columns)
            if index < self.names
            or not self.has_head
            or any(cell != NOTHING for cell in column.cells)
        ]
        if self.title:
            yield from textwrap.wrap(one_line(self.title), width)
        parts = _parts(kept, self.names, width, may_cut=self.has_head)
        for number, part in enumerate(parts):
            if number:
                yield ""
            notes = self.notes if number == len(parts) - 1 else ()
            yield from _block(part, notes, width, has_head=self.has_head)


@dataclass(frozen=True)
class _Column:
    """One column, as wide as it is to be drawn."""

    head: str
    is_text: bool
    cells: tuple[str, ...]
    width: int

    @classmethod
    def of(cls, name: str, cells: Sequence[str]) -> _Column:
        """Return a column as wide as its widest cell."""
        head = name.strip()
        return cls(
            head, name.endswith(" "), tuple(cells), max(map(_width, (head, *cells)), default=1)
        )

    @property
    def least(self) -> int:
        """How narrow it may be drawn."""
        words = max(map(_width, self.head.split()), default=1)
        if self.is_text:
            return min(self.width, max(LEAST_TEXT, words))
        return max(words, *map(_width, self.cells), 1)

    def narrowed(self, width: int) -> _Column:
        """Return it in another width."""
        return _Column(self.head, self.is_text, self.cells, max(1, width))

    def lines(self, cell: str) -> list[str]:
        """Return a cell in lines of this width, padded."""
        wrapped = [cell] if _width(cell) <= self.width else _wrap(cell, self.width)
        return [self._padded(line) for line in wrapped or [""]]

    def _padded(self, line: str) -> str:
        space = " " * (self.width - _width(line))
        return line + space if self.is_text else space + line


def _width(text: str) -> int:
    """Return how many places of a terminal a text takes."""
    if text.isascii():
        return len(text)
    from rich.cells import cell_len  # noqa: PLC0415  (only where a name is not plain)

    return cell_len(text)


def _wrap(text: str, width: int) -> list[str]:
    """Return a text in lines of at most so many places; words that are too long are cut."""
    lines = []
    for line in textwrap.wrap(text, width, break_on_hyphens=False):
        rest = line
        while _width(rest) > width:  # characters of two places
            count = next(n for n in range(len(rest), 0, -1) if n == 1 or _width(rest[:n]) <= width)
            lines.append(rest[:count])
            rest = rest[count:]
        lines.append(rest)
    return lines


def _total(widths: Sequence[int]) -> int:
    """Return the width of a line with columns of these widths."""
    return len(INDENT) + sum(widths) + len(GAP) * (len(widths) - 1)


def _parts(columns: list[_Column], names: int, width: int, *, may_cut: bool) -> list[list[_Column]]:
    """Cut columns into tables that fit; each begins with the names, and is narrow enough."""
    first, others = columns[:names], columns[names:]
    parts: list[list[_Column]] = [[*first]]
    for column in others:
        widths = [item.least for item in (*parts[-1], column)]
        if may_cut and len(parts[-1]) > names and _total(widths) > width:
            parts.append([*first])
        parts[-1].append(column)
    return [_narrowed(part, width) for part in parts]


def _narrowed(columns: list[_Column], width: int) -> list[_Column]:
    """Wrap the text of the widest columns until all of them fit, as far as that goes."""
    widths = [column.width for column in columns]
    while (over := _total(widths) - width) > 0:
        loose = [i for i, column in enumerate(columns) if widths[i] > column.least]
        if not loose:
            break
        widest = max(loose, key=lambda i: widths[i])
        widths[widest] = max(columns[widest].least, widths[widest] - over)
    return [column.narrowed(own) for column, own in zip(columns, widths, strict=True)]


def _block(
    columns: list[_Column], notes: Sequence[str], width: int, *, has_head: bool
) -> Iterator[str]:
    """Yield the lines of one table."""
    if has_head:
        yield from _lines(columns, [column.head for column in columns])
        yield INDENT + "─" * (_total([column.width for column in columns]) - len(INDENT))
    for index in range(len(columns[0].cells)):
        yield from _lines(columns, [column.cells[index] for column in columns])
        if notes and notes[index]:
            indent = INDENT + 2 * GAP
            yield from textwrap.wrap(
                one_line(notes[index]),
                width,
                initial_indent=indent,
                subsequent_indent=indent,
                break_on_hyphens=False,
            )


def _lines(columns: list[_Column], cells: Sequence[str]) -> Iterator[str]:
    """Yield one row, of as many lines as its highest cell."""
    drawn = [column.lines(cell) for column, cell in zip(columns, cells, strict=True)]
    empty = [" " * column.width for column in columns]
    for number in range(max(map(len, drawn))):
        line = [own[number] if number < len(own) else empty[i] for i, own in enumerate(drawn)]
        yield (INDENT + GAP.join(line)).rstrip()
