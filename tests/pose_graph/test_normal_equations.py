"""Claims about the normal equations: they are those of the errors, whatever the order."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import F64, Pose2, wrap_angle
from slamfusion.pose_graph.least_squares import Measurements, NormalEquations


def random_graph(seed: int, count: int = 12) -> tuple[Measurements, F64]:
    """Edges any way round, some twice, between poses that do not fit them."""
    rng = np.random.default_rng(seed)
    chain = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    extra = rng.integers(0, count, (2 * count, 2))
    edges = np.concatenate((chain, extra[extra[:, 0] != extra[:, 1]]))
    edges = np.where(rng.uniform(size=(len(edges), 1)) < 0.5, edges, edges[:, ::-1])
    edges = np.concatenate((edges, edges[:3]))
    roots = rng.normal(size=(len(edges), 3, 3))
    information = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3)
    motions = rng.normal(size=(len(edges), 3)) * 2.0
    poses = rng.normal(size=(count, 3)) * 3.0
    return Measurements(edges, motions, information), poses


def dense_jacobian(measured: Measurements, poses: F64) -> F64:
    """Derivatives of all errors by all poses, (3 M, 3 N), by differences."""
    columns = []
    for index in range(poses.size):
        moved = [poses.copy(), poses.copy()]
        for sign, other in zip((1.0, -1.0), moved, strict=True):
            other.ravel()[index] += sign * 1e-6
        difference = measured.errors(moved[0]) - measured.errors(moved[1])
        columns.append(np.asarray(difference / 2e-6).T.ravel())
    return np.stack(columns, axis=1)


def test_errors_are_those_of_g2o() -> None:
    measured, poses = random_graph(3)
    errors = measured.errors(poses)
    for index, (start, end) in enumerate(measured.edges):
        one, two = Pose2(*poses[start]), Pose2(*poses[end])
        error = Pose2(*measured.motions[index]).inverse().compose(one.inverse().compose(two))
        expected = (error.x, error.y, wrap_angle(error.yaw_rad))
        assert errors[:, index] == pytest.approx(expected, abs=1e-12)
        squared = np.array(expected) @ measured.information[index] @ np.array(expected)
        assert measured.squared_errors(poses)[index] == pytest.approx(squared)


@pytest.mark.parametrize("fixed", [(0,), (5,), (2, 7, 11)])
@pytest.mark.parametrize("weighted", [False, True])
def test_matrix_and_gradient_are_those_of_finite_differences(
    fixed: tuple[int, ...], weighted: bool
) -> None:
    measured, poses = random_graph(1)
    weights = np.random.default_rng(2).uniform(0.1, 1.0, len(measured)) if weighted else None
    equations = NormalEquations(measured, len(poses), fixed)
    equations.linearise(poses, weights)
    jacobian = dense_jacobian(measured, poses)
    factors = np.ones(len(measured)) if weights is None else weights
    blocks = measured.information * factors[:, None, None]
    weighed = np.einsum("mij,mjn->min", blocks, jacobian.reshape(len(measured), 3, -1))
    columns = (3 * equations.free[:, None] + np.arange(3)).ravel()
    hessian = (jacobian.T @ weighed.reshape(jacobian.shape))[np.ix_(columns, columns)]
    gradient = (weighed.reshape(jacobian.shape).T @ measured.errors(poses).T.ravel())[columns]
    assert equations.matrix().toarray() == pytest.approx(hessian, rel=1e-6, abs=1e-6)
    assert equations.gradient == pytest.approx(gradient, rel=1e-6, abs=1e-6)
