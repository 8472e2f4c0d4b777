"""The mutants of a source: what is changed, what is left alone, and that a run tells them apart."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.support.mutants import mutants_of

pytestmark = pytest.mark.once

ROOT = Path(__file__).resolve().parents[2]


def changes(source: str) -> set[str]:
    found = mutants_of(textwrap.dedent(source))
    for mutant in found:
        ast.parse(mutant.source)
    return {mutant.change for mutant in found}


@pytest.mark.parametrize(
    ("source", "wanted"),
    [
        ("a < b", {"a < b => a <= b", "a < b => a > b"}),
        ("a >= b", {"a >= b => a > b", "a >= b => a <= b"}),
        ("a is None", {"a is None => a is not None"}),
        ("a in b", {"a in b => a not in b"}),
        ("a and b", {"a and b => a or b"}),
        ("a = not b", {"not b => not not b"}),
        ("A = 2.0", {"A = 2.0 => A = 2.2", "A = 2.0 => A = 1.8"}),
        ("A = 0.0", {"A = 0.0 => A = 0.1"}),
        ("A = 3", {"A = 3 => A = 4", "A = 3 => A = 2"}),
        ("A = 40", {"A = 40 => A = 44", "A = 40 => A = 36"}),
        ("f(x=True)", {"f(x=True) => f(x=False)"}),
        ("if a:\n    b", {"a => not a"}),
        ("a = b if c else d", {"b if c else d => b if not c else d"}),
        ("[a for a in b if a == c]", {"a == c => a != c"}),
        (
            "def f(a) -> bool:\n    return a",
            {"return a => return True", "return a => return False"},
        ),
    ],
)
def test_each_kind_of_change_is_made(source: str, wanted: set[str]) -> None:
    assert changes(source) == wanted


@pytest.mark.parametrize(
    "source",
    [
        '"""Text of 3 lines."""',
        "__all__ = ['a']",
        "@dataclass(frozen=True)\nclass A:\n    b: Literal[3]",
        "def f(a: Literal[3]) -> Literal[4]:\n    return a",
        "def f(a):\n    return a",
    ],
)
def test_what_decides_nothing_is_left_alone(source: str) -> None:
    assert changes(source) == set()


def test_a_mutant_differs_in_one_place_and_says_where() -> None:
    source = "class A:\n    def f(self, x):\n        return x > 1 or self.g(x < 2)\n"
    found = mutants_of(source)
    assert {mutant.where for mutant in found} == {"A.f"}
    assert {mutant.line for mutant in found} == {3}
    assert len({mutant.source for mutant in found}) == len(found) == 9
    assert ast.unparse(ast.parse(source)) not in {mutant.source for mutant in found}


def test_a_run_counts_what_the_tests_notice(tmp_path: Path) -> None:
    """Every 75th mutant of ``accept``, against a test that sees the walls' limit alone."""
    test = tmp_path / "test_walls.py"
    test.write_text(
        "from slamfusion.fusion import accept\n"
        "def test_walls():\n"
        "    assert accept.WALLS_MIN == 24\n"
    )
    command = [sys.executable, "-m", "tests.mutation", "accept", "--every", "75", "--show"]
    options = ["--jobs", "1", "--at-least", "0.9", "--tests", str(test)]
    done = subprocess.run(
        [*command, *options], cwd=ROOT, check=False, capture_output=True, text=True
    )
    assert done.returncode == 1, done.stderr
    count = re.search(r"1 of (\d+) mutants killed \((\d+\.\d)%\)", done.stdout)
    assert count, done.stdout
    tried, percent = int(count[1]), float(count[2])
    assert tried > 1
    assert percent == pytest.approx(100.0 / tried, abs=0.05)
    assert done.stdout.count("survived") == tried - 1
    assert "90% of the mutants are to be killed; fewer are in slamfusion.fusion.accept" in (
        done.stderr
    )
