"""Run the notebooks of ``docs/examples`` and keep what they print and draw.

``python -m docs.generate.notebooks`` runs every one from its first cell, in an empty folder, writes
it back with its outputs, and its pictures beside it; ``python -m docs.generate`` then writes them
into the page. Needs the extra ``docs``.
"""

from __future__ import annotations

import base64
import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

__all__ = ["FOLDER", "notebook_parts", "run_notebook", "shown_notebook"]

FOLDER = Path(__file__).resolve().parents[1] / "examples"
TIMEOUT_S = 600


def notebook_parts() -> dict[str, Callable[[], str]]:
    """Return what writes each notebook into a page, by the name of its part."""
    return {
        f"notebook {path.stem}": functools.partial(shown_notebook, path)
        for path in sorted(FOLDER.glob("*.ipynb"))
    }


def shown_notebook(path: Path) -> str:
    """Return a notebook's cells with what they printed, as Markdown."""
    blocks: list[str] = []
    pictures = _picture_names(path)
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"]).rstrip()
        if cell["cell_type"] == "markdown":
            blocks.append(source)
            continue
        blocks.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if output["output_type"] == "stream":
                blocks.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            elif "image/png" in output.get("data", {}):
                blocks.append(f"![what the cell draws]({next(pictures)})")
    return "\n\n".join(blocks)


def run_notebook(path: Path) -> dict[str, Any]:
    """Run a notebook from its first cell in an empty folder and return it with its outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    import nbclient  # noqa: PLC0415  # of the extra `docs`
    import nbformat  # noqa: PLC0415

    book = nbformat.read(path, as_version=4)
    with TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        nbclient.NotebookClient(book, timeout=TIMEOUT_S, resources=resources).execute()
    for cell in book.cells:
        cell.metadata = {}
        for output in cell.get("outputs", ()):
            output.pop("metadata", None)
            output.get("data", {}).pop("text/plain", None)
    found: dict[str, Any] = json.loads(nbformat.writes(book))
    # A drawn cell's own value is not kept, nor what only this machine's Python is.
    for cell in found["cells"]:
        cell["outputs"] = [
            {**item, "metadata": {}} if item["output_type"] == "display_data" else item
            for item in cell.get("outputs", ())
            if item["output_type"] == "stream" or item.get("data")
        ]
        if cell["cell_type"] != "code":
            del cell["outputs"]
    found["metadata"] = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    return found


def _picture_names(path: Path) -> Iterator[str]:
    number = 0
    while True:
        number += 1
        yield f"{path.stem}-{number}.png"


def main() -> None:
    """Run every notebook and write it and its pictures."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        book = run_notebook(path)
        names = _picture_names(path)
        for cell in book["cells"]:
            for output in cell.get("outputs", ()):
                if "image/png" in output.get("data", {}):
                    picture = base64.b64decode(output["data"]["image/png"])
                    (path.parent / next(names)).write_bytes(picture)
        path.write_text(json.dumps(book, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(f"ran {path.name}")


if __name__ == "__main__":
    main()
