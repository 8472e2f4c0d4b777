"""Free space for a disc, shortest paths, and a tour of a place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.compute.lattice import cells_at
from slamfusion.errors import SimulationError
from slamfusion.geometry import B8, F64, travelled
from slamfusion.grid import FREE, OccupancyGrid

Point = tuple[float, float]

# Lattice step of the path search.
STEP_M = 0.1
# Paths keep this much more than the radius from walls, as the driver's tolerance; more with a
# steering wheel.
MARGIN_M = {"differential": 0.08, "tracks": 0.08, "bicycle": 0.16}
# Within the radius plus this, a metre costs up to COST times as much.
COMFORT_M = 0.35
COST = 4.0
# Half the diagonal of a cell.
DIAGONAL = 0.7072
SMOOTHINGS = 60


class FreeSpace:
    """The free cells of a place for a disc; unknown cells and the outside are not free."""

    def __init__(
        self, grid: OccupancyGrid, radius_m: float, margin_m: float = MARGIN_M["differential"]
    ) -> None:
        self.grid = grid
        self.radius_m, self.margin_m = radius_m, margin_m
        free = np.pad(grid.cells == FREE, 1)
        distance = scipy.ndimage.distance_transform_edt(free)[1:-1, 1:-1] * grid.resolution
        # To the wall's nearest edge, from the worst point in the cell.
        self._clearance_m: F64 = np.asarray(distance - 2.0 * DIAGONAL * grid.resolution)
        self._to_grid = grid.origin.inverse()
        self._make_graph()

    def clearance_at(self, x: float, y: float) -> float:
        """Return ``clearance_m`` of one point, in a faster way."""
        frame, resolution = self._to_grid, self.grid.resolution
        cos, sin = math.cos(frame.yaw_rad), math.sin(frame.yaw_rad)
        row = math.floor((frame.y + sin * x + cos * y) / resolution)
        col = math.floor((frame.x + cos * x - sin * y) / resolution)
        height, width = self._clearance_m.shape
        if not (0 <= row < height and 0 <= col < width):
            return -1.0
        return float(self._clearance_m[row, col])

    def clearance_m(self, points: npt.ArrayLike) -> F64:
        """Return a lower bound of the distance (m) of points (..., 2) to the nearest wall.

        Negative off the grid.
        """
        rows, cols = self.grid.cell_indices(np.asarray(points, dtype=np.float64))
        return cells_at(self._clearance_m, rows, cols, -1)

    def _make_graph(self) -> None:
        """Connect the usable places of a coarse lattice with their eight neighbours."""
        stride = max(1, round(STEP_M / self.grid.resolution))
        half = stride // 2
        clearance = self._clearance_m[half::stride, half::stride]
        usable = clearance >= self.radius_m + self.margin_m
        numbers = np.full(usable.shape, -1, dtype=np.int32)  # csgraph takes no wider index
        numbers[usable] = np.arange(np.count_nonzero(usable))
        rows, cols = np.nonzero(usable)
        self._places: F64 = self.grid.cell_centres(rows * stride + half, cols * stride + half)

        narrow = np.clip((self.radius_m + COMFORT_M - clearance) / COMFORT_M, 0.0, 1.0)
        price = 1.0 + (COST - 1.0) * narrow**2
        starts, ends, costs = [], [], []
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = np.s_[: usable.shape[0] - down, max(-right, 0) : usable.shape[1] - max(right, 0)]
            there = np.s_[down:, max(right, 0) : usable.shape[1] + min(right, 0)]
            both = usable[here] & usable[there]
            starts.append(numbers[here][both])
            ends.append(numbers[there][both])
            length_m = np.hypot(down, right) * stride * self.grid.resolution
            costs.append(length_m * (price[here][both] + price[there][both]) / 2.0)
        count = len(self._places)
        edges = (np.concatenate(starts), np.concatenate(ends))
        self._graph = scipy.sparse.csr_array((np.concatenate(costs), edges), shape=(count, count))

    def place(self, point: Point, what: str) -> int:
        """Return the lattice place nearest to a point (m, map frame), named in errors."""
        if len(self._places) and float(self.clearance_m(point)) >= self.radius_m:
            away = np.hypot(*(self._places - point).T)
            nearest = int(away.argmin())
            if away[nearest] <= 3.0 * STEP_M:
                return nearest
        raise SimulationError(
            f"{self.grid.name}: {what} at ({point[0]:.2f}, {point[1]:.2f}) m is no place for a "
            f"disc of radius {self.radius_m:g} m; move it at least "
            f"{self.radius_m + self.margin_m:.2f} m away from walls and unknown cells"
        )

    def any_place(self, rng: np.random.Generator) -> Point:
        """Draw a place from the largest connected part."""
        _, parts = scipy.sparse.csgraph.connected_components(self._graph, directed=False)
        if not parts.size:
            raise SimulationError(
                f"{self.grid.name}: no free place for a disc of radius {self.radius_m:g} m; "
                "use a smaller robot or another map"
            )
        largest = np.flatnonzero(parts == np.bincount(parts).argmax())
        x, y = self._places[rng.choice(largest)]
        return float(x), float(y)

    def way(self, start: Point, end: Point, what: str = "waypoint") -> F64:
        """Return a smooth short path of (N, 2) points about 0.05 m apart; metres, map frame."""
        first, last = self.place(start, "the start"), self.place(end, what)
        costs, befores = scipy.sparse.csgraph.dijkstra(
            self._graph, directed=False, indices=[first], return_predecessors=True
        )
        cost, before = costs[0], befores[0]
        if not np.isfinite(cost[last]):
            raise SimulationError(
                f"{self.grid.name}: no way from ({start[0]:.2f}, {start[1]:.2f}) to {what} at "
                f"({end[0]:.2f}, {end[1]:.2f}) m for a disc of radius {self.radius_m:g} m; "
                "move it, or use a smaller robot"
            )
        chain = [last]
        while chain[-1] != first:
            chain.append(int(before[chain[-1]]))
        points = np.concatenate(([start], self._places[chain[::-1]][1:-1], [end]))
        return self._smooth(_respaced(points))

    def _smooth(self, points: F64) -> F64:
        """Straighten a path as far as the margin allows, with fixed ends."""
        least = np.minimum(self.clearance_m(points), self.radius_m + self.margin_m)
        points = points.copy()
        for _ in range(SMOOTHINGS):
            moved = points.copy()
            moved[1:-1] = (points[:-2] + points[2:]) / 2.0
            kept = self.clearance_m(moved) >= least
            points[kept] = moved[kept]
        return _respaced(points)

    def tour(self, start: Point, spacing_m: float, most: int) -> list[Point]:
        """Return stops near every reachable place, in a short order, the last of them the start.

        The stop farthest on foot from all others is added until none is farther than
        ``spacing_m``; then the round trip is shortened by 2-opt. Metres, map frame.
        """
        chosen = [self.place(start, "the start")]
        costs = []
        while True:
            costs.append(
                scipy.sparse.csgraph.dijkstra(self._graph, directed=False, indices=chosen[-1:])[0]
            )
            nearest = np.min(costs, axis=0)
            nearest[~np.isfinite(nearest)] = -1.0
            if len(chosen) > most or nearest.max() < spacing_m:
                break
            chosen.append(int(nearest.argmax()))
        order = _short_round_trip(np.stack(costs)[:, chosen])
        reachable = np.isfinite(costs[0])
        stops = [self._roomy(chosen[index], reachable) for index in order[1:]]
        return [*stops, (float(start[0]), float(start[1]))]

    def _roomy(self, place: int, reachable: B8) -> Point:
        """Return the roomiest place near one: robots turn better away from corners."""
        away = np.hypot(*(self._places - self._places[place]).T)
        near = np.flatnonzero((away <= 6.0 * STEP_M) & reachable)
        best = max(
            (n for n in near if self._sees(place, int(n))),
            key=lambda n: float(self.clearance_m(self._places[n])),
        )
        x, y = self._places[best]
        return float(x), float(y)

    def _sees(self, a: int, b: int) -> bool:
        """Whether the disc can move straight from one place to the other."""
        line = np.linspace(self._places[a], self._places[b], 9)
        return bool((self.clearance_m(line) >= self.radius_m).all())


def _respaced(points: F64) -> F64:
    """Return evenly spaced points along a line, its ends kept, half of ``STEP_M`` apart."""
    along = travelled(points)
    count = max(1, round(float(along[-1]) / (STEP_M / 2.0)))
    at = np.linspace(0.0, float(along[-1]), count + 1)
    return np.stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)], axis=1)


def _short_round_trip(costs: F64) -> Sequence[int]:
    """Order places into a short round trip from place 0: nearest neighbour, then 2-opt."""
    left = set(range(1, len(costs)))
    order = [0]
    while left:
        following = min(left, key=lambda n: (costs[order[-1], n], n))
        order.append(following)
        left.remove(following)
    better = True
    while better:
        better = False
        for i in range(1, len(order) - 1):
            for k in range(i + 1, len(order)):
                a, b, c = order[i - 1], order[i], order[k]
                d = order[(k + 1) % len(order)]
                if costs[a, c] + costs[b, d] < costs[a, b] + costs[c, d] - 1e-9:
                    order[i : k + 1] = reversed(order[i : k + 1])
                    better = True
    return order
