"""Where to start from when the given poses are far off: rotations first, then everything at once.

Sources: Carlone, Tron, Daniilidis and Dellaert, Initialization Techniques for 3D SLAM, ICRA 2015
(the chordal relaxation); Carlone, Aragues, Castellanos and Bona, A Linear Approximation for
Graph-Based Simultaneous Localization and Mapping, RSS 2011 (the second step).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.pose_graph.normal_equations import NormalEquations, factorise


def rotations_first(
    equations: NormalEquations,
    poses: npt.NDArray[np.float64],
    weights: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.float64]:
    """Return a start that needs no guess: two linear problems, both solved exactly.

    First the yaws alone, as free complex numbers u with ``u_j = exp(i z) u_i`` of each edge.
    Then poses and yaws together, where the way along each edge is taken as measured.

    Args:
        equations: the graph.
        poses: (N, 3); only the fixed ones count.
        weights: (M,) by which the information is multiplied; default: 1.

    Returns:
        (N, 3) float64, not wrapped.

    Raises:
        RuntimeError: the free poses do not all hang together with a fixed one.
    """
    turned = np.array(poses, np.float64)
    turned[equations.free, 2] = _yaws(equations, turned[:, 2], weights)
    equations.linearise(turned, weights, by_measured_ways=True)
    step, _ = equations.step()
    return turned + step


def _yaws(
    equations: NormalEquations,
    yaws: npt.NDArray[np.float64],
    weights: npt.NDArray[np.float64] | None,
) -> npt.NDArray[np.float64]:
    """Return the yaws of the free poses from those of the fixed ones, (F,)."""
    measured = equations.measurements
    start, end = measured.start, measured.end
    weight = _yaw_information(measured.upper)
    if weights is not None:
        weight = weight * weights
    turn = np.exp(1j * measured.motion[2])
    count, free = len(yaws), equations.free
    rows = np.concatenate((start, end, end, start))
    columns = np.concatenate((start, end, start, end))
    values = np.concatenate((weight, weight, -weight * turn, -weight * turn.conj()))
    matrix = scipy.sparse.csc_matrix((values, (rows, columns)), shape=(count, count))
    fixed = list(equations.fixed)
    pull = -(matrix[:, fixed] @ np.exp(1j * yaws[fixed]))[free]
    return np.asarray(np.angle(factorise(matrix[:, free][free]).solve(pull)), np.float64)


def _yaw_information(information: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return what edges know of yaw when nothing is known of x and y, (M,), from (6, M)."""
    xx, xy, x_yaw, yy, y_yaw, yaw = information
    known = (yy * x_yaw * x_yaw - 2.0 * xy * x_yaw * y_yaw + xx * y_yaw * y_yaw) / (
        xx * yy - xy * xy
    )
    return np.asarray(np.maximum(yaw - known, 1e-9 * yaw))
