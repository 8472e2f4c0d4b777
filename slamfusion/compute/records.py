"""Records of devices. The text below a field is its meaning; the JSON Schema carries it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class DeviceInfo:
    """An OpenCL device."""

    index: int
    """What --device takes."""
    name: str
    """The device's own name."""
    platform: str
    """The OpenCL driver that offers it."""
    type: str
    """cpu, gpu or other."""
    version: str
    """Of OpenCL, in the driver's words."""
    compute_units: int
    """As the driver counts them."""
    memory_mb: int
    """Global memory, MB."""
    usable: bool
    """Whether it can run the kernels."""
    note: str
    """Why it cannot, or when it is chosen; may be empty."""


@dataclass(frozen=True)
class PoclState:
    """What became of the PoCL that came with the package."""

    state: Literal["absent", "known", "patched", "refused"]
    """Not installed; knows the processor; was made to know it; was left and is not used."""
    detail: str
    """One line for people, with what to do where something is to be done."""
    library: Path | None = field(default=None, repr=False)
    """The file; None where absent."""
