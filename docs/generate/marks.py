"""The generated parts of a page: where they stand, and their text."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from docs.generate import benchmarks, commands, notebooks, parameters, ros, schema

__all__ = ["COMMAND", "DOCS", "PARTS", "PICTURE", "ROOT", "by_hand", "pages", "with_parts"]

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
PICTURE = DOCS / "guides" / "nodes.svg"
# Pages that do not stand in docs/.
OUTSIDE = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "data/README.md")
COMMAND = "python -m docs.generate"
# Every generated part by its name.
PARTS: dict[str, Callable[[], str]] = {
    **parameters.TABLES,
    **ros.TABLES,
    **commands.TABLES,
    **schema.TABLES,
    **benchmarks.benchmark_tables(),
    **notebooks.notebook_parts(),
}
# What stands between the two comments, the first of which names the part.
_PART = re.compile(
    rf"<!-- (?P<name>[^:\n]+): written by `{re.escape(COMMAND)}` -->\n"
    r"(?:.*?\n)?<!-- end of (?P=name) -->",
    re.DOTALL,
)


def pages() -> list[Path]:
    """Return README, what the pages include, and every page, sorted."""
    kept = [path for path in DOCS.rglob("*.md") if "_build" not in path.parts]
    return [*(ROOT / name for name in OUTSIDE), *sorted(kept)]


def by_hand(page: str) -> str:
    """Return a page without its generated parts."""
    return _PART.sub("", page)


def with_parts(page: str) -> str:
    """Return a page with its generated parts up to date.

    Raises:
        KeyError: the page names a part that nothing writes.
    """

    def written(found: re.Match[str]) -> str:
        name = found["name"]
        begin = f"<!-- {name}: written by `{COMMAND}` -->"
        return f"{begin}\n\n{PARTS[name]()}\n\n<!-- end of {name} -->"

    return _PART.sub(written, page)
