"""The README: its table is the configuration's, its commands run, its links lead somewhere."""

from __future__ import annotations

import gzip
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from slamfusion.cli.main import COMMANDS
from slamfusion.cli.readme import TABLES, gmapping_table, parameter_table, with_tables
from slamfusion.cli.ros_tables import TABLES as ROS_TABLES
from slamfusion.config import GMAPPING_PROFILES, GmappingConfig, field_infos
from slamfusion.grid import OCCUPIED
from slamfusion.io import load_map
from slamfusion.jobs.doctor import INSTALL
from tests.cli.command import ROOT, run

README = (ROOT / "README.md").read_text(encoding="utf-8")
# Of a simulated log, a line for each scan and one for its odometry.
MOST_LINES = 1000


def blocks() -> list[list[str]]:
    """The ``slamfusion ...`` commands of each bash block, continued lines joined."""
    found = re.findall(r"```bash\n(.*?)```", README, flags=re.DOTALL)
    return [
        [line for line in block.replace("\\\n", " ").splitlines() if line.startswith("slamfusion ")]
        for block in found
    ]


def shorten(folder: Path) -> None:
    """Cut long logs below a folder to their first minute or so."""
    for path in folder.rglob("*.log.gz"):
        lines = gzip.decompress(path.read_bytes()).splitlines(keepends=True)
        path.write_bytes(gzip.compress(b"".join(lines[:MOST_LINES])))


def test_parameter_tables_are_up_to_date() -> None:
    assert with_tables(README) == README, "run: python -m slamfusion.cli.readme"


@pytest.mark.parametrize("name", TABLES | ROS_TABLES)
def test_a_table_that_is_behind_is_noticed(name: str) -> None:
    table = (TABLES | ROS_TABLES)[name]()
    assert table in README
    row = table.splitlines()[-1]
    assert with_tables(README.replace(table, table.removesuffix(row))) == README


def test_the_table_of_gmapping_has_both_profiles() -> None:
    rows = [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in gmapping_table().splitlines()[2:]
    ]
    assert [row[0].strip("`") for row in rows] == [
        info.name for info in field_infos(GmappingConfig)
    ]
    table = {row[0].strip("`"): row[1:4] for row in rows}
    own, published = GMAPPING_PROFILES["own"], GMAPPING_PROFILES["published"]
    for name in own:
        for value, shown in ((published[name], table[name][1]), (own[name], table[name][2])):
            wanted = {True: "yes", False: "no"}[value] if isinstance(value, bool) else value
            assert shown == wanted if isinstance(wanted, str) else float(shown) == value, name
    assert table["delta"][0] == "m"
    assert table["maxUrange"][1:] == ["-", "-"]
    assert table["wheel_base"][1:] == ["-", "0.3"]


def test_there_are_commands_to_run() -> None:
    assert sum(map(len, blocks())) >= 8
    assert all(blocks())


@pytest.mark.once
@pytest.mark.parametrize("block", blocks(), ids=lambda block: block[0].split()[1])
def test_commands_run_on_the_bundled_data(
    tmp_path: Path, block: list[str], request: pytest.FixtureRequest
) -> None:
    shutil.copytree(ROOT / "data", tmp_path / "data")
    for command in block:
        done = run(*shlex.split(command)[1:], cwd=tmp_path, is_anew=True)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert done.stdout
        if not request.config.getoption("--full"):
            shorten(tmp_path)


@pytest.mark.parametrize("written", ["fused_live", "fused_library"])
def test_a_program_runs_on_the_bundled_data(tmp_path: Path, written: str) -> None:
    programs = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    (program,) = (text for text in programs if written in text)
    shutil.copytree(ROOT / "data", tmp_path / "data")
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    truth = load_map(ROOT / "data" / "sample" / "truth.yaml")
    found = (load_map(tmp_path / f"{written}.yaml").cells == OCCUPIED).sum()
    assert found == pytest.approx((truth.cells == OCCUPIED).sum(), rel=0.5)


def test_every_command_and_driver_is_listed() -> None:
    for command in COMMANDS:
        assert f"| `{command.name}" in README
    for device, line in INSTALL.items():
        assert f"| {device} | {line} |" in README


def test_a_setting_that_no_command_takes_is_not_shown_as_an_option() -> None:
    rows = {row.split(" | ")[1]: row.split(" | ")[0] for row in parameter_table().splitlines()[2:]}
    assert rows["`live.extent`"] == "| (fusion node)"
    assert rows["`fusion.vote.extent`"] == "| `--extent`"


def test_links_lead_to_files_and_headings() -> None:
    headings = re.findall(r"^#+ (.*)$", README, flags=re.MULTILINE)
    anchors = {"#" + re.sub(r"[^\w -]", "", head).lower().replace(" ", "-") for head in headings}
    for target in re.findall(r"\]\(([^)]+)\)", README):
        if target.startswith("#"):
            assert target in anchors, target
        elif "://" not in target:
            assert (ROOT / target).exists(), target
