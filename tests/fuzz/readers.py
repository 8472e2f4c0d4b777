"""Every reader with a good file of each format that it takes."""

from __future__ import annotations

import gzip
import io
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import NumpyDevice
from slamfusion.config import GmappingConfig, GraphConfig
from slamfusion.evaluation.distances import load_distances
from slamfusion.evaluation.measured import error_series, result_rows
from slamfusion.evaluation.relations import read_relations
from slamfusion.fusion.live.state import LiveState
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import load_map, open_log, read_trajectory
from slamfusion.io.images import encode_image
from slamfusion.io.scan_odometry import read_scan_odometry
from slamfusion.jobs.results import read_results, write_results_file
from slamfusion.pose_graph.g2o import read_g2o
from slamfusion.sim.courses import load_course
from slamfusion.slam.gmapping.slam import Gmapping
from slamfusion.slam.graph.slam import GraphSlam
from slamfusion.slam.registry import load_config
from slamfusion.vote.lattice import Lattice
from tests.slam.drives import drive


@dataclass(frozen=True)
class Seed:
    """A good file and what reads it.

    Attributes:
        reader: what it is called in the counts.
        name: of the file, whose suffix readers look at.
        data: its bytes.
        read: raises what is expected, or returns.
        beside: another file that it names, and its bytes.
        is_text: whether lines and numbers are worth changing.
    """

    reader: str
    name: str
    data: bytes
    read: Callable[[Path], object]
    beside: tuple[str, bytes] | None = None
    is_text: bool = True

    @property
    def title(self) -> str:
        """Reader and format."""
        return f"{self.reader} {self.name}"


MAP = b"""image: map.pgm
resolution: 0.05
origin: [-1.0, 2.5, 0.1]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
mode: trinary
"""
CONFIG = b"""seed: 3
fusion: {align: {shared_frame: true}, vote: {mode: majority}}
start: {map_a: [1.0, 2.0, 0.1], map_b: "0,0,0"}
producers:
  graph: {resolution: 0.05, matcher: {beams: 90}}
  tinyslam: {usable_range_m: 8.0}
run: {producers: [graph, tinyslam], time_limit_s: 100}
device: {device: numpy}
"""
COURSE = b"""name: small
seed: 4
world: {name: office, seed: 1, resolution: 0.05}
lidar: {model: hokuyo}
drive: differential
start: [1.0, 1.0, 0.0]
waypoints: [[1, 1], [3, 1.5]]
people:
  - {waypoints: [[2, 2], [3, 3]]}
obstacles: false
"""
DISTANCES = b"""distances:
  - {name: hall, x1: 0.5, y1: 1.0, x2: 4.5, y2: 1.0, distance_m: 4.0}
  - {x1: 0.5, y1: 1.0, x2: 0.5, y2: 3.0, distance_m: 2.0}
"""
TABLE = b"name,x1,y1,x2,y2,distance_m\nhall,0.5,1.0,4.5,1.0,4.0\n,0.5,1,0.5,3,2\n"
TUM = b"# t x y z qx qy qz qw\n" + b"".join(
    b"%d.5 %d 0.5 0 0 0 0.1 0.995\n" % (row, row) for row in range(6)
)
PLANAR = b"".join(b"%d.5 %d 0.5 0.1\n" % (row, row) for row in range(6))
RELATIONS = b"1.0 2.0 0.5 0.1 0 0 0 0.2\n2.0 9.0 -0.5 0.1 0 0 0 -0.2\n"
SCAN_ODOMETRY = b"index,odom_x,odom_y,odom_theta\n0,0,0,0\n1,0.5,0,0.1\n2,1,0,0.2\n"
G2O = b"""VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0.1
VERTEX_SE2 2 2 0 0.2
FIX 0
EDGE_SE2 0 1 1 0 0.1 500 0 0 500 0 1000
EDGE_SE2 1 2 1 0 0.1 500 0 0 500 0 1000
EDGE_SE2 0 2 2 0 0.2 500 0 0 500 0 1000
"""
TORO = b"""VERTEX2 0 0 0 0
VERTEX2 1 1 0 0.1
EDGE2 0 1 1 0 0.1 500 0 500 1000 0 0
"""


def carmen() -> bytes:
    """Return a log of five scans, with what else such logs have."""
    ranges = " ".join(f"{1.0 + 0.1 * beam:.2f}" for beam in range(12))
    lines = ["PARAM robot_front_laser_max 81.91 ipc 0.1", "ODOM 0 0 0 0 0 0 1.0 host 1.0"]
    for scan in range(5):
        pose = f"{0.1 * scan} 0.0 0.01"
        lines.append(f"FLASER 12 {ranges} {pose} {pose} {1 + 0.2 * scan} host {1 + 0.2 * scan}")
        lines.append(
            f"ROBOTLASER1 0 -1.57 3.14 0.2855 81.9 0.01 0 12 {ranges} 0 {pose} {pose} 0 0 0.3 0.3 "
            f"100000 {1 + 0.2 * scan} host {1 + 0.2 * scan}"
        )
    return ("\n".join(lines) + "\n").encode()


def recording() -> bytes:
    """Return three lines as tinySLAM records them."""
    rows = []
    for scan in range(3):
        row = [str(1000 * scan), "0", str(10 * scan), str(12 * scan), *["0"] * 20]
        rows.append(" ".join([*row, *["1500"] * 682, "0"]))
    return ("\n".join(rows) + "\n").encode()


def picture() -> bytes:
    """Return a PGM of 24 x 20 cells."""
    cells = np.full((20, 24), 254, dtype=np.uint8)
    cells[0], cells[:, 0], cells[5, 3:9] = 0, 0, 205
    return b"P5\n# by hand\n24 20\n255\n" + cells.tobytes()


def encoded(kind: str) -> bytes:
    """Return the same as another kind of picture."""
    cells = np.frombuffer(picture()[-480:], dtype=np.uint8).reshape(20, 24)
    return bytes(encode_image(cells.copy(), kind))


def plain_picture() -> bytes:
    """Return the same in digits."""
    return b"P2\n24 20\n255\n" + b" ".join(b"%d" % value for value in picture()[-480:])


def as_pixels(path: Path) -> object:
    """Read a picture as a map of its own."""
    return load_map(path, resolution=0.05)


def as_odometry(path: Path) -> list[Pose2]:
    """Read odometry for a log of three lines."""
    return read_scan_odometry(path, path, [(0.0, 0.0, 0.0)] * 3)


def as_scans(path: Path) -> object:
    """Read every scan of a log."""
    return sum(1 for _ in open_log(path))


def as_live_state(path: Path) -> object:
    """Read the state of a fusion."""
    return LiveState.from_bytes(path.read_bytes())


def live_state() -> bytes:
    """Return the state of a fusion of two inputs."""
    grid = OccupancyGrid(np.zeros((6, 5), dtype=np.int8), 0.05)
    places = {"a": Pose2(1.0, 2.0, 0.1), "b": Pose2()}
    pairs = {frozenset(("a", "b")): 0.7}
    state = LiveState(Lattice(0.05, Pose2()), grid, grid, places, "a", pairs, 3.0)
    return state.to_bytes()


def results(folder: Path) -> bytes:
    """Return saved results of one path."""
    series = {"ate_m": error_series(np.full(4, 0.1), np.arange(4.0))}
    rows = result_rows("flat", "", "graph", {"ate_rmse_m": 0.1}, series)
    path = folder / "results.zip"
    write_results_file(path, command="trajectory", arguments=(), document={}, rows=rows)
    return path.read_bytes()


def part_of_results(whole: bytes, name: str) -> Seed:
    """Return one file in saved results, which is read in the place of the good one."""
    with zipfile.ZipFile(io.BytesIO(whole)) as packed:
        entries = {entry: packed.read(entry) for entry in packed.namelist()}

    def read(path: Path) -> object:
        other = path.with_name("repacked.zip")
        with zipfile.ZipFile(other, "w") as packed:
            for entry, data in {**entries, name: path.read_bytes()}.items():
                packed.writestr(entry, data)
        return read_results(other)

    return Seed("results", Path(name).name, entries[name], read)


def states(folder: Path) -> dict[str, tuple[bytes, Callable[[Path], object]]]:
    """Return a state of each mapper that has one, and what reads it."""
    scans, _ = drive(4)
    made: dict[str, tuple[bytes, Callable[[Path], object]]] = {}
    kinds = (
        ("graph", GraphSlam, GraphConfig()),
        ("gmapping", Gmapping, GmappingConfig(particles=1)),
    )
    for name, kind, config in kinds:
        mapper = kind(config, NumpyDevice(), 0)
        for scan in scans:
            mapper.feed(scan.scan, scan.odometry)
        mapper.save_state(folder / name)

        def read(path: Path, kind: type = kind, config: object = config) -> object:
            return kind.load_state(path, config, NumpyDevice(), 0)

        made[name] = ((folder / name).read_bytes(), read)
    return made


def bags(folder: Path) -> dict[str, bytes]:
    """Return a bag of each kind that is one file; empty without the library that writes them."""
    try:
        from tests.io.bags import Bag  # noqa: PLC0415
    except BaseException as skipped:
        if type(skipped).__name__ != "Skipped":
            raise
        return {}
    bag = Bag()
    for scan in range(4):
        bag.scan(1.0 + 0.2 * scan).odometry(1.0 + 0.2 * scan, (0.1 * scan, 0.0, 0.0))
    found = {}
    for kind in ("ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "mcap"):
        (folder / kind).mkdir()
        path = bag.write(folder / kind, kind)
        if path.is_dir():
            (path,) = (item for item in path.iterdir() if item.suffix in {".db3", ".mcap"})
        found[f"{kind}{path.suffix}"] = path.read_bytes()
    return found


def seeds(folder: Path) -> list[Seed]:
    """Return a good file of every format.

    Args:
        folder: where some are made.
    """
    pgm = ("map.pgm", picture())
    found = [
        Seed("map", "map.yaml", MAP, load_map, beside=pgm),
        Seed("settings", "config.yaml", CONFIG, load_config),
        Seed("course", "course.yaml", COURSE, load_course),
        Seed("distances", "distances.yaml", DISTANCES, load_distances),
        Seed("distances", "distances.csv", TABLE, load_distances),
        Seed("log", "carmen.log", carmen(), as_scans),
        Seed("log", "tiny.dat", recording(), as_scans),
        Seed("trajectory", "path.tum", TUM, read_trajectory),
        Seed("trajectory", "path.txt", PLANAR, read_trajectory),
        Seed("trajectory", "drive.log", carmen(), read_trajectory),
        Seed("relations", "pairs.relations", RELATIONS, read_relations),
        Seed("scan odometry", "odometry.csv", SCAN_ODOMETRY, as_odometry),
        Seed("graph", "a.g2o", G2O, read_g2o),
        Seed("graph", "a.graph", TORO, read_g2o),
        Seed("picture", "p5.pgm", picture(), as_pixels, is_text=False),
        Seed("picture", "p2.pgm", plain_picture(), as_pixels),
        Seed("picture", "a.png", encoded("png"), as_pixels, is_text=False),
        Seed("picture", "a.bmp", encoded("bmp"), as_pixels, is_text=False),
        Seed("live state", "fusion.state", live_state(), as_live_state, is_text=False),
    ]
    saved = results(folder)
    found.append(Seed("results", "a.zip", saved, read_results, is_text=False))
    found += [part_of_results(saved, name) for name in ("manifest.json", "results.csv")]
    for name, (data, read) in states(folder).items():
        found.append(Seed("state", f"{name}.state", data, read, is_text=False))
    for name, data in bags(folder).items():
        found.append(Seed("bag", name, data, as_scans, is_text=False))
    packed = [item for item in found if item.name in {"carmen.log", "path.tum", "a.g2o", "p5.pgm"}]
    for item in packed:
        data = gzip.compress(item.data, mtime=0)
        found.append(replace(item, name=f"{item.name}.gz", data=data, is_text=False))
    return found


def repacked_png(data: bytes) -> bytes:
    """Return a PNG whose chunks have the checksums of what they hold now, so that it is decoded."""
    out, at = io.BytesIO(), 8
    out.write(data[:8])
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        body = data[at + 4 : at + 8 + length]
        out.write(data[at : at + 4] + body + zlib.crc32(body).to_bytes(4, "big"))
        at += 12 + length
    return out.getvalue()
