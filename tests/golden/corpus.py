"""The entries of the corpus: how they run, and what of them is compared."""

from __future__ import annotations

import difflib
import gzip
import hashlib
import json
import platform
import re
import shlex
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
EXPECTED = HERE / "expected"
RECORDED = HERE / "recorded.json"

# Of the commands; to be set before any worker starts.
ENVIRONMENT = {"COLUMNS": "80", "LC_ALL": "C.UTF-8", "POCL_MAX_PTHREAD_COUNT": "1"}
# Keys of JSON documents and of YAML files whose values differ from run to run or by machine.
VOLATILE = re.compile(
    r"(process_)?(time|cpu)_s|solve_s|stages_s|.*memory_mb|time_per_scan_ms|versions?|devices?"
    r"|workers|processes"
)
# What does in tables and sentences: devices, durations, memory.
MASKS = (
    (re.compile(r"(pthread|basic)-.{1,80}? \(Portable Computing Language\)"), "DEVICE"),
    (re.compile(r"^(time[^\t:\n]*|peak memory)[\t:].*$", re.MULTILINE), r"\1 MASKED"),
    (
        re.compile(
            r"^(\w+\t(?:-|yes|no)(?:\t(?:-|[\d.]+)){4})\t[\d.]+(?=(?:\t[^\t\n]*)?$)", re.MULTILINE
        ),
        r"\1 MASKED",
    ),
    (re.compile(r", \d+\.\d+ s\.?$", re.MULTILINE), ", MASKED"),
)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
DIGEST = re.compile(r"sha256:? [0-9a-f]+")
# How far numbers may differ on another processor.
RELATIVE, ABSOLUTE = 0.05, 0.02
# Texts that are longer appear with their digest alone, and so do the rows of longer lists.
TEXT_BYTES = 2000
STORE = ".zarr"
# How the text of an entry begins that could not be run.
FAILED = "cannot be run:"
MOST_ITEMS = 12


@dataclass(frozen=True)
class Entry:
    """A line of the table.

    Attributes:
        name: of the entry, of its folder and of its expected text.
        is_fast: part of the test suite.
        commands: command lines of ``slamfusion``, run one after another in one folder. A word that
            begins with another entry's name and a slash is a file that this entry wrote.
        events: of a live fusion, instead of commands; see ``tests.golden.live``.
        files: files with their text that the commands read.
        needs: names of the entries that have to run before.
        is_shared: reads recorded data that are no part of the project.
    """

    name: str
    is_fast: bool
    commands: tuple[str, ...] = ()
    events: tuple[str, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    needs: frozenset[str] = frozenset()
    is_shared: bool = False

    @property
    def expected(self) -> Path:
        """The file with its expected text."""
        return EXPECTED / f"{self.name}.txt"


def load_entries() -> dict[str, Entry]:
    """Return the entries by name, in the order of the tables."""
    entries = {"help": Entry("help", is_fast=True), "ros": Entry("ros", is_fast=True)}
    live = yaml.safe_load((HERE / "live.yaml").read_text(encoding="utf-8"))
    for name, events in live.items():
        entries[name] = Entry(name, is_fast=name == "live-begins", events=tuple(events))
    table = yaml.safe_load((HERE / "commands.yaml").read_text(encoding="utf-8"))
    for name, row in table.items():
        lines = [row["run"]] if isinstance(row["run"], str) else row["run"]
        commands = tuple(" ".join(line.split()) for line in lines)
        files = tuple(row.get("files", {}).items())
        starts = set(re.findall(r"(?<= )[\w-]+(?=/)", " ".join(commands)))
        entries[name] = Entry(
            name,
            is_fast=row.get("fast", False),
            commands=commands,
            files=files,
            needs=frozenset(starts & (table.keys() - {name})),
            is_shared="shared" in starts,
        )
    return entries


def run_entries(names: Iterable[str], work: Path, workers: int) -> Iterator[tuple[str, str]]:
    """Run entries, and those that they need before them, side by side.

    Args:
        names: of the entries.
        work: an empty folder.
        workers: processes.

    Yields:
        Each name with the text to compare, as it ends. Entries of recorded data that are absent,
        and what needs them, are left out.
    """
    from tests.support.datasets import DATASETS  # noqa: PLC0415 - its environment is the caller's

    entries = load_entries()
    (work / "data").symlink_to(ROOT / "data")
    if DATASETS.is_dir():
        (work / "shared").symlink_to(DATASETS)
    wanted = set(names)
    while more := {need for name in wanted for need in entries[name].needs} - wanted:
        wanted |= more
    left = {
        name: entry
        for name, entry in entries.items()
        if name in wanted and (DATASETS.is_dir() or not entry.is_shared)
    }
    done: set[str] = set()
    running: dict[Any, str] = {}
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        while left or running:
            for name in [name for name, entry in left.items() if entry.needs <= done]:
                running[pool.submit(run_entry, left.pop(name), work)] = name
            if not running:
                return  # what is left needs absent data
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                name = running.pop(future)
                done.add(name)
                yield (
                    name,
                    f"{FAILED} {error!r}\n" if (error := future.exception()) else future.result(),
                )


def run_entry(entry: Entry, work: Path) -> str:
    """Run one entry and return its text."""
    if entry.name == "help":
        return _help()
    if entry.name == "ros":
        return _ros()
    if entry.events:
        from tests.golden.live import play  # noqa: PLC0415 - opens a device

        return play(entry.events)
    return _run_commands(entry, work)


def _run_commands(entry: Entry, work: Path) -> str:
    """Run command lines as a user does, and describe what they printed and wrote."""
    from tests.cli.command import run  # noqa: PLC0415 - its environment is the caller's

    folder = work / entry.name
    folder.mkdir()
    for name, text in entry.files:
        (folder / name).write_text(text, encoding="utf-8")
    parts, printed = [], set()
    for line in entry.commands:
        result = run(*shlex.split(line), cwd=work, timeout=900.0)
        parts += [f"$ slamfusion {line}", *map(_text_of, (result.stdout, result.stderr))]
        parts.append(f"exit code {result.returncode}\n")
        printed.add(parts[-3])
    given = {name for name, _ in entry.files}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        is_in_store = any(above.suffix == STORE for above in path.parents)
        if name in given or is_in_store or not (path.is_file() or path.suffix == STORE):
            continue
        text = _file(path)
        if text in printed:
            text = "a document above"
        elif len(text) > TEXT_BYTES:
            text = f"{len(text.splitlines())} lines, {_digest(text.encode())}"
        parts.append(name + (":\n" if "\n" in text else ": ") + text)
    text = "\n".join(part.rstrip("\n") for part in parts if part) + "\n"
    for place, word in ((str(work.resolve()), "WORK"), (str(work), "WORK"), (str(ROOT), "ROOT")):
        text = text.replace(place, word)
    return text


# -- what is compared -----------------------------------------------------------------------------


def _digest(data: bytes) -> str:
    return "sha256 " + hashlib.sha256(data).hexdigest()[:16]


def _text_of(printed: str) -> str:
    """Return what a command printed, a JSON document in canonical form."""
    if printed.startswith("{"):
        return "\n".join(_lines(_steady(json.loads(printed)))) + "\n"
    for pattern, word in MASKS:
        printed = pattern.sub(word, printed)
    return printed


def _file(path: Path) -> str:
    """Return a line or a text for a file, or a Zarr store, that a command wrote."""
    if path.suffix == STORE:
        files = sorted(file for file in path.rglob("*") if file.is_file())
        names = [file.relative_to(path).as_posix().encode() for file in files]
        data = b"".join(name + file.read_bytes() for name, file in zip(names, files, strict=True))
        return f"{len(files)} files, {_digest(data)}"
    if path.suffix == ".pgm" or (path.suffix == ".png" and "report" not in path.parts):
        return _picture(path.read_bytes())
    if path.suffix in {".tum", ".g2o"}:
        return _path(path.read_bytes())
    if path.suffix == ".gz":
        return _path(gzip.decompress(path.read_bytes()))
    if path.suffix in {".json", ".yaml", ".csv", ".md", ".tex"}:
        return _text_of(path.read_text(encoding="utf-8"))
    return "is there"


def _picture(data: bytes) -> str:
    """Return the size, the commonest values and a digest of the cells of a picture."""
    import cv2  # noqa: PLC0415 - loads slowly

    cells = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    values, counts = np.unique(cells, return_counts=True)
    common = sorted(zip(counts.tolist(), values.tolist(), strict=True), reverse=True)[:4]
    shown = ", ".join(f"{count} of {value}" for count, value in common)
    size = " x ".join(map(str, cells.shape[::-1]))
    return f"{size} cells, {shown}, {_digest(cells.tobytes())}"


def _path(data: bytes) -> str:
    """Return the length, the last line and a digest of a file with a line for each pose."""
    lines = data.decode().splitlines()
    return f"{len(lines)} lines, the last {lines[-1][:120]}, {_digest(data)}"


def _steady(value: Any) -> Any:
    """Return a document without what differs from run to run; long lists as their digest."""
    if isinstance(value, dict):
        return {
            key: _unusual(item, _defaults()) if key == "config" else _steady(item)
            for key, item in value.items()
            if not VOLATILE.fullmatch(key)
        }
    if isinstance(value, list):
        items = [_steady(item) for item in value]
        if len(items) <= MOST_ITEMS:
            return items
        return f"{len(items)} items, {_digest(json.dumps(items).encode())}"
    return value


@cache
def _defaults() -> dict[str, Any]:
    from slamfusion.config import RunConfig  # noqa: PLC0415
    from slamfusion.slam.registry import BUILT_IN, producer  # noqa: PLC0415

    own = {name: asdict(producer(name).config) for name in BUILT_IN}
    return json.loads(json.dumps({**asdict(RunConfig()), "producers": own}))


def _unusual(value: Any, default: Any) -> Any:
    """Return the settings of a tree that are not the defaults; the help has those."""
    if not isinstance(value, dict) or not isinstance(default, dict):
        return value
    found = {key: _unusual(item, default.get(key)) for key, item in value.items()}
    return {key: item for key, item in found.items() if item not in ({}, default.get(key, {}))}


def _lines(value: Any, name: str = "", pad: str = "") -> Iterator[str]:
    """Yield the lines of a document: what is short in one line, else a line for each item."""
    key = f"{name}: " if name else ""
    short = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, (dict, list)) or len(pad) + len(key) + len(short) <= 140:
        yield f"{pad}{key}{short}"
        return
    yield f"{pad}{key}".rstrip() or "-"
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for below, item in items:
        yield from _lines(item, str(below), pad + " ")


# -- entries that are no commands -----------------------------------------------------------------


def _help() -> str:
    """Return the help of every command and group; an option that was described before has a ^."""
    import click  # noqa: PLC0415

    from slamfusion.cli.program import cli  # noqa: PLC0415

    seen: set[str] = set()

    def short(part: str) -> str:
        words = " ".join(part.split())
        if not words.startswith("-") or words not in seen:
            seen.add(words)
            return part
        return part.strip().split("  ")[0].split("\n")[0] + " ^"

    def walk(command: click.Command, name: str) -> Iterator[str]:
        context = click.Context(command, info_name=name, terminal_width=80, max_content_width=80)
        context.meta["help-all"] = True
        parts = re.split(r"\n(?=  \S|\n)", command.get_help(context))
        text = re.sub("\n {20,}", "\n" + 8 * " ", "\n".join(map(short, parts)))
        yield f"$ {name} --help\n{text}\n"
        if isinstance(command, click.Group):
            for below in command.list_commands(context):
                found = command.get_command(context, below)
                assert found is not None
                yield from walk(found, f"{name} {below}")

    return "\n".join(walk(cli, "slamfusion"))


def _ros() -> str:
    """Return the topics, services and parameters of every node."""
    from docs.generate.ros import service_table, topic_table  # noqa: PLC0415
    from slamfusion.ros.interface import NAME_LISTS, NODES, node_parameters  # noqa: PLC0415

    lines = [topic_table(), "", service_table()]
    for node in NODES:
        lines += ["", f"{node}:"]
        lines += [f"  {item.name}: {list(item.default)}" for item in NAME_LISTS.get(node, ())]
        for option in node_parameters(node):
            info = option.info
            limits = f"{info.low} to {info.high} {info.choices or ''}".rstrip()
            lines.append(f"  {option.key}: {option.default!r} ({info.kind.__name__}, {limits})")
    return "\n".join(lines) + "\n"


# -- comparing ------------------------------------------------------------------------------------


def this_machine() -> dict[str, Any]:
    """Return what the last digits of results depend on."""
    from slamfusion.compute import open_device  # noqa: PLC0415

    model = platform.processor()
    if (cpuinfo := Path("/proc/cpuinfo")).is_file():
        found = re.search(r"model name\s*: (.*)", cpuinfo.read_text(encoding="utf-8"))
        flags = re.search(r"flags\s*: (.*)", cpuinfo.read_text(encoding="utf-8"))
        model = found[1] if found else model
        model += f" {_digest(flags[1].encode())}" if flags else ""
    libraries = ("numpy", "scipy", "opencv-python-headless", "click")
    return {
        "processor": model,
        "device": open_device().name,
        "python": ".".join(map(str, sys.version_info[:2])),
        **{name: version(name) for name in libraries},
    }


@cache
def is_same_machine() -> bool:
    """Return whether results are promised to be those that were recorded, to the last digit."""
    return RECORDED.is_file() and this_machine() == json.loads(RECORDED.read_text("utf-8"))


def difference(entry: Entry, text: str, *, to_the_digit: bool) -> str:
    """Return a readable difference between the expected and a new text; empty where none counts.

    Args:
        entry: whose text it is.
        text: the new one.
        to_the_digit: on another machine, too, numbers must be equal; see the package.
    """
    if not entry.expected.is_file():
        return f"{entry.expected.name} is not there; record it"
    wanted = entry.expected.read_text(encoding="utf-8")
    if text == wanted:
        return ""
    is_exact = to_the_digit or is_same_machine()
    if not is_exact and _is_near(wanted, text):
        return ""
    words = "" if is_exact else " on another machine: numbers may differ by 5 %, digests freely"
    names = ("expected" + words, "found")
    lines = (wanted.splitlines(), text.splitlines())
    return "\n".join(difflib.unified_diff(*lines, *names, lineterm="", n=2))


def _is_near(wanted: str, found: str) -> bool:
    """Return whether two texts differ in nothing but digests and the size of numbers."""
    texts = [DIGEST.sub("sha256", text) for text in (wanted, found)]
    if len({NUMBER.sub("#", text) for text in texts}) > 1:
        return False
    numbers = [np.array(NUMBER.findall(text), dtype=np.float64) for text in texts]
    return bool(np.allclose(*numbers, rtol=RELATIVE, atol=ABSOLUTE))
