"""The pages build without a warning and without network, and can be searched."""

from __future__ import annotations

import json
import subprocess
import sys
import zlib
from importlib.util import find_spec
from pathlib import Path

import pytest

import slamfusion
from docs.generate.marks import DOCS
from tests.cli.command import ROOT

# Sphinx itself is imported by the build's own process.
IS_INSTALLED = all(find_spec(name) for name in ("sphinx", "myst_parser", "furo"))
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(not IS_INSTALLED, reason="Sphinx is absent: install the extra docs"),
]

# In the build's own process: whoever asks for an address fails. Nearly all that it makes is kept to
# its end: without looking for what is not it takes a fifth less.
OFFLINE = """
import gc, socket, sys
gc.disable()
def refuse(*_, **__):
    raise OSError("the build asks the network")
socket.getaddrinfo = refuse
socket.socket.connect = refuse
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("html")
    words = ["-W", "--keep-going", "-q", "-E", "-b", "html", "-d", str(folder / "trees")]
    command = [sys.executable, "-c", OFFLINE, *words, str(DOCS), str(folder / "html")]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return folder / "html"


def test_every_page_is_built(built: Path):
    for page in DOCS.rglob("*.md"):
        assert (built / page.relative_to(DOCS)).with_suffix(".html").is_file(), page


@pytest.mark.parametrize(
    ("word", "page"),
    [
        ("overlap", "concepts/alignment"),
        ("nav2", "guides/nav2"),
        ("resamplethreshold", "concepts/gmapping"),
        ("fused_map", "reference/ros"),
    ],
)
def test_the_pages_can_be_searched(built: Path, word: str, page: str):
    assert (built / "search.html").is_file()
    text = (built / "searchindex.js").read_text(encoding="utf-8")
    index = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
    found = [index[kind][word] for kind in ("terms", "titleterms") if word in index[kind]]
    numbers = {number for item in found for number in (item if isinstance(item, list) else [item])}
    assert page in {index["docnames"][number] for number in numbers}


def test_every_public_name_of_the_library_is_described(built: Path):
    inventory = (built / "objects.inv").read_bytes()
    lines = zlib.decompress(inventory.split(b"using zlib.\n", 1)[1]).decode().splitlines()
    described = {line.split(" ")[0].rpartition(".")[2] for line in lines}
    numbers = {"FREE", "OCCUPIED", "UNKNOWN", "__version__"}
    assert set(slamfusion.__all__) - numbers <= described


def test_a_page_asks_for_nothing_from_elsewhere(built: Path):
    """What a page loads (scripts, styles, pictures, fonts) lies beside it."""
    for page in built.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        for part in ('src="http', 'src="//', 'rel="stylesheet" href="http'):
            assert part not in text, page
