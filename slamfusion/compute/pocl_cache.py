"""Find a folder in which PoCL can store its kernels, before it is first used.

PoCL keeps every kernel in a cache of files. If a file cannot be written it reports that there is no
device, or that a kernel does not build; on a full disk its compiler ends the process. So the space
is checked first: in PoCL's own folder, else in a temporary one for this process; if that is full
too, PoCL is not used, and ``open_device`` takes NumPy unless a device was named.
"""

from __future__ import annotations

import atexit
import logging
import multiprocessing
import os
import shutil
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

LOG = logging.getLogger(__name__)
# What PoCL calls itself.
PLATFORM = "Portable Computing Language"
FOLDER, CACHES = "POCL_CACHE_DIR", "XDG_CACHE_HOME"
# All kernels of a run take 3 MB; a kernel is built again for each size that it is run with.
ROOM_BYTES = 2**24


@dataclass(frozen=True)
class PoclCache:
    """The folder in which PoCL stores its kernels; None if there is none.

    ``detail`` is why it is not PoCL's own, in one line; else empty.
    """

    folder: Path | None
    detail: str = ""


@cache
def find_cache() -> PoclCache:
    """Return the folder that PoCL uses from now on; call it before pyopencl is imported.

    Where the caches of the user cannot be written, pyopencl's own is put there too.
    """
    own, caches = _own_folder(), user_caches()
    reason, other_reason = _why_not(own), _why_not(caches)
    if not reason and not other_reason:
        return PoclCache(own)
    folder, why = (own, reason) if reason else (caches, other_reason)
    found = _temporary(f"PoCL's cache {folder} cannot be written ({why})")
    if found.folder is not None:
        os.environ[FOLDER] = str(found.folder)  # processes that are started share it
        if other_reason:
            os.environ[CACHES] = str(found.folder)
        if multiprocessing.parent_process() is None:
            LOG.warning("%s", found.detail)
    return found


def _temporary(problem: str) -> PoclCache:
    """Return a cache that is removed when this process ends."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="slamfusion-pocl-"))
    except OSError as error:
        reason = error.strerror or str(error)
        return PoclCache(None, f"{problem}, and no temporary folder either ({reason})")
    reason = _why_not(folder)
    if reason:
        shutil.rmtree(folder, ignore_errors=True)
        return PoclCache(None, f"{problem}, and {folder.parent} neither ({reason})")
    atexit.register(_remove, folder, os.getpid())
    advice = f"free some space there, or let {FOLDER} name another folder"
    return PoclCache(folder, f"{problem}: kernels are built for this process only; {advice}")


def _remove(folder: Path, owner: int) -> None:
    """Remove the folder at the end of the process that made it, not of its forks."""
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)


def _own_folder() -> Path:
    """Return PoCL's folder: from the environment, or else in the user's caches."""
    told = os.environ.get(FOLDER)
    if told:
        return Path(told)
    return user_caches() / "pocl" / "kcache"


def user_caches() -> Path:
    """Return the user's cache folder."""
    for variable, below in ((CACHES, ""), ("HOME", ".cache")):
        if os.environ.get(variable):
            return Path(os.environ[variable], below)
    return Path("/tmp")  # noqa: S108 - PoCL's own choice


def _why_not(folder: Path) -> str:
    """Create a folder and return why kernels cannot be stored there; empty if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
    except OSError as error:
        return error.strerror or str(error)
    return ""
