"""What a run leaves in its folder, and the processes that it starts."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

SUFFIXES = (".json", ".pgm", ".tum", ".yaml")
MAPS_OF_FUSION = {
    f"{name}{end}" for name in ("fused", "fused_agreement") for end in (".yaml", ".pgm")
} | {"fused.tum", "fused.json"}


def files_of(*names: str) -> set[str]:
    return {f"{name}{suffix}" for name in names for suffix in SUFFIXES}


def outputs(folder: Path) -> set[str]:
    """The files in a run's folder, without those of the report."""
    return {path.name for path in folder.iterdir() if path.is_file()}


def producers_of(parent: int) -> list[int]:
    """Return the processes of its producers that are at work."""
    found = []
    for child in Path(f"/proc/{parent}/task/{parent}/children").read_text("ascii").split():
        with contextlib.suppress(OSError):  # it has ended
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
    return found


def a_producer_of(parent: int) -> int:
    """Return a process of one of its producers."""
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s:
        if found := producers_of(parent):
            return found[0]
        time.sleep(0.02)
    raise AssertionError("no producer was started")
