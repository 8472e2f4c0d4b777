"""Names of before; they go with the next commits."""

from __future__ import annotations

from typing import Any, TypeAlias

from slamfusion.compute.compute_device import ComputeDevice, NumpyDevice
from slamfusion.compute.layout import SHIFT_LANES

__all__ = ["SHIFT_LANES", "Backend", "Handle", "NumpyBackend"]

Backend: TypeAlias = ComputeDevice
NumpyBackend: TypeAlias = NumpyDevice
Handle: TypeAlias = Any
