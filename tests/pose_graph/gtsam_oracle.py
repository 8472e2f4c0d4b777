"""GTSAM as an oracle and a rival, where it is installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from slamfusion.geometry import F64, wrap_angle
from slamfusion.pose_graph.graph import PoseGraph


def has_gtsam() -> bool:
    """Whether GTSAM is installed."""
    return find_spec("gtsam") is not None


class GtsamGraph:
    """A graph as GTSAM's factors, pose 0 held by a prior.

    With ``like_g2o`` the errors are g2o's, as custom factors with derivatives: slow. Without, they
    are those of GTSAM's own factors between poses.
    """

    def __init__(self, graph: PoseGraph, *, like_g2o: bool = False) -> None:
        import gtsam  # noqa: PLC0415

        self._gtsam: Any = gtsam
        self._count = len(graph)
        self._factors = gtsam.NonlinearFactorGraph()
        for (start, end), motion, information in zip(
            graph.edges.tolist(), graph.motions, graph.information, strict=True
        ):
            noise = gtsam.noiseModel.Gaussian.Information(information)
            if like_g2o:
                error = _g2o_error(start, end, motion)
                factor = gtsam.CustomFactor(noise, [start, end], error)
            else:
                factor = gtsam.BetweenFactorPose2(start, end, gtsam.Pose2(*motion), noise)
            self._factors.add(factor)
        tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
        self._factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*graph.poses[0]), tight))

    def chi2(self, poses: F64) -> float:
        """Return chi-square as GTSAM counts it."""
        return 2.0 * float(self._factors.error(self._values(poses)))

    def optimize(self, start: F64, solver: str = "MULTIFRONTAL_CHOLESKY") -> F64:
        """Return the poses that Levenberg and Marquardt find from a start, (N, 3).

        Args:
            start: (N, 3).
            solver: of the linear system; ``MULTIFRONTAL_QR`` takes worse conditions, and longer.
        """
        parameters = self._gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType(solver)
        parameters.setRelativeErrorTol(1e-6)
        parameters.setAbsoluteErrorTol(1e-9)
        values = self._values(start)
        found = self._gtsam.LevenbergMarquardtOptimizer(self._factors, values, parameters)
        best = found.optimize()
        poses = [best.atPose2(index) for index in range(self._count)]
        return np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses])

    def relative_covariance(self, poses: F64, first: int, second: int) -> F64:
        """Return the covariance of one pose in the frame of another, (3, 3), axes of the second."""
        values = self._values(poses)
        marginals = self._gtsam.Marginals(self._factors, values)
        keys = self._gtsam.KeyVector([first, second])
        # By blocks: whether the full matrix sorts by key differs between its releases.
        blocks = marginals.jointMarginalCovariance(keys)
        joint = np.block([[blocks.at(one, other) for other in keys] for one in keys])
        between = values.atPose2(first).between(values.atPose2(second))
        jacobian = np.hstack((-between.inverse().AdjointMap(), np.eye(3)))
        return np.asarray(jacobian @ joint @ jacobian.T)

    def _values(self, poses: F64) -> Any:
        values = self._gtsam.Values()
        for index, pose in enumerate(poses):
            values.insert(index, self._gtsam.Pose2(*pose))
        return values


def _g2o_error(start: int, end: int, motion: F64) -> Any:
    """Return g2o's error of an edge as GTSAM wants it: by poses in their own axes."""
    cos_z, sin_z = np.cos(motion[2]), np.sin(motion[2])
    turn = np.array([[cos_z, sin_z], [-sin_z, cos_z]])

    def error(_: Any, values: Any, jacobians: Any) -> F64:
        one, two = values.atPose2(start), values.atPose2(end)
        yaw = wrap_angle(two.theta() - one.theta())
        cos, sin = np.cos(one.theta()), np.sin(one.theta())
        x, y = two.x() - one.x(), two.y() - one.y()
        way = np.array([cos * x + sin * y, cos * y - sin * x])
        if jacobians is not None:
            of_one, of_two = np.zeros((3, 3)), np.zeros((3, 3))
            of_one[:2, :2] = -turn
            of_one[:2, 2] = turn @ [way[1], -way[0]]
            of_two[:2, :2] = turn @ [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            of_one[2, 2], of_two[2, 2] = -1.0, 1.0
            jacobians[0], jacobians[1] = of_one, of_two
        return np.append(turn @ (way - motion[:2]), wrap_angle(yaw - motion[2]))

    return error
