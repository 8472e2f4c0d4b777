"""Run every operation of a device on small random input against its NumPy twin.

``slamfusion doctor`` runs this in about a second. The kernel tests run the same checks over many
shapes, and one of them holds that every operation of ``ComputeDevice`` has a check here. Nothing
else imports it.
"""

from __future__ import annotations

import numpy as np

from slamfusion.compute.compute_device import ComputeDevice, NumpyDevice
from slamfusion.compute.self_test.grid_checks import GRID_CHECKS
from slamfusion.compute.self_test.map_checks import MAP_CHECKS
from slamfusion.compute.self_test.sample import Check, Sample
from slamfusion.errors import DeviceError

__all__ = ["CHECKS", "Sample", "differences", "self_test"]

CHECKS: dict[str, Check] = GRID_CHECKS | MAP_CHECKS
# Kernels that sum float32 where their twin sums float64 may differ by this share of the largest
# term of a row; all others not at all.
RELATIVE = 1e-4


def self_test(device: ComputeDevice) -> list[tuple[str, bool, str]]:
    """Check every operation once.

    Returns:
        (operation, passed, what was found) each.
    """
    sample = Sample((33, 70), seed=1)
    results = []
    for name in CHECKS:
        try:
            found = differences(name, device, sample)
        except DeviceError as error:
            found = str(error)
        results.append((name, not found, found or "equals its NumPy twin"))
    return results


def differences(name: str, device: ComputeDevice, sample: Sample) -> str:
    """Return how an operation differs from its twin on a sample; empty where it does not."""
    found = CHECKS[name](device, sample)
    wanted = CHECKS[name](NumpyDevice(), sample)
    for n, (own, twin) in enumerate(zip(found, wanted, strict=True)):
        if own.shape != twin.shape or own.dtype != twin.dtype:
            return f"output {n} is {own.dtype} {own.shape}, the twin's {twin.dtype} {twin.shape}"
        if not own.size:
            continue
        gap = np.abs(own.astype(np.float64) - twin.astype(np.float64))
        allowed = np.zeros_like(gap)
        if twin.dtype.kind == "f":
            allowed += RELATIVE * np.maximum(1.0, np.abs(twin).max(axis=-1, keepdims=True))
        wrong = int(np.count_nonzero(~(gap <= allowed)))
        if wrong:
            return f"output {n}: {wrong} of {gap.size} values differ, by up to {gap.max():g}"
    return ""
