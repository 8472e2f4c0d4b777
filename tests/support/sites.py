"""Sites that many robots map in part: a floor of many wings, and square maps that overlap.

    site = many_maps(20, seed=1)
    result = fuse_grids(site.grids, config, device)
    site.errors_m(result.reference, {record.name: record.alignment.transform for ...})

Every fifth map of a site of five or more is of another building: two of each, that share ground,
and one alone where their number is odd.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from slamfusion.evaluation.distances import sample_on_lattice
from slamfusion.geometry import F64, Pose2, fit_motion
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid
from slamfusion.sim import draw_building
from tests.support.degrade import Degradation, degrade_map

RESOLUTION = 0.05
# Wings of a floor, one beside the other, metres: each a corridor with rooms on both sides.
WING_M = (11.0, 16.0)
# Of a map's side from one map to the next along x or y: so much that neighbours share 20 to 60 %.
STRIDE = (0.45, 0.72)
STRANGER_SHARE = 0.2
FAULTS = Degradation(bend_cells=1.5, flip_share=0.01, speckle_share=0.02)


@dataclass(frozen=True, eq=False)
class ManyMaps:
    """Maps of one or several buildings.

    Attributes:
        grids: the maps.
        buildings: of each map, by number.
        poses: of each map's frame in its building's, metres.
        neighbours: pairs of maps (lower index first) and the share of ground that they have in
            common.
    """

    grids: tuple[OccupancyGrid, ...]
    buildings: tuple[int, ...]
    poses: tuple[Pose2, ...]
    neighbours: dict[tuple[int, int], float]

    def errors_m(self, reference: str, transforms: Mapping[str, Pose2]) -> dict[str, float]:
        """Return how far the middle of each map is from its place, metres; inf in another building.

        Of three maps or more the places are laid on the true ones as well as they fit: a site of
        many maps turns by a little about the map whose frame it has.

        Args:
            reference: the map in whose frame the transforms are.
            transforms: of map frames into the reference's, by the maps' names.
        """
        number = {grid.name: index for index, grid in enumerate(self.grids)}
        still = number[reference]
        errors, names, found, wanted = {}, [], [], []
        for name, transform in transforms.items():
            index = number[name]
            if self.buildings[index] != self.buildings[still]:
                errors[name] = math.inf
                continue
            grid = self.grids[index]
            half = np.array([grid.width, grid.height]) / 2.0 * grid.resolution
            middle = grid.origin.transform(half)
            names.append(name)
            found.append(transform.transform(middle))
            wanted.append(self.poses[still].inverse().compose(self.poses[index]).transform(middle))
        places, true = np.array(found), np.array(wanted)
        if len(names) > 2:
            places = fit_motion(_poses(places), _poses(true)).transform(places)
        return errors | dict(zip(names, np.hypot(*(places - true).T).tolist(), strict=True))


def _poses(places: F64) -> F64:
    """Return poses (N, 3) at places (N, 2); they all head the same way."""
    return np.column_stack((places, np.zeros(len(places))))


def draw_site(rng: np.random.Generator, width_m: float, height_m: float) -> OccupancyGrid:
    """Draw a floor of wings, one above the other, as one map; its frame begins in a corner."""
    shape = (round(height_m / RESOLUTION), round(width_m / RESOLUTION))
    cells = np.full(shape, UNKNOWN, dtype=np.int8)
    row = 0
    while row < shape[0]:
        high_m = rng.uniform(*WING_M)
        wing = draw_building(rng, width_m, high_m, RESOLUTION).cells
        part = wing[: shape[0] - row, : shape[1]]
        cells[row : row + part.shape[0], : part.shape[1]] = part
        row += part.shape[0] - 2
        if part.shape[0] < wing.shape[0]:
            break
    return OccupancyGrid(cells, RESOLUTION, Pose2(), "site")


@cache
def many_maps(count: int, seed: int, cells: int = 700) -> ManyMaps:
    """Draw maps of a site, and some of other buildings.

    Args:
        count: maps in all.
        seed: of everything.
        cells: on each side of a map.
    """
    rng = np.random.default_rng((seed, count, cells))
    strangers = int(STRANGER_SHARE * count)
    sizes = [count - strangers, *[2] * (strangers // 2), *[1] * (strangers % 2)]
    drawn = [item for n, size in enumerate(sizes) for item in maps_of(n, size, cells, rng)]
    order = rng.permutation(len(drawn))
    drawn = [drawn[index] for index in order]
    grids = tuple(grid.with_name(f"map {n}") for n, (grid, _, _) in enumerate(drawn))
    neighbours = {
        (a, b): share
        for a in range(count)
        for b in range(a + 1, count)
        if drawn[a][2] == drawn[b][2]
        and (share := _common(grids[a], drawn[a][1], grids[b], drawn[b][1])) > 0.0
    }
    return ManyMaps(
        grids, tuple(item[2] for item in drawn), tuple(item[1] for item in drawn), neighbours
    )


def maps_of(
    number: int, count: int, cells: int, rng: np.random.Generator
) -> list[tuple[OccupancyGrid, Pose2, int]]:
    """Draw a building and maps of it: the map, the pose of its frame, the building's number."""
    side_m = cells * RESOLUTION
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    # Corners of turned maps reach beyond their sides.
    edge_m = 0.75 * side_m
    stride = rng.uniform(*STRIDE, size=(2, max(rows, columns))) * side_m
    at_x, at_y = (edge_m + np.concatenate(([0.0], np.cumsum(part)[:-1])) for part in stride)
    site = draw_site(rng, float(at_x[columns - 1]) + edge_m, float(at_y[rows - 1]) + edge_m)
    made = []
    for index in range(count):
        centre = (float(at_x[index % columns]), float(at_y[index // columns]))
        yaw_rad = rng.uniform(-math.pi, math.pi)
        window = _window(site, centre, yaw_rad, cells)
        grid, pose = degrade_map(window, rng, replace(FAULTS, origin_yaw_rad=yaw_rad))
        # A frame of its own: the first place of the robot, anywhere in it.
        start = Pose2(*(float(value) for value in rng.uniform(-3.0, 3.0, 3)))
        origin = start.compose(grid.origin)
        moved = OccupancyGrid(grid.cells, grid.resolution, origin)
        made.append((moved, pose.compose(start.inverse()), number))
    return made


def _window(
    site: OccupancyGrid, centre: tuple[float, float], yaw_rad: float, cells: int
) -> OccupancyGrid:
    """Return a square of a site, turned about its centre, on a lattice of its own."""
    half = cells * RESOLUTION / 2.0
    corner = Pose2(*centre, yaw_rad).compose(Pose2(-half, -half))
    lattice = OccupancyGrid(np.zeros((1, 1), dtype=np.int8), RESOLUTION, corner)
    box = CellBox(0, 0, cells, cells)
    return replace(lattice, cells=sample_on_lattice(site, lattice, box, Pose2()))


def _common(a: OccupancyGrid, pose_a: Pose2, b: OccupancyGrid, pose_b: Pose2) -> float:
    """Return the share of one map's box that lies on the other's box."""
    points = np.stack(np.meshgrid(np.arange(0.5, 20.0), np.arange(0.5, 20.0)), axis=-1) / 20.0
    own = points.reshape(-1, 2) * np.array([a.width, a.height]) * a.resolution
    into = b.origin.inverse().compose(pose_b.inverse()).compose(pose_a).compose(a.origin)
    there = into.transform(own) / b.resolution / np.array([b.width, b.height])
    return float(((there >= 0.0) & (there < 1.0)).all(axis=1).mean())
