"""The lock files of the suite: versions, hashes, and nothing of where they were made."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:  # Python 3.10 has none
    tomllib = pytest.importorskip("tomli")

LAUNCH = Path(__file__).resolve().parents[2] / "launch_scripts"
LOCKS = ("lock.txt", "lock-jazzy.txt")
# No address of a registry, no folder of a machine.
PINNED = re.compile(r"[a-z0-9][a-z0-9._-]*==[^ /@]+( ; [^\\/@]+?)? \\")
HASH = re.compile(r"    --hash=sha256:[0-9a-f]{64}( \\)?")


def entries(name: str) -> dict[str, list[str]]:
    """Return the hashes of each pinned package of a lock."""
    found: dict[str, list[str]] = {}
    package = ""
    for line in (LAUNCH / name).read_text(encoding="utf-8").splitlines():
        if HASH.fullmatch(line):
            found[package].append(line)
        else:
            assert PINNED.fullmatch(line), line
            package = line
            assert package not in found
            found[package] = []
    return found


@pytest.mark.parametrize("name", LOCKS)
def test_every_package_has_one_version_and_its_hashes(name: str) -> None:
    found = entries(name)
    assert len(found) > 50
    assert all(found.values())


def test_locks_agree_with_what_else_is_pinned() -> None:
    """PoCL's library is known by its digest, and Jazzy's NumPy by the constraints."""
    for name in LOCKS:
        assert any(line.startswith("pocl-binary-distribution==3.0 ") for line in entries(name))
    pinned = (LAUNCH / "constraints-jazzy.txt").read_text(encoding="utf-8").splitlines()
    wanted = [line for line in pinned if line and not line.startswith("#")]
    assert wanted
    for line in wanted:
        assert any(entry.startswith(f"{line} ") for entry in entries("lock-jazzy.txt"))


def test_the_scripts_take_them() -> None:
    script = (LAUNCH / "test.sh").read_text(encoding="utf-8")
    for name in LOCKS:
        assert f"launch_scripts/{name}" in script


@pytest.mark.parametrize(
    ("name", "extras"), [("lock.txt", ("dev", "ros")), ("lock-jazzy.txt", ("test",))]
)
def test_all_that_the_extras_need_is_locked(name: str, extras: tuple[str, ...]) -> None:
    """A package that is added to pyproject.toml wants ``launch_scripts/lock.sh``."""
    project = tomllib.loads((LAUNCH.parent / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    wanted, waiting = set(project["dependencies"]), list(extras)
    while waiting:
        for line in project["optional-dependencies"][waiting.pop()]:
            own = re.fullmatch(r"slamfusion\[(.*)\]", line)
            waiting += own[1].split(",") if own else []
            wanted |= set() if own else {line}
    locked = {line.split("==")[0] for line in entries(name)}
    for line in wanted:
        package = re.split(r"[^A-Za-z0-9._-]", line)[0].lower().replace("_", "-")
        assert package in locked, f"{package}: run launch_scripts/lock.sh"
