"""Pose graphs in files: the poses that fit their edges best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.io import AtomicFiles, write_tum
from slamfusion.jobs.documents import path_text, settings_used
from slamfusion.jobs.inputs import as_path
from slamfusion.jobs.records import SettingsJson
from slamfusion.pose_graph import GraphFile, Optimized, optimize, read_g2o, write_g2o
from slamfusion.trajectory import Trajectory


class GraphOptimizeDocument(SettingsJson):
    """``slamfusion graph optimize``."""

    file: str
    """The pose graph."""
    nodes: int
    """Its vertices."""
    edges: int
    """Its edges."""
    closures: int
    """Of the edges, the ones that close a loop."""
    fixed: Sequence[int]
    """Ids of the vertices that were held."""
    has_poses: bool
    """Whether the file gave the vertices poses; else they were laid along the odometry."""
    skipped_lines: Mapping[str, int]
    """Lines that were not understood, by kind."""
    chi2_start: float
    """Chi-square before, of all edges."""
    chi2: float
    """Chi-square after, of the edges that are no outliers."""
    chi2_all: float
    """Chi-square after, of all edges."""
    iterations: int
    """Steps of the solver."""
    converged: bool
    """Whether the last step changed next to nothing."""
    doubted: Sequence[tuple[int, int]]
    """Ids of both ends of the outliers: closures taken to be false."""
    time_s: float
    """Wall time of the optimisation, seconds."""
    output: str | None
    """The file that the graph was written to."""
    tum: str | None
    """The file that the poses were written to."""


@dataclass(frozen=True, eq=False)
class OptimizedGraph:
    """A pose graph of a file with the poses that fit its edges best.

    Attributes:
        found: the new poses, and what was found on the way.
    """

    path: Path
    config: RunConfig
    file: GraphFile
    found: Optimized

    def outliers(self) -> list[tuple[int, int]]:
        """Return the ids of from and to of the outliers: closures taken to be false."""
        ends = self.file.ids[self.file.graph.edges[self.found.is_outlier]]
        return [(int(start), int(end)) for start, end in ends]

    def trajectory(self) -> Trajectory:
        """Return the new poses, with the vertex ids as times."""
        return Trajectory(self.file.ids.astype(np.float64), self.found.poses)


def optimize_graph(path: str | Path, config: RunConfig | None = None) -> OptimizedGraph:
    """Find the poses that fit the edges of a pose graph best.

    Args:
        path: g2o's or TORO's text, plain or gzip.

    Raises:
        GraphError: the file is damaged, or its poses cannot be found from its edges.
        OSError: the file cannot be opened.
    """
    config = config or RunConfig()
    file = read_g2o(Path(path))
    settings = config.graph_optimizer
    found = optimize(
        file.graph,
        fixed=file.fixed,
        robust=settings.robust,
        start=settings.start,
        max_iterations=settings.max_iterations,
        tolerance=settings.tolerance,
    )
    return OptimizedGraph(Path(path), config, file, found)


def save_optimized_graph(
    graph: OptimizedGraph,
    output: str | Path | None = None,
    *,
    tum: str | Path | None = None,
    files: AtomicFiles | None = None,
) -> GraphOptimizeDocument:
    """Write what is asked for, all of it or nothing.

    Args:
        output: g2o file for the graph with its new poses; all edges stay. None: none.
        tum: file for the new poses, with the vertex ids as times. None: none.

    Returns:
        What ``slamfusion graph optimize`` prints as JSON; it names the files.

    Raises:
        MapFileError: a file cannot be written.
    """
    file, found = graph.file, graph.found
    out_path, tum_path = as_path(output), as_path(tum)
    with AtomicFiles() if files is None else nullcontext(files) as together:
        if out_path is not None:
            moved = file.graph.with_poses(found.poses)
            write_g2o(out_path, moved, file.ids, file.fixed, files=together)
        if tum_path is not None:
            write_tum(tum_path, graph.trajectory(), files=together)
    return {
        "file": str(graph.path),
        "nodes": len(file.graph),
        "edges": len(file.graph.edges),
        "closures": int(file.graph.is_closure.sum()),
        "fixed": [int(file.ids[index]) for index in file.fixed],
        "has_poses": file.has_poses,
        "skipped_lines": file.skipped,
        "chi2_start": found.chi2_start,
        "chi2": found.chi2,
        "chi2_all": found.chi2_all,
        "iterations": found.iterations,
        "converged": found.is_converged,
        "doubted": graph.outliers(),
        "time_s": found.time_s,
        "output": path_text(out_path),
        "tum": path_text(tum_path),
        **settings_used(graph.config),
    }
