"""Claims about the tree of transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from slamfusion.io.transforms import TransformTree, rotation_matrices

Row = tuple[float, ...]


def level(x: float, y: float, yaw_rad: float) -> Row:
    return (x, y, 0.0, 0.0, 0.0, math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0))


def tree_of(*edges: tuple[str, str, float, Row]) -> TransformTree:
    tree = TransformTree()
    for parent, child, stamp, row in edges:
        assert tree.add(parent, child, stamp, np.array(row))
    return tree


def test_a_way_leads_down_and_up_again() -> None:
    tree = tree_of(
        ("base", "arm", 0.0, level(1.0, 0.0, math.pi / 2.0)),
        ("base", "laser", 0.0, level(3.0, 1.0, 0.0)),
    )
    rotation, translation = tree.sample("arm", "laser", 0.0)
    # Seen from the arm, whose x axis is the base's y axis.
    assert translation[0] == pytest.approx([1.0, -2.0, 0.0])
    assert rotation[0] == pytest.approx(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), abs=1e-12)


def test_frames_that_nothing_connects() -> None:
    tree = tree_of(("a", "b", 0.0, level(0, 0, 0)), ("c", "d", 0.0, level(0, 0, 0)))
    assert tree.is_connected("a", "b")
    assert not tree.is_connected("a", "d")
    assert not tree.is_connected("a", "none")
    with pytest.raises(KeyError):
        tree.sample("a", "d", 0.0)


def test_a_circle_of_frames_ends() -> None:
    tree = tree_of(*((a, b, 0.0, level(1, 0, 0)) for a, b in ("ab", "bc", "ca")))
    assert not tree.is_connected("a", "z")


@pytest.mark.parametrize(
    "row",
    [
        (0,) * 7,
        (1e300, 0, 0, 0, 0, 0, 1),
        (math.nan, 0, 0, 0, 0, 0, 1),
        (0, 0, 0, 0, 0, 0, math.inf),
    ],
)
def test_what_is_no_transform_is_refused(row: Row) -> None:
    assert not TransformTree().add("a", "b", 0.0, np.array(row))


turns = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(first=turns, second=turns, share=st.floats(0.0, 1.0))
def test_rotations_between_two_are_scipys(
    first: list[float], second: list[float], share: float
) -> None:
    ends = Rotation.from_quat([first, second])
    if (ends[0].inv() * ends[1]).magnitude() > math.pi - 1e-3:
        return  # half a turn has no short way
    tree = tree_of(("a", "b", 1.0, (0, 0, 0, *first)), ("a", "b", 2.0, (4, 0, 0, *second)))
    rotation, translation = tree.sample("a", "b", 1.0 + share)
    expected = Slerp([0.0, 1.0], ends)(share).as_matrix()
    np.testing.assert_allclose(rotation[0], expected, atol=1e-6)
    assert translation[0] == pytest.approx([4.0 * share, 0.0, 0.0])


@given(turn=turns)
def test_matrices_are_scipys(turn: list[float]) -> None:
    unit = np.array([turn]) / np.linalg.norm(turn)
    np.testing.assert_allclose(
        rotation_matrices(unit), Rotation.from_quat(unit).as_matrix(), atol=1e-12
    )


def test_a_long_rest_takes_little_memory_and_changes_nothing() -> None:
    tree = TransformTree()
    for k in range(10_000):
        tree.add("a", "b", k * 1e-3, np.array(level(min(k, 9000) / 9000.0 // 1.0, 0.0, 0.0)))
    stamps = tree.change_stamps_s("a", "b")
    assert len(stamps) < 300
    assert (stamps[0], stamps[-1]) == (0.0, 9.999)
    wanted = np.array([0.0, 4.5, 8.999, 9.0, 9.5, 9.999])
    assert tree.sample("a", "b", wanted)[1][:, 0].tolist() == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


def test_static_transforms_hold_at_every_time() -> None:
    tree = TransformTree()
    tree.add("a", "b", 5.0, np.array(level(2.0, 0.0, 0.0)), is_static=True)
    assert tree.is_constant("a", "b")
    assert tree.change_stamps_s("a", "b").size == 0
    assert tree.sample("a", "b", [-1e9, 1e9])[1][:, 0].tolist() == [2.0, 2.0]
