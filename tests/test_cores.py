"""How many cores there are, and how many threads were asked for."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from slamfusion.cores import told_threads, usable_cores


def test_cores_are_those_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5, 6})
    assert usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert usable_cores() == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_cores() == 1


@pytest.mark.parametrize(
    ("told", "threads"), [("3", 3), ("0", None), ("", None), ("x", None), ("-2", None)]
)
def test_threads_are_a_number_or_not_told(
    monkeypatch: pytest.MonkeyPatch, told: str, threads: int | None
) -> None:
    monkeypatch.setenv("SOME_THREADS", told)
    assert told_threads("SOME_THREADS") == threads
    monkeypatch.delenv("SOME_THREADS")
    assert told_threads("SOME_THREADS") is None


def test_what_counts_cores_before_the_libraries_loads_none_of_them() -> None:
    code = (
        "import sys, slamfusion.cli.address_space\n"
        "print([name for name in ('numpy', 'cv2', 'scipy', 'yaml') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
