"""Claims about the tree of transforms of a recording, and how transforms are put together."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from slamfusion.io.transforms import TransformError, TransformTree

Row = tuple[float, ...]


def level(x: float, y: float, yaw_rad: float) -> Row:
    return (x, y, 0.0, 0.0, 0.0, math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0))


def tree_of(*edges: tuple[str, str, float, Row]) -> TransformTree:
    tree = TransformTree()
    for parent, child, stamp, row in edges:
        assert tree.add(parent, child, stamp, row)
    return tree


def test_frames_that_nothing_connects() -> None:
    tree = tree_of(("a", "b", 0.0, level(0, 0, 0)), ("c", "d", 0.0, level(0, 0, 0)))
    assert tree.is_connected("a", "b")
    assert not tree.is_connected("a", "d")
    assert not tree.is_connected("a", "none")
    with pytest.raises(TransformError, match=r"from 'd' to 'a'; known frames: a, b, c, d"):
        tree.sample("a", "d", 0.0)


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
    assert not TransformTree().add("a", "b", 0.0, row)


turns = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(first=turns, second=turns, share=st.floats(0.0, 1.0))
def test_rotations_between_two_are_scipys(
    first: list[float], second: list[float], share: float
) -> None:
    ends = Rotation.from_quat([first, second])
    if (ends[0].inv() * ends[1]).magnitude() > math.pi - 1e-3:
        return  # half a turn has no short way
    tree = tree_of(("a", "b", 1.0, (0, 0, 0, *first)), ("a", "b", 2.0, (4, 0, 0, *second)))
    (pose,) = tree.sample("a", "b", 1.0 + share)
    expected = Slerp([0.0, 1.0], ends)(share).as_matrix()
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-6)
    assert pose[:3, 3] == pytest.approx([4.0 * share, 0.0, 0.0])


places = st.lists(st.floats(-50, 50), min_size=3, max_size=3)
rows = st.builds(lambda place, turn: (*place, *turn), places, turns)


def matrix(row: Row) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(row[3:]).as_matrix(), row[:3]
    return pose


@given(st.lists(st.tuples(rows, st.booleans()), min_size=1, max_size=5))
def test_a_way_is_the_product_of_its_matrices(links: list[tuple[Row, bool]]) -> None:
    tree, live = TransformTree(), TransformTree(keep_s=10.0)
    expected = down = np.eye(4)
    for index, (row, is_forward) in enumerate(links):
        names = (f"f{index}", f"f{index + 1}")
        assert tree.add(*(names if is_forward else names[::-1]), 7.0, row)
        assert live.add(*names, 7.0, row)  # a live frame has one parent
        expected = expected @ (matrix(row) if is_forward else np.linalg.inv(matrix(row)))
        down = down @ matrix(row)
    last = f"f{len(links)}"
    found = tree.sample("f0", last, [7.0, 1e9])
    np.testing.assert_allclose(found, [expected, expected], atol=1e-9)
    np.testing.assert_allclose(tree.sample(last, "f0", 7.0)[0] @ expected, np.eye(4), atol=1e-9)
    if abs(down[2, 2]) < 0.6 or math.hypot(down[0, 0], down[1, 0]) < 1e-3:
        return  # tilted
    mount = live.mount("f0", last, 7.0)
    assert mount.is_flipped == (down[2, 2] < 0.0)
    pose = mount.pose
    assert (pose.x, pose.y) == pytest.approx(down[:2, 3], abs=1e-9)
    ahead = down[:2, 0] / np.linalg.norm(down[:2, 0])
    assert (math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)) == pytest.approx(ahead, abs=1e-9)


def test_a_recording_may_come_in_any_order_and_in_two_parents() -> None:
    tree = tree_of(
        ("odom", "base", 2.0, level(2.0, 0.0, 0.0)),
        ("map", "base", 1.0, level(7.0, 0.0, 0.0)),
        ("odom", "base", 1.0, level(1.0, 0.0, 0.0)),
        ("odom", "base", 1.0, level(50.0, 0.0, 0.0)),
    )
    found = tree.sample("odom", "base", [0.0, 1.0, 1.5, 2.0, 3.0])
    assert found[:, 0, 3].tolist() == [1.0, 1.0, 1.5, 2.0, 2.0]
    assert tree.sample("odom", "map", 1.0)[0, 0, 3] == -6.0
    assert tree.change_stamps_s("odom", "base").tolist() == [1.0, 2.0]


def test_static_transforms_hold_at_every_time() -> None:
    tree = TransformTree()
    tree.add("a", "b", 4.0, level(1.0, 0.0, 0.0), is_static=True)
    tree.add("a", "b", 5.0, level(2.0, 0.0, 0.0), is_static=True)
    assert tree.is_constant("a", "b")
    assert tree.change_stamps_s("a", "b").size == 0
    assert tree.sample("a", "b", [-1e9, 1e9])[:, 0, 3].tolist() == [2.0, 2.0]
