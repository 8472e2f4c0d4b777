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
import tempfile
from functools import cache
from pathlib import Path

LOG = logging.getLogger(__name__)
# What PoCL calls itself.
PLATFORM = "Portable Computing Language"
FOLDER, CACHES = "POCL_CACHE_DIR", "XDG_CACHE_HOME"
# All kernels of a run take 3 MB; a kernel is built again for each size that it is run with.
ROOM_BYTES = 2**24


@cache
def find_cache() -> str:
    """Let PoCL store its kernels; return why it cannot, empty if it can.

    Call it before pyopencl is imported, which keeps files in the user's caches itself.
    """
    if os.environ.get(CACHES):
        caches = Path(os.environ[CACHES])
    elif os.environ.get("HOME"):
        caches = Path(os.environ["HOME"], ".cache")
    else:
        caches = Path("/tmp")  # noqa: S108 - PoCL's own choice
    own = Path(os.environ.get(FOLDER) or caches / "pocl" / "kcache")
    folder = own
    try:
        for folder in (own, caches):
            _reserve(folder)
    except OSError as error:
        problem = f"PoCL's cache {folder} cannot be written ({error.strerror})"
    else:
        return ""
    try:
        temporary = tempfile.TemporaryDirectory(prefix="slamfusion-pocl-")
    except OSError as error:
        return f"{problem}, and no temporary folder either ({error.strerror})"
    atexit.register(temporary.cleanup)
    try:
        _reserve(Path(temporary.name))
    except OSError as error:
        return f"{problem}, and {Path(temporary.name).parent} neither ({error.strerror})"
    # Processes that are started share it.
    os.environ[FOLDER] = os.environ[CACHES] = temporary.name
    LOG.warning(
        "%s: kernels are built for this process only; free some space there, or let %s name "
        "another folder", problem, FOLDER,
    )  # fmt: skip
    return ""


def _reserve(folder: Path) -> None:
    """Create a folder; OSError if kernels cannot be stored there."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
