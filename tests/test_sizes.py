"""No class and no module of the package grows beyond what a reader takes in at once."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

PACKAGE = Path(__file__).resolve().parents[1] / "slamfusion"
CLASS_LINES = 250
MODULE_LINES = 500
# What may be longer, and why. Twins of kernels are one operation, and tables of messages, such as
# the records of the JSON documents, have nothing to be split along. None of them needs it today.
LONGER: dict[str, str] = {}


def too_long(folder: Path) -> dict[str, int]:
    """Return the lines of every module and class in a folder that has too many, by its place."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        place = path.relative_to(folder).as_posix()
        lines = len(text.splitlines())
        if lines > MODULE_LINES:
            found[place] = lines
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef) and node.end_lineno is not None:
                first = min([node.lineno, *(item.lineno for item in node.decorator_list)])
                if node.end_lineno - first + 1 > CLASS_LINES:
                    found[f"{place}:{node.name}"] = node.end_lineno - first + 1
    return found


def test_classes_and_modules_are_short() -> None:
    found = too_long(PACKAGE)
    unknown = {place: lines for place, lines in found.items() if place not in LONGER}
    assert not unknown, f"split along what changes together: {unknown}"
    assert not set(LONGER) - set(found), "an exception that nothing needs"


def test_one_line_too_many_is_noticed(tmp_path: Path) -> None:
    def write(name: str, members: int, rest: int) -> None:
        body = [f"    a{number} = {number}" for number in range(members)]
        lines = ["@object", "class Long:", *body, *(f"b{number} = 0" for number in range(rest))]
        (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-8")

    write("short.py", CLASS_LINES - 2, MODULE_LINES - CLASS_LINES)
    assert too_long(tmp_path) == {}
    write("class.py", CLASS_LINES - 1, 0)
    write("module.py", 1, MODULE_LINES - 2)
    assert too_long(tmp_path) == {"class.py:Long": CLASS_LINES + 1, "module.py": MODULE_LINES + 1}
