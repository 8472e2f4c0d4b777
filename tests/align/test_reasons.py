"""What the fusion says is said by every command and by the node, whatever options they have."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import slamfusion

FUSION = Path(slamfusion.__file__).parent / "fusion"
OPTION = re.compile(r"--[a-z]|-p [a-z]")


def said(path: Path) -> list[str]:
    """Return every text of a module but for its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in docstrings
    ]


def test_no_reason_advises_an_option_that_a_front_end_may_lack() -> None:
    paths = sorted(FUSION.rglob("*.py"))
    texts = [(path.name, text) for path in paths for text in said(path)]
    assert any("no fit inside the window" in text for _, text in texts)
    assert not [item for item in texts if OPTION.search(item[1]) or "give a start" in item[1]]
