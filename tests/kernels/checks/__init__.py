"""Run any operation of a device on random input and compare it with its NumPy twin."""

from __future__ import annotations

import functools

import numpy as np

from slamfusion.compute.compute_device import ComputeDevice, NumpyDevice
from tests.kernels.checks.grid_checks import GRID_CHECKS
from tests.kernels.checks.map_checks import MAP_CHECKS
from tests.kernels.checks.sample import Arrays, Check, Sample

CHECKS: dict[str, Check] = GRID_CHECKS | MAP_CHECKS
# Kernels that sum float32 where their twin sums float64 may differ by this share of the largest
# term of a row; all others not at all.
RELATIVE = 1e-4


@functools.cache
def twin(name: str, sample: Sample) -> Arrays:
    """Return what the NumPy twin of an operation gives, which every device is compared with."""
    return CHECKS[name](NumpyDevice(), sample)


def differences(name: str, device: ComputeDevice, sample: Sample) -> str:
    """Return how an operation differs from its twin on a sample; empty where it does not."""
    found = CHECKS[name](device, sample)
    wanted = twin(name, sample)
    for n, (own, other) in enumerate(zip(found, wanted, strict=True)):
        if own.shape != other.shape or own.dtype != other.dtype:
            return f"output {n} is {own.dtype} {own.shape}, the twin's {other.dtype} {other.shape}"
        if not own.size:
            continue
        gap = np.abs(own.astype(np.float64) - other.astype(np.float64))
        allowed = np.zeros_like(gap)
        if other.dtype.kind == "f":
            allowed += RELATIVE * np.maximum(1.0, np.abs(other).max(axis=-1, keepdims=True))
        wrong = int(np.count_nonzero(~(gap <= allowed)))
        if wrong:
            return f"output {n}: {wrong} of {gap.size} values differ, by up to {gap.max():g}"
    return ""
