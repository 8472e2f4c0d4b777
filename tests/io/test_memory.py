"""Claims about what memory there is and when work is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from slamfusion.errors import MemoryBudgetError
from slamfusion.io import available_memory, check_memory, map_memory_needed, memory
from slamfusion.io.memory import format_bytes


def test_no_more_is_available_than_the_machine_has() -> None:
    assert 0 < available_memory() <= psutil.virtual_memory().total


def test_what_fits_passes_and_what_does_not_is_refused_with_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 3 * 2**30)
    check_memory(3 * 2**30, "a map", "here.yaml")
    with pytest.raises(MemoryBudgetError) as caught:
        check_memory(5 * 2**30, "fusing 3 maps", "here.yaml")
    assert str(caught.value) == (
        "here.yaml: fusing 3 maps needs 5.0 GiB of memory, but only 3.0 GiB is available; "
        "free memory, crop it or use a coarser cell"
    )


def test_a_large_map_needs_two_bytes_a_cell() -> None:
    cells = 30_000 * 30_000
    assert 2 * cells <= map_memory_needed(cells) < 2.2 * cells


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 bytes"),
        (1023, "1023 bytes"),
        (1536, "1.5 KiB"),
        (2**31, "2.0 GiB"),
        (2**42, "4.0 TiB"),
    ],
)
def test_byte_counts_are_readable(count: int, text: str) -> None:
    assert format_bytes(count) == text


def write_group(folder: Path, limit_name: str, usage_name: str, limit: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / limit_name).write_text(f"{limit}\n")
    (folder / usage_name).write_text("600\n")
    (folder / "memory.stat").write_text("active_file 7\ninactive_file 100\n")


@pytest.mark.parametrize(
    ("line", "sub", "names"),
    [
        ("0::/box/inner", "", ("memory.max", "memory.current")),
        ("4:memory:/box/inner", "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")),
    ],
)
def test_the_tightest_control_group_counts(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    line: str,
    sub: str,
    names: tuple[str, str],
) -> None:
    write_group(tmp_path / sub / "box" / "inner", *names, "max")
    write_group(tmp_path / sub / "box", *names, "1000")
    own = tmp_path / "own"
    own.write_text(f"3:cpuset:/\n{line}\n")
    monkeypatch.setattr(memory, "_CGROUP_ROOT", tmp_path)
    monkeypatch.setattr(memory, "_OWN_CGROUPS", own)
    assert available_memory() == 1000 - (600 - 100)


def test_without_control_groups_the_machine_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "_OWN_CGROUPS", tmp_path / "none")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=12345))
    assert available_memory() == 12345


def test_a_limit_of_the_process_refuses_a_map_instead_of_being_killed(tmp_path: Path) -> None:
    path = tmp_path / "large.pgm"
    with path.open("wb") as file:
        file.write(b"P5 30000 30000 255\n")
        file.truncate(19 + 30_000 * 30_000)
    script = (
        "import resource, sys\n"
        "from slamfusion.io import load_map\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))\n"
        "try: load_map(sys.argv[1], resolution=0.05)\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], check=True, capture_output=True, text=True
    )
    assert done.stdout.startswith("MemoryBudgetError")
    assert "30000 x 30000 PGM needs 1.7 GiB" in done.stdout
