"""From transforms of map frames, metres, to motions of grids, cells, and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import to_lattice
from slamfusion.geometry import Pose2, wrap_angle

F64 = npt.NDArray[np.float64]


def motion_of(reference: GridFeatures, moving: GridFeatures, transform: Pose2) -> F64:
    """Return a map-frame transform as (x, y where the moving centre lands, yaw) in cells."""
    ref, mov = reference.grid.grid, moving.grid.grid
    lattice = ref.origin.inverse().compose(transform).compose(mov.origin)
    centre = np.array(moving.centre) * mov.resolution
    landed = lattice.transform(centre) / ref.resolution
    return np.array([landed[0], landed[1], lattice.yaw_rad])


def transform_of(reference: GridFeatures, moving: GridFeatures, motion: F64) -> Pose2:
    """Return a motion as the transform of map frames, metres."""
    ref, mov = reference.grid.grid, moving.grid.grid
    x, y, yaw = to_lattice(motion[None], moving.centre)[0]
    lattice = Pose2(float(x) * ref.resolution, float(y) * ref.resolution, wrap_angle(float(yaw)))
    return ref.origin.compose(lattice).compose(mov.origin.inverse())
