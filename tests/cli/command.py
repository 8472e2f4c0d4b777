"""Run the installed command as a user does."""

from __future__ import annotations

import functools
import io
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from slamfusion.cli.program import run_program
from tests.support.documents import check_document, command_of
from tests.support.forks import Server

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "data" / "sample"
MAPS = [str(SAMPLE / f"map_{letter}.yaml") for letter in "abc"]
TRUTH = str(SAMPLE / "truth.yaml")
INSTALLED = Path(sys.executable).with_name("slamfusion")
# Before any test has changed it for itself.
ENVIRONMENT = dict(os.environ)


def run(
    *arguments: str | Path,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    limits: Mapping[int, int] | None = None,
    timeout: float = 180.0,
) -> subprocess.CompletedProcess[str]:
    """Start ``slamfusion`` with arguments and return what it printed, but for lines of progress.

    Such lines come on a slow machine; see ``slamfusion.cli.output.progress_bar``.

    It is a process of its own: a fork of one that has loaded its libraries, where that is the same.

    Args:
        arguments: as on the command line.
        cwd: where it runs.
        env: added to the environment.
        limits: resource limits by number, e.g. ``resource.RLIMIT_AS``.
        timeout: seconds after which the test fails.
    """
    words = [str(INSTALLED), *map(str, arguments)]
    whole = {**os.environ, **(env or {})}
    if not limits and server().can_start(whole):
        return _without_progress(run_forked(words, cwd, whole, timeout))

    def set_limits() -> None:
        for kind, value in (limits or {}).items():
            resource.setrlimit(kind, (value, value))

    return _without_progress(
        subprocess.run(
            words,
            cwd=cwd,
            env=whole,
            preexec_fn=set_limits if limits else None,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
    )


def run_here(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command in this process, which may remember searches; see ``run``."""
    words = [str(word) for word in arguments]
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = run_program(words)
    done = subprocess.CompletedProcess(
        [str(INSTALLED), *words], code, out.getvalue(), err.getvalue()
    )
    return _without_progress(done)


def _without_progress(done: subprocess.CompletedProcess[str]) -> subprocess.CompletedProcess[str]:
    done.stderr = without_progress(done.stderr)
    return done


def without_progress(text: str) -> str:
    """Return what was said on stderr without the lines of progress."""
    return re.sub(
        r"^slamfusion: [^:\n]+: (?:\d+ %, )?\d+ s(?:, about \d+ s left)?\n",
        "",
        text,
        flags=re.MULTILINE,
    )


@functools.cache
def server() -> Server:
    """Return what is forked, begun with the environment of the tests."""
    return Server(INSTALLED, ["slamfusion"], ENVIRONMENT, without=["slamfusion.ros"])


def run_forked(
    words: list[str], cwd: Path | None, env: Mapping[str, str], timeout: float
) -> subprocess.CompletedProcess[str]:
    """Run a command in a fork; see ``run``."""
    with (
        Path(os.devnull).open("rb") as nothing,
        tempfile.TemporaryFile("w+", encoding="utf-8") as out,
        tempfile.TemporaryFile("w+", encoding="utf-8") as err,
    ):
        files = [file.fileno() for file in (nothing, out, err)]
        process = server().start(words[1:], env, cwd, files)
        try:
            code = process.wait(timeout)
        finally:
            process.kill()
        for file in (out, err):
            file.seek(0)
        return subprocess.CompletedProcess(words, code, out.read(), err.read())


def json_of(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """Return the one JSON document on stdout, which is one that the command may print.

    Anything else there is an error: NaN, or a key that the published schema does not know.
    """

    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} in JSON")

    document = json.loads(done.stdout, parse_constant=refuse)
    assert isinstance(document, dict)
    check_document(document, command_of(done.args), failed=done.returncode != 0)
    return document


def assert_one_line_failure(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """Exit code 1 and exactly one line on stderr, which holds all the words."""
    assert done.returncode == 1, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("slamfusion: error: ")
    for word in words:
        assert word in lines[0]


def tree(folder: Path) -> dict[str, bytes | None]:
    """Return every path below a folder with its bytes; None for folders and links."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
