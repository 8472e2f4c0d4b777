"""Offer Intel's CPU device (the extra ``intel``), which builds kernels on any x86-64 processor.

Its wheel puts ``libintelocl.so`` into the environment's ``lib`` folder, with an entry for OpenCL's
loader that names the folder of another machine. So the loader is shown, while it looks for
platforms, a folder for the moment that has the usual entries and this one. It is no default where
PoCL works: its threads spin, and PoCL is as fast.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

DISTRIBUTION = "intel-opencl-rt"
LIBRARY = "libintelocl.so"
PLATFORM = "Intel(R) OpenCL"
# Where the loader looks; a user who set one knows what to show.
VENDORS, USUAL_FOLDER = "OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"
DEFAULT_FOLDER = "/etc/OpenCL/vendors"


@cache
def intel_library() -> Path | None:
    """Return Intel's OpenCL of this environment; None where the extra is not installed."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    try:
        files = importlib.metadata.files(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.name == LIBRARY:
            path = Path(str(file.locate())).resolve()
            return path if path.is_file() else None
    return None


def is_intel_extra(device: Any) -> bool:
    """Return whether a device is the one that the extra brings."""
    return intel_library() is not None and device.platform.name.strip() == PLATFORM


@contextlib.contextmanager
def intel_shown() -> Iterator[None]:
    """Let OpenCL's loader see Intel's CPU device too, if it looks for platforms now.

    Where the environment says what the loader shall see, or the extra is absent, nothing changes.
    """
    library = intel_library()
    if library is None or os.environ.get(VENDORS):
        yield
        return
    usual = Path(os.environ.get(USUAL_FOLDER) or DEFAULT_FOLDER)
    with tempfile.TemporaryDirectory(prefix="slamfusion-icd-") as folder:
        for entry in usual.glob("*.icd"):
            shutil.copy(entry, folder)
        # Beside it the loader of pyopencl's wheel always looks into its own folder, for PoCL's.
        Path(folder, "slamfusion-intel.icd").write_text(f"{library}\n", encoding="utf-8")
        os.environ[VENDORS] = folder
        try:
            yield
        finally:
            del os.environ[VENDORS]
