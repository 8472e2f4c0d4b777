"""Files and memory: regular files only, checked sizes, and atomic writing.

Data goes into a temporary file next to its target, is forced to disk, and is then renamed over the
target. If anything fails, the old file stays.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import secrets
import stat
from collections.abc import Hashable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar, Token
from io import BufferedReader
from pathlib import Path

from slamfusion.errors import MapFileError, MemoryBudgetError, SlamFusionError

# Of the interpreter and its buffers.
WORKING_BYTES = 64 * 2**20
M_ARENA_MAX = -8  # of malloc.h


def available_memory() -> int:
    """Return the bytes that processes may still take before the machine swaps."""
    with suppress(OSError, StopIteration):  # as psutil, which takes 17 ms to import
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        line = next(line for line in lines if line.startswith("MemAvailable:"))
        return 1024 * int(line.split()[1])
    import psutil  # noqa: PLC0415  (not on Linux)

    return int(psutil.virtual_memory().available)


def check_memory(
    bytes_needed: int,
    what: str,
    where: str,
    fix: str = "free memory, crop it or use a coarser cell",
) -> None:
    """Refuse work that would not fit into memory.

    Args:
        bytes_needed: peak, bytes.
        what: subject of the error sentence: ``a 30000 x 30000 map``.
        where: the file, topic or option that asked for it.

    Raises:
        MemoryBudgetError: with the needed and the available amount.
    """
    available = available_memory()
    if bytes_needed > available:
        raise MemoryBudgetError(
            f"{where}: {what} needs {format_bytes(bytes_needed)} of memory, but only "
            f"{format_bytes(available)} is available; {fix}"
        )


def return_freed_memory() -> None:
    """Return freed memory to the system, if the C library can (glibc keeps arrays of some MB)."""
    _of_glibc("malloc_trim", 0)


def use_one_arena() -> None:
    """Let all threads that are started from now on take memory from one heap, with glibc.

    Otherwise each has its own, and what one has freed is of no use to the others.
    """
    if not os.environ.get("MALLOC_ARENA_MAX"):
        _of_glibc("mallopt", M_ARENA_MAX, 1)


def _of_glibc(name: str, *numbers: int) -> None:
    """Call a function that other C libraries may lack."""
    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function(*numbers)


def format_bytes(count: int) -> str:
    """Return a byte count as people read it: ``1.7 GiB``."""
    for power, unit in ((4, "TiB"), (3, "GiB"), (2, "MiB"), (1, "KiB")):
        if count >= 1024**power:
            return f"{count / 1024**power:.1f} {unit}"
    return f"{count} bytes"


# Files that people write by hand: settings, courses, distances, maps' YAML.
SMALL_BYTES = 2**20

_KINDS = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"))


def user_path(text: str) -> Path:
    """Return a path with ``~`` as the home folder; ``~NAME`` stays if there is no user NAME."""
    return Path(os.path.expanduser(text))  # noqa: PTH111 - pathlib raises


def open_regular(path: Path, error: type[SlamFusionError]) -> BufferedReader:
    """Open a regular file for reading; a folder, pipe, socket or device is refused."""
    _check_regular(path, path.stat().st_mode, error)
    # The file may have been replaced by a pipe: opening must not wait for its writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        _check_regular(path, os.fstat(descriptor).st_mode, error)
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def read_small(path: Path, error: type[SlamFusionError], what: str) -> bytes:
    """Return the bytes of a hand-written file, at most ``SMALL_BYTES``."""
    with open_regular(path, error) as file:
        data = file.read(SMALL_BYTES + 1)
    if len(data) > SMALL_BYTES:
        raise error(
            f"{path}: wanted {what} of at most {format_bytes(SMALL_BYTES)}, found more; "
            "check what the file is"
        )
    return data


def _check_regular(path: Path, mode: int, error: type[SlamFusionError]) -> None:
    if not stat.S_ISREG(mode):
        found = next((name for is_kind, name in _KINDS if is_kind(mode)), "a device")
        advice = "name a file in it" if stat.S_ISDIR(mode) else "save it to a file and name that"
        raise error(f"{path}: wanted a file, found {found}; {advice}")


def refuse_overwriting(
    reads: Iterable[tuple[Path, Path]], writes: Iterable[tuple[str, Path]]
) -> None:
    """Refuse outputs that would replace an input, each other, a folder or a device.

    Two paths are one file if they are equal without links or have the same inode.

    Args:
        reads: inputs as given, each with a file that is read for it.
        writes: outputs as asked for, in words, each with a file that may be written or removed.
    """
    taken: dict[Hashable, str] = {}
    for given, file in reads:
        words = f"the input {file}" + ("" if file == given else f" (of {given})")
        for mark in _marks(file):
            taken.setdefault(mark, words)
    for asked, file in writes:
        own = f"a file of {asked}"
        for mark in _marks(file):
            words = taken.setdefault(mark, own)
            if words != own:
                message = f"{asked} would replace {words} with {file}; choose another name"
                raise SlamFusionError(message)
        if file.exists() and not file.is_file():
            what = "a folder" if file.is_dir() else "a device or pipe"
            raise SlamFusionError(f"{asked} cannot be written: {file} is {what}; name a file")


def _marks(path: Path) -> Iterator[Hashable]:
    """Yield what all paths of one file share: the real path and the inode."""
    with suppress(OSError, ValueError):  # an impossible path is reported when it is opened
        yield os.path.realpath(path)
        found = path.stat()
        yield found.st_dev, found.st_ino


_FIXES = {
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some of the quota or write elsewhere",
    errno.EFBIG: "raise the file size limit or write elsewhere",
    errno.EACCES: "choose a place you may write to",
    errno.EPERM: "choose a place you may write to",
    errno.EROFS: "choose a place you may write to",
    errno.ENAMETOOLONG: "choose a shorter name",
}


class AtomicFiles:
    """Several files that are put in place together when the ``with`` block ends without error.

    A block within another one of the same thread belongs to it: whatever is written between is put
    in place with the outer block's files.

    ``add`` writes each file next to its target. At the end of the block they are renamed over
    their targets in the order of adding, then the files passed to ``remove`` are removed; a lock
    on the folder keeps two processes apart. An exception in the block removes what was written
    and leaves the old files. Missing parent folders are made; links are followed.

    A process that is killed between two renames leaves new files next to old ones, each of them
    complete. So a file that depends on another is added after it and holds its digest
    (``save_map``).

    Raises:
        MapFileError: a target cannot be written.
    """

    def __init__(self) -> None:
        self._targets: dict[Path, Path] = {}  # by temporary file
        self._removed: list[Path] = []
        self._made_folders: list[Path] = []
        self._before: Token[AtomicFiles | None] | None = None

    def add(self, path: str | Path, *parts: bytes | bytearray | memoryview) -> None:
        """Write one file next to its target.

        Args:
            path: absent or a regular file.
            parts: its bytes, in order.
        """
        try:
            target = Path(os.path.realpath(path))
            missing = [part for part in target.parents if not part.exists()]
            for folder in reversed(missing):
                folder.mkdir(exist_ok=True)
                self._made_folders.append(folder)
            mode = target.stat().st_mode if target.exists() else None
            if mode is not None and not stat.S_ISREG(mode):
                what = "a folder" if stat.S_ISDIR(mode) else "a device or pipe"
                raise ValueError(f"it is {what}, not a regular file")  # noqa: TRY301
            temporary = target.parent / f".slamfusion-{secrets.token_hex(8)}.tmp"
            self._targets[temporary] = target
            with temporary.open("xb") as file:
                for part in parts:
                    file.write(part)
                file.flush()
                os.fsync(file.fileno())
            if mode is not None:
                temporary.chmod(stat.S_IMODE(mode))
        except (OSError, ValueError) as error:
            raise _cannot_write(path, error) from None

    def remove(self, *paths: Path) -> None:
        """Remove files, which may be missing, at the end of the block; added ones stay."""
        self._removed += paths

    def __enter__(self) -> AtomicFiles:  # noqa: PYI034  typing.Self needs Python 3.11
        if (outer := _OPEN.get()) is not None:
            return outer
        self._before = _OPEN.set(self)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._before is None:
            return
        _OPEN.reset(self._before)
        path = None
        try:
            if kind is None:
                with _locked({path.parent for path in self._targets.values()}):
                    for temporary, path in self._targets.items():
                        temporary.replace(path)
                    added = set(self._targets.values())
                    for path in self._removed:
                        if Path(os.path.realpath(path)) not in added:
                            path.unlink(missing_ok=True)
        except OSError as error:
            raise _cannot_write(path, error) from None
        finally:
            for temporary in self._targets:
                with suppress(OSError):
                    temporary.unlink(missing_ok=True)
            for folder in reversed(self._made_folders):
                with suppress(OSError):  # it holds files
                    folder.rmdir()


@contextmanager
def _locked(folders: set[Path]) -> Iterator[None]:
    """Let one process at a time rename files in the folders."""
    with ExitStack() as held:
        for folder in sorted(folders):
            descriptor = os.open(folder, os.O_RDONLY)
            held.callback(os.close, descriptor)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


# The open block of the thread.
_OPEN: ContextVar[AtomicFiles | None] = ContextVar("open files", default=None)


def write_atomic(path: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Write one file atomically; see ``AtomicFiles``."""
    with AtomicFiles() as files:
        files.add(path, data)


def _cannot_write(path: str | Path | None, error: OSError | ValueError) -> MapFileError:
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        fix = _FIXES.get(error.errno or 0, "check the path or write elsewhere")
    else:
        reason, fix = str(error), "choose another name"
    return MapFileError(f"{path}: cannot write: {reason}; {fix}")
