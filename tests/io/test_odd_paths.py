"""Paths as other programs write them: other columns are read, other axes are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, TrajectoryError
from slamfusion.geometry import compose_poses, invert_poses
from slamfusion.io import read_trajectory
from tests.io.bags import LOCALIZED, ODOMETRY, POSE, TEXT, Bag, yaw_quaternion

STAMPS_S = 1.7e9 + np.arange(30.0)
YAWS = np.linspace(0.3, 2.9, 30)
POSES = np.column_stack((4.0 * np.sin(YAWS), -4.0 * np.cos(YAWS), YAWS))
# Axes of a camera that looks ahead: x right, y down, z ahead.
OPTICAL = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def rows(world: Rotation | None = None, body: Rotation | None = None) -> np.ndarray:
    """Rows ``t x y z qx qy qz qw`` of the path, in other axes of the world and of the robot."""
    places = np.column_stack((POSES[:, :2], np.full(len(POSES), 0.4)))
    turns = Rotation.from_euler("z", POSES[:, 2:])
    if body is not None:
        turns = turns * body
    if world is not None:
        places, turns = world.inv().apply(places), world.inv() * turns
    return np.column_stack((STAMPS_S, places, turns.as_quat()))


def written(folder: Path, table: np.ndarray, *heading: str, between: str = " ") -> Path:
    path = folder / "path.txt"
    lines = [between.join(f"{value:.9f}" for value in row) for row in table.tolist()]
    path.write_text("\n".join([*heading, *lines]) + "\n", encoding="utf-8")
    return path


def test_quaternions_written_w_first(tmp_path: Path) -> None:
    path = written(tmp_path, rows()[:, [0, 1, 2, 3, 7, 4, 5, 6]])
    with pytest.raises(TrajectoryError, match="use --quaternion wxyz"):
        read_trajectory(path)
    found = read_trajectory(path, LogConfig(quaternion="wxyz"))
    assert np.allclose(found.poses, POSES, atol=1e-6)


@pytest.mark.parametrize("world", [None, OPTICAL])
def test_the_axes_of_a_camera(tmp_path: Path, world: Rotation | None) -> None:
    path = written(tmp_path, rows(world, OPTICAL))
    with pytest.raises(TrajectoryError, match="use --axes camera"):
        read_trajectory(path)
    found = read_trajectory(path, LogConfig(axes="camera")).poses
    wanted, got = (compose_poses(invert_poses(item[:1]), item) for item in (POSES, found))
    assert np.allclose(got, wanted, atol=1e-6)


@pytest.mark.parametrize(
    "config", [LogConfig(quaternion="wxyz"), LogConfig(axes="camera")], ids=["wxyz", "camera"]
)
def test_options_leave_files_alone_that_need_none(tmp_path: Path, config: LogConfig) -> None:
    """A path in camera axes may be compared with a truth in those of a robot."""
    found = read_trajectory(written(tmp_path, rows()), config)
    assert np.allclose(found.poses, POSES, atol=1e-6)


def test_a_path_on_no_floor_is_refused(tmp_path: Path) -> None:
    table = rows()
    table[:, 3] = 8.0 * table[:, 1]
    with pytest.raises(TrajectoryError, match=r"z varies by .* m"):
        read_trajectory(written(tmp_path, table))
    table[:, 3] = 0.1 * table[:, 1]  # a ramp
    assert len(read_trajectory(written(tmp_path, table))) == len(table)


def test_a_yaw_in_degrees_is_refused(tmp_path: Path) -> None:
    table = np.column_stack((STAMPS_S[:2], POSES[:2, :2], (170.0, -175.0)))
    with pytest.raises(TrajectoryError, match=r"theta jumps by 345 between two poses.*degrees\?"):
        read_trajectory(written(tmp_path, table))


def test_a_path_of_positions_alone_is_named(tmp_path: Path) -> None:
    table, told = rows(), list[str]()
    table[:, 4:] = (0.0, 0.0, 0.0, 1.0)
    read_trajectory(written(tmp_path, table), warn=told.append)
    assert ["positions alone?" in sentence for sentence in told] == [True]
    table[:, 2] = 0.0  # straight ahead
    read_trajectory(written(tmp_path, table), warn=told.append)
    read_trajectory(written(tmp_path, rows()), warn=told.append)
    assert len(told) == 1


EUROC = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],"
    "q_RS_z [],v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]"
)


def test_rows_of_euroc(tmp_path: Path) -> None:
    table = np.column_stack((rows()[:, [0, 1, 2, 3, 7, 4, 5, 6]], np.ones((30, 3))))
    table[:, 0] *= 1e9
    found = read_trajectory(written(tmp_path, table, EUROC, between=","))
    assert np.allclose(found.poses, POSES, atol=1e-6)
    assert np.allclose(found.stamps_s, STAMPS_S)


@pytest.mark.parametrize(
    "heading", ["time,x,y,theta", "# stamp, x, y, yaw", "\ufefft,x,y,heading", "# a comment"]
)
@pytest.mark.parametrize("between", [",", ", ", ";"])
def test_headings_with_commas_and_marks(tmp_path: Path, heading: str, between: str) -> None:
    table = np.column_stack((STAMPS_S, POSES))
    path = written(tmp_path, table, heading, between=between)
    text = path.read_text(encoding="utf-8").replace("\n", ",\n")
    path.write_text(text.replace(",", between), encoding="utf-8")
    assert np.allclose(read_trajectory(path).poses, POSES)


def test_a_heading_may_name_columns_in_any_order(tmp_path: Path) -> None:
    table = np.column_stack((POSES[:, 2], np.zeros(30), POSES[:, 1], POSES[:, 0], STAMPS_S))
    found = read_trajectory(written(tmp_path, table, "yaw battery y x timestamp"))
    assert np.allclose(found.poses, POSES)


@pytest.mark.parametrize(
    ("heading", "units"),
    [
        ("time_ns,x_mm,y_cm,yaw_deg", (1e9, 1e3, 1e2, 180.0 / np.pi)),
        ("t [ms],x [m],y [mm],theta (deg)", (1e3, 1.0, 1e3, 180.0 / np.pi)),
    ],
)
def test_a_heading_has_the_units(tmp_path: Path, heading: str, units: tuple[float, ...]) -> None:
    table = np.column_stack((STAMPS_S - STAMPS_S[0], POSES)) * units
    found = read_trajectory(written(tmp_path, table, heading, between=","))
    assert np.allclose(found.poses, POSES, atol=1e-6)
    assert np.allclose(found.stamps_s, STAMPS_S - STAMPS_S[0])


def test_all_times_of_a_file_have_one_unit(tmp_path: Path) -> None:
    table = np.column_stack((np.linspace(50e9, 150e9, 30), POSES))
    found = read_trajectory(written(tmp_path, table))
    assert np.allclose(found.poses, POSES)
    assert found.stamps_s[-1] == pytest.approx(3.0 * found.stamps_s[0])


def test_poses_of_kitti_are_named(tmp_path: Path) -> None:
    path = written(tmp_path, np.tile(np.eye(3, 4).ravel(), (3, 1)))
    with pytest.raises(TrajectoryError, match="12 columns as in KITTI, without a time"):
        read_trajectory(path)


def test_nanoseconds_in_a_tum_file(tmp_path: Path) -> None:
    table = rows()
    table[:, 0] *= 1e9
    assert np.allclose(read_trajectory(written(tmp_path, table)).stamps_s, STAMPS_S)


def with_poses(bag: Bag, topic: str, kind: str) -> Bag:
    for stamp_s, pose in zip(STAMPS_S.tolist(), POSES.tolist(), strict=True):
        bag.add(stamp_s, topic, kind, pose=pose)
    return bag


def with_scans(bag: Bag) -> Bag:
    """Scans, and odometry that is not the path."""
    for stamp_s in STAMPS_S.tolist():
        bag.odometry(stamp_s, (0.1 * (stamp_s - STAMPS_S[0]), 0.0, 0.0)).scan(stamp_s)
    return bag


@pytest.mark.parametrize("kind", [POSE, LOCALIZED, ODOMETRY])
def test_the_only_pose_topic_of_a_bag_is_its_path(tmp_path: Path, kind: str) -> None:
    path = with_poses(Bag(), "/truth", kind).write(tmp_path)
    for place in (path, next(path.glob("*.mcap"))):
        found = read_trajectory(place)
        assert np.allclose(found.poses, POSES, atol=1e-6)
        assert np.allclose(found.stamps_s, STAMPS_S)


@pytest.mark.parametrize("kind", [POSE, LOCALIZED, ODOMETRY])
def test_a_pose_topic_beside_scans_is_chosen(tmp_path: Path, kind: str) -> None:
    path = with_poses(with_scans(Bag()), "/truth", kind).write(tmp_path)
    assert np.allclose(read_trajectory(path, pose_topic="/truth").poses, POSES, atol=1e-6)
    if kind == ODOMETRY:
        return
    said: list[str] = []
    odometry = read_trajectory(path, warn=said.append)
    assert odometry.poses[-1] == pytest.approx([2.9, 0.0, 0.0])
    assert len(said) == 1
    assert "--pose-topic: /truth" in said[0]


@pytest.mark.parametrize("topic", [None, "tf"])
def test_transforms_are_a_path(tmp_path: Path, topic: str | None) -> None:
    bag = Bag() if topic is None else with_scans(Bag())
    for stamp_s, (x, y, yaw) in zip(STAMPS_S.tolist(), POSES.tolist(), strict=True):
        bag.transform(stamp_s, "world", "odom", (1.0, 0.0, 0.0))
        bag.transform(stamp_s, "odom", "base_link", (x, y, 0.0), yaw_quaternion(yaw))
    found = read_trajectory(bag.write(tmp_path), pose_topic=topic)
    assert np.allclose(found.poses, POSES + np.array([1.0, 0.0, 0.0]), atol=1e-6)


def test_several_pose_topics_need_a_choice(tmp_path: Path) -> None:
    bag = with_poses(with_poses(Bag(), "/a", POSE), "/b", LOCALIZED)
    path = bag.write(tmp_path)
    with pytest.raises(LogError, match=r"several .* /a, /b; choose one with --pose-topic"):
        read_trajectory(path)
    with pytest.raises(LogError, match=r"'/c' in it; found /a, /b; change --pose-topic"):
        read_trajectory(path, pose_topic="/c")


def test_a_bag_without_any_path_says_so(tmp_path: Path) -> None:
    path = Bag().add(1.0, "/note", TEXT, data="hello").write(tmp_path)
    with pytest.raises(LogError, match="or a topic with --pose-topic"):
        read_trajectory(path)
