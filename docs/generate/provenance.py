"""What is kept of a measurement beside its numbers: the commit, and the machine's cores."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

__all__ = ["commit", "cores"]

ROOT = Path(__file__).resolve().parents[2]


def commit() -> str:
    """Return the checkout's commit; with ``+`` where sources were changed after it."""
    done = [
        subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for words in (
            ("rev-parse", "--short=7", "HEAD"),
            ("status", "--porcelain", "--", "slamfusion", "kernels"),
        )
    ]
    return done[0].strip() + ("+" if done[1].strip() else "")


def cores() -> str:
    """Return how many cores there are and how busy they are, before what is said of the device."""
    return f"{os.cpu_count()} cores (load {os.getloadavg()[0]:.1f}), "
