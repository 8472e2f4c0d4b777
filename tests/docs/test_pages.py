"""README and pages: generated parts are the code's, commands run, links lead somewhere."""

from __future__ import annotations

import gzip
import importlib.util
import re
import shlex
import shutil
from pathlib import Path

import click
import pytest
import yaml

from docs.generate.commands import walk
from docs.generate.marks import COMMAND, DOCS, pages, with_parts
from slamfusion.cli.program import cli
from slamfusion.config import FusionNodeConfig
from slamfusion.grid import OCCUPIED
from slamfusion.io import load_map
from tests.cli.command import ROOT, run
from tests.support.fresh import run_python

pytestmark = pytest.mark.once

PAGES = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in pages()}
# Of a simulated log, a line for each scan and one for its odometry.
MOST_LINES = 120
README_LINES = 150


FENCE = re.compile(r"^( *)(`{3,})(\S*)\n(.*?)^\1\2$", flags=re.DOTALL | re.MULTILINE)


def fenced(kind: str) -> list[tuple[str, str]]:
    """Page and text of each fenced block of a kind, without its indentation."""
    return [
        (name, re.sub(f"^{found[1]}", "", found[4], flags=re.MULTILINE))
        for name, text in PAGES.items()
        for found in FENCE.finditer(text)
        if found[3] == kind
    ]


def commands(block: str) -> list[str]:
    """The ``slamfusion ...`` commands of a block, continued lines joined."""
    lines = block.replace("\\\n", " ").splitlines()
    return [line for line in lines if line.startswith("slamfusion ")]


# Each block once: README's stand on pages too.
RUN = {block: name for name, block in reversed(fenced("bash"))}
BLOCKS = [
    pytest.param(
        block,
        id=f"{name}: {commands(block)[0].split()[1]}",
        marks=() if name == "README.md" else pytest.mark.full,
    )
    for block, name in RUN.items()
]
SHOWN = [
    pytest.param(command, id=f"{name}: {command[:50]}")
    for name, block in fenced("")
    for command in commands(block)
]


def shorten(folder: Path) -> None:
    """Cut long logs below a folder to their first seconds."""
    for path in folder.rglob("*.log.gz"):
        lines = gzip.decompress(path.read_bytes()).splitlines(keepends=True)
        path.write_bytes(gzip.compress(b"".join(lines[:MOST_LINES])))


@pytest.mark.parametrize("name", PAGES)
def test_generated_parts_are_up_to_date(name: str) -> None:
    assert with_parts(PAGES[name]) == PAGES[name], f"run: {COMMAND}"


def test_the_readme_is_short() -> None:
    assert len(PAGES["README.md"].splitlines()) <= README_LINES


@pytest.mark.parametrize("block", BLOCKS)
def test_commands_run_on_the_bundled_data(
    tmp_path: Path, block: str, request: pytest.FixtureRequest
) -> None:
    shutil.copytree(ROOT / "data", tmp_path / "data")
    for command in commands(block):
        done = run(*shlex.split(command)[1:], cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert done.stdout
        if not request.config.getoption("--full"):
            shorten(tmp_path)


@pytest.mark.parametrize("command", SHOWN)
def test_a_command_for_data_of_the_reader_names_options_that_are_there(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = shlex.split(command, comments=True)[1:]
    monkeypatch.chdir(tmp_path)
    for word in words:  # the reader's files
        if "." in word or word.isupper() or word.endswith("part1"):
            (tmp_path / word).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / word).touch()
    parse(cli, words)


def parse(command: click.Command, words: list[str]) -> None:
    """Read a command line as it would be read, and run nothing.

    Raises:
        click.UsageError: an option or a subcommand is not there, or has a wrong value.
    """
    if words[:1] == ["node"]:
        words = words[: words.index("--ros-args")] if "--ros-args" in words else words
    if not isinstance(command, click.Group):
        command.make_context(command.name, list(words))
        return
    with click.Context(command) as context:
        rest = click.Command.parse_args(command, context, list(words))
        _, found, left = command.resolve_command(context, rest)
    assert found is not None
    parse(found, left)


def test_modules_and_scripts_that_pages_name_are_there() -> None:
    """But for dated measurements, which name the command of their own commit."""
    named = {
        (name, word)
        for name, text in PAGES.items()
        for line in re.sub(r"^\*\d{4}-.*\*$", "", text, flags=re.MULTILINE).splitlines()
        for word in re.findall(r"python -m ((?:tests|docs|slamfusion)[\w.]*)", line)
    }
    assert len(named) > 10
    for name, module in named:
        assert importlib.util.find_spec(module.rstrip(".")), (name, module)
    for name, text in PAGES.items():
        for script in re.findall(r"launch_scripts/[\w./-]*\w", text):
            assert (ROOT / script).exists(), (name, script)


def test_options_in_running_text_are_there() -> None:
    """Of commands between backticks; places to fill in are passed over."""
    contexts = dict(walk())
    seen = 0
    for name, text in PAGES.items():
        for span in re.findall(r"`(slamfusion [^`]+)`", " ".join(text.split())):
            found = max((key for key in contexts if span.startswith(key)), key=len, default=None)
            for option in re.findall(r"(?<=\s)--[a-z][\w-]*", span):
                if found is not None and not found.endswith(" node"):
                    known = {
                        item
                        for parameter in contexts[found].command.params
                        for item in (*parameter.opts, *parameter.secondary_opts)
                    }
                    assert option in {*known, "--help"}, (name, span)
                    seen += 1
    assert seen > 5


@pytest.mark.parametrize("written", ["fused_live", "fused_library"])
def test_a_program_runs_on_the_bundled_data(tmp_path: Path, written: str) -> None:
    (program,) = (text for _, text in fenced("python") if written in text)
    shutil.copytree(ROOT / "data", tmp_path / "data")
    done = run_python(program, tmp_path)
    assert done.returncode == 0, done.stderr
    truth = load_map(ROOT / "data" / "sample" / "truth.yaml")
    found = (load_map(tmp_path / f"{written}.yaml").cells == OCCUPIED).sum()
    assert found == pytest.approx((truth.cells == OCCUPIED).sum(), rel=0.5)


def test_nav2_is_told_our_topic_and_frames() -> None:
    ((_, example),) = ((name, text) for name, text in fenced("yaml") if name.endswith("nav2.md"))
    told = yaml.safe_load(example)
    costmap = told["global_costmap"]["global_costmap"]["ros__parameters"]
    node = FusionNodeConfig()
    assert costmap["global_frame"] == node.fused_frame
    assert told["bt_navigator"]["ros__parameters"]["global_frame"] == node.fused_frame
    assert costmap["robot_base_frame"] == node.base_frame
    assert costmap["static_layer"]["map_topic"] == "/fused/map"
    assert costmap["static_layer"]["map_subscribe_transient_local"] is True


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and the built pages make them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head).lower().replace(" ", "-") for head in heads}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_files_and_headings(name: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", PAGES[name]):
        if "://" not in target:
            path, _, anchor = target.partition("#")
            page = (ROOT / name).parent / path if path else ROOT / name
            assert page.exists(), target
            assert not anchor or anchor in anchors(page), target


def test_every_page_is_in_the_contents() -> None:
    listed = set()
    for name, text in PAGES.items():
        for block in re.findall(r"```\{toctree\}\n(.*?)```", text, flags=re.DOTALL):
            rows = [row for row in block.splitlines() if row and not row.startswith(":")]
            listed |= {((ROOT / name).parent / f"{row}.md").resolve() for row in rows}
    assert listed == {path for path in DOCS.rglob("*.md") if "_build" not in path.parts} - {
        DOCS / "index.md"
    }
