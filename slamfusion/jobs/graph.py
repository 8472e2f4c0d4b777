"""Pose graphs in files: the poses that fit their edges best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.io import AtomicFiles, write_tum
from slamfusion.jobs.inputs import as_path
from slamfusion.jobs.records import Settings
from slamfusion.json_values import FLAT
from slamfusion.pose_graph.g2o import GraphFile, read_g2o, write_g2o
from slamfusion.pose_graph.optimize import Optimized, optimize
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class OptimizedGraph:
    """A pose graph with the poses that fit its edges best; ``slamfusion graph optimize``."""

    graph: GraphFile = field(metadata=FLAT)
    found: Optimized = field(metadata=FLAT)
    file: Path
    """The pose graph."""
    nodes: int
    """Its vertices."""
    edges: int
    """Its edges."""
    closures: int
    """Of the edges, the ones that close a loop."""
    fixed: Sequence[int]
    """Ids of the vertices that were held."""
    doubted: Sequence[tuple[int, int]]
    """Ids of both ends of the outliers: closures taken to be false."""
    output: Path | None = None
    """The file that the graph was written to."""
    tum: Path | None = None
    """The file that the poses were written to."""
    settings: Settings = field(metadata=FLAT)

    def trajectory(self) -> Trajectory:
        """Return the new poses, with the vertex ids as times."""
        return Trajectory(self.graph.ids.astype(np.float64), self.found.poses)


def optimize_graph(path: str | Path, config: RunConfig | None = None) -> OptimizedGraph:
    """Find the poses that best fit the edges of a pose graph, a g2o or TORO file, plain or gzip.

    Raises:
        GraphError: the file is damaged, or its poses cannot be found from its edges.
    """
    config = config or RunConfig()
    file = read_g2o(Path(path))
    settings = config.graph_optimizer
    found = optimize(file.graph, fixed=file.fixed, robust=settings.robust, start=settings.start)
    outliers = file.ids[file.graph.edges[found.is_outlier]]
    return OptimizedGraph(
        graph=file,
        found=found,
        file=Path(path),
        nodes=len(file.graph),
        edges=len(file.graph.edges),
        closures=int(file.graph.is_closure.sum()),
        fixed=file.ids[list(file.fixed)].tolist(),
        doubted=[(int(start), int(end)) for start, end in outliers],
        settings=Settings(config),
    )


def save_optimized_graph(
    graph: OptimizedGraph, output: str | Path | None = None, *, tum: str | Path | None = None
) -> OptimizedGraph:
    """Write the requested files, all or none; return the graph with its files.

    Args:
        output: g2o file for the graph with its new poses and all edges.
        tum: file for the new poses, with the vertex ids as times.
    """
    file = graph.graph
    written = replace(graph, output=as_path(output), tum=as_path(tum))
    with AtomicFiles():
        if written.output is not None:
            moved = file.graph.with_poses(graph.found.poses)
            write_g2o(written.output, moved, file.ids, file.fixed)
        if written.tum is not None:
            write_tum(written.tum, graph.trajectory())
    return written
