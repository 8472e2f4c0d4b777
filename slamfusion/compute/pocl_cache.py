"""Find a folder in which PoCL can store its kernels, before it is first used.

PoCL keeps every kernel in a cache of files. If a file cannot be written it reports that there is no
device, or that a kernel does not build; on a full disk its compiler ends the process. So the space
is checked first: in PoCL's own folder, else in a temporary one for this process; if that is full
too, PoCL is not used, and ``open_device`` takes NumPy unless a device was named.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

LOG = logging.getLogger(__name__)
# What PoCL calls itself.
PLATFORM = "Portable Computing Language"
FOLDER, CACHES = "POCL_CACHE_DIR", "XDG_CACHE_HOME"
# All kernels of a run take 3 MB; a kernel is built again for each size that it is run with.
ROOM_BYTES = 2**24


def cache_folders() -> tuple[Path, Path]:
    """Return the folder in which PoCL stores its kernels, and that of the user's caches."""
    if os.environ.get(CACHES):
        caches = Path(os.environ[CACHES])
    elif os.environ.get("HOME"):
        caches = Path(os.environ["HOME"], ".cache")
    else:
        caches = Path("/tmp")  # noqa: S108 - PoCL's own choice
    return Path(os.environ.get(FOLDER) or caches / "pocl" / "kcache"), caches


@cache
def find_cache() -> str:
    """Let PoCL store its kernels; return why it cannot, empty if it can.

    Call it before pyopencl is imported, which keeps files in the user's caches itself.
    """
    own, caches = cache_folders()
    reasons = {name: _why_not(folder) for name, folder in ((FOLDER, own), (CACHES, caches))}
    if not any(reasons.values()):
        return ""
    folder, reason = (own, reasons[FOLDER]) if reasons[FOLDER] else (caches, reasons[CACHES])
    problem = f"PoCL's cache {folder} cannot be written ({reason})"
    try:
        temporary = Path(tempfile.mkdtemp(prefix="slamfusion-pocl-"))
    except OSError as error:
        return f"{problem}, and no temporary folder either ({error.strerror})"
    atexit.register(_remove, temporary, os.getpid())
    if reason := _why_not(temporary):
        return f"{problem}, and {temporary.parent} neither ({reason})"
    # Processes that are started share it; pyopencl's own files move only where they must.
    os.environ[FOLDER] = str(temporary)
    if reasons[CACHES]:
        os.environ[CACHES] = str(temporary)
    LOG.warning(
        "%s: kernels are built for this process only; free some space there, or let %s name "
        "another folder", problem, FOLDER,
    )  # fmt: skip
    return ""


def _why_not(folder: Path) -> str:
    """Create a folder and return why kernels cannot be stored there; empty if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _remove(folder: Path, owner: int) -> None:
    """Remove the folder at the end of the process that made it, not of its forks."""
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)
