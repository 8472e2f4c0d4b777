"""The fixed-step search of [F16], kept as it is for comparison (``--step N``).

It minimises the squared difference of -1 / 0 / 1 over the reference's box: whole shifts and turns
on a grid of N cells and N degrees around the start, then half the step around the best, down to
one cell and one degree. It knows nothing of walls and finds the answer only near the start.

Source: Fernandes and Alexandre, ICARSC 2016, the alignment step. Ours reads every (step / 2)-th
cell while the step is large, which the paper does not say.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken, check_cancelled
from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import invert, to_lattice
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.errors import ConfigError

F64 = npt.NDArray[np.float64]

REACH_SHARE = 0.25
BATCH = 4096
POSES_MAX = 20_000_000


def fixed_step_search(
    reference: GridFeatures,
    moving: GridFeatures,
    step: int,
    window: SearchWindow,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> F64:
    """Return the motion (3,) of least [F16] error: where the centre lands in cells, and yaw.

    Args:
        reference, moving: the two grids. step: first step, cells and degrees. window: the start,
        and how far to look; a quarter of the reference's longer side unless given. device:
        computes the errors. cancel: asked before each batch of poses.
    """
    reach = window.shift_cells
    if reach is None:
        reach = REACH_SHARE * max(reference.shape)
    best = np.array(window.start)
    turn = math.degrees(window.yaw_rad)
    while True:
        shifts = step * np.arange(-(reach // step), reach // step + 1)
        turns = np.radians(step * np.arange(-(turn // step), turn // step + 1))
        count = len(shifts) ** 2 * len(turns)
        if count > POSES_MAX:
            message = (
                f"a first step of {step} cells means {count:.3g} poses to try; choose a larger "
                "step, or a narrower window (window_m, window_yaw_rad)"
            )
            raise ConfigError(message)
        grid = np.stack(np.meshgrid(shifts, shifts, turns, indexing="ij"), axis=-1).reshape(-1, 3)
        best = _least_error(reference, moving, best + grid, max(1, step // 2), device, cancel)
        if step == 1:
            return best
        reach, turn = float(step), float(step)
        step = max(1, step // 2)


def _least_error(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    stride: int,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> F64:
    """Return the motion of least error; of equals the first."""
    errors = []
    for start in range(0, len(motions), BATCH):
        check_cancelled(cancel)
        poses = invert(to_lattice(motions[start : start + BATCH], moving.centre))
        errors.append(
            device.squared_error(reference.cells, moving.cells, fixed_poses(poses), stride)
        )
    return np.asarray(motions[int(np.argmin(np.concatenate(errors)))])
