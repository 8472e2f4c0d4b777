"""What a JSON document says of a device: a typed record.

The text below a key is its meaning and unit; the published JSON Schema carries it.
"""

from __future__ import annotations

from typing import Literal, TypedDict


class DeviceJson(TypedDict):
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


class PoclJson(TypedDict):
    """What became of the PoCL that came with the package."""

    state: Literal["absent", "known", "patched", "refused"]
    """Not installed; knows the processor; was made to know it; was left and is not used."""
    detail: str
    """One line for people, with what to do where something is to be done."""
