"""The compute device of a node; what opening it warned of stands in log and diagnostics."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.ros.base import Diagnostics, Level

# Whose warnings stay true while the node runs and cost it time: NumPy in place of OpenCL, kernels
# that are built at each start. That the wheel's PoCL was changed costs nothing.
LOGGERS = ("slamfusion.compute", "slamfusion.compute.pocl_cache")


class _Diagnosed(logging.Handler):
    """Puts warnings into the diagnostics, from where they reach the node's log."""

    def __init__(self, diagnostics: Diagnostics) -> None:
        super().__init__(logging.WARNING)
        self._diagnostics = diagnostics

    def emit(self, record: logging.LogRecord) -> None:
        """Add one record, under the name of who warns."""
        if record.name in LOGGERS:
            self._diagnostics.add(
                f"device {record.name}", Level.WARN, record.getMessage(), is_of_all=True
            )


def open_node_device(wanted: str, diagnostics: Diagnostics) -> ComputeDevice:
    """Open a device; see ``open_device`` for the argument and the errors.

    Args:
        wanted: as in the parameter ``device``.
        diagnostics: told what is wrong with the device, until the node ends.
    """
    with _told(diagnostics):
        return open_device(wanted)


@contextmanager
def _told(diagnostics: Diagnostics) -> Iterator[None]:
    """Put what is warned of in a ``with`` block into the diagnostics."""
    handler = _Diagnosed(diagnostics)
    logger = logging.getLogger(LOGGERS[0])
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
