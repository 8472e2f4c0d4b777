"""Make data/sample: a drawn building, three faulty maps of it, and their true transforms.

Run as ``python -m data.make_sample [FOLDER]`` here; the same files come out every time.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import save_map
from slamfusion.sim import draw_building
from tests.support.degrade import Degradation, degrade_map

SEED = 1
SAMPLE = Path(__file__).resolve().parent / "sample"

# Three SLAMs with three kinds of faults, so that no two fail in the same place: thick walls and a
# wide margin; speckled and cut short; thin and slightly bent, on an origin with yaw.
FAULTS = {
    "map_a": Degradation(
        yaw_rad=0.35,
        shift_share=(0.12, -0.08),
        wall_change_cells=1,
        flip_share=0.02,
        margin_share=0.3,
    ),
    "map_b": Degradation(
        yaw_rad=-2.2,
        shift_share=(-0.3, 0.25),
        crop_share=0.96,
        flip_share=0.02,
        speckle_share=0.05,
        margin_share=0.05,
    ),
    "map_c": Degradation(
        yaw_rad=1.4,
        shift_share=(0.4, 0.1),
        origin_yaw_rad=0.6,
        bend_cells=1.0,
        flip_share=0.02,
        wall_change_cells=-1,
    ),
}


def make_maps() -> tuple[OccupancyGrid, dict[str, tuple[OccupancyGrid, Pose2]]]:
    """Return the truth and each faulty map with its pose in the truth's frame."""
    truth = draw_building(np.random.default_rng(SEED), 12.0, 8.5)
    faulty = {}
    for number, (name, faults) in enumerate(FAULTS.items()):
        grid, pose = degrade_map(truth, np.random.default_rng([SEED, number]), faults)
        origin = Pose2(*(round(value, 6) for value in _values(grid.origin)))
        grid = OccupancyGrid(grid.cells, grid.resolution, origin, name)
        faulty[name] = (grid, pose)
    return truth.with_name("truth"), faulty


def _values(pose: Pose2) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.yaw_rad


def main(folder: Path = SAMPLE) -> None:
    """Write the maps and transforms.yaml into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    truth, faulty = make_maps()
    save_map(truth, folder / "truth", mode="trinary")
    transforms = {}
    for name, (grid, pose) in faulty.items():
        save_map(grid, folder / name, mode="trinary")
        x, y, yaw = (round(value, 6) for value in _values(pose))
        transforms[name] = {"dx_m": x, "dy_m": y, "yaw_rad": yaw}
    text = "# Maps a point of each map's frame into the frame of truth.yaml; metres, radians.\n"
    text += yaml.safe_dump(transforms, sort_keys=True)
    (folder / "transforms.yaml").write_text(text, encoding="utf-8")
    print(f"wrote {len(faulty) + 1} maps and transforms.yaml to {folder}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
