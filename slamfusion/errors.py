"""The expected errors of SLAMfusion; any other exception is a bug and keeps its traceback.

A message gives what was wanted, what was found, where, and what to do. ``OSError`` passes through.
"""

from __future__ import annotations

import os
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

OUT_OF_MEMORY = "out of memory; free some, crop the maps or use a coarser cell"

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60
_SHORT.repr_array = _SHORT.repr_list  # type: ignore[assignment, method-assign]  # of ROS


def shown(value: Any) -> str:
    """Return a value from outside for a message: short, on one line."""
    if isinstance(value, int) and value.bit_length() > 256:  # Python refuses to print long ones
        return f"a number of {value.bit_length()} bits"
    return _SHORT.repr(value)


def counted(count: int, noun: str, verb: str = "") -> str:
    """Return a number of things, ``2 poses``; with a verb, given as for many: ``1 pose is``."""
    if count == 1:
        return f"1 {noun} {'is' if verb == 'are' else verb and f'{verb}s'}".rstrip()
    return f"{count} {noun}s {verb}".rstrip()


def unknown(value: str, known: Iterable[str]) -> str:
    """Return a message for an unknown word, with the nearest known one."""
    words = list(known)
    import difflib  # noqa: PLC0415  (only for an error)

    near = difflib.get_close_matches(value, words, n=1)
    ask = f"; did you mean {near[0]!r}?" if near else ""
    return f"{value!r} is not one of {', '.join(words)}{ask}"


class SlamFusionError(Exception):
    """Root of every expected failure; the command line prints it as one line and exits with 1."""


class GridError(SlamFusionError, ValueError):
    """A grid's cells, resolution or origin cannot be an occupancy grid, or two grids do not fit."""


class MapFileError(SlamFusionError):
    """A map file (YAML or image) is missing, damaged, or outside what a map server reads."""


class LogError(SlamFusionError):
    """A log or bag cannot be read: unknown kind, damaged, or nothing in it that SLAM needs."""


class ScanError(SlamFusionError, ValueError):
    """A laser scan's readings or geometry cannot be a scan."""


class SimulationError(SlamFusionError):
    """A world, robot or course cannot be simulated as asked."""


class TrajectoryError(SlamFusionError, ValueError):
    """A trajectory or its truth is damaged, or the two do not meet in time."""


class GraphError(SlamFusionError, ValueError):
    """A pose graph or its file is damaged, or its poses cannot be found from its edges."""


class ConfigError(SlamFusionError, ValueError):
    """A configuration value is unknown, of the wrong type, or out of its range."""


class StartError(ConfigError):
    """A start is no pose with tolerances, or names no input: the command line was used wrongly."""


class DeviceError(SlamFusionError):
    """No usable OpenCL device, or a kernel failed to build or run on it."""


class FleetError(SlamFusionError):
    """Processes or cluster workers cannot do their tasks, or do not answer."""


class AlignmentError(SlamFusionError):
    """The grids could not be aligned.

    Attributes:
        pairs: the tried ``Alignment`` records.
        grids: the maps of ``fuse_maps``.
    """

    def __init__(self, message: str, pairs: tuple[Any, ...] = ()) -> None:
        super().__init__(message)
        self.pairs = pairs
        self.grids: tuple[Any, ...] = ()


class MemoryBudgetError(SlamFusionError):
    """The work needs more memory than the machine has free; nothing was allocated."""


def error_text(error: Exception, path: Path | None = None) -> str:
    """Return the message of an error; what the operating system said follows the file.

    path: is left out at the start of the message.
    """
    if isinstance(error, MemoryError):
        return OUT_OF_MEMORY
    text = str(error)
    if isinstance(error, OSError):
        is_absent = isinstance(error, FileNotFoundError)
        reason = "no such file" if is_absent else error.strerror or text
        has_name = isinstance(error.filename, (str, bytes))
        where = f"{os.fsdecode(error.filename)}: " if has_name else ""
        advice = {
            FileNotFoundError: "; check the path",
            PermissionError: "; check its permissions",
            IsADirectoryError: "; name a file in it",
        }.get(type(error), "")
        text = f"{where}{reason}{advice}"
    return text.removeprefix(f"{path}: ")


@contextmanager
def extra_needed(
    extra: str, subject: str, kind: type[SlamFusionError] = SlamFusionError
) -> Iterator[None]:
    """Raise an error that says what to install if an import in the ``with`` block is missing.

    Args:
        extra: of this package, with what is imported.
        subject: start of the message: ``the report needs``.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        message = f"{subject} {error.name}; pip install 'slamfusion[{extra}]'"
        raise kind(message) from error
