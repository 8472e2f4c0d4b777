"""Code in a Python of its own, in which nothing was loaded yet."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def run_python(
    code: str, cwd: Path | None = None, **env: str | None
) -> subprocess.CompletedProcess[str]:
    """Run code and return what it printed.

    Args:
        code: of the program.
        cwd: where it runs.
        env: variables in its environment; those of None are not there.
    """
    whole = {name: value for name, value in {**os.environ, **env}.items() if value is not None}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        env=whole,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
