"""Claims about the tree of transforms, recorded or live, and how transforms are put together."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from slamfusion.geometry import Pose2
from slamfusion.io.transforms import KEEP_S, TransformError, TransformTree

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
    tree = tree_of(("a", "c", 0.0, level(0, 0, 0)))
    for child in ("c", *map(str, range(100)), "b"):
        assert not tree.add("a", child, 1.0, row)
    with pytest.raises(TransformError, match=r"not finite or no rotation: .*'a' -> 'b'") as refused:
        tree.mount("a", "b", 0.0)
    assert len(str(refused.value)) < 300
    with pytest.raises(TransformError, match=r"1\.000 s too old; later ones are left out, not fin"):
        tree.mount("a", "c", 1.0)


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


# --- live -----------------------------------------------------------------------------------------


def sent(parent: str, child: str, pose: Pose2, time_s: float = 0.0) -> tuple[str, str, float, Row]:
    return parent, child, time_s, level(pose.x, pose.y, pose.yaw_rad)


def near(one: Pose2, other: Pose2) -> bool:
    turn = math.remainder(one.yaw_rad - other.yaw_rad, 2.0 * math.pi)
    return math.hypot(one.x - other.x, one.y - other.y) < 1e-6 and abs(turn) < 1e-7


def test_between_two_stamps_a_pose_is_interpolated_the_short_way() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(1.0, 0.0, 3.0), 10.0))
    tree.add(*sent("odom", "base", Pose2(2.0, 4.0, -3.0), 10.4))
    found = tree.mount("odom", "base", 10.1).pose
    step = (2.0 * math.pi - 6.0) / 4.0
    assert near(found, Pose2(1.25, 1.0, 3.0 + step))
    assert near(tree.mount("odom", "base", 10.4).pose, Pose2(2.0, 4.0, -3.0))


def test_a_time_outside_of_what_is_known_is_refused_and_says_whether_to_wait() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(), 10.0))
    with pytest.raises(TransformError, match=r"from 'base' to 'odom' is 0\.500 s too old") as late:
        tree.mount("odom", "base", 10.5)
    assert late.value.may_come
    with pytest.raises(TransformError, match=r"is 1\.000 s too new") as early:
        tree.mount("odom", "base", 9.0)
    assert not early.value.may_come
    assert near(tree.mount("odom", "base", 10.04).pose, Pose2())


def test_a_gap_between_two_stamps_is_refused() -> None:
    tree = TransformTree(KEEP_S)
    for time_s in (10.0, 12.0):
        tree.add(*sent("odom", "base", Pose2(), time_s), arrived_s=time_s)
    with pytest.raises(TransformError, match=r"no transform from 'base' to 'odom' within 0\.5 s"):
        tree.mount("odom", "base", 11.0)


def test_time_that_jumps_back_begins_again_when_three_say_so() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(1.0, 0.0, 0.0), 100.0))
    assert not tree.add(*sent("odom", "base", Pose2(2.0, 0.0, 0.0), 99.5))
    for index in range(3):
        assert tree.mount("odom", "base", 100.0).pose.x == pytest.approx(1.0)
        assert tree.heard_s("odom", "base") == pytest.approx(4.9 + 0.1 * index if index else 99.5)
        assert tree.add(*sent("odom", "base", Pose2(3.0 + index, 0.0, 0.0), 5.0 + 0.1 * index))
    assert near(tree.mount("odom", "base", 5.0).pose, Pose2(3.0, 0.0, 0.0))
    assert near(tree.mount("odom", "base", 5.2).pose, Pose2(5.0, 0.0, 0.0))
    with pytest.raises(TransformError):
        tree.mount("odom", "base", 100.0)
    assert tree.strays == 0


@pytest.mark.parametrize("offset_s", [-1.8, -95.0, 3600.0])
def test_one_stray_stamp_takes_no_transform_away(offset_s: float) -> None:
    tree = TransformTree(KEEP_S)
    for index in range(20):
        time_s = 100.0 + 0.1 * index
        tree.add(*sent("odom", "base", Pose2(float(index), 0.0, 0.0), time_s))
        if index == 10:
            assert tree.add(*sent("odom", "base", Pose2(500.0, 0.0, 0.0), time_s + offset_s))
    for index in range(20):
        assert tree.mount("odom", "base", 100.0 + 0.1 * index).pose.x == pytest.approx(float(index))
    assert tree.strays == 1


def test_what_is_held_back_is_let_in_when_time_is_known_to_be_there() -> None:
    tree = TransformTree(KEEP_S)
    for time_s in (100.0, 100.1, 5.0):
        tree.add(*sent("odom", "base", Pose2(time_s, 0.0, 0.0), time_s))
    tree.settle(99.0)
    assert tree.mount("odom", "base", 100.0).pose.x == pytest.approx(100.0)
    tree.settle(5.1)
    assert tree.mount("odom", "base", 5.0).pose.x == pytest.approx(5.0)
    assert tree.heard_s("base", "odom") == 5.0
    assert tree.heard_s("map", "odom") is None


def test_an_upside_down_frame_is_told_and_a_tilted_one_refused() -> None:
    tree = TransformTree(KEEP_S)
    half_a_turn_about_x = (0.3, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0)
    tree.add("base", "laser", 0.0, half_a_turn_about_x, is_static=True)
    mount = tree.mount("base", "laser", 0.0)
    assert mount.is_flipped
    assert near(mount.pose, Pose2(0.3, 0.1, 0.0))
    for half_rad, tilt in ((0.5, 57), (0.6, None)):
        row = (0.3, 0.1, 0.0, math.sin(half_rad), 0.0, 0.0, math.cos(half_rad))
        tree.add("base", "laser", 0.0, row, is_static=True)
        if tilt is not None:
            found = tree.mount("base", "laser", 0.0)
            assert round(math.degrees(found.tilt_rad)) == tilt
            assert not found.is_flipped
    with pytest.raises(TransformError, match="tilted by 69 degrees"):
        tree.mount("base", "laser", 0.0)


def test_a_frame_has_the_parent_that_was_sent_last() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(1.0, 0.0, 0.0)), is_static=True)
    assert tree.is_connected("odom", "base")
    tree.add(*sent("map", "base", Pose2(2.0, 0.0, 0.0)), is_static=True)
    assert tree.mount("map", "base", 0.0).pose.x == pytest.approx(2.0)
    assert not tree.is_connected("odom", "base")
    assert tree.frames == {"map", "base"}
