"""Standard streams that are closed, full, or whose reader has gone; and interrupts at the start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from slamfusion.fleet import interrupts_held
from slamfusion.io import write_carmen
from tests.cli.command import INSTALLED, MAPS, ROOT, server, without_progress
from tests.slam.drives import drive
from tests.support.fresh import run_python

TUM = "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n3 2 0 0 0 0 0 1\n"
G2O = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
SHOWN = "slamfusion: open that address in a browser; Ctrl-C ends it\n"
# All commands print in one way: these, with their work, and the help of two.
COMMANDS: dict[str, list[str]] = {
    "help": ["--help"],
    "align": ["align", *MAPS[:2]],
    "devices": ["devices"],
    "node": ["node", "--help"],
    "show": ["show", str(ROOT / "data" / "sample")],
    "trajectory": ["trajectory", "t.tum", "--truth", "t.tum"],
    "graph": ["graph", "optimize", "g.g2o"],
    "slam": ["slam", "tinyslam", "d.log", "-o", "out/map", "--device", "numpy"],
}


def run_with(arguments: list[str], folder: Path, out: int) -> tuple[int, str]:
    """Return code and words of a command whose standard output is a descriptor."""
    (folder / "t.tum").write_text(TUM, encoding="utf-8")
    (folder / "g.g2o").write_text(G2O, encoding="utf-8")
    write_carmen(folder / "d.log", drive(8)[0])
    with Path(os.devnull).open("rb") as nothing, tempfile.TemporaryFile("w+") as errors:
        files = [nothing.fileno(), out, errors.fileno()]
        code = server().start(arguments, os.environ, folder, files).wait(120)
        errors.seek(0)
        return code, without_progress(errors.read())


@pytest.mark.parametrize("name", COMMANDS)
def test_a_reader_that_went_away_is_told_by_the_code(tmp_path: Path, name: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        code, words = run_with(COMMANDS[name], tmp_path, writing)
        assert (code, words.removeprefix(SHOWN)) == (141, "")
    finally:
        os.close(writing)


@pytest.mark.parametrize("name", ["help", "devices", "trajectory"])
def test_a_full_output_is_named(tmp_path: Path, name: str) -> None:
    with Path("/dev/full").open("wb") as full:
        code, words = run_with(COMMANDS[name], tmp_path, full.fileno())
    assert (code, words) == (1, "slamfusion: error: standard output: No space left on device\n")


def test_closed_streams_are_no_error_and_their_numbers_nobodys(tmp_path: Path) -> None:
    """What is opened first would else be written to by whatever a library prints."""
    (tmp_path / "t.tum").write_text(TUM, encoding="utf-8")
    command = f"{INSTALLED} trajectory t.tum --truth t.tum >&- 2>&- <&-"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, env=environment, check=False)
    assert done.returncode == 0
    assert (tmp_path / "t.tum").read_text(encoding="utf-8") == TUM


def test_a_process_begins_without_hearing_an_interrupt() -> None:
    """Until it can take one: a terminal sends it while the process imports."""
    code = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"
    with interrupts_held():
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert process.communicate(timeout=60)[0] == "True\n"
    assert process.returncode == 0


def test_the_first_process_begins_without_hearing_one_too() -> None:
    """With the first one multiprocessing starts its tracker, and then ends the blocking."""
    code = """if True:
        import signal
        from multiprocessing import resource_tracker
        from slamfusion.fleet import interrupts_held
        with interrupts_held():
            resource_tracker.ensure_running()
            print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
    """
    done = run_python(code)
    assert (done.stdout, done.stderr) == ("True\n", "")


def test_an_interrupt_that_another_thread_takes_is_held_too() -> None:
    """Threads of libraries do not block it, and Python's handler runs in the main thread."""
    seen = []
    thread = threading.Thread(target=signal.raise_signal, args=[signal.SIGINT])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), interrupts_held():  # noqa: PT012 - raised as it ends
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            thread.start()
            thread.join()
            seen.append("the end of the block")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen == ["the end of the block"]
