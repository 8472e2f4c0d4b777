"""The README: its table is the configuration's, its commands run, its links lead somewhere."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from slamfusion.cli.doctor import INSTALL
from slamfusion.cli.main import COMMANDS
from slamfusion.cli.readme import with_table
from tests.cli.command import ROOT, run

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks() -> list[list[str]]:
    """The ``slamfusion ...`` commands of each bash block, continued lines joined."""
    found = re.findall(r"```bash\n(.*?)```", README, flags=re.DOTALL)
    return [
        [line for line in block.replace("\\\n", " ").splitlines() if line.startswith("slamfusion ")]
        for block in found
    ]


def test_parameter_table_is_up_to_date() -> None:
    assert with_table(README) == README, "run: python -m slamfusion.cli.readme"


def test_there_are_commands_to_run() -> None:
    assert sum(map(len, blocks())) >= 8
    assert all(blocks())


@pytest.mark.parametrize("block", blocks(), ids=lambda block: block[0].split()[1])
def test_commands_run_on_the_bundled_data(tmp_path: Path, block: list[str]) -> None:
    shutil.copytree(ROOT / "data", tmp_path / "data")
    for command in block:
        done = run(*shlex.split(command)[1:], cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert done.stdout


def test_every_command_and_driver_is_listed() -> None:
    for command in COMMANDS:
        assert f"| `{command.name}" in README
    for device, line in INSTALL.items():
        assert f"| {device} | {line} |" in README


def test_links_lead_to_files() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", README):
        if "://" not in target:
            assert (ROOT / target).exists(), target
