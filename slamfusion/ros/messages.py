"""Convert between ROS messages and values, without a running node.

A message that is no grid, scan or pose is refused with a ``SlamFusionError`` that gives the reason.
"""

from __future__ import annotations

import math
import struct
from array import array
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry, Path
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from slamfusion import grid as grids
from slamfusion import scan as scans
from slamfusion.errors import GridError, ScanError, TrajectoryError
from slamfusion.geometry import F64, Pose2, quaternion_yaw_rad, row_of
from slamfusion.io.transforms import Mount
from slamfusion.trajectory import Trajectory

try:
    from map_msgs import msg as map_msgs

    MapUpdate: Any = map_msgs.OccupancyGridUpdate
except ImportError:  # only a sourced ROS has it; without it only whole maps are exchanged
    MapUpdate = None

NS = 10**9
# Most poses of a published path.
PATH_POSES = 2000
# A quaternion whose axis leaves the vertical by more (sine of half the tilt) is no yaw rotation.
TILT_MAX = 0.02
# Rows of x, y and yaw in the covariance of a geometry_msgs/PoseWithCovariance.
PLANE = (0, 1, 5)
# A shorter or longer quaternion is invalid.
LENGTH_MIN, LENGTH_MAX = 1e-3, 1e3


def stamp_s(message: Any) -> float:
    """Return the seconds of a builtin_interfaces/Time or a header's, to the nearest double."""
    return stamp_ns(message) / NS


def stamp_ns(message: Any) -> int:
    """Return the nanoseconds of a builtin_interfaces/Time, or of a message with a header."""
    stamp = message.header.stamp if hasattr(message, "header") else message
    return int(stamp.sec) * NS + int(stamp.nanosec)


def ns_to_stamp(nanoseconds: int) -> Time:
    """Return nanoseconds as a builtin_interfaces/Time."""
    return Time(sec=nanoseconds // NS, nanosec=nanoseconds % NS)


def to_stamp(seconds: float) -> Time:
    """Return seconds as a builtin_interfaces/Time, to 1 ns; ValueError outside 32 bits."""
    return ns_to_stamp(to_ns(seconds))


def to_ns(seconds: float) -> int:
    """Return seconds in nanoseconds, to 1 ns; ValueError outside of a builtin_interfaces/Time."""
    whole = math.floor(seconds)
    nanoseconds = whole * NS + round((seconds - whole) * NS)
    if not -(2**31) <= nanoseconds // NS < 2**31:
        raise ValueError(f"{seconds} s is no ROS time; wanted less than 2^31 s")
    return nanoseconds


def pose2_from_message(pose: Any) -> Pose2:
    """Return the pose in the plane of a geometry_msgs/Pose or geometry_msgs/Transform.

    Height is dropped. A tilt above 2 degrees, an upside-down frame, a quaternion of length 0 and
    values that are not finite are refused.

    Raises:
        TrajectoryError: it is no pose in the plane.
    """
    place = pose.position if hasattr(pose, "position") else pose.translation
    turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    words = f"({turn.x:g}, {turn.y:g}, {turn.z:g}, {turn.w:g})"
    if not all(map(math.isfinite, (place.x, place.y, turn.x, turn.y, turn.z, turn.w))):
        message = f"pose ({place.x}, {place.y}) with quaternion {words} is not finite"
        raise TrajectoryError(message)
    length = math.hypot(turn.x, turn.y, turn.z, turn.w)
    if not LENGTH_MIN <= length <= LENGTH_MAX:
        raise TrajectoryError(f"quaternion {words} is no rotation; for none send w = 1")
    if math.hypot(turn.x, turn.y) > TILT_MAX * length:
        message = f"quaternion {words} tilts or turns over; wanted a turn about z alone"
        raise TrajectoryError(message)
    return Pose2(place.x, place.y, quaternion_yaw_rad(turn.x, turn.y, turn.z, turn.w))


def _fill(place: Any, turn: Any, pose: Pose2) -> None:
    place.x, place.y = float(pose.x), float(pose.y)
    turn.z, turn.w = math.sin(0.5 * pose.yaw_rad), math.cos(0.5 * pose.yaw_rad)


def _pose(pose: Pose2) -> Pose:
    message = Pose()
    _fill(message.position, message.orientation, pose)
    return message


def pose_to_message(pose: Pose2, frame_id: str, stamp: Time) -> PoseStamped:
    """Return a geometry_msgs/PoseStamped; metres, height 0."""
    return PoseStamped(header=Header(frame_id=frame_id, stamp=stamp), pose=_pose(pose))


def sure_pose_to_message(
    pose: Pose2, covariance: F64, frame_id: str, stamp: Time
) -> PoseWithCovarianceStamped:
    """Return a PoseWithCovarianceStamped; covariance (3, 3) of x, y, yaw in metres and radians."""
    message = PoseWithCovarianceStamped(header=Header(frame_id=frame_id, stamp=stamp))
    message.pose.pose = _pose(pose)
    whole = np.zeros((6, 6))
    whole[np.ix_(PLANE, PLANE)] = covariance
    message.pose.covariance = whole.ravel()
    return message


def odometry_to_message(pose: Pose2, frame_id: str, child: str, stamp: Time) -> Odometry:
    """Return a nav_msgs/Odometry without speeds and covariances (which stay 0)."""
    message = Odometry(header=Header(frame_id=frame_id, stamp=stamp), child_frame_id=child)
    message.pose.pose = _pose(pose)
    return message


def transform_to_message(pose: Pose2, parent: str, child: str, stamp: Time) -> TransformStamped:
    """Return the pose of ``child`` in ``parent`` as a geometry_msgs/TransformStamped."""
    message = TransformStamped(header=Header(frame_id=parent, stamp=stamp), child_frame_id=child)
    _fill(message.transform.translation, message.transform.rotation, pose)
    return message


def _row_of_path(frame_size: int) -> np.dtype[Any]:
    """Return how a pose of a serialized path lies in memory, from the second one on.

    ``frame_size`` is of its frame_id, with the zero behind it. XCDR1 of the DDS-XTypes standard:
    numbers lie at multiples of their size, counted from behind the four bytes of its header.
    """
    stamp = [("sec", "<i4"), ("nanosec", "<u4")]
    frame = [("size", "<u4"), ("frame", f"({frame_size},)u1")]
    return np.dtype([*stamp, *frame, ("pose", "(7,)<f8")], align=True)


def path_to_bytes(trajectory: Trajectory, frame_id: str, stamp: Time) -> bytes:
    """Return a serialized nav_msgs/Path with at most ``PATH_POSES``; see ``Trajectory.at_most``.

    As messages 5000 poses would take 50 ms to make, and 90 ms to read.
    """
    trajectory = trajectory.at_most(PATH_POSES)
    count, stamps_s = len(trajectory), trajectory.stamps_s.tolist()
    header = Header(frame_id=frame_id, stamp=stamp)
    first = [
        pose_to_message(trajectory.pose(n), frame_id, to_stamp(stamps_s[0]))
        for n in range(min(count, 1))
    ]
    start = bytearray(serialize_message(Path(header=header, poses=first)))
    frame = np.frombuffer(frame_id.encode() + b"\0", dtype=np.uint8)
    rows = np.zeros(max(count - 1, 0), dtype=_row_of_path(len(frame)))
    if len(rows):
        count_at = -(-(16 + len(frame)) // 4) * 4
        start[count_at : count_at + 4] = count.to_bytes(4, "little")
        stamps = [to_ns(stamp_s) for stamp_s in stamps_s[1:]]
        rows["sec"], rows["nanosec"] = np.divmod(np.array(stamps, dtype=np.int64), NS)
        rows["size"], rows["frame"] = len(frame), frame
        poses = trajectory.poses[1:]
        rows["pose"][:, :2] = poses[:, :2]
        halves = (0.5 * poses[:, 2]).tolist()
        rows["pose"][:, 5] = [*map(math.sin, halves)]
        rows["pose"][:, 6] = [*map(math.cos, halves)]
    return bytes(start) + rows.tobytes()


def path_from_bytes(data: bytes, name: str) -> Trajectory:
    """Return a serialized nav_msgs/Path in its frame; TrajectoryError if it is invalid."""
    rows = _rows_of_path(data)
    poses: list[Any]
    if rows is None:
        items = deserialize_message(data, Path).poses
        stamps_s = [stamp_s(item) for item in items]
        poses = [row_of(pose2_from_message(item.pose)) for item in items]
    else:
        stamps = rows["sec"].astype(np.int64) * NS + rows["nanosec"]
        stamps_s = [stamp / NS for stamp in stamps.tolist()]
        poses = [(x, y, quaternion_yaw_rad(*turn)) for x, y, _, *turn in rows["pose"].tolist()]
    return Trajectory(np.array(stamps_s), np.array(poses).reshape(-1, 3), name)


def _rows_of_path(data: bytes) -> npt.NDArray[Any] | None:
    """Return the poses of a path that lies as ``_row_of_path`` says; None of any other."""
    if data[:2] != b"\0\1":  # little-endian
        return None

    def number(at: int) -> int:
        return int.from_bytes(data[at : at + 4], "little")

    count_at = -(-(16 + number(12)) // 4) * 4
    count, first_at = number(count_at), count_at + 4
    size = number(first_at + 8)
    if not count or size > len(data):
        return None
    pose_at = 4 + -(-(first_at + 8 + size) // 8) * 8
    kind = _row_of_path(size)
    if len(data) != pose_at + 56 + (count - 1) * kind.itemsize:
        return None
    rows = np.empty(count, dtype=kind)
    rows[1:] = np.frombuffer(data, kind, count - 1, pose_at + 56)
    rows["sec"][0], rows["nanosec"][0], rows["size"][0] = struct.unpack_from("<iII", data, first_at)
    rows["pose"][0] = np.frombuffer(data, "<f8", 7, pose_at)
    poses = rows["pose"]
    length = np.sqrt((poses[:, 3:] ** 2).sum(axis=1))
    is_plain = (
        (rows["size"] == size)
        & np.isfinite(poses).all(axis=1)
        & (length >= LENGTH_MIN)
        & (length <= LENGTH_MAX)
        & (np.hypot(poses[:, 3], poses[:, 4]) <= TILT_MAX * length)
    )
    return rows if is_plain.all() else None


def grid_from_message(message: Any, name: str) -> grids.OccupancyGrid:
    """Return a nav_msgs/OccupancyGrid as a grid; its cells are copied once.

    Raises:
        GridError: a resolution that is not positive and finite, no cells, another number of cells
            than width x height, values outside of -1..100, an origin that is not finite, tilted
            or upside down.
    """
    info = message.info
    height, width = int(info.height), int(info.width)
    if len(message.data) != height * width:
        found = f"{len(message.data)} cells sent for a map of {width} x {height}"
        raise GridError(f"{name}: {found}")
    try:
        origin = pose2_from_message(info.origin)
    except TrajectoryError as error:
        raise GridError(f"{name}: the map's origin: {error}") from None
    cells = np.array(message.data, dtype=np.int8).reshape(height, width)
    cells.flags.writeable = False
    # The shortest decimal of the float32: 0.05 arrives as 0.05000000074505806, and must equal the
    # resolution of saved maps.
    return grids.OccupancyGrid(cells, float(str(np.float32(info.resolution))), origin, name)


def grid_to_message(grid: grids.OccupancyGrid, frame_id: str, stamp: Time) -> OccupancyGrid:
    """Return a nav_msgs/OccupancyGrid."""
    info = MapMetaData(map_load_time=stamp, resolution=float(grid.resolution))
    info.width, info.height, info.origin = grid.width, grid.height, _pose(grid.origin)
    data = array("b")
    data.frombytes(grid.cells.reshape(-1).view(np.uint8).data)
    header = Header(frame_id=frame_id, stamp=stamp)
    return OccupancyGrid(header=header, info=info, data=data)


def update_to_message(
    before: grids.OccupancyGrid, grid: grids.OccupancyGrid, header: Header
) -> Any:
    """Return the changed box as an OccupancyGridUpdate; None if unchanged or of another lattice."""
    lattices = [(one.origin, one.resolution, one.cells.shape) for one in (before, grid)]
    if lattices[0] != lattices[1]:
        return None
    is_changed = before.cells != grid.cells
    box = grids.known_box(np.where(is_changed, np.int8(0), np.int8(grids.UNKNOWN)))
    if box is None:
        return None
    data = array("b", grid.cells[box.slices()].tobytes())
    size = {"width": box.width, "height": box.height}
    return MapUpdate(header=header, x=box.col0, y=box.row0, **size, data=data)


def updated_map(message: OccupancyGrid | None, update: Any) -> OccupancyGrid:
    """Return a copy of a map with the cells of a map_msgs/OccupancyGridUpdate.

    Raises:
        GridError: there is no map, the update is empty, outside of the map or in another frame, or
            either has another number of cells than its size.
    """
    if message is None:
        raise GridError("it came before the first map")
    info, frame, own = message.info, update.header.frame_id, message.header.frame_id
    x, y, width, height = (int(n) for n in (update.x, update.y, update.width, update.height))
    box, problem = f"{width} x {height} cells at column {x} and row {y}", ""
    if frame.lstrip("/") not in {"", own.lstrip("/")}:
        problem = f"it is in {frame!r}, and the map in {own!r}"
    elif len(update.data) != width * height or not update.data:
        problem = f"{len(update.data)} cells sent for {box}"
    elif min(x, y) < 0 or x + width > info.width or y + height > info.height:
        problem = f"{box} lie outside of a map of {info.width} x {info.height}"
    elif len(message.data) != info.width * info.height:
        problem = f"the map has {len(message.data)} cells for {info.width} x {info.height}"
    if problem:
        raise GridError(problem)
    data = array("b", message.data)
    cells = np.frombuffer(data, dtype=np.int8).reshape(info.height, info.width)
    part = np.array(update.data, dtype=np.int8).reshape(height, width)
    cells[y : y + height, x : x + width] = part
    header = Header(frame_id=own, stamp=update.header.stamp)
    return OccupancyGrid(header=header, info=info, data=data)


def scan_from_message(message: Any, mount: Mount) -> scans.LaserScan:
    """Return a sensor_msgs/LaserScan as a scan; readings are unchanged (REP-117).

    Raises:
        ScanError: no beam, or invalid angles or limits.
    """
    try:
        ranges = np.array(message.ranges, dtype=np.float32)
        return mount.scan(message, stamp_s(message), ranges)
    except ScanError as error:
        text = f"scan at {stamp_s(message):.3f} s in {message.header.frame_id!r}: {error}"
        raise ScanError(text) from None


def scan_to_message(scan: scans.LaserScan, frame_id: str) -> LaserScan:
    """Return a sensor_msgs/LaserScan; angles and limits become float32, the mount is dropped."""
    message = LaserScan(header=Header(frame_id=frame_id, stamp=to_stamp(scan.stamp_s)))
    message.angle_min = float(scan.angle_min_rad)
    message.angle_increment = float(scan.angle_increment_rad)
    message.angle_max = float(scan.angle_min_rad + scan.angle_increment_rad * (len(scan) - 1))
    message.time_increment = float(scan.time_increment_s)
    message.range_min = float(scan.range_min_m)
    message.range_max = float(min(scan.range_max_m, float(np.finfo(np.float32).max)))
    message.ranges = array("f", scan.ranges.tobytes())
    return message
