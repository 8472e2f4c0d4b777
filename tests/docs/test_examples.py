"""The notebooks are short, were run from the first cell on, and run again."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest

from docs.generate.notebooks import FOLDER, run_notebook, shown_notebook

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LINES = 20


def code(book: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in book["cells"] if cell["cell_type"] == "code"]


def printed(book: dict[str, Any]) -> str:
    return "".join(
        "".join(item["text"])
        for cell in code(book)
        for item in cell["outputs"]
        if item["output_type"] == "stream"
    )


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


def test_a_notebook_was_run_in_order_and_fits_on_a_page(path: Path):
    book = json.loads(path.read_text(encoding="utf-8"))
    cells = code(book)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell["outputs"] for cell in cells)
    source = ["".join(cell["source"]) for cell in cells]
    assert sum(bool(line.strip()) for text in source for line in text.splitlines()) <= LINES
    assert all(ast.parse(text) for text in source)


def test_a_notebook_holds_nothing_of_the_machine(path: Path):
    text = path.read_text(encoding="utf-8")
    assert str(Path.home()) not in text
    assert "/tmp" not in text  # noqa: S108 - nothing is written there


def test_a_page_shows_what_a_notebook_printed_and_drew(path: Path):
    book = json.loads(path.read_text(encoding="utf-8"))
    page = shown_notebook(path)
    for line in printed(book).splitlines():
        assert line in page
    assert (path.parent / f"{path.stem}-1.png").stat().st_size < 200_000
    assert f"({path.stem}-1.png)" in page


@pytest.mark.full
def test_a_notebook_runs_and_says_the_same_of_the_same_things(path: Path):
    """Numbers may differ from device to device; what is told of, in which order, may not."""
    pytest.importorskip("nbclient", reason="nbclient is absent: install the extra docs")
    pytest.importorskip("ipykernel", reason="ipykernel is absent: install the extra docs")
    kept = json.loads(path.read_text(encoding="utf-8"))
    again = run_notebook(path)
    words = [
        [
            line.split()[:2]
            for line in printed(book).splitlines()
            if line.startswith(("path", "map"))
        ]
        for book in (kept, again)
    ]
    assert words[0]
    assert words[0] == words[1]
    assert "fits" in printed(again)
